"""Which detections show which markings, jointly, and the belief after them (Neira and Tardos 2001)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import SHIFTS
from v2hdm.localization.belief import CAMERA, HEADING, VEHICLE, Belief, Plane, with_markings
from v2hdm.localization.paint import Paint
from v2hdm.localization.seeing import Expected, Sighted, expect, ground_points
from v2hdm.native import kernels
from v2hdm.records import BoolArray, Calibration, FloatArray, IntArray

_REACH_M = 2.5  # the corners of a marking that the image's border cuts seem so far from its centre, m
_REACH_SIGMAS = 4.0  # in sigmas of the place, beside
_RANGE_M = 35.0  # distance, m, of markings that are looked for: farther than any is detected
_GATE = 3.3  # one in two thousand right pairs, or right sets of them, fits worse (sigmas of a normal)
# Twice the difference of log likelihoods from which one marking explains a detection and no other does.
CLEARER_BY = 9.0
_ROUNDS = 3  # of pairing what is clear once the clearer pairs are known
_STEPS = 4  # of an update: half a metre off at the first, a few millimetres at the third
_SETTLED = 0.02  # longest step, in sigmas of the prior belief, that changes nothing any more
# Degrees of freedom of the t distribution of a detection's error: shadow and wear misplace one in fifty.
_TAIL = 12.0
_AXES = np.arange(2)  # of a marking's place
_SHIFT_ROWS = (2 * SHIFTS[..., None] + np.arange(2)).reshape(4, 8)  # rows of stacked corners by their shift


def largest_square(count: FloatArray, sigmas: float = _GATE) -> FloatArray:
    """Squared distances that so many unknowns (...) exceed as rarely (Wilson and Hilferty 1931)."""
    freedom = np.maximum(count, 1.0)
    part = 2.0 / (9.0 * freedom)
    return np.asarray(freedom * (1 - part + sigmas * np.sqrt(part)) ** 3)


class Pairs(NamedTuple):
    """P detections, each with the marking that it shows."""

    detection: IntArray  # (P,) of the look
    marking: IntArray  # (P,) of the map
    order: IntArray  # (P, 8) rows of the detection's stacked corners by the marking's

    def subset(self, rows: IntArray | BoolArray) -> Pairs:
        """Some of them."""
        return Pairs(self.detection[rows], self.marking[rows], self.order[rows])


@dataclass(frozen=True)
class Scene:
    """One image before a map: what :func:`locate` works on."""

    quads: Sighted
    paint: Paint
    plane: Plane
    camera: int
    calibration: Calibration
    noise_factor: float  # of the detector's covariances

    def expect(self, belief: Belief, markings: IntArray) -> Expected:
        """Markings as this image should show them."""
        corners_map = self.paint.corners_map[markings]
        states = belief.states_of(markings)
        rows = np.flatnonzero(states >= 0)
        corners_map[rows, :, :2] += belief.mean[states[rows, None] + _AXES][:, None]
        return expect(belief, self.plane, self.camera, self.calibration, corners_map)

    def spread(self, belief: Belief, expected: Expected, markings: IntArray) -> FloatArray:
        """The derivative (M, 8, n) of the expected pixels by the whitened states of a belief."""
        begin = VEHICLE + CAMERA * self.camera
        states = belief.states_of(markings)
        by_centre = expected.by_place.reshape(-1, 8, 2)
        compiled = kernels()
        if compiled is not None:
            return np.asarray(compiled.spread(belief.root, expected.by_states, by_centre, states, begin))
        rows_of_states = [*range(VEHICLE), *range(begin, begin + CAMERA)]
        flat = expected.by_states.reshape(-1, VEHICLE + CAMERA) @ belief.root[rows_of_states]
        out = flat.reshape(len(markings), 8, -1)
        rows = np.flatnonzero(states >= 0)
        out[rows] += by_centre[rows] @ belief.root[states[rows, None] + _AXES]
        return np.asarray(out)

    def noise(self, pairs: Pairs, expected: Expected, belief: Belief | None) -> FloatArray:
        """The covariance (P, 8, 8) of pairs: detections, shapes, and places that ``belief`` does not hold."""
        map_m2 = self.paint.shape_m2[pairs.marking]
        if belief is not None:
            is_free = belief.states_of(pairs.marking) < 0
            map_m2[is_free] += np.tile(self.paint.centre_m2[pairs.marking[is_free]], (1, 4, 4))
        covariance_px2 = self.quads.covariance_px2
        compiled = kernels()
        if compiled is not None:
            detections = (covariance_px2, pairs.detection, pairs.order, self.noise_factor)
            by_corner = expected.by_place.reshape(-1, 8, 2)
            return np.asarray(compiled.pair_noise(*detections, map_m2, by_corner))
        rows = pairs.order
        out = covariance_px2[pairs.detection[:, None, None], rows[:, :, None], rows[:, None, :]]
        by_place = np.zeros((len(rows), 8, 8))
        for corner in range(4):
            axes = slice(2 * corner, 2 * corner + 2)
            by_place[:, axes, axes] = expected.by_place[:, corner]
        return np.asarray(self.noise_factor * out + by_place @ map_m2 @ by_place.swapaxes(1, 2))

    def residual(self, pairs: Pairs, expected: Expected) -> FloatArray:
        """Detected less expected pixels (P, 8)."""
        stacked = self.quads.corners_px.reshape(-1, 8)[pairs.detection]
        return np.asarray(np.take_along_axis(stacked, pairs.order, axis=1) - expected.px.reshape(-1, 8))

    def freedom(self, pairs: Pairs) -> FloatArray:
        """Numbers (P,) of a pair's coordinates that say anything."""
        return np.asarray(2.0 * self.quads.informs[pairs.detection].sum(axis=1))


class Located(NamedTuple):
    """A belief after an image."""

    belief: Belief
    pairs: Pairs
    squared: float  # squared distance of all pairs, in sigmas, the belief's own change included
    freedom: float  # coordinates of the pairs
    misfit: float  # squared residuals after the update, in sigmas of the noise
    misfit_freedom: float  # what that should be if the noise is as stated


def candidates(belief: Belief, scene: Scene) -> tuple[Pairs, FloatArray]:
    """All pairs that the belief allows, and minus twice their log likelihoods (P,)."""
    quads = scene.quads
    none = Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 8), np.int64)), np.zeros(0)
    neighbours = scene.paint.near(belief.mean[:2], _RANGE_M)
    if not len(quads.kinds) or not len(neighbours):
        return none
    pose = belief.map_from_vehicle(scene.plane)
    ground = ground_points(quads.corners_px, pose, scene.plane, scene.calibration)
    is_on_ground: BoolArray = np.asarray(quads.informs & np.isfinite(ground).all(axis=2))
    share = is_on_ground / np.maximum(is_on_ground.sum(axis=1, keepdims=True), 1)
    middle = (np.where(is_on_ground[..., None], ground, 0.0) * share[..., None]).sum(axis=1)
    arm_m = np.linalg.norm(middle - belief.mean[:2], axis=1)
    turn_rad = float(np.linalg.norm(belief.root[HEADING]))
    reach_m = _REACH_M + _REACH_SIGMAS * (belief.sigma_m + arm_m * turn_rad)
    apart_m = np.linalg.norm(middle[:, None] - scene.paint.centres_map[neighbours][None], axis=2)
    alike = np.array([scene.paint.looks_like(neighbours, kind) for kind in quads.kinds])
    reach_m = np.where(is_on_ground.sum(axis=1) > 0, reach_m, -1.0)
    detection, row = np.nonzero(alike & (apart_m < reach_m[:, None]))
    used, place = np.unique(row, return_inverse=True)
    expected = scene.expect(belief, neighbours[used])
    is_ahead = (np.isfinite(expected.px).sum(axis=(1, 2)) == 8)[place]
    detection = detection[is_ahead]
    place = place[is_ahead]
    if not len(detection):
        return none
    spread = scene.spread(belief, expected, neighbours[used])[place]
    expected = Expected(*(array[place] for array in expected))
    state_px2 = (spread**2).sum(axis=2)
    order = _order(quads, detection, expected.px.reshape(-1, 8), state_px2.mean(axis=1) + 1.0)
    pairs = Pairs(detection, neighbours[used][place], order)
    noise = scene.noise(pairs, expected, belief)
    distance = _distances(noise, scene.residual(pairs, expected), spread)
    fits = distance.squared <= largest_square(scene.freedom(pairs))
    loss = distance.squared + distance.log_determinant
    return pairs.subset(fits), loss[fits]


class _Distances(NamedTuple):
    """How far detections (P) lie from what is expected, in sigmas of noise and belief together."""

    squared: FloatArray  # (P,)
    log_determinant: FloatArray  # (P,) of the covariance


def _distances(noise: FloatArray, residual: FloatArray, spread: FloatArray) -> _Distances:
    """Distances of residuals (P, 8) by noise (P, 8, 8) and a belief's ``spread`` (P, 8, n)."""
    compiled = kernels()
    if compiled is not None:
        return _Distances(*compiled.distances(noise, residual, spread))
    total = spread @ spread.swapaxes(1, 2) + noise
    squared = (residual * np.linalg.solve(total, residual[..., None])[..., 0]).sum(axis=1)
    return _Distances(squared, np.linalg.slogdet(total)[1])


class _Whitened(NamedTuple):
    """Residuals (P, 8), and their slopes (P, 8, n), in sigmas of noise."""

    residual: FloatArray
    slope: FloatArray


def _whitened(noise: FloatArray, residual: FloatArray, spread: FloatArray) -> _Whitened:
    """Residuals (P, 8) and slopes (P, 8, n) by the root of noise (P, 8, 8)."""
    compiled = kernels()
    if compiled is not None:
        return _Whitened(*compiled.whiten(noise, residual, spread))
    inner = np.linalg.inv(np.linalg.cholesky(noise))
    return _Whitened((inner @ residual[..., None])[..., 0], inner @ spread)


class Offsets(NamedTuple):
    """How far detections (P) lie from markings on the ground."""

    off_m: FloatArray  # (P, 2) in the map
    covariance_m2: FloatArray  # (P, 2, 2)


def offsets(belief: Belief, scene: Scene, detection: IntArray, marking: IntArray) -> Offsets:
    """How far detections (P) lie from markings (P), by least squares over their corners in the image."""
    expected = scene.expect(belief, marking)
    spread = scene.spread(belief, expected, marking)
    state_px2 = (spread**2).sum(axis=2)
    order = _order(scene.quads, detection, expected.px.reshape(-1, 8), state_px2.mean(axis=1) + 1.0)
    pairs = Pairs(detection, marking, order)
    total = spread @ spread.swapaxes(1, 2) + scene.noise(pairs, expected, belief)
    by_place = expected.by_place.reshape(-1, 8, 2)
    weighted = np.linalg.solve(total, by_place)
    covariance_m2 = np.linalg.inv(by_place.swapaxes(1, 2) @ weighted)
    pull = weighted.swapaxes(1, 2) @ scene.residual(pairs, expected)[..., None]
    return Offsets((covariance_m2 @ pull)[..., 0], covariance_m2)


def _order(quads: Sighted, detection: IntArray, px: FloatArray, state_px2: FloatArray) -> IntArray:
    """The corners' orders (P, 8) in which detections lie nearest to markings at ``px`` (P, 8)."""
    turned = _SHIFT_ROWS[None]  # (1, 4, 8)
    stacked = quads.corners_px.reshape(-1, 8)[detection][:, turned[0]]
    variance = np.diagonal(quads.covariance_px2, axis1=1, axis2=2)[detection][:, turned[0]]
    squared = ((stacked - px[:, None]) ** 2 / (variance + state_px2[:, None, None])).sum(axis=2)
    return np.asarray(_SHIFT_ROWS[squared.argmin(axis=1)])


class Clear(NamedTuple):
    """Pairs that are clear, and whether others are not: that may be told once the clear ones are known."""

    pairs: Pairs
    is_all: bool


def clear_pairs(pairs: Pairs, loss: FloatArray) -> Clear:
    """The pairs that are the only explanation of a detection, one for each marking."""
    order = np.argsort(loss, kind="stable")
    best: dict[int, int] = {}
    doubted: set[int] = set()
    for row in order.tolist():
        detection = int(pairs.detection[row])
        if detection not in best:
            best[detection] = row
        elif loss[row] < loss[best[detection]] + CLEARER_BY:
            doubted.add(detection)
    paired: set[int] = set()
    rows = []
    for detection, row in sorted(best.items(), key=lambda item: float(loss[item[1]])):
        marking = int(pairs.marking[row])
        if detection not in doubted and marking not in paired:
            rows.append(row)
            paired.add(marking)
    return Clear(pairs.subset(np.array(sorted(rows), dtype=np.int64)), not doubted)


def update(belief: Belief, scene: Scene, pairs: Pairs) -> Located:
    """The belief after pairs: least squares over the whitened state, robust in each pair."""
    free = [marking for marking in pairs.marking.tolist() if marking not in belief.markings]
    belief = with_markings(belief, free, [scene.paint.centre_m2[marking] for marking in free])
    count = len(belief.mean)
    whitened = np.zeros(count)
    freedom = scene.freedom(pairs)
    step = np.zeros(count)
    for _ in range(_STEPS):
        at = replace(belief, mean=belief.mean + belief.root @ whitened)
        expected = scene.expect(at, pairs.marking)
        if not np.isfinite(expected.px).all():  # a corner is behind the camera
            return Located(belief, pairs, np.inf, 1.0, np.inf, 1.0)
        noise = scene.noise(pairs, expected, None)
        spread = scene.spread(belief, expected, pairs.marking)
        residual, slope = _whitened(noise, scene.residual(pairs, expected), spread)
        squared = (residual**2).sum(axis=1)
        weight = (_TAIL + freedom) / (_TAIL + squared)
        root_weight = np.sqrt(weight)[:, None]
        rows = (root_weight[..., None] * slope).reshape(-1, count)
        pull = (root_weight * residual).reshape(-1) @ rows - whitened
        information = np.eye(count) + rows.T @ rows
        step = np.linalg.solve(information, pull)
        whitened = whitened + step
        if np.abs(step).max() < _SETTLED:
            break
    left = residual - (slope @ step)
    misfit = float((weight * (left**2).sum(axis=1)).sum())
    inner = np.linalg.inv(np.linalg.cholesky(information))
    root = belief.root @ inner.T
    explained = count - float((inner**2).sum())
    after = replace(belief, mean=belief.mean + belief.root @ whitened, root=root)
    total = float((left**2).sum() + whitened @ whitened)
    return Located(after, pairs, total, float(freedom.sum()), misfit, float(freedom.sum()) - explained)


def locate(belief: Belief, scene: Scene) -> Located:
    """The belief after an image, whose detections are paired by individual and joint compatibility."""
    pairs, loss = candidates(belief, scene)
    chosen, is_all = clear_pairs(pairs, loss)
    nothing = Located(belief, chosen, 0.0, 0.0, 0.0, 0.0)
    if not len(chosen.detection):
        return nothing
    located = update(belief, scene, chosen)
    for _ in range(_ROUNDS - 1):
        if is_all:
            break
        pairs, loss = candidates(located.belief, scene)
        is_new = ~np.isin(pairs.detection, chosen.detection) & ~np.isin(pairs.marking, chosen.marking)
        more, is_all = clear_pairs(pairs.subset(is_new), loss[is_new])
        if not len(more.detection):
            break
        chosen = Pairs(*(np.concatenate(parts) for parts in zip(chosen, more, strict=True)))
        located = update(belief, scene, chosen)
    while located.squared > largest_square(np.array(located.freedom)):
        if len(chosen.detection) <= 1:
            return nothing
        chosen = chosen.subset(_all_but_worst(belief, scene, chosen, located))
        located = update(belief, scene, chosen)
    return located


def _all_but_worst(belief: Belief, scene: Scene, pairs: Pairs, located: Located) -> IntArray:
    """The rows of all pairs but the one that the others contradict most."""
    expected = scene.expect(located.belief, pairs.marking)
    noise = scene.noise(pairs, expected, None)
    residual = scene.residual(pairs, expected)
    squared = (residual * np.linalg.solve(noise, residual[..., None])[..., 0]).sum(axis=1)
    per_freedom = squared / np.maximum(scene.freedom(pairs), 1.0)
    return np.flatnonzero(np.arange(len(squared)) != per_freedom.argmax())


def explained(located: Located, is_judged: BoolArray) -> int:
    """How many of the detections (D,) that are judged are explained."""
    return int(is_judged[located.pairs.detection].sum())


def markings_of(parts: Sequence[Located]) -> set[int]:
    """The markings that images showed."""
    return {marking for located in parts for marking in located.pairs.marking.tolist()}
