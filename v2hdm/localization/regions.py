"""Where in its next image a camera should look, once the map says what it will show there.

A tracked map settles most of what an image shows. Between two full searches only some of the markings that it
expects are looked at, spread over the distance, in boxes around where they should be.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from v2hdm.geometry.lens import distort_points
from v2hdm.localization.belief import HEADING, Belief
from v2hdm.localization.joint import Scene
from v2hdm.records import FloatArray, IntArray

EVERY_FULL = 5
"""Of so many images of a camera, one is searched as a whole: at 10 Hz every half second."""

_RANGE_M = 20.0  # distance, m, up to which markings are found at almost every look
_MOST = 8  # markings that are looked for: of more, few say anything new of a vehicle's six unknowns
_LEAST = 4  # markings with which a look is worth it; where fewer are expected, all is searched
_MOST_SHARE = 0.16  # share of the image that is looked at
_HALVES = (0.0, 1.0, *(numerator / 2**power for power in range(1, 5) for numerator in range(1, 2**power, 2)))
_AROUND_M = 0.25  # way, m, around a marking that is looked at
_AROUND_PX = 6.0  # px beside
_SIGMAS = 4.0  # of the place in the image, beside
EARLY_S = 0.05
"""Time, s, by which an image may be taken earlier or later than it was expected."""

_BESIDE = 0.25  # share of an image's size beside it, up to which a lens' polynomial is taken at its word
_SURE_M, _SURE_RAD = 0.15, np.deg2rad(1.0)  # standard deviations of a place that is known well enough
_FOUND = 0.6  # share of the markings looked for, from which the last look was as expected


@dataclass
class Glances:
    """What is known of one camera's looks: how many since a full search, and how they went."""

    since_full: int
    expected: int = 0
    was_as_expected: bool = False

    def note(self, found: int) -> None:
        """Take the number of markings that an image showed."""
        self.was_as_expected = found >= _FOUND * max(self.expected, _LEAST)

    def is_full_due(self, every_full: int) -> bool:
        """Whether the next image is to be searched as a whole."""
        return not self.was_as_expected or self.since_full + 1 >= every_full


@dataclass
class Looking:
    """When each camera looks at all of an image, by name: not all at the same time."""

    every_full: int
    glances: dict[str, Glances] = field(default_factory=dict)

    def of(self, camera: str) -> Glances:
        """The looks of a camera."""
        if camera not in self.glances:
            count = len(self.glances)
            self.glances[camera] = Glances(since_full=(count * self.every_full) // 2 % self.every_full)
        return self.glances[camera]

    def regions(
        self, camera: str, belief: Belief | None, scene: Scene | None, speed_m_s: float
    ) -> FloatArray | None:
        """Boxes (R, 4) for the next image of a camera, px; None for all of it.

        ``belief`` is that of the image's time, None where nothing is sure; ``scene`` has its camera.
        """
        glances = self.of(camera)
        expected = None
        if belief is not None and scene is not None and not glances.is_full_due(self.every_full):
            expected = expected_boxes(belief, scene, speed_m_s)
        if expected is None:
            glances.since_full = 0
            glances.expected = 0
            return None
        glances.since_full += 1
        glances.expected = len(expected)
        return expected


def expected_boxes(belief: Belief, scene: Scene, speed_m_s: float) -> FloatArray | None:
    """Boxes (R, 4) around markings that an image should show whole; None where these are too few.

    None also where the place is not known well enough.
    """
    turn_rad = float(np.linalg.norm(belief.root[HEADING]))
    if belief.sigma_m > _SURE_M or turn_rad > _SURE_RAD:
        return None
    numbers = scene.paint.near(belief.mean[:2], _RANGE_M + _AROUND_M)
    if not len(numbers):
        return None
    expected = scene.expect(belief, numbers)
    info = scene.calibration.info
    size = np.array([info.width, info.height])
    # Far beside the image a lens' polynomial folds back; behind the camera a point is nan.
    is_near = (expected.px > -_BESIDE * size) & (expected.px < (1 + _BESIDE) * size)
    rows = np.flatnonzero(is_near.all(axis=(1, 2)))
    corners_px = distort_points(info, expected.px[rows].reshape(-1, 2)).reshape(-1, 4, 2)
    is_whole = ((corners_px > 0) & (corners_px < size - 1)).all(axis=(1, 2))
    rows = rows[is_whole]
    corners_px = corners_px[is_whole]
    spread_px = np.linalg.norm(scene.spread(belief, expected, numbers)[rows], axis=2).max(axis=1)
    by_place = expected.by_place[rows]
    px_by_m = np.linalg.norm(by_place, axis=(2, 3)).max(axis=1)
    around_px = _AROUND_PX + _SIGMAS * spread_px + _AROUND_M * px_by_m
    ahead_map = np.array([np.cos(belief.mean[HEADING]), np.sin(belief.mean[HEADING])])
    early_px = EARLY_S * abs(speed_m_s) * np.abs(by_place @ ahead_map).max(axis=1)
    low = corners_px.min(axis=1) - around_px[:, None] - early_px
    high = corners_px.max(axis=1) + around_px[:, None] + early_px
    boxes = np.concatenate([low, high], axis=1)
    chosen = _spread_out(boxes, expected.depth_m[rows].mean(axis=1), _MOST_SHARE * info.width * info.height)
    return boxes[chosen] if len(chosen) >= _LEAST else None


def _spread_out(boxes_px: FloatArray, distance_m: FloatArray, most_px2: float) -> IntArray:
    """Some of the markings in boxes (M, 4) at distances (M,), near and far, on not too large an area."""
    order = np.argsort(distance_m)
    area_px2 = np.prod(boxes_px[:, 2:] - boxes_px[:, :2], axis=1)
    chosen: list[int] = []
    left_px2 = most_px2
    # The nearest and the farthest, what is midway between them, then between those, and so on.
    for share in _HALVES:
        row = int(order[round(share * (len(order) - 1))]) if len(order) else -1
        if row >= 0 and row not in chosen and len(chosen) < _MOST and area_px2[row] < left_px2:
            chosen.append(row)
            left_px2 -= float(area_px2[row])
    return np.array(chosen, dtype=np.int64)
