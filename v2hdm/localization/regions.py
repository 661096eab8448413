"""Where in its next image a camera should look, once the map says what it will show there.

A tracked map settles most of what an image shows. Between two full searches only some of the markings that it
expects are looked at, spread over the distance, in boxes around where they should be.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.lens import distort_points
from v2hdm.localization.belief import HEADING, Belief
from v2hdm.localization.joint import Scene
from v2hdm.localization.seeing import Expected
from v2hdm.records import FloatArray, IntArray

EVERY_FULL = 5
"""One of so many images of a camera is searched as a whole: at 10 Hz every half second."""

_RANGE_M = 20.0  # distance, m, up to which markings are found at almost every look
_MOST = 8  # markings that are looked for: of more, few say anything new of a vehicle's six unknowns
_LEAST = 4  # least expected markings to search regions alone; with fewer, whole images may be searched
_MOST_SHARE = 0.16  # share of the image that is looked at
# Ranks of markings by distance, in parts of their number, in the order in which they are chosen.
_HALVES = (0.0, 1.0, *(numerator / 2**power for power in range(1, 5) for numerator in range(1, 2**power, 2)))
_AROUND_M = 0.25  # way, m, around a marking that is looked at
_AROUND_PX = 6.0  # px beside
_SIGMAS = 4.0  # of the place in the image, beside
EARLY_S = 0.05
"""Largest difference, s, between an image's expected and actual time."""

_BESIDE = 0.25  # share of an image's size beside it, up to which a lens' polynomial is taken at its word
_SURE_M, _SURE_RAD = 0.15, np.deg2rad(1.0)  # standard deviations of a place that is known well enough
_SURER_M = 0.04  # standard deviation, m, of one at which fewer than the least markings are worth a look
_LAST_LOOKS = 10  # looks of a camera that determine its interval
_SLOW_S = 0.5  # interval, s, after which nothing is expected at its place any more
_AHEAD = 4  # number of coming images announced: a look may last longer than the interval
_EARLIER = 3  # images that a whole search may come earlier, to avoid the other cameras' whole searches
_PATIENCE = 2.0  # so many times its turn a whole search is waited for, before it comes first
_FOUND = 0.6  # share of the markings looked for, from which the last look was as expected
_SOME = 0.3  # share from which it was so in part


class View(NamedTuple):
    """A belief at the time of an image, and the scene that has its camera."""

    belief: Belief
    scene: Scene


class Ahead(NamedTuple):
    """Where to look in an image that is to come."""

    stamp_s: float
    regions_px: FloatArray | None  # boxes (R, 4), px, or None for everywhere
    is_all_later: bool = False  # whether all of it is to be searched once there is time


@dataclass
class Glances:
    """One camera's looks: their times, the last whole one, and how the last one went."""

    stamps_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST_LOOKS))
    whole_s: float = -np.inf
    told_s: float = -np.inf  # time of the last image that was to be searched as a whole, at once or later
    at_once_s: float = -np.inf  # the same of one that was to be at once
    gave_way_s: float = -np.inf  # the same of one that was not to be, since another camera's was
    to_come_s: list[float] = field(default_factory=list)  # times of images that are to be searched so
    boxes: dict[float, int] = field(default_factory=dict)  # numbers of boxes of the images to come, by time
    was_as_expected: bool = False
    was_partly_expected: bool = False

    def note(self, stamp_s: float, is_whole: bool, markings: int) -> None:
        """Take a look and the number of markings that it showed."""
        self.stamps_s.append(stamp_s)
        if is_whole:
            self.note_all(stamp_s)
        expected = 1 if is_whole else max(self._boxes_at(stamp_s), 1)
        self.was_as_expected = markings >= _FOUND * expected
        self.was_partly_expected = markings >= _SOME * expected

    def _boxes_at(self, stamp_s: float) -> int:
        """In how many boxes an image was to be looked at; earlier ones are forgotten."""
        self.boxes = {at_s: count for at_s, count in self.boxes.items() if at_s > stamp_s - _SLOW_S}
        nearest_s = min(self.boxes, key=lambda at_s: abs(at_s - stamp_s), default=stamp_s)
        return self.boxes.get(nearest_s, 0)

    def note_all(self, stamp_s: float) -> None:
        """Take note that all of an image was searched."""
        self.whole_s = max(self.whole_s, stamp_s)

    @property
    def interval_s(self) -> float | None:
        """The time between two images; None where that is not known, or too long to expect anything."""
        apart_s = [later - earlier for earlier, later in pairwise(self.stamps_s) if later > earlier]
        interval_s = min(apart_s, default=np.inf)
        return interval_s if interval_s <= _SLOW_S else None


@dataclass
class Looking:
    """When each camera looks at all of an image, by name: not all at the same time."""

    every_full: int
    glances: dict[str, Glances] = field(default_factory=dict)

    def of(self, camera: str) -> Glances:
        """The looks of a camera."""
        return self.glances.setdefault(camera, Glances())

    def stamps_ahead(self, camera: str, now_s: float) -> list[float]:
        """When the next images of a camera will have been taken, that of which may already be there first."""
        glances = self.of(camera)
        interval_s = glances.interval_s
        if interval_s is None:
            return []
        newest_s = glances.stamps_s[-1]
        behind = max(1, math.floor((now_s - newest_s) / interval_s))
        return [newest_s + (behind + number) * interval_s for number in range(_AHEAD)]

    def ahead(
        self,
        camera: str,
        stamps_s: Sequence[float],
        view_at: Callable[[float], View | None],
        speed_m_s: float,
        has_time_later: bool = False,
    ) -> list[Ahead]:
        """Where to look in images of a camera that are to come at some times.

        ``view_at`` gives the view at such a time, None where nothing is sure. With ``has_time_later`` whole
        searches can follow a look at parts.
        """
        glances = self.of(camera)
        interval_s = glances.interval_s
        whole_s = glances.whole_s
        at_once_s = glances.at_once_s
        out: list[Ahead] = []
        for stamp_s in stamps_s:
            boxes = None
            # A whole look that was told of, but has not come yet, is as good as done for some images.
            if interval_s is not None and stamp_s - glances.told_s < (_AHEAD + 0.5) * interval_s:
                whole_s = max(whole_s, glances.told_s)
            is_due = interval_s is None or self._is_due(camera, stamp_s, whole_s, interval_s)
            # After a look that did not show what was expected all of the next image is searched.
            is_due |= not (glances.was_as_expected or out)
            is_in_parts = not is_due and glances.was_as_expected
            if has_time_later:
                is_in_parts = self._can_wait(camera, stamp_s, at_once_s)
            if is_in_parts:
                view = view_at(stamp_s)
                boxes = None if view is None else expected_boxes(*view, speed_m_s)
            if boxes is None or is_due:
                whole_s = stamp_s
                # What is told of later images is told again.
                glances.told_s = glances.told_s if out else stamp_s
            if not out and boxes is not None and self._gives_way(camera, stamp_s):
                glances.gave_way_s = stamp_s
            if boxes is None:
                at_once_s = stamp_s
                glances.at_once_s = glances.at_once_s if out else stamp_s
            else:
                glances.boxes[stamp_s] = len(boxes)
            out.append(Ahead(stamp_s, boxes, is_all_later=boxes is not None and is_due))
        glances.to_come_s = [ahead.stamp_s for ahead in out if ahead.regions_px is None or ahead.is_all_later]
        return out

    def _can_wait(self, camera: str, stamp_s: float, at_once_s: float) -> bool:
        """Whether a whole search may come after a look at parts.

        It may not where none has come for too long, or the last look showed too little of what it was to, but
        for the images that come before such a search, of one at ``at_once_s``, has had time to end, and for
        one image while another camera is searched so: two at a time would make both poses late.
        """
        glances = self.of(camera)
        interval_s = glances.interval_s or 0.0
        since_s = stamp_s - at_once_s
        if 0.5 * interval_s < since_s < (_AHEAD + 0.5) * interval_s and at_once_s > glances.whole_s:
            return True
        if self._gives_way(camera, stamp_s):
            return True
        most_s = _PATIENCE * self.every_full * interval_s
        return glances.was_partly_expected and stamp_s - glances.whole_s < most_s

    def _gives_way(self, camera: str, stamp_s: float) -> bool:
        """Whether another camera's image is searched at once at a time; not for two images in a row."""
        glances = self.of(camera)
        interval_s = glances.interval_s or 0.0
        others_s = [other.at_once_s for name, other in self.glances.items() if name != camera]
        gave_way_before = 0.5 * interval_s < stamp_s - glances.gave_way_s < 1.5 * interval_s
        return not gave_way_before and any(abs(at_s - stamp_s) < 0.5 * interval_s for at_s in others_s)

    def _is_due(self, camera: str, stamp_s: float, whole_s: float, interval_s: float) -> bool:
        """Whether an image is to be searched as a whole: the last of N, or one before if others take turns.

        An earlier one is, where other cameras' whole searches fall on all that are left.
        """
        left = self.every_full - round((stamp_s - whole_s) / interval_s)
        if left <= 0:
            return True
        later_s = [stamp_s + number * interval_s for number in range(1, left + 1)]
        is_last_chance = left <= _EARLIER and all(
            self._is_whole_beside(camera, later, interval_s) for later in later_s
        )
        return is_last_chance and not self._is_whole_beside(camera, stamp_s, interval_s)

    def _is_whole_beside(self, camera: str, stamp_s: float, interval_s: float) -> bool:
        """Whether another camera searches a whole image at a time, as it was told, or as will be its turn.

        Of two cameras whose turns are the same the second one gives way.
        """
        cameras = list(self.glances)
        stamps_s = [stamp for other in cameras if other != camera for stamp in self.glances[other].to_come_s]
        for other in cameras[: cameras.index(camera)]:
            glances = self.glances[other]
            stamps_s.append(max(glances.whole_s, glances.told_s) + self.every_full * interval_s)
        return any(abs(stamp - stamp_s) < 0.5 * interval_s for stamp in stamps_s)


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
    in_image = Expected(*(array[rows] for array in expected))
    spread_px = np.linalg.norm(scene.spread(belief, in_image, numbers[rows]), axis=2).max(axis=1)
    by_place = in_image.by_place
    px_by_m = np.linalg.norm(by_place, axis=(2, 3)).max(axis=1)
    around_px = _AROUND_PX + _SIGMAS * spread_px + _AROUND_M * px_by_m
    ahead_map = np.array([np.cos(belief.mean[HEADING]), np.sin(belief.mean[HEADING])])
    early_px = EARLY_S * abs(speed_m_s) * np.abs(by_place @ ahead_map).max(axis=1)
    low = corners_px.min(axis=1) - around_px[:, None] - early_px
    high = corners_px.max(axis=1) + around_px[:, None] + early_px
    boxes = np.concatenate([low, high], axis=1)
    chosen = _spread_out(boxes, expected.depth_m[rows].mean(axis=1), _MOST_SHARE * info.width * info.height)
    least = _LEAST if belief.sigma_m > _SURER_M else 1
    return boxes[chosen] if len(chosen) >= least else None


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
