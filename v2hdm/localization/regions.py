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
_MOST = 9  # markings that are looked for: of more, few say anything new of a vehicle's six unknowns
_LEAST = 4  # markings with which a look is worth it; where fewer are expected, all is searched
_AROUND_M = 0.4  # way, m, around a marking that is looked at: it may have been painted again beside
_AROUND_PX = 8.0  # px beside
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
        self.was_as_expected = found >= _FOUND * self.expected

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
    chosen = _spread_out(expected.depth_m[rows].mean(axis=1))
    if len(chosen) < _LEAST:
        return None
    rows = rows[chosen]
    corners_px = corners_px[chosen]
    spread_px = np.linalg.norm(scene.spread(belief, expected, numbers)[rows], axis=2).max(axis=1)
    px_by_m = np.linalg.norm(expected.by_place[rows], axis=(2, 3)).max(axis=1)
    around_m = _AROUND_M + EARLY_S * abs(speed_m_s)
    around_px = _AROUND_PX + _SIGMAS * spread_px + around_m * px_by_m
    low = corners_px.min(axis=1) - around_px[:, None]
    high = corners_px.max(axis=1) + around_px[:, None]
    return np.concatenate([low, high], axis=1)


def _spread_out(distance_m: FloatArray) -> IntArray:
    """Some of the markings at distances (M,), near and far."""
    order = np.argsort(distance_m)
    places = np.linspace(0, len(order) - 1, min(_MOST, len(order)))
    return np.asarray(order[np.unique(places.round().astype(np.int64))])
