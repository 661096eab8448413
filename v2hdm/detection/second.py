"""Whole searches of images that were looked at in parts, while no newer image waits."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

from v2hdm.detection.frames import Frame, NewestFrames
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.steps import Steps

_STEP_S = 0.02  # time that a step takes, s, before any was timed: a whole image takes 70 ms in seven
_SLOWER = 0.3  # the next step of a kind may take this share longer
_FORGETS = 0.9  # of the longest time of a step that is kept from one to the next
_IMPATIENT = 0.8
"""Share of a step's longest time that is kept from one image to the next while there is no time for the step.

Otherwise one slow step would stop the search for ever. To begin the next image a little late is better than
to search all of it at once.
"""


class Second(NamedTuple):
    """An image with all that it shows."""

    frame: Frame
    camera: str
    road: Road


class _Search(NamedTuple):
    """A search that is going on."""

    frame: Frame
    camera: str
    steps: Steps[Road]


class SecondLooks:
    """Searches the last image that was added, step by step, in the time that newer frames leave.

    An image that comes while a step is taken waits for its end. No step is begun shortly before an image is
    expected, unless several images in a row have left no time for it.
    """

    def __init__(self, frames: NewestFrames) -> None:
        self._frames = frames
        self._search: _Search | None = None
        self._number = 0  # of the next step of the search
        self._longest_s: dict[int, float] = {}  # time of each step

    def add(self, frame: Frame, road: RoadDetector) -> None:
        """Search an image later; while another is searched, that one goes first, and this is left out."""
        if self._search is None:
            self._search = _Search(frame, road.camera.info.name, road.steps(frame.pixels))
            self._number = 0

    def look(self) -> Second | None:
        """Take steps while there is time; a finished search, None where a newer frame is to be taken."""
        while self._search is not None:
            step_s = self._longest_s.get(self._number, _STEP_S)
            if not self._frames.is_idle_for((1 + _SLOWER) * step_s):
                self._longest_s[self._number] = _IMPATIENT * step_s
                return None
            road = self._step(self._search.steps)
            if road is not None:
                second = Second(self._search.frame, self._search.camera, replace(road, is_second=True))
                self._search = None
                return second
        return None

    def _step(self, steps: Steps[Road]) -> Road | None:
        """Take a step, and its time; the road after the last one."""
        begin_s = time.perf_counter()
        road: Road | None = None
        try:
            next(steps)
        except StopIteration as end:
            road = end.value
        spent_s = time.perf_counter() - begin_s
        self._longest_s[self._number] = max(spent_s, _FORGETS * self._longest_s.get(self._number, 0.0))
        self._number += 1
        return road
