"""Lines on tight bends: where a line shows no points of its own it runs beside the longest one that bends.

A dash or two tell where a line is and which way it points, but not how the way bends. Where that turns by a
large angle within the view no curve u(v) of few parameters tells it either. What is painted along a way runs
at one distance beside what else is, however the way bends: so a line is the offset curve, on the ground, of
the longest line seen, at the distance that its own points have from that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.geometry.ipm import apply_homography
from v2hdm.records import BoolArray, FloatArray, LaneDetection

_STEP_M = 0.5
_MOST_RANGE_M = 45.0
_MOST_DRAWN_M = 60.0
_NEAR_SHARE = 0.05
"""What is that much nearer than a line's own points is not drawn: it is about to be behind the camera."""

_LEAST_GUIDE_M = 8.0
_LEAST_TURN_RAD = 0.15
"""A line that is seen for so long and turns by so much shows how the way bends."""

_LEAST_RADIUS_M = 8.0
_END_M = 7.0
_CARRIED_M = 15.0
"""It is carried on by so much, with the curvature of its last metres."""

_TANGENT_M = 1.5
_LEAST_BESIDE_M, _MOST_BESIDE_M = 0.8, 12.0
_UNEVEN_M, _UNEVEN_SHARE = 0.15, 0.03
"""The distance of what runs beside it changes by so much, and by this share of it (standard deviation)."""

_LEAST_EVEN = 0.6
"""So many of a line's points must be at that distance; the others are on something else."""

_ONE_LINE_M = 0.6
"""Lines that run at one distance from the guide are the same line."""

_BLEND_M = 3.0
"""So far from a line's own points its distance to the guide becomes what it is on the whole."""

DRAWN_STEP_PX = 8.0
"""Whole lines are given by a point every so many rows of the image."""

_SIGMA_M, _SIGMA_SHARE = 0.05, 0.02
"""A line is known so well beside its guide, and by this share of the way from its own points worse."""


@dataclass(frozen=True)
class Seen:
    """A line as drawn, and which (N,) of its points lie between points that were seen."""

    lane: LaneDetection
    seen: BoolArray


@dataclass(frozen=True)
class _Guide:
    """Points (K, 2) every :data:`_STEP_M` on the ground, m, and the normals (K, 2) to the left of them."""

    points: FloatArray
    normals: FloatArray

    def beside(self, ground: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """The index (M,) of the point abreast of each on the ground (M, 2), and how far left (M,) that is."""
        apart = ground[:, None] - self.points
        nearest = np.argmin((apart**2).sum(axis=2), axis=1)
        return nearest, (apart[np.arange(len(ground)), nearest] * self.normals[nearest]).sum(axis=1)


def beside_guide(lines: Sequence[Seen], view: CameraView) -> list[LaneDetection]:
    """The lines, surest first, drawn beside the longest one where that shows a tight bend."""
    given = [line.lane for line in lines]
    if len(lines) < 2:
        return given
    grounds = _grounds(lines, view)
    length_m = [_length_m(ground) for ground in grounds]
    # One after the other: most images show no bend, and each is asked only if those longer show none.
    for longest in sorted(range(len(lines)), key=lambda k: -length_m[k]):
        guide = _guide(grounds[longest]) if length_m[longest] >= _LEAST_GUIDE_M else None
        if guide is not None:
            break
    else:
        return given
    beside = [None if k == longest else _even(guide, ground) for k, ground in enumerate(grounds)]
    drawn: list[LaneDetection] = []
    taken: list[float] = []
    for k, line in enumerate(lines):
        own = beside[k]
        if own is None:
            drawn.append(line.lane)
            continue
        offset_m = float(np.mean(own[1]))
        if any(abs(offset_m - other) < _ONE_LINE_M for other in taken):
            continue
        taken.append(offset_m)
        same = [j for j, o in enumerate(beside) if o and abs(np.mean(o[1]) - offset_m) < _ONE_LINE_M]
        at, offsets_m = (np.concatenate([o[part] for j in same if (o := beside[j])]) for part in (0, 1))
        nearest = max(_near_end(lines[j], view) for j in same)
        drawn.append(_redrawn(line.lane, guide, at, offsets_m, nearest, view))
    return drawn


def _near_end(line: Seen, view: CameraView) -> float:
    """The row, px, below which a line has ended; infinite where it leaves the image."""
    first = line.lane.points_px[0]
    return float(first[1]) if view.inside(first, 3 * DRAWN_STEP_PX) else np.inf


def _grounds(lines: Sequence[Seen], view: CameraView) -> list[FloatArray]:
    """What is seen of each line on the ground (M, 2), m, as far as the ground is known well."""
    seen_px = [line.lane.points_px[line.seen] for line in lines]
    ground = view.ground(view.undistort(np.concatenate(seen_px)))
    parts = np.split(ground, np.cumsum([len(px) for px in seen_px])[:-1])
    return [part[view.range_m(part) < _MOST_RANGE_M] for part in parts]


def _length_m(ground: FloatArray) -> float:
    return float(np.hypot(*np.diff(ground, axis=0).T).sum()) if len(ground) > 1 else 0.0


def _guide(ground: FloatArray) -> _Guide | None:
    """A line's points on the ground (M, 2) as a guide; None where it is short or shows no tight bend."""
    if len(ground) < 4 or _length_m(ground) < _LEAST_GUIDE_M:
        return None
    middle = len(ground) // 2
    chords = ground[[middle, -1]] - ground[[0, middle]]
    # The halves of an arc differ in direction by half of what it turns by: a quick way to see straight ones.
    between = chords[0, 0] * chords[1, 1] - chords[0, 1] * chords[1, 0]
    if abs(float(between)) < _LEAST_TURN_RAD / 4 * float(np.hypot(*chords.T).prod()):
        return None
    points = _evenly(ground)
    tangents = _tangents(points)
    heading = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    # The trend: what is seen far away wriggles.
    along = np.linspace(-1.0, 1.0, len(heading))
    if 2 * abs(float(along @ heading) / float(along @ along)) < _LEAST_TURN_RAD:
        return None
    points = np.concatenate([_arc_on(points[::-1])[::-1], points, _arc_on(points)])
    tangents = _tangents(points)
    return _Guide(points, np.column_stack([-tangents[:, 1], tangents[:, 0]]))


def _evenly(ground: FloatArray) -> FloatArray:
    """A row of points (M, 2), a point every :data:`_STEP_M` along it."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ground, axis=0).T))])
    at = np.arange(0.0, along[-1], _STEP_M)
    return np.column_stack([np.interp(at, along, ground[:, k]) for k in range(2)])


def _tangents(points: FloatArray) -> FloatArray:
    reach = round(_TANGENT_M / _STEP_M)
    index = np.arange(len(points))
    chord = points[np.minimum(index + reach, len(points) - 1)] - points[np.maximum(index - reach, 0)]
    return np.asarray(chord / np.maximum(np.hypot(*chord.T), 1e-9)[:, None])


def _arc_on(points: FloatArray) -> FloatArray:
    """Points on the arc by which a row of them goes on beyond its last."""
    last = points[-round(_END_M / _STEP_M) :]
    chord = last[-1] - last[0]
    axis = chord / max(float(np.hypot(*chord)), 1e-9)
    normal = np.array([-axis[1], axis[0]])
    x, y = (last - last[-1]) @ axis, (last - last[-1]) @ normal
    basis = np.column_stack([x * x, x, np.ones(len(x))])
    bend, slope, _ = np.linalg.lstsq(basis, y, rcond=None)[0]
    curvature = np.clip(2 * bend / (1 + slope**2) ** 1.5, -1 / _LEAST_RADIUS_M, 1 / _LEAST_RADIUS_M)
    heading = np.arctan(slope) + curvature * _STEP_M * (np.arange(round(_CARRIED_M / _STEP_M)) + 0.5)
    steps = _STEP_M * (np.cos(heading)[:, None] * axis + np.sin(heading)[:, None] * normal)
    return np.asarray(last[-1] + np.cumsum(steps, axis=0))


def _even(guide: _Guide, ground: FloatArray) -> tuple[np.ndarray, FloatArray] | None:
    """:meth:`_Guide.beside` of a line's points; None where they run some other way than the guide."""
    if len(ground) < 2:
        return None
    at, beside_m = guide.beside(ground)
    inner = (at > 0) & (at < len(guide.points) - 1)
    at, beside_m = at[inner], beside_m[inner]
    if len(at) < 2:
        return None
    middle = float(np.median(beside_m))
    if not _LEAST_BESIDE_M < abs(middle) < _MOST_BESIDE_M:
        return None
    along = np.abs(beside_m - middle) < 2 * (_UNEVEN_M + _UNEVEN_SHARE * abs(middle))
    return (at[along], beside_m[along]) if along.mean() >= _LEAST_EVEN else None


def _redrawn(
    lane: LaneDetection,
    guide: _Guide,
    at: np.ndarray,
    offsets_m: FloatArray,
    nearest_row: float,
    view: CameraView,
) -> LaneDetection:
    """A line as the curve beside the guide that its own points suggest.

    They are abreast of the guide's points ``at`` (M,), ``offsets_m`` (M,) to the left; the line is not drawn
    nearer than ``nearest_row``, px.
    """
    index = np.arange(len(guide.points))
    nearest = np.argmin(np.abs(index[:, None] - at), axis=1)
    away_m = _STEP_M * np.abs(index - at[nearest])
    mean = offsets_m.mean()
    offset_m = mean + (offsets_m[nearest] - mean) * np.exp(-away_m / _BLEND_M)
    ground = guide.points + offset_m[:, None] * guide.normals
    sigma_m = np.hypot(_SIGMA_M, _SIGMA_SHARE * away_m)
    run = _seen_run(ground, int(np.median(at)), view)
    if run is None or run.stop - run.start < 2:
        return lane
    sigma_m = sigma_m[run]
    px = view.distort(apply_homography(view.pinhole_px_from_vehicle, ground[run]))
    run = _monotone_run(px[:, 1], int(np.argmin(sigma_m)))
    px, sigma_m = px[run], sigma_m[run]
    if px[0, 1] < px[-1, 1]:
        px, sigma_m = px[::-1], sigma_m[::-1]
    lowest = min(px[0, 1], float(view.info.height) + DRAWN_STEP_PX)
    rows = np.arange(max(px[-1, 1], 0.0), lowest, DRAWN_STEP_PX)[::-1]
    if len(rows) < 2:
        return lane
    u = np.interp(rows, px[::-1, 1], px[::-1, 0])
    points_px = np.column_stack([u, rows])
    slope = np.gradient(u, rows)
    half = np.array([0.5, 0.0])
    beside = view.ground(view.undistort(np.concatenate([points_px - half, points_px + half])))
    width_m = np.hypot(*(beside[: len(rows)] - beside[len(rows) :]).T)
    sigma_px = np.interp(rows, px[::-1, 1], sigma_m[::-1]) / np.maximum(width_m, 1e-6) * np.hypot(1, slope)
    kept = view.inside(points_px, -DRAWN_STEP_PX) & (rows <= nearest_row)
    return replace(lane, points_px=points_px[kept], sigma_px=sigma_px[kept]) if kept.sum() > 1 else lane


def _seen_run(ground: FloatArray, start: int, view: CameraView) -> slice | None:
    """The run of points about ``start`` that a camera may see and that keeps on forwards."""
    steps = np.diff(ground, axis=0)
    row = view.pinhole_px_from_vehicle[2]
    depth = ground @ row[:2] + row[2]
    good = (depth / depth[start] > _NEAR_SHARE) & (view.range_m(ground) < _MOST_DRAWN_M)
    good[1:-1] &= (steps[1:] * steps[:-1]).sum(axis=1) > 0
    return _run(good, start)


def _monotone_run(rows: FloatArray, start: int) -> slice:
    sign = np.sign(np.diff(rows))
    at = min(start, len(sign) - 1)
    run = _run(sign == sign[at], at)
    return slice(0, len(rows)) if run is None else slice(run.start, run.stop + 1)


def _run(good: BoolArray, start: int) -> slice | None:
    """The run of what is good about a place; None where it is not good there."""
    if not good[start]:
        return None
    bad = np.flatnonzero(~good)
    before, after = bad[bad < start], bad[bad > start]
    return slice(int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else len(good))
