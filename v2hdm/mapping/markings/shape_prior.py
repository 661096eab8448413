"""What the markings of a class have in common, as an observation of each of them.

The diamonds of a yard are painted with one stencil, the dashes of a road with one roller. A marking seen
well a hundred times over, each time as another one, says how large the next one is, which may have been seen
four times, one of its corners under a puddle. So every marking is fused with the shape of its class (an
empirical Bayes estimate: Efron and Morris, Stein's estimation rule and its competitors, 1973). To first order
that is a factor between its corners in the joint adjustment, given to the corners alone: what known sizes
would add about the extrinsics is a hundredth of what the drive says.

All classes are parallelograms: half the diagonals say all of a shape, and the closure p0 - p1 + p2 - p3 = 0
holds where nothing else is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from v2hdm.geometry.quadrilateral import characteristic_lengths
from v2hdm.mapping.markings.completion import SolvedCorners
from v2hdm.mapping.markings.paint_error import PaintError, learn_paint_error
from v2hdm.records import FloatArray, IntArray

_COMMON_SHARE = 0.6
"""A class has one shape if this share of its markings has it."""

_LEAST_MEMBERS = 8
_MAX_MISS_M = 0.05
_MAX_MISS_SHARE = 0.08
"""A marking has the common shape if no corner misses it by more than this, or by this share of its size."""

SHAPE_SIGMA_M = 0.01
"""How far a painted corner lies from where the stencil would have it, at least."""

_GATE_PROBABILITY = 1e-3
"""Share of sound markings that a hypothesis on the shape may turn away."""

_AFTERTHOUGHT_PROBABILITY = 0.05
"""The same for a hypothesis that is made up because the marking contradicts its class."""

_ELONGATED = 2.0
"""Paint this many times as long as wide is rolled by the metre: its width is common, its length its own."""

_ONE_LENGTH_SHARE = 0.95
"""A class is of one length if this share of its markings has it."""

_UNKNOWN_M2 = 1e4
"""Variance of what a hypothesis leaves open, m^2."""

_CLOSURE = np.kron(np.array([[0.5, -0.5, 0.5, -0.5]]), np.eye(2))


@dataclass(frozen=True)
class Shape:
    """A parallelogram (4, 2) about its centre, m, that a class has in common up to ``sigma_m`` a corner."""

    corners: FloatArray
    sigma_m: float

    @property
    def stretch(self) -> FloatArray | None:
        """How the corners (8,) move as the long sides grow by 1; None if the shape is not elongated."""
        sides = self.corners[1:3] - self.corners[:2]
        length = np.linalg.norm(sides, axis=1)
        long = int(np.argmax(length))
        if length[long] < _ELONGATED * length[1 - long]:
            return None
        along = sides[long] / length[long]
        return np.kron(np.sign(self.corners @ along), along) / 2


def with_class_shapes(solved: SolvedCorners, kind: IntArray, accepted: IntArray) -> SolvedCorners:
    """Fuse the groups ``accepted`` (A,) with the shape that most of their class, ``kind`` (G,), has.

    A group that contradicts it keeps its own shape, but for what one of two things explains: another
    length, where paint is rolled by the metre, or a corner that was taken for another edge, which the
    shape then replaces.
    """
    corners, covariance = solved.corners_map.copy(), solved.covariance_m2.copy()
    shapes = class_shapes(solved, kind, accepted)
    paint = _paint_error(solved, [(group, shapes.get(int(kind[group]))) for group in accepted])
    for group in accepted:
        shape = shapes.get(int(kind[group]))
        corners[group], covariance[group] = fuse(corners[group], covariance[group], shape, paint)
    return replace(solved, corners_map=corners, covariance_m2=covariance)


def _paint_error(solved: SolvedCorners, members: Sequence[tuple[int, Shape | None]]) -> PaintError:
    """What the markings' deviations from the shapes of their classes say about errors of the paint."""
    updates = [
        update
        for group, shape in members
        if shape is not None and not solved.completed[group]
        for update in [_shaped(solved.corners_map[group], solved.covariance_m2[group], shape)]
        if update.plausibility > _GATE_PROBABILITY
    ]
    return learn_paint_error([update.residual for update in updates], [update.formal for update in updates])


def without_guessed_lengths(
    before: SolvedCorners, placed: SolvedCorners, seen_map: FloatArray, kind: IntArray, accepted: IntArray
) -> SolvedCorners:
    """Take back the placing of groups by the shape of their class where it guesses how long they are.

    Paint that is rolled by the metre comes in lengths of its own, so that one end of it says where the other
    is only if the whole class is of one length.

    Args:
        before: the corners before some groups were placed by their class's shape.
        placed: the corners after.
        seen_map: (G, 4, 2) where each corner was seen, nan where it was not.
        kind: (G,) class of every group.
        accepted: (A,) the groups that give their classes their shapes.
    """
    corners, covariance = placed.corners_map.copy(), placed.covariance_m2.copy()
    completed = placed.completed.copy()
    moved = ~np.isclose(before.corners_map, placed.corners_map, equal_nan=True).all(axis=(1, 2))
    for group in np.flatnonzero(moved):
        stretch = Shape(_parallelogram(corners[group]), SHAPE_SIGMA_M).stretch
        peers = before.corners_map[accepted[kind[accepted] == kind[group]]]
        if stretch is None or _is_of_one_length(peers):
            continue
        off = np.linalg.norm(seen_map[group] - corners[group], axis=1) <= _MAX_MISS_M
        far = stretch.reshape(4, 2) @ (corners[group][0] - corners[group].mean(axis=0)) > 0
        if not (off[far].any() and off[~far].any()):
            corners[group], covariance[group] = before.corners_map[group], before.covariance_m2[group]
            completed[group] = before.completed[group]
    return SolvedCorners(corners, covariance, completed)


def _is_of_one_length(corners: FloatArray) -> bool:
    """Whether as good as all markings (N, 4, 2) are as long as the typical one."""
    length = characteristic_lengths(corners)[:, -1]
    typical = np.median(length)
    alike = np.abs(length - typical) <= miss_limit_m(float(typical))
    return bool(np.mean(alike) >= _ONE_LENGTH_SHARE)


def miss_limit_m(size_m: float) -> float:
    """How far a corner of a marking whose longer diagonal is ``size_m`` may be off the shape of its class."""
    return max(_MAX_MISS_M, _MAX_MISS_SHARE * size_m)


def class_shapes(solved: SolvedCorners, kind: IntArray, accepted: IntArray) -> dict[int, Shape]:
    """The shapes of those classes, ``kind`` (G,), of which the groups ``accepted`` (A,) have one."""
    shapes = {}
    for one in np.unique(kind[accepted]).tolist():
        groups = accepted[kind[accepted] == one]
        shape = common_shape(solved.corners_map[groups], solved.covariance_m2[groups])
        if shape is not None:
            shapes[one] = shape
    return shapes


def common_shape(corners: FloatArray, covariance: FloatArray) -> Shape | None:
    """The shape that most of a class's markings (N, 4, 2) of covariances (N, 8, 8) have, if there is one."""
    if len(corners) < _LEAST_MEMBERS:
        return None
    lengths = characteristic_lengths(corners)
    typical = int(np.argmin(np.abs(lengths - np.median(lengths, axis=0)).sum(axis=1)))
    shape, members = _parallelogram(corners[typical]), np.array([typical])
    limit_m = miss_limit_m(float(lengths[typical].max()))
    for _ in range(2):
        laid = [_lay(shape, one, np.ones(4)) for one in corners]
        members = np.flatnonzero([np.linalg.norm(one.off, axis=1).max() <= limit_m for one in laid])
        if len(members) < max(_COMMON_SHARE * len(corners), _LEAST_MEMBERS):
            return None
        own = np.stack([laid[m].taken_back(corners[m]) for m in members])
        shape = _parallelogram(np.median(own, axis=0))
    return Shape(shape, _spread_m(shape, corners[members], covariance[members]))


def fuse(
    corners: FloatArray, covariance: FloatArray, shape: Shape | None, paint: PaintError
) -> tuple[FloatArray, FloatArray]:
    """Corners (4, 2) and covariance (8, 8) under what is known of the shape; as seen if nothing fits.

    ``paint`` is the distribution of errors that all images share.
    """
    update = _closed(corners, covariance) if shape is None else _shaped(corners, covariance, shape)
    own_m2 = paint.variance_m2(update.residual, update.formal)
    if update.plausibility > _GATE_PROBABILITY:
        return replace(update, covariance=covariance + own_m2 * np.eye(8)).result
    doubts = [] if shape is None else _doubts(corners, covariance + paint.sigma_m**2 * np.eye(8), shape)
    best = max(doubts, key=lambda doubt: doubt.plausibility, default=update)
    # What contradicts itself for no reason that can be told is known as badly as it contradicts itself.
    if best.plausibility > _AFTERTHOUGHT_PROBABILITY:
        return best.result
    return corners, covariance + own_m2 * np.eye(8)


@dataclass(frozen=True)
class _Update:
    """Corners (8,) of ``covariance``, of which ``jacobian`` (m, 8) times a deviation is ``residual`` (m,).

    The latter is known up to ``noise`` (m, m), but for ``left_open`` directions.
    """

    corners: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    noise: FloatArray
    left_open: int = 0

    @property
    def formal(self) -> FloatArray:
        """Covariance (m, m) of the residual by that of the corners alone."""
        return np.asarray(self.jacobian @ self.covariance @ self.jacobian.T)

    @property
    def _innovation(self) -> FloatArray:
        return np.asarray(self.formal + self.noise)

    @property
    def distance2(self) -> float:
        """The squared residual in standard deviations."""
        return float(self.residual @ np.linalg.solve(self._innovation, self.residual))

    @property
    def plausibility(self) -> float:
        """How often a marking of which the hypothesis holds is farther from it than this one."""
        return float(chi2.sf(self.distance2, len(self.residual) - self.left_open))

    @property
    def result(self) -> tuple[FloatArray, FloatArray]:
        """Corners (4, 2) and covariance (8, 8) under the hypothesis (a Kalman update)."""
        gain = np.linalg.solve(self._innovation, self.jacobian @ self.covariance).T
        # Joseph's form: a sum of squares, so that what is nearly known keeps its small variance.
        left = np.eye(8) - gain @ self.jacobian
        covariance = left @ self.covariance @ left.T + gain @ self.noise @ gain.T
        return (self.corners - gain @ self.residual).reshape(4, 2), (covariance + covariance.T) / 2


def _closed(corners: FloatArray, covariance: FloatArray) -> _Update:
    """That it is a parallelogram."""
    noise = SHAPE_SIGMA_M**2 * np.eye(2)
    return _Update(corners.reshape(8), covariance, _CLOSURE, _CLOSURE @ corners.reshape(8), noise)


def _doubts(corners: FloatArray, covariance: FloatArray, shape: Shape) -> list[_Update]:
    """What may explain that a marking contradicts its class."""
    without = [_shaped(corners, covariance, shape, without=corner) for corner in range(4)]
    return (
        without if shape.stretch is None else [_shaped(corners, covariance, shape, any_length=True), *without]
    )


def _shaped(
    corners: FloatArray,
    covariance: FloatArray,
    shape: Shape,
    without: int | None = None,
    any_length: bool = False,
) -> _Update:
    """That it has the shape of its class; the corner ``without`` is not believed, or the length is open."""
    weight, noise, left_open = np.ones(4), shape.sigma_m**2 * np.eye(8), 0
    if without is not None:
        weight[without], left_open = 0.0, 2
        covariance = covariance.copy()
        part = slice(2 * without, 2 * without + 2)
        covariance[part], covariance[:, part] = 0.0, 0.0
        covariance[part, part] = _UNKNOWN_M2 * np.eye(2)
    if any_length and shape.stretch is not None:
        noise, left_open = noise + _UNKNOWN_M2 * np.outer(shape.stretch, shape.stretch), 1
    laid = _lay(shape.corners, corners, weight)
    turn = np.kron(np.roll(np.eye(4), -laid.shift, axis=0), laid.rotation)
    jacobian = laid.shape_directions()
    return _Update(
        corners.reshape(8),
        covariance,
        jacobian,
        jacobian @ laid.off.reshape(8),
        jacobian @ turn @ noise @ turn.T @ jacobian.T,
        left_open,
    )


@dataclass(frozen=True)
class _Laid:
    """A shape laid on corners: ``placed`` = roll(shape, -shift) @ rotation.T + centre is ``off`` them."""

    shift: int
    rotation: FloatArray
    centre: FloatArray
    placed: FloatArray
    off: FloatArray

    def taken_back(self, corners: FloatArray) -> FloatArray:
        """Corners (4, 2) in the frame and order of the shape."""
        return np.roll((corners - self.centre) @ self.rotation, self.shift, axis=0)

    def shape_directions(self) -> FloatArray:
        """Orthonormal directions (5, 8) in which corners move other than rigidly."""
        arms = self.placed - self.placed.mean(axis=0)
        turning = np.stack([-arms[:, 1], arms[:, 0]], axis=1).reshape(8)
        rigid = np.column_stack([np.tile(np.eye(2), (4, 1)), turning])
        return np.asarray(np.linalg.qr(rigid, mode="complete")[0][:, 3:].T)


def _lay(shape: FloatArray, corners: FloatArray, weight: FloatArray) -> _Laid:
    """Move and turn a parallelogram (4, 2) onto corners by weighted least squares.

    It looks the same from both ends, so that one shift by a corner is all there is to try.
    """
    best: _Laid | None = None
    for shift in (0, 1):
        rolled = np.roll(shape, -shift, axis=0)
        rotation, centre = rigid_onto(rolled, corners, weight)
        placed = rolled @ rotation.T + centre
        laid = _Laid(shift, rotation, centre, placed, corners - placed)
        if best is None or weight @ (laid.off**2).sum(1) < weight @ (best.off**2).sum(1):
            best = laid
    assert best is not None
    return best


def rigid_onto(points: FloatArray, target: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (2, 2) and shift (2,) that take points (N, 2) nearest to a target, weighted (Kabsch, 1976)."""
    from_centre, to_centre = (weight @ part / weight.sum() for part in (points, target))
    a, b = points - from_centre, target - to_centre
    turn = np.arctan2(weight @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), weight @ (a * b).sum(axis=1))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return rotation, np.asarray(to_centre - rotation @ from_centre)


def _parallelogram(corners: FloatArray) -> FloatArray:
    """The parallelogram (4, 2) about its centre that corners come nearest to."""
    arms = (corners[:2] - corners[2:]) / 2
    return np.concatenate([arms, -arms])


def _spread_m(shape: FloatArray, corners: FloatArray, covariance: FloatArray) -> float:
    """How far the corners of members (N, 4, 2) lie from the shape beyond their own covariances.

    The standard deviation under which the median marking is as far from the shape as that of a chi-square
    variable, but no less than what paint allows.
    """
    lays = [_lay(shape, one, np.ones(4)) for one in corners]
    directions = np.stack([laid.shape_directions() for laid in lays])
    off = (directions @ np.stack([laid.off.reshape(8, 1) for laid in lays]))[..., 0]
    own = directions @ covariance @ directions.transpose(0, 2, 1)
    wanted = float(chi2.median(off.shape[1]))
    low, high = SHAPE_SIGMA_M, float(np.abs(off).max()) + SHAPE_SIGMA_M
    for _ in range(20):
        sigma_m = np.sqrt(low * high)
        innovation = own + sigma_m**2 * np.eye(off.shape[1])
        squared = np.sum(off * np.linalg.solve(innovation, off[..., None])[..., 0], axis=1)
        low, high = (sigma_m, high) if np.median(squared) > wanted else (low, sigma_m)
    return float(low)
