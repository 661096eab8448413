"""The pictures of a drive's check, which show a person the rest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from v2hdm.detection.frames import read_bgr
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.planar import length_along
from v2hdm.ground.motion import trajectory_of_images
from v2hdm.ground.results import GroundEstimate
from v2hdm.records import Drive, FloatArray, Trajectory
from v2hdm.report import style
from v2hdm.report.coverage import ENOUGH_VIEWS, coverage_of
from v2hdm.report.photos import save_grid
from v2hdm.report.weak import thin_stretches

_PICTURES = 3  # sample images of each camera: near the start, in the middle and near the end
_ARROWS = 30  # arrows along the route: enough to see a heading go wrong, few enough to see each
_MOST_POINTS = 5000  # points of the line that is drawn


def ground_seen(drive: Drive, ground: Mapping[str, GroundEstimate]) -> list[str]:
    """How much ground the images show how finely, and where to drive again: a line each."""
    coverage = coverage_of(drive, {name: _mountings(drive, ground, name)[-1] for name in drive.cameras})
    if not coverage.covered_m2:
        return []
    sample_mm = 1000 * coverage.sample_of_covered_m()
    of_images = (
        f"ground: {coverage.covered_m2:,.0f} m2 seen in {ENOUGH_VIEWS} images or more, as if nothing stood "
        f"there, at {sample_mm:.0f} mm a pixel"
    )
    return [
        of_images,
        *(f"drive again: {stretch.says}" for stretch in thin_stretches(coverage, drive.route_map)),
    ]


def _mountings(drive: Drive, ground: Mapping[str, GroundEstimate], name: str) -> list[FloatArray]:
    """The guessed mounting (4, 4) of a camera, and the one that bare ground shows, if it shows any."""
    mountings = [initial_extrinsic(drive.cameras[name])]
    calibration = ground[name].calibration if name in ground else None
    return mountings if calibration is None else [*mountings, calibration.cam_from_vehicle]


def draw_check(drive: Drive, folder: Path, ground: Mapping[str, GroundEstimate]) -> None:
    """Draw the route, and the metric grid of guess and ground estimate in sample images of every camera."""
    _save_route(folder / "route.png", drive.recorded or drive.trajectory or trajectory_of_images(drive))
    for name, camera in drive.cameras.items() if drive.has_pictures else ():
        images = [image for image in drive.images if image.camera == name]
        mountings = dict(zip(("guess", "ground"), _mountings(drive, ground, name), strict=False))
        for number in range(_PICTURES):
            image = images[(2 * number + 1) * len(images) // (2 * _PICTURES)]
            caption = f"{name}, {image.stamp_s:.2f} s"
            path = folder / f"{name}_{number + 1}.jpg"
            save_grid(path, read_bgr(image.path), camera, mountings, caption)


def _save_route(path: Path, trajectory: Trajectory) -> None:
    """Draw where the vehicle was, how fast, and where its x axis pointed."""
    stride = -(-len(trajectory.stamp_s) // _MOST_POINTS)
    stamp_s = trajectory.stamp_s[::stride]
    poses = trajectory.map_from_vehicle[::stride]
    place = poses[:, :2, 3]
    with style.figure(path, 8.0, 6.0) as fig:
        axes = fig.subplots()
        if len(place) > 1:
            segments = np.stack([place[:-1], place[1:]], axis=1)
            speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(stamp_s)
            line = LineCollection(list(segments), array=speed, cmap="cividis", lw=8, capstyle="round")
            line.set_clim(0.0, max(float(np.percentile(speed, 99)), 1e-9))
            axes.add_collection(line)
            fig.colorbar(line, ax=axes, shrink=0.7, label="speed (m/s)")
        _draw_headings(axes, poses)
        axes.plot(place[0, 0], place[0, 1], "o", color="white", mec="#1b1e21", ms=9, zorder=4, label="start")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set(xlabel="x: east (m)", ylabel="y: north (m)")
        axes.set_title("Route as recorded; arrows: the vehicle's x axis")
        fig.legend(loc="outside lower left")


def _draw_headings(axes: Axes, poses: FloatArray) -> None:
    """Arrows at even distances along the path, each a twentieth of the route's extent long."""
    place = poses[:, :2, 3]
    way = length_along(place)
    chosen = np.unique(np.searchsorted(way, np.linspace(0, way[-1], _ARROWS)))
    length = 0.05 * max(float(np.ptp(place, axis=0).max()), 1e-9)
    look: dict[str, Any] = {"color": "white", "edgecolor": "#1b1e21", "linewidth": 0.7, "width": 0.0028}
    x, y = place[chosen].T
    right, up = (length * poses[chosen, :2, 0]).T
    axes.quiver(x, y, right, up, angles="xy", scale_units="xy", scale=1, zorder=3, **look)
