"""Kernels that draw polygons: the windows that they cover, paint, faces of boxes, shadows.

Many polygons are drawn at once, in their order. Parts of one array belong to polygon p from ``rows[p]`` to
``rows[p + 1]``. Windows are (first row, end, first column, end) of arrays (H, W). A pixel that a polygon does
not cover stays as it is to the last bit, though it is computed: so LLVM takes many at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from v2hdm.compiled import exact_kernel, exactly_inlined
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.simulate.render.pixels import HALF, ONE, ZERO, Plane, clip, fade, read, read_back, sampled, write

_f = np.float32
_u = np.uint8


@exact_kernel
def bands(
    boundaries_px: FloatArray,
    boundary_rows: IntArray,
    bounds: Any,
    limits: Any,
    out: IntArray,
    rows: IntArray,
) -> None:
    """Write the windows of outlines into ``out``, several of those from an area on, and their ``rows``.

    ``bounds`` are the first row, height and width of what is drawn, ``limits`` a window's rows and that area.
    """
    first_row, height, width = bounds
    for p in range(len(rows) - 1):
        number = rows[p]
        boundary = boundaries_px[boundary_rows[p] : boundary_rows[p + 1]]
        count = len(boundary)
        top = np.inf
        bottom = -np.inf
        left = np.inf
        right = -np.inf
        for k in range(count):
            top = min(top, boundary[k, 1])
            bottom = max(bottom, boundary[k, 1])
            left = min(left, boundary[k, 0])
            right = max(right, boundary[k, 0])
        begin = max(int(np.floor(top)) - 2, first_row)
        end = min(int(np.ceil(bottom)) + 3, height)
        step = limits[0] if (end - begin) * (right - left) > limits[1] else max(end - begin, 1)
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
        rows[p + 1] = number


@exactly_inlined
def _share(edges: Any, e: Any, u: Any, v: Any) -> Any:
    """How much of a pixel an edge leaves."""
    return clip(u * edges[e, 0] + v * edges[e, 1] + edges[e, 2], ZERO, ONE)


@exactly_inlined
def _cover(edges: Any, parts: Any, rays: Any, row: Any, columns: Any, out: Any, line: Any, shift: Any) -> Any:
    """Write how much of a row's pixels an outline covers into a line of ``out``; whether it covers any.

    By its edges (:func:`.view.edges_of`) from the first to the second of ``parts``.
    """
    u, v = rays
    e, end = parts
    begin_column, end_column = columns
    covers = False
    if end - e == 4:
        for column in range(begin_column, end_column):
            u_px = read(u, row, column)
            v_px = read(v, row, column)
            across = max(_share(edges, e, u_px, v_px) + _share(edges, e + 2, u_px, v_px) - ONE, ZERO)
            along = max(_share(edges, e + 1, u_px, v_px) + _share(edges, e + 3, u_px, v_px) - ONE, ZERO)
            covered = across * along
            write(out, line, column + shift, covered)
            covers |= covered > ZERO
        return covers
    for column in range(begin_column, end_column):
        u_px = u[row, column]
        v_px = v[row, column]
        total = _share(edges, e, u_px, v_px) - _f(end - e - 1)
        for k in range(e + 1, end):
            total += _share(edges, k, u_px, v_px)
        covered = max(total, ZERO)
        out[line, column + shift] = covered
        covers |= covered > ZERO
    return covers


@exactly_inlined
def _scales(scales: Any) -> Any:
    """The scales of a polygon's textures, read once: LLVM would not know that they stay the same."""
    return (
        (scales[0, 0], scales[0, 1], scales[0, 2], scales[0, 3]),
        (scales[1, 0], scales[1, 1], scales[1, 2], scales[1, 3]),
        (scales[2, 0], scales[2, 1], scales[2, 2], scales[2, 3]),
    )


@exactly_inlined
def _texture(tile: Any, scale: Any, x_m: Any, y_m: Any, footprint_m: Any) -> Any:
    per_m, turn_x, turn_y, per_wave = scale
    return sampled(tile, x_m, y_m, per_m, turn_x, turn_y) * fade(footprint_m, per_wave)


@exact_kernel
def draw_paint(
    bands: Any, first_row: int, edges: Plane, edge_rows: IntArray, rays: Any, ground: Any, tiles: Any,
    scales: Plane, looks: Plane, kinds: NDArray[np.uint8], covered: Plane, albedo: Plane,
    labels: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Paint polygons onto ``albedo`` (H', 3 W) from ``first_row`` on, and into ``labels`` (H, W).

    ``scales`` (P, 3, 4) are of the tiles of wear, stains and grain: turns a metre, turns at 0, waves a metre;
    ``looks`` (P, 5) are threshold, dirt and the paint's reflectance, ``kinds`` (P,) its labels. ``covered``
    (1, W) is written to.
    """
    windows, rows = bands
    x_m, y_m, footprint_m = ground
    wear, stains, grain = tiles
    for p in range(len(looks)):
        parts = (edge_rows[p], edge_rows[p + 1])
        wear_scale, stains_scale, grain_scale = _scales(scales[p])
        threshold = looks[p, 0]
        dirty = looks[p, 1]
        blue = looks[p, 2]
        green = looks[p, 3]
        red = looks[p, 4]
        kind = kinds[p]
        for n in range(rows[p], rows[p + 1]):
            columns = (windows[n, 2], windows[n, 3])
            for row in range(windows[n, 0], windows[n, 1]):
                if not _cover(edges, parts, rays, row, columns, covered, 0, 0):
                    continue
                at = row - first_row
                for column in range(columns[0], columns[1]):
                    share = read_back(covered, 0, column)
                    write(labels, row, column, kind if share > HALF else read_back(labels, row, column))
                    x = read(x_m, at, column)
                    y = read(y_m, at, column)
                    footprint = read(footprint_m, at, column)
                    flaking = _texture(wear, wear_scale, x, y, footprint)
                    flaking += _f(0.7) * _texture(stains, stains_scale, x, y, footprint)
                    remainder = (flaking - threshold) / (_f(0.35) + footprint * _f(12.0)) + HALF
                    tone = ONE + _f(0.06) * _texture(grain, grain_scale, x, y, footprint)
                    dirt = dirty * clip(_f(0.8) - _f(0.4) * flaking, ZERO, _f(1.6))
                    opacity = share * clip(remainder, ZERO, ONE) * (ONE - _f(0.6) * dirt)
                    tone *= ONE - _f(0.4) * dirt
                    _lay_over(albedo, at, 3 * column, tone * blue, opacity)
                    _lay_over(albedo, at, 3 * column + 1, tone * green, opacity)
                    _lay_over(albedo, at, 3 * column + 2, tone * red, opacity)


@exactly_inlined
def _lay_over(plane: Any, row: Any, place: Any, colour: Any, opacity: Any) -> None:
    below = read_back(plane, row, place)
    write(plane, row, place, below + opacity * (colour - below))


@exact_kernel
def look_at_faces(
    bands: Any, span: Any, edges: Plane, edge_rows: IntArray, rays: Any, planes: Plane, per_focal: Any,
    places: IntArray, out: Plane, covers: BoolArray,
) -> None:  # fmt: skip
    """Write coverage, metres along both sides, and a pixel's size (4, ...) of faces of boxes.

    ``span`` are the number of the first face and the one after the last. ``planes`` (F, 3, 3) are of faces
    from pinhole pixels. A window's pixels begin at its ``places`` (K,); ``covers`` (K,) says whether its face
    covers any.
    """
    windows, rows = bands
    u, v = rays
    for p in range(span[0], span[1]):
        m = planes[p]
        for n in range(rows[p], rows[p + 1]):
            width = windows[n, 3] - windows[n, 2]
            covers[n] = False
            for row in range(windows[n, 0], windows[n, 1]):
                shift = places[n] - places[rows[span[0]]] + (row - windows[n, 0]) * width - windows[n, 2]
                columns = (windows[n, 2], windows[n, 3])
                parts = (edge_rows[p], edge_rows[p + 1])
                covers[n] |= _cover(edges, parts, rays, row, columns, out, 0, shift)
                for column in range(columns[0], columns[1]):
                    u_px = read(u, row, column)
                    v_px = read(v, row, column)
                    inverse = m[2, 0] * u_px + m[2, 1] * v_px + m[2, 2]
                    depth = ONE / (_f(1e-6) if abs(inverse) < _f(1e-6) else inverse)
                    along = (m[0, 0] * u_px + m[0, 1] * v_px + m[0, 2]) * depth
                    up = (m[1, 0] * u_px + m[1, 1] * v_px + m[1, 2]) * depth
                    write(out, 1, column + shift, clip(along, _f(-50.0), _f(50.0)))
                    write(out, 2, column + shift, clip(up, _f(-50.0), _f(50.0)))
                    write(out, 3, column + shift, abs(depth) * per_focal)


@exact_kernel
def draw_faces(
    bands: Any, span: Any, places: IntArray, covers: BoolArray, patches: Plane, waves: Plane, pictures: Plane,
    tile: Plane, scales: Plane, looks: Plane, radiance: Plane, hidden: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Draw what :func:`look_at_faces` saw over ``radiance`` (H, 3 W) and as 1 into ``hidden`` (H, W).

    ``waves`` (1, ...) are sines of the corrugation, ``pictures`` (3, ...) radiances, if there are any.
    ``looks`` (F, 6) are a face's radiance and whether it is corrugated, upright, and has a picture.
    """
    windows, rows = bands
    for p in range(span[0], span[1]):
        per_m = scales[p, 0]
        turn_x = scales[p, 1]
        turn_y = scales[p, 2]
        blue = looks[p, 0]
        green = looks[p, 1]
        red = looks[p, 2]
        relief = _f(0.16) * looks[p, 3]
        dark = _f(0.2) * looks[p, 4]
        foot = _f(0.8) if looks[p, 4] > ZERO else ONE
        is_pictured = looks[p, 5] > ZERO
        for n in range(rows[p], rows[p + 1]):
            if not covers[n]:
                continue
            width = windows[n, 3] - windows[n, 2]
            for row in range(windows[n, 0], windows[n, 1]):
                shift = places[n] - places[rows[span[0]]] + (row - windows[n, 0]) * width - windows[n, 2]
                for column in range(windows[n, 2], windows[n, 3]):
                    at = column + shift
                    covered = read(patches, 0, at)
                    write(hidden, row, column, _u(1) if covered > HALF else read_back(hidden, row, column))
                    up = read(patches, 2, at)
                    tone = ONE + _f(0.1) * sampled(
                        tile, read(patches, 1, at), up * _f(0.35), per_m, turn_x, turn_y
                    )
                    fine = read(patches, 3, at) * _f(20.0)
                    tone += relief * clip(read(waves, 0, at) * _f(2.5), _f(-1.0), ONE) / (ONE + fine * fine)
                    tone *= foot + dark * clip(up * _f(1.2), ZERO, ONE)
                    tone = clip(tone, _f(0.2), _f(1.8))
                    if is_pictured:
                        _lay_over(radiance, row, 3 * column, tone * read(pictures, 0, at), covered)
                        _lay_over(radiance, row, 3 * column + 1, tone * read(pictures, 1, at), covered)
                        _lay_over(radiance, row, 3 * column + 2, tone * read(pictures, 2, at), covered)
                    else:
                        _lay_over(radiance, row, 3 * column, tone * blue, covered)
                        _lay_over(radiance, row, 3 * column + 1, tone * green, covered)
                        _lay_over(radiance, row, 3 * column + 2, tone * red, covered)


@exact_kernel
def cast_shadows(
    bands: Any, first_row: int, lines: Plane, line_rows: IntArray, softness_m: Plane, darkness: Plane,
    ground: Any, inside_m: Plane, out: Plane,
) -> None:  # fmt: skip
    """Lower the sun's visibility ``out`` (H', W) to that in polygons with inward ``lines`` (L, 3).

    ``inside_m`` (1, W) is written to.
    """
    windows, rows = bands
    x_m, y_m, footprint_m = ground
    for p in range(len(softness_m)):
        soft_m = softness_m[p]
        dark = darkness[p]
        for n in range(rows[p], rows[p + 1]):
            for row in range(windows[n, 0] - first_row, windows[n, 1] - first_row):
                for column in range(windows[n, 2], windows[n, 3]):
                    write(inside_m, 0, column, _f(np.inf))
                for k in range(line_rows[p], line_rows[p + 1]):
                    by_x = lines[k, 0]
                    by_y = lines[k, 1]
                    along = lines[k, 2]
                    for column in range(windows[n, 2], windows[n, 3]):
                        at = read(x_m, row, column) * by_x + read(y_m, row, column) * by_y - along
                        write(inside_m, 0, column, min(read_back(inside_m, 0, column), at))
                for column in range(windows[n, 2], windows[n, 3]):
                    sharpness = ONE / (soft_m + read(footprint_m, row, column))
                    shade = clip(read_back(inside_m, 0, column) * sharpness + HALF, ZERO, ONE)
                    write(out, row, column, min(read_back(out, row, column), ONE - shade * dark))
