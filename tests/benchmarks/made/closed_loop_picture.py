"""The picture of a van that drove by the localiser's pose alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import NDArray

from tests.benchmarks.made.closed_loop import Lap, Site, render
from tests.benchmarks.made.van import Van, outlines
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import inverse
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.report.style import GRID, OKABE_ITO, TRUTH, figure

_VIEW_M = np.array([19.0, 11.0])  # half width and half height of the ground that the plan shows
_OUTLINE_S = 2.0  # time between two outlines of the van
_ASKED_CM = 10.0  # largest distance from the planned path that is asked for
_NEAR_M, _FAR_M = 1.0, 25.0  # depths of the markings that are drawn in the image


def draw(drives: Sequence[tuple[Site, Sequence[Lap]]], path: Path) -> None:
    """Draw an image with the map at the localiser's pose, a bend from above, and all distances, as PNG."""
    site, laps = drives[-1]
    step = _in_bend(laps[0])
    with figure(path, 10.0, 8.2) as sheet:
        grid = sheet.add_gridspec(2, 2, height_ratios=[1.05, 1.0])
        image = sheet.add_subplot(grid[0, 0])
        image.imshow(_image(site, laps[0], step))
        image.set_axis_off()
        image.set_title("Rendered where the van is, the map drawn at its pose", fontsize=10)
        _plan(sheet.add_subplot(grid[0, 1]), site, laps[0], step)
        _distances(sheet.add_subplot(grid[1, :]), [part for _, parts in drives for part in parts])


def _in_bend(lap: Lap) -> int:
    """The step amid the first bend."""
    turn_rad = np.abs(np.gradient(np.unwrap(lap.poses[:, 2])))
    bends = turn_rad > 0.5 * turn_rad.max()
    first = int(bends.argmax())
    return first + int((~bends[first:]).argmax()) // 2


def _image(site: Site, lap: Lap, step: int) -> NDArray[np.uint8]:
    """The front camera's image (H, W, 3), RGB, with the map's markings and borders where they should be."""
    place, heading = lap.poses[step, :2], float(lap.poses[step, 2])
    van = Van(np.random.default_rng(0), place, heading, stamp_s=float(lap.stamp_s[step]))
    image = render(site, "front", van, np.random.default_rng(0))
    cam_from_map = site.port.cam_from_vehicle["front"] @ inverse(lap.located[step])
    info = site.port.cameras["front"].info
    for lane in site.port.hd_map.lanes:
        _draw_line(image, info, cam_from_map, lane.points_map, (90, 200, 255), closed=False)
    for marking in site.port.hd_map.markings:
        _draw_line(image, info, cam_from_map, marking.corners_map, (80, 220, 80), closed=True)
    return np.asarray(image[..., ::-1])


def _draw_line(
    image: NDArray[np.uint8], info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray,
    colour: tuple[int, int, int], closed: bool,
) -> None:  # fmt: skip
    points_cam = points_map @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
    is_shown = (points_cam[:, 2] > _NEAR_M) & (points_cam[:, 2] < _FAR_M)
    if is_shown.sum() < 2 or (closed and not is_shown.all()):
        return
    pinhole = points_cam[is_shown] @ info.intrinsic.T
    px = distort_points(info, pinhole[:, :2] / pinhole[:, 2:])
    if not (np.abs(px) < 4 * info.width).all():
        return
    cv2.polylines(image, [np.round(16 * px).astype(np.int32)], closed, colour, 2, cv2.LINE_AA, 4)


def _plan(axes: Axes, site: Site, lap: Lap, step: int) -> None:
    """The van in a bend, from above."""
    centre = lap.poses[step, :2]
    hd_map = site.port.hd_map
    axes.add_collection(LineCollection([lane.points_map for lane in hd_map.lanes], colors=TRUTH, lw=1.2))
    shapes = [marking.corners_map for marking in hd_map.markings]
    axes.add_collection(PolyCollection(shapes, facecolors=GRID, edgecolors=TRUTH, lw=0.5))
    every = round(_OUTLINE_S / float(np.median(np.diff(lap.stamp_s))))
    rows = np.arange(step % every, len(lap.poses), every)
    axes.add_collection(
        PolyCollection(list(outlines(lap.poses[rows])), facecolors="none", edgecolors=OKABE_ITO["sky"], lw=1)
    )
    axes.plot(
        *site.path.points_map.T, color="#2d3439", lw=0.9, ls=(0, (5, 3)), label="planned: recorded by RTK"
    )
    axes.plot(
        *lap.poses[:, :2].T, color=OKABE_ITO["vermillion"], lw=1.4, label="driven by the localiser's pose"
    )
    axes.set_xlim(centre[0] - _VIEW_M[0], centre[0] + _VIEW_M[0])
    axes.set_ylim(centre[1] - _VIEW_M[1], centre[1] + _VIEW_M[1])
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.17), fontsize=8.5, ncols=2)


def _distances(axes: Axes, laps: Sequence[Lap]) -> None:
    """How far the van was from the planned path, by its way."""
    km = sum(part.km for part in laps)
    for part in laps:
        steps_m = np.linalg.norm(np.diff(part.poses[:, :2], axis=0), axis=1)
        way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        axes.plot(way_m, 100 * part.left_m, lw=0.7, color=OKABE_ITO["blue"], alpha=0.55)
    for side in (-1, 1):
        axes.axhline(side * _ASKED_CM, color=OKABE_ITO["vermillion"], lw=1, ls=(0, (5, 3)))
    axes.axhline(0.0, color=TRUTH, lw=0.8)
    axes.set_ylim(-1.2 * _ASKED_CM, 1.2 * _ASKED_CM)
    axes.set_xlim(0.0, None)
    axes.set_xlabel("way, m")
    axes.set_ylabel("left of the planned path, cm")
    axes.set_title(f"{len(laps)} laps of both ports, {km:.1f} km; asked: 10 cm", fontsize=10)
