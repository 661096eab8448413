"""What belongs to a camera: the points of its manual calibration, and its residuals over the image."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes

from v2hdm.experiment.figures.look import LINK, drive_of
from v2hdm.experiment.residuals import CELLS
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo
from v2hdm.report import style
from v2hdm.report.camera_grid import project_line

_ROI = "#0b7a75"
_ARROW_SHARE = 0.8
"""Share of a cell's width that the longest arrow of a field takes."""


def save_calibration(path: Path, record: Mapping[str, Any], pictures: Path) -> str | None:
    """Draw the clicked and surveyed points and the region of interest; returns the caption."""
    cameras = record["cameras"]
    with style.figure(path, 13.0, 4.3 * len(cameras)) as fig:
        panels = fig.subplots(len(cameras), 2, squeeze=False, width_ratios=[1.5, 1])
        for row, (name, camera) in enumerate(cameras.items()):
            _draw_image(panels[row, 0], camera, pictures)
            _draw_ground(panels[row, 1], camera)
            panels[row, 0].set_title(f"{drive_of(record)}, {name}: as clicked")
            panels[row, 1].set_title(f"{name}: as surveyed")
        panels[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    count = [len(camera["clicked_px"]) for camera in cameras.values() if camera["clicked_px"] is not None]
    points = f"The {count[0]} points" if count else "No points are known"
    started = sorted({camera["initial_ipm"] for camera in cameras.values()})
    return (
        f"{points} of the manual calibration of {drive_of(record)}: numbered as clicked in the image (px), "
        "and as surveyed on the ground in the vehicle's frame (m; x forward, y left). The teal line is "
        "the region of interest within which the IPM that the mapping starts from "
        f"({' and '.join(started)}) is trusted. See that the points span the ground that the naive methods "
        "use, and that the far ones are clicked where a pixel is decimetres long."
    )


def _draw_image(axes: Axes, camera: Mapping[str, Any], pictures: Path) -> None:
    image = cv2.imread(str(pictures / camera["picture"]))
    info = info_of(camera)
    if image is not None:
        axes.imshow(image[..., ::-1])
    roi = np.array(camera["roi_vehicle"])
    closed = np.vstack([roi, roi[:1]])
    dense = np.concatenate([np.linspace(a, b, 40) for a, b in itertools.pairwise(closed)])
    for piece in project_line(info, np.array(camera["true_cam_from_vehicle"]), dense):
        axes.plot(*piece.T, color=_ROI, lw=2.5)
    if camera["clicked_px"] is not None:
        clicked = np.array(camera["clicked_px"])
        axes.plot(*clicked.T, "+", color=LINK, ms=11, mew=2)
        for number, point in enumerate(clicked, 1):
            axes.annotate(
                str(number), point, xytext=(6, 4), textcoords="offset points", color="white", weight="bold",
                bbox={"facecolor": "black", "alpha": 0.55, "pad": 1.0, "lw": 0}, fontsize=8,
            )  # fmt: skip
    axes.set_xlim(-0.5, info.width - 0.5)
    axes.set_ylim(info.height - 0.5, -0.5)
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")


def _draw_ground(axes: Axes, camera: Mapping[str, Any]) -> None:
    roi = np.array(camera["roi_vehicle"])
    axes.plot(*np.vstack([roi, roi[:1]]).T, color=_ROI, lw=2.5, label="region of interest")
    if camera["surveyed_vehicle"] is not None:
        surveyed = np.array(camera["surveyed_vehicle"])
        axes.plot(*surveyed.T, "+", color=LINK, ms=11, mew=2, label="surveyed point")
        for number, point in enumerate(surveyed, 1):
            axes.annotate(str(number), point, xytext=(6, 4), textcoords="offset points", fontsize=8)
    centre = camera_centre(np.array(camera["true_cam_from_vehicle"]))
    axes.plot(*centre[:2], "k^", ms=8, label="camera")
    axes.plot(0, 0, "ko", mfc="white", ms=7, label="rear axle")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.set_xlabel("x: forward (m)")
    axes.set_ylabel("y: left (m)")


def save_fields(path: Path, record: Mapping[str, Any]) -> str | None:
    """Draw the median residuals over the image, before and after; returns the caption."""
    cameras = record.get("residuals")
    if not cameras:
        return None
    told = []
    with style.figure(path, 13.0, 4.2 * len(cameras)) as fig:
        panels = fig.subplots(len(cameras), 2, squeeze=False)
        for row, (name, found) in enumerate(cameras.items()):
            field, lengths = found["field"], []
            for column, when in enumerate(("before", "after")):
                _draw_field(panels[row, column], field[when], field["size_px"])
                length = field[when]["length_px"]
                lengths.append("-" if length is None else f"{length:.2f} px")
                panels[row, column].set_title(f"{drive_of(record)}, {name}: {when}, {lengths[-1]}")
            told.append(f"{name} from {lengths[0]} to {lengths[1]}")
    return (
        "Median residual of detected corners against the optimised map by cell of the image, "
        f"{drive_of(record)}: before, under the IPM that the mapping started from and the recorded poses; "
        "after, under the optimised extrinsic and the adjusted poses. Axes in px of the image without "
        "distortion. The arrow above each panel gives its scale, which differs between panels; cells "
        "without an arrow hold too few corners. The median length of all residuals falls: "
        f"{', '.join(told)}. See that before the arrows run along with each other, as under a turned "
        "camera, and look for any such order that is left after."
    )


def _draw_field(axes: Axes, field: Mapping[str, Any], size_px: tuple[int, int]) -> None:
    width, height = size_px
    cell = np.array([width / CELLS[0], height / CELLS[1]])
    places, arrows = [], []
    for index, mean in enumerate(field["median_px"]):
        if mean is not None:
            places.append((np.array([index % CELLS[0], index // CELLS[0]]) + 0.5) * cell)
            arrows.append(mean)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_xticks(np.arange(CELLS[0] + 1) * cell[0])
    axes.set_yticks(np.arange(CELLS[1] + 1) * cell[1])
    axes.grid(color="#e6eaed")
    axes.set_axisbelow(True)
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")
    if not arrows:
        return
    longest = float(np.linalg.norm(arrows, axis=1).max())
    scale = max(longest, 1e-6) / (_ARROW_SHARE * cell[0])
    drawn = axes.quiver(
        *np.array(places).T, *np.array(arrows).T, angles="xy", scale_units="xy", scale=scale, width=0.004,
        color=LINK, pivot="mid",
    )  # fmt: skip
    round_px = float(f"{longest:.1g}")
    axes.quiverkey(drawn, 0.85, 1.06, round_px, f"{round_px:g} px", labelpos="E")


def info_of(camera: Mapping[str, Any]) -> CameraInfo:
    """The intrinsics in a record."""
    plain = dict(camera["info"])
    return CameraInfo(
        **plain | {"intrinsic": np.array(plain["intrinsic"]), "distortion": tuple(plain["distortion"])}
    )
