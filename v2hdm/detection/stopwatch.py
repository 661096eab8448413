"""Time spent in each stage of a detection; :func:`lap` costs nothing until a :class:`Stopwatch` runs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

_running: ContextVar[Stopwatch | None] = ContextVar("stopwatch", default=None)


KEPT = 10_000
"""Images whose times are kept, the last ones: a vehicle's process runs for days."""


class Stopwatch:
    """Collects the time of each stage, image by image; of the last :data:`KEPT` images."""

    def __init__(self) -> None:
        self._images: deque[dict[str, float]] = deque(maxlen=KEPT)
        self._total_s: deque[float] = deque(maxlen=KEPT)
        self._count = 0
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
                self._images.append(self._now)
                self._total_s.append(time.perf_counter() - start)
                self._count += 1
        finally:
            _running.reset(token)

    def discard(self) -> None:
        """There was no image after all."""
        self._now = None

    @property
    def images(self) -> int:
        """How many images were timed."""
        return self._count

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages in the order in which they were first seen."""
        return tuple(dict.fromkeys(stage for laps in self._images for stage in laps))

    def times_s(self, stage: str) -> np.ndarray:
        """Seconds (N,) spent in a stage, one value an image; 0 where it was not entered."""
        return np.array([laps.get(stage, 0.0) for laps in self._images])

    def total_s(self) -> np.ndarray:
        """Seconds (N,) from beginning to end of each image, stages or not."""
        return np.array(self._total_s)

    def add(self, stage: str, seconds: float) -> None:
        """Add to a stage of the image at hand."""
        if self._now is not None:
            self._now[stage] = self._now.get(stage, 0.0) + seconds


@contextmanager
def lap(stage: str) -> Iterator[None]:
    """Time a stage; entered again for the same image, the times add up. Stages must not be nested."""
    stopwatch = _running.get()
    if stopwatch is None:
        yield
        return
    start = time.perf_counter()
    try:
        yield
    finally:
        stopwatch.add(stage, time.perf_counter() - start)
