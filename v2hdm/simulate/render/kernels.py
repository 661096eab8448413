"""Kernels that pass over a whole picture: ground, sky, light, motion and sensor.

Each does in one pass what took numpy many.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from v2hdm.compiled import exact_kernel, exactly_inlined
from v2hdm.simulate.render.pixels import (
    HALF,
    ONE,
    ZERO,
    Plane,
    between,
    clip,
    fade,
    read,
    read_back,
    sampled,
    write,
)
from v2hdm.simulate.render.scene import cubic_step

_f = np.float32
_i = np.int32


@exact_kernel
def meet_plane(
    rays: Any, by_pixel: Any, centre: Any, least: Any, per_focal: Any, out: Any, below: NDArray[np.bool_]
) -> int:
    """Write x and y, depth and footprint (H, W) where rays meet level ground; returns the first row with any.

    ``by_pixel`` are three factors of x and y per depth, and of inverse depth, for pinhole pixels; ``centre``
    is the camera's. Pixels whose inverse depth is ``least`` or less are not ``below`` (H, W). Of rows before
    the first one nothing else is written.
    """
    u, v = rays
    x_m, y_m, depth_m, footprint_m = out
    first = -1
    for row in range(below.shape[0]):
        meets = False
        for column in range(below.shape[1]):
            inverse = _along(by_pixel[2], read(u, row, column), read(v, row, column))
            write(below, row, column, inverse > least)
            meets |= inverse > least
        if first < 0 and meets:
            first = row
        if first < 0:
            continue
        for column in range(below.shape[1]):
            u_px = read(u, row, column)
            v_px = read(v, row, column)
            depth = ONE / max(_along(by_pixel[2], u_px, v_px), least)
            write(x_m, row, column, _along(by_pixel[0], u_px, v_px) * depth + centre[0])
            write(y_m, row, column, _along(by_pixel[1], u_px, v_px) * depth + centre[1])
            write(depth_m, row, column, depth)
            write(footprint_m, row, column, depth * depth * per_focal)
    return first


@exactly_inlined
def _along(factors: Any, u_px: Any, v_px: Any) -> Any:
    return u_px * factors[0] + v_px * factors[1] + factors[2]


@exact_kernel
def ground_tone(tiles: Any, scales: Plane, amplitudes: Plane, coarse: Plane, ground: Any, out: Plane) -> None:
    """Write the relative reflectance (H', W) by grain, stains and ``coarse`` stains (H', W)."""
    fine, medium = tiles
    x_m, y_m, footprint_m = ground
    # Read once, here: LLVM would not know that they stay the same.
    fine_per_m = scales[0, 0]
    fine_x = scales[0, 1]
    fine_y = scales[0, 2]
    fine_per_wave = scales[0, 3]
    medium_per_m = scales[1, 0]
    medium_x = scales[1, 1]
    medium_y = scales[1, 2]
    medium_per_wave = scales[1, 3]
    grain = amplitudes[0]
    stains = amplitudes[1]
    large = amplitudes[2]
    for row_number in range(out.shape[0]):
        for column_number in range(out.shape[1]):
            row = _i(row_number)
            column = _i(column_number)
            x = read(x_m, row, column)
            y = read(y_m, row, column)
            footprint = read(footprint_m, row, column)
            noise = sampled(fine, x, y, fine_per_m, fine_x, fine_y)
            tone = noise * (fade(footprint, fine_per_wave) * grain)
            noise = sampled(medium, x, y, medium_per_m, medium_x, medium_y)
            tone += noise * (fade(footprint, medium_per_wave) * stains)
            tone += read(coarse, row, column) * large
            write(out, row, column, clip(tone + ONE, _f(0.25), _f(2.5)))


@exact_kernel
def spread(tone: Plane, colour: Any, out: Plane) -> None:
    """Write a tone (H', W) times a colour (3,) into ``out`` (H', 3 W)."""
    for row in range(tone.shape[0]):
        for column in range(tone.shape[1]):
            value = read(tone, row, column)
            write(out, row, 3 * column, value * colour[0])
            write(out, row, 3 * column + 1, value * colour[1])
            write(out, row, 3 * column + 2, value * colour[2])


@exact_kernel
def draw_sky(
    azimuth: Plane, elevation: Plane, clouds: Plane, scale: Plane, sky: Plane, skyline: Plane,
    per_turn: Any, height_rad: Any, per_focal: Any, out: Plane,
) -> None:  # fmt: skip
    """Write sky and skyline (R, W, 3) by each pixel's direction (R, W), rad.

    ``sky`` (3, 3) is the colour at the horizon, by how much the zenith differs, and the walls'; ``skyline``
    (2, blocks) has heights and tones of blocks, ``per_turn`` of them a rad.
    """
    blocks = skyline.shape[1]
    for row in range(azimuth.shape[0]):
        for column in range(azimuth.shape[1]):
            turn = azimuth[row, column]
            up = elevation[row, column]
            cloud = sampled(clouds, turn, up * _f(2.0), scale[0], scale[1], scale[2])
            bright = ONE + _f(0.05) * cloud
            share = _f(np.sqrt(clip(up * _f(2.2), ZERO, ONE)))
            block = int(np.floor((turn + _f(np.pi)) * per_turn)) % blocks
            above = skyline[0, block] * height_rad - up
            covered = clip(above / per_focal + HALF, ZERO, ONE)
            for c in range(3):
                lit = (sky[0, c] + sky[1, c] * share) * bright
                out[row, column, c] = lit + covered * (sky[2, c] * skyline[1, block] - lit)


@exact_kernel
def light_ground(
    albedo: Plane, sun: Plane, wet: Plane, wet_levels: Any, ground: Any, centre: Any, light: Any
) -> None:
    """Turn ``albedo`` (H', 3 W) into radiance; ``light`` (3 x 3) is of the sun, the sky and the horizon.

    Lambert's law; water darkens and mirrors the sky by its angle (after Schlick 1994). Ground is
    wet by a cubic step of the depth ``wet``, which has no size where all is dry; ``wet_levels`` are the depth
    at which the step begins and the inverse of its width.
    """
    x_m, y_m = ground
    low, per_range = wet_levels
    squared_height = centre[2] * centre[2]
    is_wet = wet.shape[0] > 0
    for row in range(albedo.shape[0]):
        for column in range(sun.shape[1]):
            share = clip((read(wet, row, column) - low) * per_range, ZERO, ONE) if is_wet else ZERO
            film = cubic_step(share)
            x = read(x_m, row, column) - centre[0]
            y = read(y_m, row, column) - centre[1]
            sine = centre[2] / _f(np.sqrt(x * x + y * y + squared_height))
            grazing = ONE - max(sine, _f(0.12))
            squared = grazing * grazing
            mirror = film * (_f(0.02) + _f(0.45) * squared * squared * grazing)
            clear = ONE - _f(0.45) * film
            direct = read(sun, row, column)
            for c in range(3):
                place = 3 * column + c
                lit = read_back(albedo, row, place) * (direct * light[0][c] + light[1][c])
                write(albedo, row, place, lit * clear + mirror * light[2][c])


@exactly_inlined
def _at_border(place: int, last: int) -> int:
    return min(max(place, 0), last)


@exactly_inlined
def _between_pixels(image: Any, places: Any, x: Any, y: Any) -> Any:
    """Blue, green and red at a place of an image between four pixels of it."""
    share_x = x - _f(np.floor(x))
    share_y = y - _f(np.floor(y))
    top, bottom, left, right = places
    blue = between(image, places, share_x, share_y)
    green = between(image, (top, bottom, left + 1, right + 1), share_x, share_y)
    return blue, green, between(image, (top, bottom, left + 2, right + 2), share_x, share_y)


@exactly_inlined
def _mean_of_three(
    image: Any, flow: Any, share: Any, row: Any, column: Any, back: Any, ahead: Any, out: Any
) -> None:
    """Write a pixel of :func:`blur_along`, between the four pixels ``back`` and the four ``ahead`` of it."""
    along_x = read(flow, row, 2 * column) * share
    along_y = read(flow, row, 2 * column + 1) * share
    x = _f(column)
    y = _f(row)
    blue, green, red = _between_pixels(image, back, x - along_x, y - along_y)
    blue_ahead, green_ahead, red_ahead = _between_pixels(image, ahead, x + along_x, y + along_y)
    first = 3 * column
    third = _f(1.0 / 3.0)
    write(out, row, first, (read(image, row, first) + blue + blue_ahead) * third)
    write(out, row, first + 1, (read(image, row, first + 1) + green + green_ahead) * third)
    write(out, row, first + 2, (read(image, row, first + 2) + red + red_ahead) * third)


@exactly_inlined
def _places(rows: Any, column: Any, last: Any) -> Any:
    """The rows and first numbers of the four pixels around a place of an image."""
    return rows[0], rows[1], 3 * _at_border(column, last), 3 * _at_border(column + 1, last)


@exact_kernel
def blur_along(image: Plane, flow: Plane, share: Any, moved: NDArray[np.int32], out: Plane) -> None:
    """Write the mean (H, 3 W) of an image and of it moved by a share of the flow (H, 2 W) px either way.

    Pixels that move to neighbouring ones are done together. ``moved`` (4, W) is written to: to which columns
    from its own, and to which rows, a row's pixels move back and ahead.
    """
    width = image.shape[1] // 3
    last = width - 1
    last_row = image.shape[0] - 1
    for row in range(image.shape[0]):
        for column in range(width):
            along_x = read(flow, row, 2 * column) * share
            along_y = read(flow, row, 2 * column + 1) * share
            write(moved, 0, column, int(np.floor(_f(column) - along_x)) - column)
            write(moved, 1, column, int(np.floor(_f(column) + along_x)) - column)
            write(moved, 2, column, int(np.floor(_f(row) - along_y)))
            write(moved, 3, column, int(np.floor(_f(row) + along_y)))
        begin = 0
        while begin < width:
            back = moved[0, begin]
            ahead = moved[1, begin]
            upper = moved[2, begin]
            lower = moved[3, begin]
            end = begin + 1
            while (
                end < width
                and moved[0, end] == back
                and moved[1, end] == ahead
                and moved[2, end] == upper
                and moved[3, end] == lower
            ):
                end += 1
            behind = (_at_border(upper, last_row), _at_border(upper + 1, last_row))
            before = (_at_border(lower, last_row), _at_border(lower + 1, last_row))
            inner = min(max(begin, -min(back, ahead)), end)
            outer = max(min(end, last - max(back, ahead)), inner)
            for column in range(inner, outer):
                left = 3 * (column + back)
                right = 3 * (column + ahead)
                _mean_of_three(
                    image, flow, share, row, column,
                    (behind[0], behind[1], left, left + 3), (before[0], before[1], right, right + 3), out,
                )  # fmt: skip
            for low, high in ((begin, inner), (outer, end)):
                for column in range(low, high):
                    _mean_of_three(
                        image, flow, share, row, column,
                        _places(behind, column + back, last), _places(before, column + ahead, last), out,
                    )  # fmt: skip
            begin = end


@exactly_inlined
def _expose(
    image: Any, noise: Any, row: Any, place: Any, gain: Any, falloff: Any, sensor: Any, levels: Any
) -> None:
    """Write the level of a number of an image's row, in steps of ``sensor``."""
    field, shift_row, shift_column = noise
    per_electron, dark, steps = sensor
    level = read(image, row, place) * gain * falloff
    sigma = _f(np.sqrt(max(level, ZERO) * per_electron + dark))
    level = (level + sigma * read(field, row + shift_row, place + 3 * shift_column)) * steps
    write(levels, 0, place, int(clip(level, ZERO, steps)))


@exact_kernel
def record(
    image: Plane, gain: Plane, falloff: Plane, noise: Any, per_electron: Any, dark: Any,
    codes: NDArray[np.uint8], levels: NDArray[np.int32], out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Write the codes (H, 3 W) of an image with shot noise and noise in the dark.

    It is exposed by a ``gain`` (3,) and the lens's ``falloff`` (H, W). ``noise`` is a field of normal
    numbers with the row and column of the first pixel's. ``levels`` (1, 3 W) is written to.
    """
    sensor = (per_electron, dark, _f(len(codes) - 1))
    blue = gain[0]
    green = gain[1]
    red = gain[2]
    for row in range(image.shape[0]):
        # Apart from looking up the codes: one load at a time, it would keep LLVM from taking many at once.
        for column in range(falloff.shape[1]):
            lost = read(falloff, row, column)
            _expose(image, noise, row, 3 * column, blue, lost, sensor, levels)
            _expose(image, noise, row, 3 * column + 1, green, lost, sensor, levels)
            _expose(image, noise, row, 3 * column + 2, red, lost, sensor, levels)
        for place in range(image.shape[1]):
            out[row, place] = codes[levels[0, place]]
