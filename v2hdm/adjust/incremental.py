r"""The map while the vehicle drives: one marking at a time, at a cost that does not grow with the map.

Given the extrinsics the markings are independent, so all that the settled ones say about the extrinsics is
the sum of their Schur complements, one quadratic in the 6C tangents :math:`\xi` of
``cam_from_vehicle = exp(xi) @ start``. A further marking is solved for together with that quadratic, and
its own Schur complement is added. Every corner stays an affine function of :math:`\xi`, read on demand. To
take a marking back out, subtract what was added; to see it again, do that and solve it with all sightings.
When the number of markings has doubled, all are linearised anew: a constant share of the cost of each.

The poses' errors are marginalised out marking by marking, so that for the estimate two markings in one image
do not share them: what that gives away against the batch adjustment is the price of its independence. For the
covariance they do: with H the information, J_m the influence of the poses' errors e_m on marking m's part of
the gradient, it is that of a composite likelihood (Varin, Reid and Firth, Statistica Sinica 21, 2011),
:math:`H^{-1} (H + \sum_{m \ne n} J_m \, \mathrm{cov}(e_m, e_n) \, J_n^T) H^{-1}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from v2hdm.adjust.marking_fit import (
    MarkingObservations,
    Normal,
    back_projected,
    normal_equations,
    squared_residuals,
)
from v2hdm.adjust.pose_errors import Noise
from v2hdm.adjust.variance import VarianceFactors, variance_factors
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import exp, left_jacobian
from v2hdm.records import FloatArray

_MAX_STEPS = 30
# Mean squared step of an unknown, in standard deviations, below which nothing moves any more.
_STEP_TOLERANCE = 1e-4
_PREVIEW_TOLERANCE = 1e-2
_PASSES = 2
# Beyond so many times its length a drift's correlation is below one per cent.
_REACHES = 5.0


@dataclass(frozen=True)
class RigPrior:
    """What is known before the first marking.

    ``intrinsic`` (C, 4) is fx, fy, cx, cy; ``cam_from_vehicle`` (C, 4, 4) the start;
    ``centre_vehicle`` and ``centre_sigma_m`` (C, 3) the survey of the camera centres;
    ``rotation_sigma_rad`` how far off the start's rotation may be.
    """

    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    centre_vehicle: FloatArray
    centre_sigma_m: FloatArray
    rotation_sigma_rad: float = 0.1


@dataclass(frozen=True)
class Settled:
    """One marking of the map, linearised at the tangents ``at`` (6C,).

    Its corners are ``corners_map`` (n, 2) there and move by ``-gain`` (2n, 6C) times the change of the
    tangents; given the extrinsics their covariance is ``covariance_m2`` (2n, 2n). ``information`` (6C, 6C)
    and ``vector`` (6C,) are the marking's part of the extrinsics' normal equations. ``frame_state`` (F, 6)
    are the states of the marking's own frames, which cost ``state_squared`` standard deviations squared;
    ``influence`` (6C, 6F) is what errors of these states add to the vector.
    """

    observations: MarkingObservations
    at: FloatArray
    corners_map: FloatArray
    gain: FloatArray
    covariance_m2: FloatArray
    information: FloatArray
    vector: FloatArray
    frame_state: FloatArray
    state_squared: float
    influence: FloatArray

    def corners_at(self, tangents: FloatArray) -> FloatArray:
        """The corners (n, 2) under other extrinsics."""
        return self.corners_map - (self.gain @ (tangents - self.at)).reshape(-1, 2)


@dataclass
class State:
    """All that changes as the map grows.

    ``settled`` holds the markings by their number, of which ``linearised_count`` were there when all were
    last linearised anew; ``tangents`` (6C,) solves ``information`` (6C, 6C) times it = ``vector`` (6C,).
    """

    settled: dict[int, Settled]
    linearised_count: int
    tangents: FloatArray
    information: FloatArray
    vector: FloatArray

    @classmethod
    def empty(cls, prior: RigPrior, tangents: FloatArray) -> State:
        """No markings, and extrinsics to begin with at ``tangents`` (6C,)."""
        return cls({}, 0, tangents, *_prior_at(prior, tangents))


class IncrementalMap:
    """Extrinsics and corners, up to date after every marking."""

    def __init__(self, prior: RigPrior, noise: Noise, state: State | None = None) -> None:
        """Begin with an empty map, or go on from ``state``.

        Args:
            prior: what is known of the cameras.
            noise: how observations and poses err.
            state: where another map of the same rig stopped.
        """
        self.prior = prior
        self.noise = noise
        if state is None:
            state = State.empty(prior, np.zeros(6 * len(prior.cam_from_vehicle)))
        self.state = state

    @property
    def markings(self) -> Mapping[int, Settled]:
        """The settled markings by their number, in the order in which they came."""
        return self.state.settled

    @property
    def cam_from_vehicle(self) -> FloatArray:
        """The extrinsics (C, 4, 4) that all markings together say."""
        return self._extrinsics(self.state.tangents)

    @property
    def extrinsic_covariance(self) -> FloatArray:
        """Covariance (C, 6, 6) of each extrinsic's left tangent: translation m, rotation rad."""
        covariance = self._left_covariance()
        starts = range(0, len(covariance), 6)
        return np.stack([covariance[k : k + 6, k : k + 6] for k in starts])

    def corners_map(self, marking: int) -> FloatArray:
        """Corners (n, 2) of a marking under the present extrinsics."""
        return self._known(marking).corners_at(self.state.tangents)

    def corner_covariance(self, marking: int) -> FloatArray:
        """Joint covariance (2n, 2n), m^2, of a marking's corners."""
        return _corner_covariance(self._known(marking), self._tangent_covariance())

    def corner_covariances(self) -> dict[int, FloatArray]:
        """The same of all markings, by their number."""
        extrinsic = self._tangent_covariance()
        return {marking: _corner_covariance(one, extrinsic) for marking, one in self.markings.items()}

    def variance(self) -> VarianceFactors:
        """How many times as large as stated the variances are."""
        squared, of_priors, corners = [np.zeros(0)], self._prior_squared(), 0
        for marking, settled in self.state.settled.items():
            fit = squared_residuals(
                settled.observations,
                self.prior.intrinsic,
                self.cam_from_vehicle,
                self.corners_map(marking),
                settled.frame_state,
            )
            squared.append(fit)
            of_priors += settled.state_squared
            corners += len(settled.corners_map)
        free = 2 * corners + self.state.tangents.size - int(np.isfinite(self.prior.centre_sigma_m).sum())
        return variance_factors(np.concatenate(squared), of_priors, free)

    def _prior_squared(self) -> float:
        """How far the cameras' centres are from their prior, standard deviations squared."""
        extrinsics = self.cam_from_vehicle
        centre = -np.einsum("cba,cb->ca", extrinsics[:, :3, :3], extrinsics[:, :3, 3])
        return float(np.sum(((centre - self.prior.centre_vehicle) / self.prior.centre_sigma_m) ** 2))

    def preview(self, observations: MarkingObservations) -> FloatArray:
        """Where a marking's corners (n, 2) would come to lie, without taking it into the map.

        Raises:
            AdjustError: a corner has no observation, or the marking cannot be solved for.
        """
        settled, tangents = self._solve("preview", observations, None, _PREVIEW_TOLERANCE)
        return settled.corners_at(tangents)

    def observe(self, marking: int, observations: MarkingObservations) -> None:
        """Take a marking into the map; one that is in it already is re-estimated from all its observations.

        Raises:
            AdjustError: a corner has no observation, or the marking cannot be solved for.
        """
        before = self.state.settled.get(marking)
        if before is not None:
            observations = before.observations.joined(observations)
            self.forget(marking)
        try:
            settled, _ = self._solve(marking, observations, before)
        except AdjustError:
            if before is not None:
                self._add(marking, before)
            raise
        self._add(marking, settled)
        if len(self.state.settled) >= 2 * self.state.linearised_count:
            self.linearise()

    def forget(self, marking: int) -> None:
        """Take a marking back out of the map and out of what the extrinsics rest on."""
        settled = self._known(marking)
        del self.state.settled[marking]
        self.state.information = self.state.information - settled.information
        self.state.vector = self.state.vector - settled.vector
        self.state.tangents = _solved(self.state.information, self.state.vector)

    def linearise(self) -> None:
        """Linearise everything anew where it is now; happens by itself whenever the map has doubled."""
        for _ in range(_PASSES):
            at = self.state.tangents
            self.state.information, self.state.vector = _prior_at(self.prior, at)
            for marking, settled in self.state.settled.items():
                renewed = self._settle(settled.observations, at, settled.corners_at(at), settled.frame_state)
                self.state.settled[marking] = renewed
                self.state.information = self.state.information + renewed.information
                self.state.vector = self.state.vector + renewed.vector
            self.state.tangents = _solved(self.state.information, self.state.vector)
        self.state.linearised_count = len(self.state.settled)

    def _add(self, marking: int, settled: Settled) -> None:
        """Add a marking's part to the normal equations and solve them."""
        self.state.settled[marking] = settled
        self.state.information = self.state.information + settled.information
        self.state.vector = self.state.vector + settled.vector
        self.state.tangents = _solved(self.state.information, self.state.vector)

    def _known(self, marking: int) -> Settled:
        if marking not in self.state.settled:
            raise AdjustError(f"marking {marking} is not in the map")
        return self.state.settled[marking]

    def _extrinsics(self, tangents: FloatArray) -> FloatArray:
        return np.asarray(exp(tangents.reshape(-1, 6)) @ self.prior.cam_from_vehicle)

    def _left_covariance(self) -> FloatArray:
        """Covariance (6C, 6C) of the left tangents at the present extrinsics."""
        turn = block_diag(*left_jacobian(self.state.tangents.reshape(-1, 6)))
        return np.asarray(turn @ self._tangent_covariance() @ turn.T)

    def _tangent_covariance(self) -> FloatArray:
        """Covariance (6C, 6C) of the tangents, errors that markings share included."""
        alone = np.linalg.inv(self.state.information)
        return np.asarray(alone + alone @ self._shared() @ alone)

    def _shared(self) -> FloatArray:
        """What the poses' errors that markings share add to the variance (6C, 6C) of the vector."""
        settled = list(self.state.settled.values())
        frames = [one.observations.frames for one in settled]
        begin, end = (np.array([pick(f.travelled_m) for f in frames]) for pick in (np.min, np.max))
        reach_m = _REACHES * self.noise.reach_m
        out = np.zeros_like(self.state.information)
        for m, one in enumerate(settled):
            near = (begin <= end[m] + reach_m) & (end >= begin[m] - reach_m)
            for n in np.flatnonzero(near[:m]).tolist():
                part = one.influence @ self.noise.covariance(frames[m], frames[n]) @ settled[n].influence.T
                out += part + part.T
        return out

    def _solve(
        self,
        marking: int | str,
        observations: MarkingObservations,
        before: Settled | None = None,
        tolerance: float = _STEP_TOLERANCE,
    ) -> tuple[Settled, FloatArray]:
        """Gauss-Newton over the marking's corners and the extrinsics, the settled markings as a quadratic.

        Corners and frames that were there ``before`` start where they were.
        """
        unseen = np.flatnonzero(np.bincount(observations.corner) == 0)
        if len(unseen):
            raise AdjustError(
                f"corner {unseen[0]} of marking {marking} has no observation: number them from 0"
            )
        for name in ("vehicle_from_map", "pinhole_px", "covariance_px"):
            if not np.isfinite(getattr(observations, name)).all():
                raise AdjustError(f"{name} of marking {marking} is not finite: leave that observation out")
        tangents = self.state.tangents
        corners = back_projected(observations, self.prior.intrinsic, self._extrinsics(tangents))
        frames = np.unique(observations.frame)
        state = np.zeros((len(frames), 6))
        if before is not None:
            corners[: len(before.corners_map)] = before.corners_at(tangents)
            state[np.searchsorted(frames, np.unique(before.observations.frame))] = before.frame_state
        for _ in range(_MAX_STEPS):
            settled = self._settle(observations, tangents, corners, state)
            information = self.state.information + settled.information
            reached = _solved(information, self.state.vector + settled.vector)
            step = reached - tangents
            moved = settled.corners_at(reached)
            shift = (moved - corners).reshape(-1)
            length = step @ information @ step + shift @ np.linalg.solve(settled.covariance_m2, shift)
            tangents, corners, state = reached, moved, settled.frame_state
            if not np.isfinite(length):
                break
            if length < tolerance * (len(step) + len(shift)):
                return settled, reached
        raise AdjustError(
            f"marking {marking} does not settle: its observations contradict one another or lie above the "
            "horizon; leave it out"
        )

    def _settle(
        self, observations: MarkingObservations, tangents: FloatArray, corners: FloatArray, state: FloatArray
    ) -> Settled:
        """Linearise a marking and eliminate its corners."""
        normal = normal_equations(
            observations, self.prior.intrinsic, self._extrinsics(tangents), corners, state, self.noise
        )
        return _eliminated(observations, normal, tangents, corners)


def _prior_at(prior: RigPrior, tangents: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The prior's part of the normal equations, linearised at ``tangents``: (6C, 6C) and (6C,)."""
    extrinsics = exp(tangents.reshape(-1, 6)) @ prior.cam_from_vehicle
    rotation, translation = extrinsics[:, :3, :3], extrinsics[:, :3, 3]
    off = -np.einsum("cba,cb->ca", rotation, translation) - prior.centre_vehicle
    root = 1 / prior.centre_sigma_m
    information = np.zeros((len(tangents),) * 2)
    vector = np.zeros(len(tangents))
    for c, chart in enumerate(left_jacobian(tangents.reshape(-1, 6))):
        part = slice(6 * c, 6 * c + 6)
        # A left perturbation moves the centre by minus its translation, turned into the vehicle.
        jacobian = np.zeros((3, 6))
        jacobian[:, :3] = -rotation[c].T * root[c][:, None]
        jacobian = jacobian @ chart
        information[part, part] = jacobian.T @ jacobian
        vector[part] = -jacobian.T @ (off[c] * root[c])
    vector += information @ tangents
    turns = np.tile([0, 0, 0, 1, 1, 1], len(extrinsics)) / prior.rotation_sigma_rad**2
    return information + np.diag(turns), vector


def _corner_covariance(settled: Settled, extrinsic: FloatArray) -> FloatArray:
    return np.asarray(settled.covariance_m2 + settled.gain @ extrinsic @ settled.gain.T)


def _solved(information: FloatArray, vector: FloatArray) -> FloatArray:
    return np.asarray(cho_solve(cho_factor(information, lower=True), vector))


def _eliminated(
    observations: MarkingObservations, normal: Normal, tangents: FloatArray, corners: FloatArray
) -> Settled:
    chart = block_diag(*left_jacobian(tangents.reshape(-1, 6)))
    factor = cho_factor(normal.V, lower=True)
    gain = cho_solve(factor, normal.W.T)
    best = corners - cho_solve(factor, normal.by_corner).reshape(-1, 2)
    information = chart.T @ (normal.U - normal.W @ gain) @ chart
    gradient = chart.T @ (normal.by_extrinsic - gain.T @ normal.by_corner)
    return Settled(
        observations=observations,
        at=tangents,
        corners_map=best,
        gain=gain @ chart,
        covariance_m2=cho_solve(factor, np.eye(len(normal.V))),
        information=(information + information.T) / 2,
        vector=information @ tangents - gradient,
        frame_state=normal.frame_state,
        state_squared=normal.state_squared,
        influence=chart.T @ (normal.influence[: len(chart)] - gain.T @ normal.influence[len(chart) :]),
    )
