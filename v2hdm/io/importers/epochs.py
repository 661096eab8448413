"""Times of sentences that have none, from those around them that do.

A receiver writes the sentences of an epoch together, so a heading between two epochs is of the one before, or
of the one after where it comes first. Several between two epochs are spread over the time between them.
Which of both holds is shown by a sentence of the same epoch behind it, or by the times at which a logger
received them; else the drive has to show it (:func:`v2hdm.io.importers.poses.assemble`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.records import FloatArray

_MOST = 0.5  # share of the sentences that decides
_LATE_S = 0.5  # share of an epoch that separates arrivals of one from those of the next


class Untimed(NamedTuple):
    """A sentence at its ``place`` in the log."""

    place: int
    stamp_s: float | None  # its own time, or that of the last sentence before it that has one
    received_s: float | None  # on the logger's clock
    values: tuple[float, ...]


class Timed(NamedTuple):
    """Headings with times."""

    stamp_s: FloatArray  # (N,) rising strictly
    values: FloatArray  # (N, V)
    later_s: FloatArray | None  # (N,) the times that they have otherwise; None where there is no doubt


def time_headings(headings: Sequence[Untimed], epochs: Sequence[Untimed], where: str) -> Timed | None:
    """Times of ``headings`` among sentences with times, ``epochs``; None where nothing has a time."""
    places, stamps = _distinct(epochs)
    if not len(stamps):
        return None
    # The epoch that each heading follows, -1 before the first, and its number among those behind that epoch.
    epoch = np.searchsorted(places, [heading.place for heading in headings], side="right") - 1
    first = np.searchsorted(epoch, epoch, side="left")
    number = np.arange(len(epoch)) - first
    count = np.searchsorted(epoch, epoch, side="right") - first
    usual = int(np.median(count[epoch >= 0])) if (epoch >= 0).any() else 1
    parts = np.maximum(count, usual)
    step_s = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    ends = np.append(stamps[1:], stamps[-1] + step_s)
    # Gaps of the log are not spread over.
    lasts_s = np.minimum(ends - stamps, 1.5 * step_s)
    begin_s = stamps[epoch]
    length_s = lasts_s[epoch]
    before = epoch < 0
    begin_s = np.where(before, stamps[0] - step_s, begin_s)
    length_s = np.where(before, step_s, length_s)
    number = np.where(before, parts - count + number, number)
    earlier_s = begin_s + length_s * number / parts
    later_s = begin_s + length_s * (number + 1) / parts
    rows = np.unique(earlier_s, return_index=True)[1]
    values = np.array([heading.values for heading in headings])[rows]
    earlier_s = earlier_s[rows]
    later_s = later_s[rows]
    received = [headings[row] for row in rows]
    if usual == 1 and _enclosed(received, epochs) > _MOST:
        return _timed(earlier_s, values, epoch[rows] >= 0)
    if (is_later := _arrived_later(received, epochs, earlier_s, later_s)) is not None:
        return (
            _timed(later_s, values, earlier_s >= -np.inf)
            if is_later
            else _timed(earlier_s, values, ~before[rows])
        )
    return Timed(earlier_s, values, later_s)


def _timed(stamp_s: FloatArray, values: FloatArray, is_usable: np.ndarray) -> Timed:
    return Timed(stamp_s[is_usable], values[is_usable], None)


def _distinct(epochs: Sequence[Untimed]) -> tuple[FloatArray, FloatArray]:
    """Places and times of the first sentence of each epoch, both rising."""
    places: list[int] = []
    stamps: list[float] = []
    for epoch in epochs:
        assert epoch.stamp_s is not None
        if not stamps or epoch.stamp_s > stamps[-1]:
            places.append(epoch.place)
            stamps.append(epoch.stamp_s)
    return np.array(places), np.array(stamps)


def _enclosed(headings: Sequence[Untimed], epochs: Sequence[Untimed]) -> float:
    """Share of headings that a sentence of the epoch before them follows."""
    places = np.array([epoch.place for epoch in epochs])
    following = np.searchsorted(places, [heading.place for heading in headings], side="right")
    same = [
        row < len(epochs) and heading.stamp_s is not None and epochs[row].stamp_s == heading.stamp_s
        for heading, row in zip(headings, following.tolist(), strict=True)
    ]
    return float(np.mean(same)) if same else 0.0


def _arrived_later(
    headings: Sequence[Untimed], epochs: Sequence[Untimed], earlier_s: FloatArray, later_s: FloatArray
) -> bool | None:
    """Whether headings came as long after ``later_s`` as epochs do; None where it is unknown."""
    delays_s = [epoch.received_s - epoch.stamp_s for epoch in epochs
                if epoch.received_s is not None and epoch.stamp_s is not None]  # fmt: skip
    came = [(k, heading.received_s) for k, heading in enumerate(headings) if heading.received_s is not None]
    if not delays_s or len(came) < _MOST * len(headings):
        return None
    rows = [k for k, _ in came]
    received_s = np.array([received for _, received in came])
    usual_s = float(np.median(delays_s))
    off_earlier_s = abs(float(np.median(received_s - earlier_s[rows])) - usual_s)
    off_later_s = abs(float(np.median(received_s - later_s[rows])) - usual_s)
    apart_s = float(np.median(later_s - earlier_s))
    if abs(off_earlier_s - off_later_s) < _LATE_S * apart_s:
        return None
    return off_later_s < off_earlier_s
