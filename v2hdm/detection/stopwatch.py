"""Time spent in each stage of a detection; :func:`lap` costs nothing until a :class:`Stopwatch` runs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

_running: ContextVar[Stopwatch | None] = ContextVar("stopwatch", default=None)

KEPT = 10_000  # images whose times are kept, the last ones: a vehicle's process runs for days
TOTAL = "all"  # the name of the time from beginning to end of an image, stages or not


class Stopwatch:
    """Collects the time of each stage, image by image; of the last :data:`KEPT` of all ``images``."""

    def __init__(self) -> None:
        self.images = 0
        self._kept: deque[dict[str, float]] = deque(maxlen=KEPT)
        self._now: dict[str, float] | None = None

    @contextmanager
    def image(self) -> Iterator[None]:
        """Run while one image is worked on; one that ends in an error does not count."""
        self._now = {}
        token = _running.set(self)
        start = time.perf_counter()
        try:
            yield
            if self._now is not None:
                self._kept.append(self._now | {TOTAL: time.perf_counter() - start})
                self.images += 1
        finally:
            _running.reset(token)

    def discard(self) -> None:
        """There was no image after all."""
        self._now = None

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages in the order in which they were first seen."""
        return tuple(dict.fromkeys(stage for laps in self._kept for stage in laps if stage != TOTAL))

    def times_s(self, stage: str) -> np.ndarray:
        """Seconds (N,) spent in a stage or in :data:`TOTAL`, one value per image; 0 where not entered."""
        return np.array([laps.get(stage, 0.0) for laps in self._kept])


@contextmanager
def lap(stage: str) -> Iterator[None]:
    """Time a stage; entered again for the same image, the times add up. Stages must not be nested."""
    stopwatch = _running.get()
    start = time.perf_counter()
    try:
        yield
    finally:
        if stopwatch is not None and (laps := stopwatch._now) is not None:
            laps[stage] = laps.get(stage, 0.0) + time.perf_counter() - start
