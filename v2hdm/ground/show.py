"""An estimate in words: one line of figures, and a line for each thing that a drive cannot tell.

The matched ground of one pair of images, laid out from above under the guess and under the estimate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.geometry.mounting import angle_sigmas, mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.ground.model import Mount, guessed_mount, hit_ground
from v2hdm.ground.patches import Sheet, View, read_grey
from v2hdm.ground.results import GroundEstimate, GroundStatus, MatchedGround, Reading
from v2hdm.records import Drive, FloatArray

_NAMES = {
    "clock_s": ("clock", 1e3, "ms"),
    "focal_scale": ("focal length", 1e2, "%"),
    "distortion_k1": ("distortion k1", 1.0, ""),
    "grade": ("grade of the poses", 1e2, "%"),
    "up_m": ("centre up", 1e2, "cm"),
    "forward_m": ("centre forward", 1e2, "cm"),
    "left_m": ("centre left", 1e2, "cm"),
}
"""What each parameter is called, and the factor and unit that people read it in."""

_WHY = {
    GroundStatus.NO_MATCH: "the ground does not match between images: check poses, clock and guess",
    GroundStatus.TOO_LITTLE: "too little ground is seen by two images: drive further, or widen roi_vehicle",
}


def lines(estimate: GroundEstimate) -> Iterator[str]:
    """What the terminal shows of one camera."""
    calibration = estimate.calibration
    if calibration is None or calibration.covariance is None:
        reading = estimate.reading
        other = "" if reading is Reading.AS_GIVEN else f"; it does with the poses read as: {reading.value}"
        yield f"{estimate.camera}: {_WHY[estimate.status]}{other}"
        return
    matrix = calibration.cam_from_vehicle
    angles = np.rad2deg(mounting_angles(matrix))
    sigmas = np.rad2deg(angle_sigmas(matrix, calibration.covariance))
    height_m = camera_centre(matrix)[2]
    up = matrix[:3, 2]
    height_sigma_m = float(np.sqrt(up @ calibration.covariance[:3, :3] @ up))
    parts = [
        f"{name} {angle:.2f} +- {sigma:.2f} deg"
        for name, angle, sigma in zip(("roll", "pitch", "yaw"), angles, sigmas, strict=True)
    ]
    parts.append(f"height {height_m:.3f} +- {height_sigma_m:.3f} m")
    yield f"{estimate.camera}: {', '.join(parts)}"
    told = [p for p in estimate.parameters.values() if p.told]
    if told:
        yield "  beside it: " + ", ".join(
            f"{_NAMES[p.name][0]} {_NAMES[p.name][1] * p.value:+.2g} +- "
            f"{_NAMES[p.name][1] * p.sigma:.2g} {_NAMES[p.name][2]}".rstrip()
            for p in told
        )
    for parameter in estimate.parameters.values():
        if not parameter.told:
            yield f"  cannot tell {_NAMES[parameter.name][0]}: {parameter.why_not}"


_GRID_M = 0.02
_MARGIN_M = 0.6
_LONGER = 5
"""Arrows are drawn so many times as long as what they show."""

_ARROW = (60, 60, 230)
_GAP_PX = 12
_TITLE_PX = 30


@dataclass(frozen=True)
class _Pair:
    """One pair: indices into the drive's images, estimated poses (2, 4, 4) and the matches' pixels (N, 2)."""

    images: tuple[int, int]
    poses: FloatArray
    first_px: FloatArray
    second_px: FloatArray


def draw_matched_ground(drive: Drive, estimate: GroundEstimate) -> NDArray[np.uint8] | None:
    """The pair with most matches, under the guess and under the estimate side by side; BGR.

    Both with the estimated errors of the two poses, so that the mounting makes the difference. Orange and
    blue are the two images: where they agree the ground is grey. An arrow leads from where the first image
    sees a patch to where the second sees it, five times as long. None without an estimate.
    """
    if estimate.calibration is None or estimate.patches is None:
        return None
    pair = _fullest(estimate.patches)
    guess = guessed_mount(drive.cameras[estimate.camera])
    matrix = estimate.calibration.cam_from_vehicle
    turn = matrix[:3, :3].T
    found = Mount(guess.info, turn, -turn @ matrix[:3, 3])
    panels = []
    for title, mount in (("guess", guess), ("estimate", found)):
        panels.append(_panel(drive, pair, mount, title))
    height = max(panel.shape[0] for panel in panels)
    padded = [
        cv2.copyMakeBorder(p, 0, height - p.shape[0], 0, _GAP_PX, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for p in panels
    ]
    return np.hstack(padded).astype(np.uint8)


def _fullest(patches: MatchedGround) -> _Pair:
    number = int(np.argmax(np.bincount(patches.pair)))
    own = patches.pair == number
    first, second = (int(image) for image in patches.pair_images[number])
    return _Pair((first, second), patches.pair_poses[number], patches.first_px[own], patches.second_px[own])


def _panel(drive: Drive, pair: _Pair, mount: Mount, title: str) -> NDArray[np.uint8]:
    images = [drive.images[k] for k in pair.images]
    hits = [
        hit_ground(mount, px, np.tile(pose, (len(px), 1, 1))).points_map
        for px, pose in zip((pair.first_px, pair.second_px), pair.poses, strict=True)
    ]
    sheet = _sheet(hits[0], pair.poses[0])
    layers = []
    for image, pose in zip(images, pair.poses, strict=True):
        grey, seen = sheet.lay(View(read_grey(str(image.path)), mount, pose))
        low, high = np.percentile(grey[seen], (1, 99)) if seen.any() else (0.0, 255.0)
        layers.append(np.where(seen, np.clip((grey - low) / max(high - low, 1.0), 0, 1), 0.5))
    # Orange on blue: blue and red channels from one image each, green from both.
    first, second = layers
    panel = (255 * np.stack([first, (first + second) / 2, second], axis=-1)).astype(np.uint8)
    panel = np.ascontiguousarray(panel[::-1, ::-1])
    _arrows(panel, sheet, *hits)
    rms_cm = 100 * float(np.sqrt(np.nanmean(np.sum((hits[1] - hits[0]) ** 2, axis=1))))
    head = np.full((_TITLE_PX, panel.shape[1], 3), 255, dtype=np.uint8)
    cv2.putText(
        head, f"{title}: {rms_cm:.1f} cm", (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA
    )
    return np.vstack([head, panel])


def _sheet(points_map: FloatArray, pose: FloatArray) -> Sheet:
    """A sheet around points, aligned with a pose: rows ahead, columns to the left."""
    forward = pose[:2, 0] / np.linalg.norm(pose[:2, 0])
    axes = np.array([forward, [-forward[1], forward[0]]])
    along = points_map @ axes.T
    low, high = np.nanmin(along, axis=0) - _MARGIN_M, np.nanmax(along, axis=0) + _MARGIN_M
    rows, columns = np.ceil((high - low) / _GRID_M).astype(int)
    return Sheet(low @ axes, axes, _GRID_M, (int(rows), int(columns)))


def _arrows(panel: NDArray[np.uint8], sheet: Sheet, first_map: FloatArray, second_map: FloatArray) -> None:
    rows, columns = sheet.shape

    def place(points_map: FloatArray) -> FloatArray:
        cells = (points_map - sheet.corner_map) @ sheet.axes.T / sheet.grid_m
        return np.column_stack([columns - 1 - cells[:, 1], rows - 1 - cells[:, 0]])

    start = place(first_map)
    end = start + _LONGER * (place(second_map) - start)
    for a, b in zip(start, end, strict=True):
        if np.isfinite(a).all() and np.isfinite(b).all():
            cv2.arrowedLine(
                panel, tuple(np.round(a).astype(int).tolist()), tuple(np.round(b).astype(int).tolist()),
                _ARROW, 2, cv2.LINE_AA, tipLength=0.25,
            )  # fmt: skip
