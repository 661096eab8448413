"""Overlays on photographs: ground grids, horizons and the map, with a legend."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import length_along, points_along
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BEST, BoolArray, Camera, CameraInfo, FloatArray, HDMap
from v2hdm.report.metrics import runs
from v2hdm.report.style import OKABE_ITO
from v2hdm.store.files import whole_file

_SUBPIXELS = 4  # fractional bits of OpenCV's coordinates
_LARGEST_PX = 1e4  # limit of drawn coordinates, below the overflow of OpenCV's integers

Bgr = tuple[int, int, int]
"""A colour as OpenCV takes it: blue, green and red, 0 to 255."""

_HALO_BGR: Bgr = (25, 25, 25)  # edge of lines: nearly black
_STRIP_BGR: Bgr = (250, 250, 250)  # background of the legend: nearly white
_TEXT_BGR: Bgr = (35, 35, 35)  # text of the legend: nearly black
_FONT = cv2.FONT_HERSHEY_DUPLEX


@dataclass(frozen=True)
class Pen:
    """Line style: ``colour`` as #rrggbb; ``dash_px``, length of dash and gap, None for solid."""

    colour: str
    dash_px: tuple[float, float] | None = None
    width: int = 2

    @property
    def bgr(self) -> Bgr:
        """The colour in OpenCV's order."""
        value = int(self.colour[1:], 16)
        return value & 255, value >> 8 & 255, value >> 16


def draw_lines(canvas: np.ndarray, lines: Iterable[FloatArray], pen: Pen) -> None:
    """Draw polylines (N, 2), px, with a dark edge for contrast on paint and on asphalt."""
    pieces = [piece for line in lines for piece in (_dashes(line, pen.dash_px) if pen.dash_px else [line])]
    clipped = [np.clip(piece, -_LARGEST_PX, _LARGEST_PX) for piece in pieces]
    fixed = [np.round(piece * (1 << _SUBPIXELS)).astype(np.int32) for piece in clipped]
    for colour, width in ((_HALO_BGR, 2 * pen.width), (pen.bgr, pen.width)):
        cv2.polylines(canvas, fixed, False, colour, width, cv2.LINE_AA, shift=_SUBPIXELS)


def _dashes(line: FloatArray, lengths_px: tuple[float, float]) -> list[FloatArray]:
    """Pieces of a polyline; ``lengths_px`` are those of a piece and of the gap behind it."""
    dash_px, gap_px = lengths_px
    way = length_along(line)
    out = []
    for start in np.arange(0.0, way[-1], dash_px + gap_px):
        end = min(start + dash_px, way[-1])
        between = (way > start) & (way < end)
        ends = points_along(line, np.array([start, end]))
        out.append(np.vstack([ends[:1], line[between], ends[1:]]))
    return out


def with_legend(canvas: np.ndarray, entries: Sequence[tuple[Pen | None, str]]) -> np.ndarray:
    """The picture (H, W, 3) with a legend of the pens below it; entries without pen are text alone."""
    width = canvas.shape[1]
    size = float(np.clip(width / 1900, 0.4, 0.75))
    row_px = round(44 * size)
    sample_px = round(64 * size)
    rows: list[list[tuple[Pen | None, str, int]]] = [[]]
    used = 0
    for pen, text in entries:
        needed = (sample_px + 12 if pen else 0) + cv2.getTextSize(text, _FONT, size, 1)[0][0] + 28
        if rows[-1] and used + needed > width - 16:
            rows.append([])
            used = 0
        rows[-1].append((pen, text, used + 16))
        used += needed
    strip = np.full((row_px * len(rows) + 8, width, 3), _STRIP_BGR, np.uint8)
    for number, row in enumerate(rows):
        middle = 4 + row_px * number + row_px // 2
        for pen, text, left in row:
            if pen is not None:
                draw_lines(strip, [np.array([[left, middle], [left + sample_px, middle]], float)], pen)
                left += sample_px + 12
            cv2.putText(strip, text, (left, middle + round(9 * size)), _FONT, size, _TEXT_BGR, 1, cv2.LINE_AA)
    return np.vstack([canvas, strip])


_FARTHEST_M = 40.0  # length of the grid ahead of the camera: lines farther out overlap near the horizon
_ALONG_M = 5.0  # spacing of the grid's lines along the view
_ACROSS_M = 2.0  # spacing of the grid's lines across the view
_HALF_WIDTH_M = 8.0  # half width of the grid about the camera
_NEAREST_M = 0.3  # least depth of ground that is drawn

PENS: Mapping[str, Pen] = {
    "guess": Pen(OKABE_ITO["orange"], dash_px=(8.0, 5.0), width=1),
    "ground": Pen(OKABE_ITO["sky"], width=1),
}
"""Line styles of the grid by mounting: the guess, and the estimate from bare ground."""

_WORDS: Mapping[str, str] = {"guess": "grid and horizon: the guess", "ground": "from bare ground"}

_ROI = Pen("#ffffff")

_SMALL_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TEXT_SIZE = 0.45  # size of the grid's coordinates, relative to OpenCV's font


def save_grid(
    path: Path, image: np.ndarray, camera: Camera, mountings: Mapping[str, FloatArray], caption: str
) -> None:
    """Draw horizon, ground grid and ROI for ``mountings`` of :data:`PENS` into an image (H, W, 3) BGR."""
    canvas = image.copy()
    legend: list[tuple[Pen | None, str]] = [(None, caption)]
    first = next(iter(mountings.values()))
    draw_lines(canvas, project_outline(camera.info, first, camera.roi_vehicle), _ROI)
    for number, (name, cam_from_vehicle) in enumerate(mountings.items()):
        _draw_grid(canvas, camera.info, cam_from_vehicle, PENS[name], to_the_left=number == 0)
        legend.append((PENS[name], _WORDS[name]))
    legend.append((_ROI, "roi_vehicle, by the guess"))
    _write_image(path, with_legend(canvas, legend), cv2.IMWRITE_JPEG_QUALITY, 88)


_ARROW_SHARE = 0.06  # length of the longest inlier's arrow, relative to the image's width
_MOST_TIMES = 1000.0  # limit of the arrows' magnification
_RIGHT = Pen(OKABE_ITO["blue"])
_WRONG = Pen(OKABE_ITO["vermillion"])


def save_points(
    path: Path,
    image: np.ndarray | None,
    info: CameraInfo,
    cam_from_vehicle: FloatArray,
    roi_vehicle: FloatArray,
    points: Sequence[tuple[str, FloatArray, FloatArray, bool]],
) -> None:
    """Draw grid, ROI and clicked points into an image (H, W, 3) BGR, or on a blank one of its size.

    ``points`` are label, pixel (2,), residual (2,), px, and whether it is an inlier. Arrows point to the
    predicted pixels, magnified for inliers.
    """
    canvas = np.full((info.height, info.width, 3), 255, np.uint8) if image is None else image.copy()
    draw_lines(canvas, project_outline(info, cam_from_vehicle, roi_vehicle), _ROI)
    _draw_grid(canvas, info, cam_from_vehicle, PENS["ground"], to_the_left=False)
    longest = max((float(np.hypot(off[0], off[1])) for _, _, off, right in points if right), default=0.0)
    times = min(_ARROW_SHARE * info.width / max(longest, 1e-9), _MOST_TIMES)
    for label, at, off, right in points:
        pen = _RIGHT if right else _WRONG
        (u, v) = np.round(at).astype(int).tolist()
        sign = cv2.MARKER_DIAMOND if right else cv2.MARKER_TILTED_CROSS
        cv2.drawMarker(canvas, (u, v), pen.bgr, sign, 14, pen.width, cv2.LINE_AA)
        if np.isfinite(off).all():
            tip = np.clip(at - (times if right else 1.0) * off, -_LARGEST_PX, _LARGEST_PX).round()
            cv2.arrowedLine(canvas, (u, v), tip.astype(int).tolist(), pen.bgr, pen.width, cv2.LINE_AA)
        _write(canvas, label, (u + 8, v + 18), (255, 255, 255))
    legend: list[tuple[Pen | None, str]] = [(PENS["ground"], f"{info.name}: grid and horizon"), (_ROI, "ROI")]
    legend.append(
        (_RIGHT, f"to the predicted pixels, {times:.0f} times as long; the longest {longest:.2f} px")
    )
    if not all(right for _, _, _, right in points):
        legend.append((_WRONG, "contradict the others, true to scale"))
    _write_image(path, with_legend(canvas, legend))


def _draw_grid(
    canvas: np.ndarray, info: CameraInfo, cam_from_vehicle: FloatArray, pen: Pen, to_the_left: bool
) -> None:
    """Draw the ground grid with its coordinates, and the horizon, under a mounting."""
    for line in _grid_lines(cam_from_vehicle):
        draw_lines(canvas, project_line(info, cam_from_vehicle, line), pen)
    draw_lines(canvas, [_horizon(info, cam_from_vehicle)], replace(pen, width=2))
    _label(canvas, info, cam_from_vehicle, pen, to_the_left)


def project_line(
    info: CameraInfo, cam_from_vehicle: FloatArray, line_vehicle: FloatArray
) -> list[FloatArray]:
    """Pieces (N, 2), recorded px, of a dense ground line (M, 2) in and near the image."""
    pinhole, depth_m = project_ground(info.intrinsic, cam_from_vehicle, line_vehicle)
    return _visible_pieces(info, pinhole, depth_m > _NEAREST_M, 0.15)


def project_outline(info: CameraInfo, cam_from_vehicle: FloatArray, outline: FloatArray) -> list[FloatArray]:
    """Pieces (N, 2), recorded px, of a ground polygon (M, 2) in and near the image."""
    sides = zip(outline, np.roll(outline, -1, axis=0), strict=True)
    return project_line(info, cam_from_vehicle, np.concatenate([np.linspace(a, b, 40) for a, b in sides]))


class _View(NamedTuple):
    """Where a camera stands, and where it looks among the vehicle's axes."""

    foot_vehicle: FloatArray  # (2,) m, the camera's nadir
    along: int  # the axis nearest to the view: 0 ahead, 1 to the left
    sign: float  # of the view along that axis


def _view_of(cam_from_vehicle: FloatArray) -> _View:
    foot = camera_centre(cam_from_vehicle)[:2]
    view = cam_from_vehicle[2, :2]
    along = int(np.argmax(np.abs(view)))
    return _View(foot, along, float(np.sign(view[along]) or 1.0))


def _marks(cam_from_vehicle: FloatArray) -> FloatArray:
    """Coordinates, in the vehicle frame, of the grid lines across the view."""
    foot, along, side = _view_of(cam_from_vehicle)
    ends = np.sort([foot[along], foot[along] + side * _FARTHEST_M])
    return np.arange(np.ceil(ends[0] / _ALONG_M), np.floor(ends[1] / _ALONG_M) + 1) * _ALONG_M


def _grid_lines(cam_from_vehicle: FloatArray) -> list[FloatArray]:
    foot, along, side = _view_of(cam_from_vehicle)
    other = 1 - along
    middle = round(float(foot[other]) / _ACROSS_M) * _ACROSS_M
    sides = middle + np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M + 0.1, _ACROSS_M)
    lines = []
    for mark in _marks(cam_from_vehicle):
        line = np.full((60, 2), mark)
        line[:, other] = np.linspace(sides[0], sides[-1], 60)
        lines.append(line)
    for mark in sides:
        # Uniform in the logarithm of distance.
        line = np.full((300, 2), mark)
        line[:, along] = foot[along] + side * np.geomspace(0.2, _FARTHEST_M, 300)
        lines.append(line)
    return lines


def _horizon(info: CameraInfo, cam_from_vehicle: FloatArray) -> FloatArray:
    """The horizon within 60 deg of the view, recorded px (N, 2)."""
    heading = np.arctan2(cam_from_vehicle[2, 1], cam_from_vehicle[2, 0])
    angles = heading + np.deg2rad(np.linspace(-60, 60, 241))
    rays = np.column_stack([np.cos(angles), np.sin(angles)]) @ cam_from_vehicle[:3, :2].T
    rays = rays[rays[:, 2] > 0.2]
    pinhole = (rays @ info.intrinsic.T)[:, :2] / rays[:, 2:]
    return distort_points(info, pinhole[np.abs(pinhole[:, 0] / info.width - 0.5) < 0.6])


def _label(
    canvas: np.ndarray, info: CameraInfo, cam_from_vehicle: FloatArray, pen: Pen, to_the_left: bool
) -> None:
    """Write the grid's coordinates, m, beside the middle of the view."""
    foot, along, _ = _view_of(cam_from_vehicle)
    last_v = np.inf
    for mark in sorted(_marks(cam_from_vehicle), key=lambda mark: abs(mark - foot[along])):
        place = foot.copy()
        place[along] = mark
        pieces = project_line(info, cam_from_vehicle, np.array([place, place]))
        if not pieces or last_v - pieces[0][0, 1] < 16:
            continue
        u, last_v = pieces[0][0]
        text = f"{'xy'[along]} {mark:g} m"
        left = -6 - cv2.getTextSize(text, _SMALL_FONT, _TEXT_SIZE, 1)[0][0] if to_the_left else 6
        _write(canvas, text, (int(u) + left, int(last_v) - 4), pen.bgr)


def _write(canvas: np.ndarray, text: str, at: tuple[int, int], colour: Bgr) -> None:
    (width, height), below = cv2.getTextSize(text, _SMALL_FONT, _TEXT_SIZE, 1)
    corner = (at[0] - 2, at[1] - height - 2)
    opposite = (at[0] + width + 2, at[1] + below)
    cv2.rectangle(canvas, corner, opposite, (40, 40, 40), cv2.FILLED)
    cv2.putText(canvas, text, at, _SMALL_FONT, _TEXT_SIZE, colour, 1, cv2.LINE_AA)


_OVERLAY_RANGE_M = 30.0  # largest distance from the vehicle of markings in an overlay

_BEFORE = Pen(OKABE_ITO["orange"], dash_px=(9.0, 6.0))  # the map under the initial calibration
OVERLAY = {BEST: Pen(OKABE_ITO["sky"])}  # the map under the results


def save_overlay(
    path: Path,
    image: np.ndarray,
    info: CameraInfo,
    hd_map: HDMap,
    position_map: FloatArray,
    views: Mapping[str, Callable[[FloatArray], FloatArray]],
) -> None:
    """Draw a map into a recorded image, projected by several calibrations and poses.

    Markings far from the vehicle's ``position_map`` (2,) are omitted. ``views`` maps names to functions from
    ground points (N, 2) to pinhole px (N, 2), nan behind the camera.
    """
    canvas = image.copy()
    outlines = [marking.corners_map for marking in hd_map.markings]
    outlines += [symbol.outline_map for symbol in hd_map.symbols]
    lines = [np.vstack([outline, outline[:1]]) for outline in outlines]
    lines += [line.points_map for lane in hd_map.lanes for line in lane.painted]
    legend: list[tuple[Pen | None, str]] = []
    for name, view in views.items():
        pen = OVERLAY.get(name, _BEFORE)
        for line in lines:
            # Densified: the lens bends lines.
            dense = np.concatenate([np.linspace(a, b, 8) for a, b in itertools.pairwise(line)])
            in_range = np.linalg.norm(dense - position_map, axis=1) < _OVERLAY_RANGE_M
            draw_lines(canvas, _visible_pieces(info, view(dense), in_range, 0.1), pen)
        said = "found by the run" if name in OVERLAY else "that the run started with"
        legend.append((pen, f"{name}: the map with the calibration and pose {said}"))
    _write_image(path, with_legend(canvas, legend))


def _visible_pieces(
    info: CameraInfo, pinhole_px: FloatArray, visible: BoolArray, margin: float
) -> list[FloatArray]:
    """Visible pieces, recorded px, of a line within the image plus ``margin``, relative to its size."""
    size = np.array([info.width, info.height])
    visible = visible & ((pinhole_px > -margin * size) & (pinhole_px < (1 + margin) * size)).all(axis=1)
    return [distort_points(info, piece) for piece in runs(pinhole_px, visible)]


def _write_image(path: Path, canvas: np.ndarray, *options: int) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(cv2.imencode(path.suffix, canvas, options)[1].tobytes())
