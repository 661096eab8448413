"""How the errors of the recorded poses are modelled: states of a frame, and how they follow one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.problem import POSE_STATES, PoseSigma
from v2hdm.records import FloatArray

# Least step between frames, as a fraction of the correlation length.
_MIN_STEP = 1e-4
# Below this share of an error its white part is rounding left over from the drift.
_MIN_WHITE_SHARE = 1e-3


@dataclass(frozen=True)
class StateComponent:
    """One state of a frame: the tangent's column, its sigma, and how far it fades (0: white)."""

    column: int
    sigma: float
    over_m: float


def state_components(pose_sigma: PoseSigma, pose_states: tuple[str, ...]) -> list[StateComponent]:
    """The states of a frame: for each error its white part, then its drift, where there are any."""
    total, drifts = pose_sigma.by_state(), pose_sigma.drift_by_state()
    chosen = [k for k, name in enumerate(POSE_STATES) if name in pose_states]
    white = {k: float(np.sqrt(max(total[k] ** 2 - drifts[k].sigma ** 2, 0.0))) for k in chosen}
    components = [StateComponent(k, white[k], 0.0) for k in chosen if white[k] > _MIN_WHITE_SHARE * total[k]]
    fading = [k for k in chosen if drifts[k].sigma]
    return components + [StateComponent(k, drifts[k].sigma, drifts[k].over_m) for k in fading]


def state_prior(
    map_from_vehicle: FloatArray, components: list[StateComponent]
) -> tuple[FloatArray, FloatArray]:
    """Transition (J, S, S) and inverse sigma (J, S) of the innovation of each frame's states.

    A drift is a first-order Gauss-Markov process along the driven distance d: memory m = exp(-d / over_m),
    innovation variance sigma^2 (1 - m^2) (Gelb, Applied Optimal Estimation, section 3.8).
    """
    poses = map_from_vehicle
    if not components:
        return np.zeros((len(poses), 0, 0)), np.zeros((len(poses), 0))
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = np.tile(np.eye(6), (max(len(poses) - 1, 0), 1, 1))
    turn[:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    transition = np.zeros((len(poses), len(components), len(components)))
    information_root = np.empty((len(poses), len(components)))
    for a, state in enumerate(components):
        memory = np.zeros(len(poses))
        if state.over_m:
            # A vehicle at rest repeats its error; a floor on the step keeps the innovation's sigma above 0.
            memory[1:] = np.exp(-np.maximum(step_m / state.over_m, _MIN_STEP))
            for b, before in enumerate(components):
                if before.over_m:
                    transition[1:, a, b] = memory[1:] * turn[:, state.column, before.column]
        information_root[:, a] = 1 / (state.sigma * np.sqrt(1 - memory**2))
    return transition, information_root
