"""Rows of parallel bars of one size at even steps, such as crosswalks, and the outline about a row."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import following, turned_left
from v2hdm.records import BoolArray, FloatArray, IntArray

LEAST_BARS = 3  # least number of bars of a row: fewer show no even steps

_LOG_LENGTH_SIGMA = 0.15
"""Standard deviation of the logarithm of a bar's length beside its neighbour's: ends are worn."""

_LOG_WIDTH_SIGMA = 0.25  # standard deviation of the logarithm of a bar's width beside its neighbour's
_TURNED_SIGMA_RAD = 0.05  # standard deviation of a bar's direction beside its neighbour's
_MOST_SQUARED = 16.3
"""Largest sum of these three, squared, in sigmas: one pair of neighbours in 1000 has more."""

_STEP_WIDTHS = (1.2, 4.5)
"""Least and largest step from bar to bar, in widths of a bar: Zeichen 293 of the StVO has gaps as wide as
bars, MUTCD 3C.05 gaps of 0.3 to 1.5 m between bars of 0.3 to 0.6 m."""
_STEP_SIGMA = 0.2  # largest deviation, RMS, of bars from an even row, in steps
_MOST_MISSING = 2  # bars that may be missing between two of a row
_SAME_PLACE_WIDTHS = 0.9  # step below which two bars, in their widths, are readings of the same paint
_NEIGHBOURS = 2  # steps on either side whose median is the usual one at a place of a row that an image shows
_ODD_SHARE = 1 / 3  # largest share of a group's members that are left out of such a row


class Tolerance(NamedTuple):
    """How exact a row is."""

    aside: float  # largest offset of neighbours along the bars, in their lengths
    least_step: float  # from bar to bar, in widths
    degree: int  # of the polynomials that places follow: 1 is a straight row of even steps


MAPPED = Tolerance(aside=0.5, least_step=_STEP_WIDTHS[0], degree=1)
"""Tolerance of a row on a map, which is metric."""

IN_IMAGE = Tolerance(aside=0.75, least_step=1.0, degree=2)
"""Tolerance of a row in an image of a camera whose mounting and lens are known about: steps grow along the
row, the row bends, and blur widens bars that are far away. Chosen on photographs that networks learn from."""


class _Bars(NamedTuple):
    """N bars."""

    centre: FloatArray  # (N, 2)
    way: FloatArray  # (N, 2) unit, along the bar, of either sign
    length: FloatArray  # (N,)
    width: FloatArray  # (N,)


def _bars_of(corners: FloatArray) -> _Bars:
    """The bars of corners (N, 4, 2)."""
    sides = (corners + following(corners)) / 2
    middle_lines = sides[:, 2:] - sides[:, :2]
    size = np.linalg.norm(middle_lines, axis=2)
    longer = middle_lines[np.arange(len(corners)), size.argmax(axis=1)]
    length = np.maximum(size.max(axis=1), 1e-9)
    return _Bars(corners.mean(axis=1), longer / length[:, None], length, np.maximum(size.min(axis=1), 1e-9))


def rows_of_bars(corners: FloatArray, tolerance: Tolerance = MAPPED) -> list[IntArray]:
    """The rows among quadrilaterals (N, 4, 2) on the ground, m: the indices of each row's bars, in order.

    A row has three or more parallel bars of one size at even steps; some of its bars may be missing. Of a row
    that is not straight, bars at odd places are left out.
    """
    if len(corners) < LEAST_BARS:
        return []
    bars = _bars_of(corners)
    cosine = np.abs(bars.way @ bars.way.T)
    log_length = np.log(bars.length)
    log_width = np.log(bars.width)
    squared = ((log_length[:, None] - log_length) / _LOG_LENGTH_SIGMA) ** 2
    squared += ((log_width[:, None] - log_width) / _LOG_WIDTH_SIGMA) ** 2
    squared += (np.arccos(np.minimum(cosine, 1.0)) / _TURNED_SIGMA_RAD) ** 2
    offset = bars.centre - bars.centre[:, None]
    along = np.abs(np.einsum("ijk,ik->ij", offset, bars.way))
    across = np.abs(np.einsum("ijk,ik->ij", offset, turned_left(bars.way)))
    lengths = along / np.sqrt(bars.length[:, None] * bars.length)
    widths = across / np.sqrt(bars.width[:, None] * bars.width)
    is_next = (squared < _MOST_SQUARED) & (lengths < tolerance.aside)
    is_next &= (widths > tolerance.least_step) & (widths < _STEP_WIDTHS[1] * (1 + _MOST_MISSING))
    is_next &= is_next.T
    find_row = _even_row if tolerance.degree == 1 else partial(_bent_row, tolerance=tolerance)
    rows = (find_row(members, bars) for members in linked_groups(is_next))
    return [row for row in rows if row is not None]


def linked_groups(is_linked: BoolArray) -> list[IntArray]:
    """The groups that links (N, N), each in both directions, connect: the ascending indices of each."""
    groups = []
    is_left = np.ones(len(is_linked), dtype=np.bool_)
    for first in range(len(is_linked)):
        if not is_left[first]:
            continue
        reached = np.arange(len(is_linked)) == first
        while (grown := reached | is_linked[reached].any(axis=0)).sum() > reached.sum():
            reached = grown
        is_left &= ~reached
        groups.append(np.flatnonzero(reached))
    return groups


def _even_row(members: IntArray, bars: _Bars) -> IntArray | None:
    """The bars in order where they make an even row; None where they do not."""
    if len(members) < LEAST_BARS:
        return None
    centres = bars.centre[members]
    course = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2][0]
    course = course * np.sign(course[np.abs(course).argmax()])  # its sign is arbitrary
    along = centres @ course
    order = np.argsort(along)
    along = along[order]
    steps = np.diff(along)
    step = float(np.median(steps[steps < 1.5 * steps.min()])) if steps.min() > 0 else 0.0
    if not _STEP_WIDTHS[0] < step / float(np.median(bars.width[members])) < _STEP_WIDTHS[1]:
        return None
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / step), 1))])
    off = along - np.polyval(np.polyfit(number, along, 1), number)
    beside = (centres - centres.mean(axis=0)) @ turned_left(course)
    is_even = np.sqrt(np.mean(off**2)) < _STEP_SIGMA * step
    is_straight = np.sqrt(np.mean(beside**2)) < _STEP_SIGMA * float(np.median(bars.length[members]))
    return members[order] if is_even and is_straight else None


def _bent_row(members: IntArray, bars: _Bars, tolerance: Tolerance) -> IntArray | None:
    """The bars in order of a row whose steps grow and which may bend, less bars at odd places; else None."""
    least = max(LEAST_BARS, len(members) * (1 - _ODD_SHARE))
    while len(members) >= least:
        centres = bars.centre[members] - bars.centre[members].mean(axis=0)
        course = np.linalg.svd(centres, full_matrices=False)[2][0]
        course = course * np.sign(course[np.abs(course).argmax()])  # its sign is arbitrary
        order = np.argsort(centres @ course)
        members = members[order]
        centres = centres[order]
        width = bars.width[members]
        steps = np.diff(centres @ course)
        is_same_place = steps < _SAME_PLACE_WIDTHS * np.sqrt(width[1:] * width[:-1])
        if is_same_place.any():
            first = int(is_same_place.argmax())
            size = (bars.width * bars.length)[members]
            members = np.delete(members, first + int(size[first] > size[first + 1]))
            continue
        step = _usual_steps(steps)
        off = _off_places(centres @ course, steps / step, tolerance.degree) / float(np.median(step))
        beside = _off_places(centres @ turned_left(course), steps / step, tolerance.degree)
        beside = beside / float(np.median(bars.length[members]))
        is_step = tolerance.least_step < np.median(step) / np.median(width) < _STEP_WIDTHS[1]
        if is_step and max(np.mean(off**2), np.mean(beside**2)) < _STEP_SIGMA**2:
            return members
        members = np.delete(members, int(np.hypot(off, beside).argmax()))
    return None


def _usual_steps(steps: FloatArray) -> FloatArray:
    """The median of the steps about each of steps (N,)."""
    places = range(len(steps))
    return np.array([np.median(steps[max(k - _NEIGHBOURS, 0) : k + _NEIGHBOURS + 1]) for k in places])


def _off_places(places: FloatArray, steps: FloatArray, degree: int) -> FloatArray:
    """How far places (N,) are off a polynomial of their numbers, by steps (N - 1,) in usual ones."""
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps), 1))])
    # Three places alone would follow any bend.
    return places - np.polyval(np.polyfit(number, places, min(degree, len(places) - 2)), number)


class RowOutline(NamedTuple):
    """The outline about a row of N bars."""

    corners: FloatArray  # (4, 2) counter-clockwise, the first two along the bars' ends
    by_corner: FloatArray  # (8, 8 N) its derivative by the stacked corners of the bars
    corner_of_bars: IntArray  # (4,) the nearest of the bars' 4 N stacked corners


def outline_of_row(corners: FloatArray) -> RowOutline:
    """The parallelogram about bars (N, 4, 2) in order along their row.

    Two of its sides are fitted to the ends of all bars; the others run along the first and the last bar.
    """
    centres = corners.mean(axis=1)
    course = centres[-1] - centres[0]
    way = _bars_of(corners).way[0]
    way = way * np.sign(turned_left(course) @ way)
    across = -turned_left(way)
    points = corners.reshape(-1, 2)
    bar = np.repeat(np.arange(len(corners)), 4)
    is_far = (points - centres[bar]) @ way > 0
    beside = points @ across
    out = np.zeros((4, 2))
    by_corner = np.zeros((8, 2 * len(points)))
    nearest = np.zeros(4, dtype=np.int64)
    for number, (at_first, far) in enumerate(((True, False), (False, False), (False, True), (True, True))):
        ends = np.flatnonzero(is_far == far)
        candidates = ends[bar[ends] == (0 if at_first else len(corners) - 1)]
        outer = candidates[np.argmin(beside[candidates]) if at_first else np.argmax(beside[candidates])]
        design = np.column_stack([np.ones(len(ends)), beside[ends]])
        weight = np.array([1.0, beside[outer]]) @ np.linalg.pinv(design)
        rows = slice(2 * number, 2 * number + 2)
        by_corner[rows, 2 * outer : 2 * outer + 2] += np.outer(across, across)
        for end, share in zip(ends.tolist(), weight.tolist(), strict=True):
            by_corner[rows, 2 * end : 2 * end + 2] += share * np.outer(way, way)
        out[number] = by_corner[rows] @ points.ravel()
        nearest[number] = outer
    return RowOutline(out, by_corner, nearest)
