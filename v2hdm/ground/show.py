"""An estimate in words, and a picture of the matched ground under the guess and under the estimate."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.geometry.mounting import mounting_words
from v2hdm.ground.model import Mount, guessed_mount, hit_ground
from v2hdm.ground.patches import Sheet, View, read_grey
from v2hdm.ground.results import GroundEstimate, GroundStatus, MatchedGround, Reading
from v2hdm.records import Drive, FloatArray

# Each parameter's name, and the factor and unit that people read it in.
_NAMES = {
    "clock_s": ("clock", 1e3, "ms"),
    "focal_scale": ("focal length", 1e2, "%"),
    "distortion_k1": ("distortion k1", 1.0, ""),
    "grade": ("grade of the poses", 1e2, "%"),
    "up_m": ("centre up", 1e2, "cm"),
    "forward_m": ("centre forward", 1e2, "cm"),
    "left_m": ("centre left", 1e2, "cm"),
}

_WHY = {
    GroundStatus.NO_MATCH: "the ground does not match between images: check poses, clock and guess",
    GroundStatus.NO_TEXTURE: "the ground is too dark or too even to be found again: drive in better light",
    GroundStatus.TOO_LITTLE: "too little ground is seen by two images: drive further, or widen roi_vehicle",
}

_GRID_M = 0.02
_MARGIN_M = 0.6
_LONGER = 5  # arrows are drawn so many times as long as what they show
_ARROW = (60, 60, 230)
_GAP_PX = 12
_TITLE_PX = 30


def lines(estimate: GroundEstimate) -> Iterator[str]:
    """The estimate for a terminal: a line of figures, and one for each quantity that is not observable."""
    calibration = estimate.calibration
    if calibration is None or calibration.covariance is None:
        reading = estimate.reading
        other = "" if reading is Reading.AS_GIVEN else f"; it does with the poses read as: {reading.value}"
        yield f"{estimate.camera}: {_WHY[estimate.status]}{other}"
        return
    angles, place = mounting_words(calibration.cam_from_vehicle, calibration.covariance)
    yield f"{estimate.camera}: {', '.join((*angles, place[2]))}"
    found = []
    for parameter in estimate.parameters.values():
        if parameter.observable:
            name, factor, unit = _NAMES[parameter.name]
            value, sigma = factor * parameter.value, factor * parameter.sigma
            found.append(f"{name} {value:+.2g} +- {sigma:.2g} {unit}".rstrip())
    if found:
        yield f"  beside it: {', '.join(found)}"
    for parameter in estimate.parameters.values():
        if not parameter.observable:
            yield f"  cannot tell {_NAMES[parameter.name][0]}: {parameter.why_not}"


def draw_matched_ground(drive: Drive, estimate: GroundEstimate) -> NDArray[np.uint8] | None:
    """The pair with most matches, under the guess and under the estimate side by side; BGR.

    Both with the estimated errors of the two poses, so that the mounting makes the difference. Orange and
    blue are the two images: where they agree the ground is grey. An arrow leads from a patch in the first
    image to its partner in the second, five times as long. None without an estimate.
    """
    if estimate.calibration is None or estimate.patches is None:
        return None
    guess = guessed_mount(drive.cameras[estimate.camera])
    found = Mount.at(guess.info, estimate.calibration.cam_from_vehicle)
    panels = [
        _panel(drive, estimate.patches, mount, title)
        for title, mount in (("guess", guess), ("estimate", found))
    ]
    height = max(panel.shape[0] for panel in panels)
    padded = [
        cv2.copyMakeBorder(p, 0, height - p.shape[0], 0, _GAP_PX, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for p in panels
    ]
    return np.hstack(padded).astype(np.uint8)


def _panel(drive: Drive, patches: MatchedGround, mount: Mount, title: str) -> NDArray[np.uint8]:
    number = int(np.argmax(np.bincount(patches.pair)))
    own, poses = patches.pair == number, patches.pair_poses[number]
    hits = [
        hit_ground(mount, px[own], np.tile(pose, (int(own.sum()), 1, 1))).points_map
        for px, pose in zip((patches.first_px, patches.second_px), poses, strict=True)
    ]
    known = hits[0][np.isfinite(hits[0]).all(axis=1)]
    sheet, _ = Sheet.around(known, poses[0], round(_MARGIN_M / _GRID_M), _GRID_M)
    layers = []
    for image, pose in zip(patches.pair_images[number].tolist(), poses, strict=True):
        grey, seen = sheet.resample(View(read_grey(str(drive.images[image].path)), mount, pose))
        low, high = np.percentile(grey[seen], (1, 99)) if seen.any() else (0.0, 255.0)
        layers.append(np.where(seen, np.clip((grey - low) / max(high - low, 1.0), 0, 1), 0.5))
    # Orange on blue: blue and red channels from one image each, green from both.
    first, second = layers
    panel = (255 * np.stack([first, (first + second) / 2, second], axis=-1)).astype(np.uint8)
    panel = np.ascontiguousarray(panel[::-1, ::-1])
    _arrows(panel, sheet, *hits)
    rms_cm = 100 * float(np.sqrt(np.nanmean(np.sum((hits[1] - hits[0]) ** 2, axis=1))))
    head = np.full((_TITLE_PX, panel.shape[1], 3), 255, dtype=np.uint8)
    text = f"{title}: {rms_cm:.1f} cm"
    cv2.putText(head, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([head, panel])


def _arrows(panel: NDArray[np.uint8], sheet: Sheet, first_map: FloatArray, second_map: FloatArray) -> None:
    rows, columns = sheet.shape

    def place(points_map: FloatArray) -> FloatArray:
        cells = (points_map - sheet.corner_map) @ sheet.axes.T / sheet.grid_m
        return np.column_stack([columns - 1 - cells[:, 1], rows - 1 - cells[:, 0]])

    start = place(first_map)
    end = start + _LONGER * (place(second_map) - start)
    for ends in np.stack([start, end], axis=1):
        if np.isfinite(ends).all():
            tail, tip = np.round(ends).astype(int).tolist()
            cv2.arrowedLine(panel, tail, tip, _ARROW, 2, cv2.LINE_AA, tipLength=0.25)
