"""How the errors of the recorded poses are modelled: states of a frame, and how they follow one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.problem import POSE_STATES, PoseSigma
from v2hdm.records import FloatArray, IntArray

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


def state_components(
    pose_sigmas: Sequence[PoseSigma], pose_states: tuple[str, ...]
) -> list[list[StateComponent]]:
    """By visit the states of a frame: for each error its white part, then its drift, where there are any.

    All visits have the same columns. What only others have is rounding in a visit's own.
    """
    chosen = [k for k, name in enumerate(POSE_STATES) if name in pose_states]
    totals = [one.by_state() for one in pose_sigmas]
    drifts = [one.drift_by_state() for one in pose_sigmas]
    white = [
        {k: float(np.sqrt(max(total[k] ** 2 - drift[k].sigma ** 2, 0.0))) for k in chosen}
        for total, drift in zip(totals, drifts, strict=True)
    ]
    pairs = list(zip(totals, white, strict=True))
    scattering = [k for k in chosen if any(own[k] > _MIN_WHITE_SHARE * total[k] for total, own in pairs)]
    fading = [k for k in chosen if any(drift[k].sigma for drift in drifts)]
    return [
        [StateComponent(k, max(own[k], _MIN_WHITE_SHARE * total[k]), 0.0) for k in scattering]
        + [
            StateComponent(k, max(drift[k].sigma, _MIN_WHITE_SHARE * total[k]), drift[k].over_m)
            for k in fading
        ]
        for total, own, drift in zip(totals, white, drifts, strict=True)
    ]


def state_prior(
    map_from_vehicle: FloatArray, by_visit: Sequence[list[StateComponent]], visit: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Transition (J, S, S) and inverse sigma (J, S) of the innovation of each frame's states.

    ``by_visit`` are the components of each visit, ``visit`` (J,) is that of each frame; no state outlasts
    its visit. A drift is a first-order Gauss-Markov process along the driven distance d: memory
    m = exp(-d / over_m), innovation variance sigma^2 (1 - m^2) (Gelb, Applied Optimal Estimation, section
    3.8).
    """
    poses, components = map_from_vehicle, by_visit[0]
    if not components:
        return np.zeros((len(poses), 0, 0)), np.zeros((len(poses), 0))
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = np.tile(np.eye(6), (max(len(poses) - 1, 0), 1, 1))
    turn[:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    continued = np.diff(visit) == 0
    sigma = np.array([[one.sigma for one in states] for states in by_visit])[visit]
    over_m = np.array([[one.over_m for one in states] for states in by_visit])[visit]
    transition = np.zeros((len(poses), len(components), len(components)))
    information_root = np.empty((len(poses), len(components)))
    for a, state in enumerate(components):
        memory = np.zeros(len(poses))
        if state.over_m:
            # A vehicle at rest repeats its error; a floor on the step keeps the innovation's sigma above 0.
            memory[1:] = continued * np.exp(-np.maximum(step_m / over_m[1:, a], _MIN_STEP))
            for b, before in enumerate(components):
                if before.over_m:
                    transition[1:, a, b] = memory[1:] * turn[:, state.column, before.column]
        information_root[:, a] = 1 / (sigma[:, a] * np.sqrt(1 - memory**2))
    return transition, information_root
