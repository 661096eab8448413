"""Loops over pixels, compiled: each does in one pass, where something is drawn, what took numpy many.

They round as numpy and ``cv2.remap`` do. Windows are (first row, end, first column, end) of arrays (H, W).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from v2hdm.compiled import exact_kernel, exactly_inlined
from v2hdm.records import FloatArray, IntArray
from v2hdm.simulate.render.scene import TILE_PX

_Plane = NDArray[np.float32]
_numba_arrays: Any = arrayobj  # which states no types
_numba_code: Any = cgutils
_f = np.float32
_i = np.int32

# Numbers in float32: an operand in float64 would widen what a kernel computes.
_TILE = _f(TILE_PX)  # side of a tile, px
_ONE = _f(1.0)  # a whole pixel, and a tone that changes nothing
_HALF = _f(0.5)  # half a pixel, from which on it counts as covered
_ZERO = _f(0.0)  # none of a pixel
_NEXT = _i(1)  # from a row or column to the following one


def _rounded_once(_: Any, a: Any, b: Any, c: Any) -> Any:
    def build(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        factor, other, addend = arguments
        return builder.fma(factor, other, addend)

    return types.float32(types.float32, types.float32, types.float32), build


_fma: Any = intrinsic(_rounded_once)  # a b + c rounded once, as in cv2.remap


def _place(context: Any, builder: Any, kind: Any, plane: Any, row: Any, column: Any) -> Any:
    """The address of a pixel of a plane (H, W); by numbers of 32 bits processors gather fastest.

    Of those of 64 bits LLVM sees which lie side by side.
    """
    array = _numba_arrays.make_array(kind)(context, builder, plane)
    width = _numba_code.unpack_tuple(builder, array.shape, 2)[1]
    if row.type.width == 64:
        return builder.gep(array.data, [builder.add(builder.mul(row, width), column)])
    width = builder.trunc(width, row.type)
    flat = builder.add(builder.mul(row, width, flags=["nsw"]), column, flags=["nsw"])
    return builder.gep(array.data, [builder.sext(flat, cgutils.intp_t)])


def _number(row: Any, column: Any) -> Any:
    """The type of numbers of rows and columns: 32 bits where both have them."""
    return types.int32 if row == column == types.int32 else types.int64


def _what_is_read(builder: Any) -> Any:
    """LLVM's name of all that :data:`_read` reads."""
    module = builder.module
    domain = module.add_metadata(["v2hdm pixels"])
    return module.add_metadata([module.add_metadata(["v2hdm read", domain])])


def _marked_read(_: Any, plane: Any, row: Any, column: Any) -> Any:
    if plane.layout != "C":
        return None  # numba then refuses the call

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value = builder.load(_place(context, builder, signature.args[0], *arguments))
        value.set_metadata("alias.scope", _what_is_read(builder))
        return value

    number = _number(row, column)
    return types.float32(plane, number, number), build


def _marked_write(_: Any, plane: Any, row: Any, column: Any, value: Any) -> Any:
    if plane.layout != "C":
        return None

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        *place, number = arguments
        number = context.get_value_as_data(builder, signature.args[3], number)
        stored = builder.store(number, _place(context, builder, signature.args[0], *place))
        stored.set_metadata("noalias", _what_is_read(builder))
        return context.get_dummy_value()

    number = _number(row, column)
    return types.none(plane, number, number, plane.dtype), build


# Reads of planes to which no ``_write`` of their kernel writes. LLVM cannot know that of a texture, whose
# pixels it would otherwise take one by one: with it a kernel takes less than half of the time.
_read: Any = intrinsic(_marked_read)
_write: Any = intrinsic(_marked_write)


@exactly_inlined
def _clip(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)


@exactly_inlined
def _wrap(metres: Any, per_metre: Any, turn: Any) -> Any:
    turns = metres * per_metre
    turns += turn
    turns -= _f(np.floor(turns))
    return turns * _TILE


@exactly_inlined
def _sample(tile: _Plane, x_m: Any, y_m: Any, per_metre: Any, turn_x: Any, turn_y: Any) -> Any:
    """A padded tile's value at a ground point, as :func:`v2hdm.simulate.render.scene.sample` has it."""
    x = _wrap(x_m, per_metre, turn_x)
    y = _wrap(y_m, per_metre, turn_y)
    column = _i(x)
    row = _i(y)
    share_x = x - _f(column)
    share_y = y - _f(row)
    right = _i(column + _NEXT)
    under = _i(row + _NEXT)
    upper = _read(tile, row, column)
    lower = _read(tile, under, column)
    above = _fma(share_x, _read(tile, row, right) - upper, upper)
    below = _fma(share_x, _read(tile, under, right) - lower, lower)
    return _fma(share_y, below - above, above)


@exactly_inlined
def _fade(footprint_m: Any, per_wave: Any) -> Any:
    waves = footprint_m * per_wave
    return _ONE / (_ONE + waves * waves)


@exactly_inlined
def _coverage(edges: NDArray[np.float32], u: Any, v: Any) -> Any:
    """How much of a pixel an outline covers, by its edges (:func:`.view.edges_of`)."""
    count = len(edges)
    if count == 4:
        first = _clip(u * edges[0, 0] + v * edges[0, 1] + edges[0, 2], _ZERO, _ONE)
        third = _clip(u * edges[2, 0] + v * edges[2, 1] + edges[2, 2], _ZERO, _ONE)
        across = max(first + third - _ONE, _ZERO)
        if across == _ZERO:
            return _ZERO
        second = _clip(u * edges[1, 0] + v * edges[1, 1] + edges[1, 2], _ZERO, _ONE)
        fourth = _clip(u * edges[3, 0] + v * edges[3, 1] + edges[3, 2], _ZERO, _ONE)
        return across * max(second + fourth - _ONE, _ZERO)
    total = _clip(u * edges[0, 0] + v * edges[0, 1] + edges[0, 2], _ZERO, _ONE) - _f(count - 1)
    for k in range(1, count):
        total += _clip(u * edges[k, 0] + v * edges[k, 1] + edges[k, 2], _ZERO, _ONE)
    return max(total, _ZERO)


@exact_kernel
def bands(boundary: FloatArray, first_row: int, height: int, width: int, limits: Any, out: IntArray) -> int:
    """Write the windows of an outline px into ``out``, several from an area on; returns their number."""
    count = len(boundary)
    top = boundary[0, 1]
    bottom = boundary[0, 1]
    left = boundary[0, 0]
    right = boundary[0, 0]
    for k in range(1, count):
        top = min(top, boundary[k, 1])
        bottom = max(bottom, boundary[k, 1])
        left = min(left, boundary[k, 0])
        right = max(right, boundary[k, 0])
    begin = max(int(np.floor(top)) - 2, first_row)
    end = min(int(np.ceil(bottom)) + 3, height)
    step = limits[0] if (end - begin) * (right - left) > limits[1] else max(end - begin, 1)
    number = 0
    for row in range(begin, end, step):
        last = min(row + step, end)
        least = np.inf
        most = -np.inf
        for k in range(count):
            following = k + 1 if k + 1 < count else 0
            rise = boundary[following, 1] - boundary[k, 1]
            if rise == 0:
                rise = 1e-9
            for level in (row - 2.0, last + 2.0):
                at = min(max((level - boundary[k, 1]) / rise, 0.0), 1.0)
                y = boundary[k, 1] + at * (boundary[following, 1] - boundary[k, 1])
                if row - 2.01 <= y <= last + 2.01:
                    x = boundary[k, 0] + at * (boundary[following, 0] - boundary[k, 0])
                    least = min(least, x)
                    most = max(most, x)
        if least > most:
            continue
        first_column = max(int(np.floor(least)) - 2, 0)
        end_column = min(int(np.ceil(most)) + 3, width)
        if first_column < end_column:
            out[number, 0] = row
            out[number, 1] = last
            out[number, 2] = first_column
            out[number, 3] = end_column
            number += 1
    return number


@exact_kernel
def draw_paint(
    windows: IntArray, count: int, first_row: int, edges: _Plane, rays: Any, ground: Any, tiles: Any,
    scales: _Plane, look: _Plane, label: int, albedo: _Plane, labels: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Paint a polygon onto ``albedo`` (H', W, 3) from ``first_row`` on, and into ``labels`` (H, W).

    ``scales`` (3, 4) are of the tiles of wear, stains and grain: turns a metre, turns at 0, waves a metre;
    ``look`` are threshold, dirt and the paint's reflectance.
    """
    u, v = rays
    x_m, y_m, footprint_m = ground
    wear, stains, grain = tiles
    for n in range(count):
        for row in range(windows[n, 0], windows[n, 1]):
            at = row - first_row
            for column in range(windows[n, 2], windows[n, 3]):
                covered = _coverage(edges, u[row, column], v[row, column])
                if covered == _ZERO:
                    continue
                if covered > _HALF:
                    labels[row, column] = label
                x = x_m[at, column]
                y = y_m[at, column]
                footprint = footprint_m[at, column]
                noise = _sample(wear, x, y, scales[0, 0], scales[0, 1], scales[0, 2])
                flaking = noise * _fade(footprint, scales[0, 3])
                noise = _sample(stains, x, y, scales[1, 0], scales[1, 1], scales[1, 2])
                flaking += _f(0.7) * (noise * _fade(footprint, scales[1, 3]))
                remainder = (flaking - look[0]) / (_f(0.35) + footprint * _f(12.0)) + _HALF
                noise = _sample(grain, x, y, scales[2, 0], scales[2, 1], scales[2, 2])
                tone = _ONE + _f(0.06) * (noise * _fade(footprint, scales[2, 3]))
                dirt = look[1] * _clip(_f(0.8) - _f(0.4) * flaking, _ZERO, _f(1.6))
                opacity = covered * _clip(remainder, _ZERO, _ONE) * (_ONE - _f(0.6) * dirt)
                tone *= _ONE - _f(0.4) * dirt
                for c in range(3):
                    below = albedo[at, column, c]
                    albedo[at, column, c] = below + opacity * (tone * look[2 + c] - below)


@exact_kernel
def look_at_face(
    window: Any, edges: _Plane, rays: Any, face_from_pinhole: _Plane, per_focal: Any, out: _Plane
) -> bool:
    """Write coverage, metres along both sides, and a pixel's size (4, h, w); whether anything is covered."""
    u, v = rays
    covers = False
    m = face_from_pinhole
    for row in range(window[0], window[1]):
        for column in range(window[2], window[3]):
            i = row - window[0]
            j = column - window[2]
            u_px = u[row, column]
            v_px = v[row, column]
            covered = _coverage(edges, u_px, v_px)
            out[0, i, j] = covered
            covers |= covered > _ZERO
            inverse = m[2, 0] * u_px + m[2, 1] * v_px + m[2, 2]
            depth = _ONE / (_f(1e-6) if abs(inverse) < _f(1e-6) else inverse)
            out[1, i, j] = _clip((m[0, 0] * u_px + m[0, 1] * v_px + m[0, 2]) * depth, _f(-50.0), _f(50.0))
            out[2, i, j] = _clip((m[1, 0] * u_px + m[1, 1] * v_px + m[1, 2]) * depth, _f(-50.0), _f(50.0))
            out[3, i, j] = abs(depth) * per_focal
    return covers


@exact_kernel
def draw_face(
    window: Any, face: _Plane, tile: _Plane, scale: _Plane, wave: _Plane, upright: bool, colour: _Plane,
    radiance: _Plane, hidden: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Draw what :func:`look_at_face` saw over ``radiance`` (H, W, 3) and into ``hidden`` (H, W).

    ``wave`` (h, w), or of no size, is the sine of the corrugation; ``colour`` is (3, h, w) or (3, 1, 1).
    """
    corrugated = wave.shape[0] > 0
    pictured = colour.shape[1] * colour.shape[2] > 1
    for i in range(window[1] - window[0]):
        for j in range(window[3] - window[2]):
            covered = face[0, i, j]
            if covered == _ZERO:
                continue
            row = i + window[0]
            column = j + window[2]
            if covered > _HALF:
                hidden[row, column] = True
            along = face[1, i, j]
            up = face[2, i, j]
            footprint = face[3, i, j]
            tone = _ONE + _f(0.1) * _sample(tile, along, up * _f(0.35), scale[0], scale[1], scale[2])
            if corrugated:
                ripple = _clip(wave[i, j] * _f(2.5), _f(-1.0), _ONE)
                fine = footprint * _f(20.0)
                tone += _f(0.16) * ripple / (_ONE + fine * fine)
            if upright:
                tone *= _f(0.8) + _f(0.2) * _clip(up * _f(1.2), _ZERO, _ONE)
            tone = _clip(tone, _f(0.2), _f(1.8))
            for c in range(3):
                shown = colour[c, i, j] if pictured else colour[c, 0, 0]
                below = radiance[row, column, c]
                radiance[row, column, c] = below + covered * (tone * shown - below)


@exactly_inlined
def _within(lines: _Plane, x: Any, y: Any, sharpness: Any) -> Any:
    least = _f(np.inf)
    for k in range(len(lines)):
        least = min(least, x * lines[k, 0] + y * lines[k, 1] - lines[k, 2])
    return _clip(least * sharpness + _HALF, _ZERO, _ONE)


@exact_kernel
def cast_shadow(
    windows: IntArray, count: int, first_row: int, lines: _Plane, softness_m: Any, darkness: Any, ground: Any,
    out: _Plane,
) -> None:  # fmt: skip
    """Lower the sun's visibility ``out`` (H', W) to that in a polygon with inward ``lines`` (N, 3)."""
    x_m, y_m, footprint_m = ground
    for n in range(count):
        for row in range(windows[n, 0] - first_row, windows[n, 1] - first_row):
            for column in range(windows[n, 2], windows[n, 3]):
                sharpness = _ONE / (softness_m + footprint_m[row, column])
                dark = _within(lines, x_m[row, column], y_m[row, column], sharpness)
                out[row, column] = min(out[row, column], _ONE - dark * darkness)


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
            inverse = _along(by_pixel[2], _read(u, row, column), _read(v, row, column))
            _write(below, row, column, inverse > least)
            meets |= inverse > least
        if first < 0 and meets:
            first = row
        if first < 0:
            continue
        for column in range(below.shape[1]):
            u_px = _read(u, row, column)
            v_px = _read(v, row, column)
            depth = _ONE / max(_along(by_pixel[2], u_px, v_px), least)
            _write(x_m, row, column, _along(by_pixel[0], u_px, v_px) * depth + centre[0])
            _write(y_m, row, column, _along(by_pixel[1], u_px, v_px) * depth + centre[1])
            _write(depth_m, row, column, depth)
            _write(footprint_m, row, column, depth * depth * per_focal)
    return first


@exactly_inlined
def _along(factors: Any, u_px: Any, v_px: Any) -> Any:
    return u_px * factors[0] + v_px * factors[1] + factors[2]


@exact_kernel
def ground_tone(
    tiles: Any, scales: _Plane, amplitudes: _Plane, coarse: _Plane, ground: Any, out: _Plane
) -> None:
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
            x = _read(x_m, row, column)
            y = _read(y_m, row, column)
            footprint = _read(footprint_m, row, column)
            noise = _sample(fine, x, y, fine_per_m, fine_x, fine_y)
            tone = noise * (_fade(footprint, fine_per_wave) * grain)
            noise = _sample(medium, x, y, medium_per_m, medium_x, medium_y)
            tone += noise * (_fade(footprint, medium_per_wave) * stains)
            tone += _read(coarse, row, column) * large
            _write(out, row, column, _clip(tone + _ONE, _f(0.25), _f(2.5)))


@exact_kernel
def spread(tone: _Plane, colour: _Plane, out: _Plane) -> None:
    """Write a tone (H', W) times a colour (3,) into ``out`` (H', W, 3)."""
    for row in range(tone.shape[0]):
        for column in range(tone.shape[1]):
            for c in range(3):
                out[row, column, c] = tone[row, column] * colour[c]


@exact_kernel
def draw_sky(
    azimuth: _Plane, elevation: _Plane, clouds: _Plane, scale: _Plane, sky: _Plane, skyline: _Plane,
    per_turn: Any, height_rad: Any, per_focal: Any, out: _Plane,
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
            cloud = _sample(clouds, turn, up * _f(2.0), scale[0], scale[1], scale[2])
            bright = _ONE + _f(0.05) * cloud
            share = _f(np.sqrt(_clip(up * _f(2.2), _ZERO, _ONE)))
            block = int(np.floor((turn + _f(np.pi)) * per_turn)) % blocks
            above = skyline[0, block] * height_rad - up
            covered = _clip(above / per_focal + _HALF, _ZERO, _ONE)
            for c in range(3):
                lit = (sky[0, c] + sky[1, c] * share) * bright
                out[row, column, c] = lit + covered * (sky[2, c] * skyline[1, block] - lit)


@exact_kernel
def light_ground(
    albedo: _Plane, sun: _Plane, wet: _Plane, wet_levels: Any, ground: Any, centre: Any, light: Any
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
            share = _clip((_read(wet, row, column) - low) * per_range, _ZERO, _ONE) if is_wet else _ZERO
            film = share * share * (_f(3.0) - _f(2.0) * share)
            x = _read(x_m, row, column) - centre[0]
            y = _read(y_m, row, column) - centre[1]
            sine = centre[2] / _f(np.sqrt(x * x + y * y + squared_height))
            grazing = _ONE - max(sine, _f(0.12))
            squared = grazing * grazing
            mirror = film * (_f(0.02) + _f(0.45) * squared * squared * grazing)
            clear = _ONE - _f(0.45) * film
            direct = _read(sun, row, column)
            for c in range(3):
                place = 3 * column + c
                lit = albedo[row, place] * (direct * light[0][c] + light[1][c])
                _write(albedo, row, place, lit * clear + mirror * light[2][c])


@exactly_inlined
def _at_border(place: int, last: int) -> int:
    return min(max(place, 0), last)


@exactly_inlined
def _between(image: Any, places: Any, channel: Any, share_x: Any, share_y: Any) -> Any:
    """A channel's value between four pixels, as cv2.remap has it."""
    top, bottom, left, right = places
    left = left + channel
    right = right + channel
    upper = _read(image, top, left)
    lower = _read(image, bottom, left)
    above = _fma(share_x, _read(image, top, right) - upper, upper)
    below = _fma(share_x, _read(image, bottom, right) - lower, lower)
    return _fma(share_y, below - above, above)


@exactly_inlined
def _between_pixels(image: Any, places: Any, x: Any, y: Any) -> Any:
    """Blue, green and red at a place of an image between four pixels of it."""
    share_x = x - _f(np.floor(x))
    share_y = y - _f(np.floor(y))
    blue = _between(image, places, 0, share_x, share_y)
    green = _between(image, places, 1, share_x, share_y)
    return blue, green, _between(image, places, 2, share_x, share_y)


@exactly_inlined
def _mean_of_three(
    image: Any, flow: Any, share: Any, row: Any, column: Any, back: Any, ahead: Any, out: Any
) -> None:
    """Write a pixel of :func:`blur_along`, between the four pixels ``back`` and the four ``ahead`` of it."""
    along_x = _read(flow, row, 2 * column) * share
    along_y = _read(flow, row, 2 * column + 1) * share
    x = _f(column)
    y = _f(row)
    blue, green, red = _between_pixels(image, back, x - along_x, y - along_y)
    blue_ahead, green_ahead, red_ahead = _between_pixels(image, ahead, x + along_x, y + along_y)
    first = 3 * column
    third = _f(1.0 / 3.0)
    _write(out, row, first, (_read(image, row, first) + blue + blue_ahead) * third)
    _write(out, row, first + 1, (_read(image, row, first + 1) + green + green_ahead) * third)
    _write(out, row, first + 2, (_read(image, row, first + 2) + red + red_ahead) * third)


@exactly_inlined
def _places(rows: Any, column: Any, last: Any) -> Any:
    """The rows and first numbers of the four pixels around a place of an image."""
    return rows[0], rows[1], 3 * _at_border(column, last), 3 * _at_border(column + 1, last)


@exact_kernel
def blur_along(image: _Plane, flow: _Plane, share: Any, moved: NDArray[np.int32], out: _Plane) -> None:
    """Write the mean (H, 3 W) of an image and of it moved by a share of the flow (H, 2 W) px either way.

    Pixels that move to neighbouring ones are done together. ``moved`` (4, W) is written to: to which columns
    from its own, and to which rows, a row's pixels move back and ahead.
    """
    width = image.shape[1] // 3
    last = width - 1
    last_row = image.shape[0] - 1
    for row in range(image.shape[0]):
        for column in range(width):
            along_x = _read(flow, row, 2 * column) * share
            along_y = _read(flow, row, 2 * column + 1) * share
            _write(moved, 0, column, int(np.floor(_f(column) - along_x)) - column)
            _write(moved, 1, column, int(np.floor(_f(column) + along_x)) - column)
            _write(moved, 2, column, int(np.floor(_f(row) - along_y)))
            _write(moved, 3, column, int(np.floor(_f(row) + along_y)))
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
    level = _read(image, row, place) * gain * falloff
    sigma = _f(np.sqrt(max(level, _ZERO) * per_electron + dark))
    level = (level + sigma * _read(field, row + shift_row, place + 3 * shift_column)) * steps
    _write(levels, 0, place, int(_clip(level, _ZERO, steps)))


@exact_kernel
def record(
    image: _Plane, gain: _Plane, falloff: _Plane, noise: Any, per_electron: Any, dark: Any,
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
            lost = _read(falloff, row, column)
            _expose(image, noise, row, 3 * column, blue, lost, sensor, levels)
            _expose(image, noise, row, 3 * column + 1, green, lost, sensor, levels)
            _expose(image, noise, row, 3 * column + 2, red, lost, sensor, levels)
        for place in range(image.shape[1]):
            out[row, place] = codes[levels[0, place]]
