"""Bundle adjustment of marking corners, camera extrinsics and vehicle poses on the ground plane.

``solve(problem, options) -> solution``, numpy in and out, by torch's LBFGS on whitened variables.
:mod:`v2hdm.adjust.problem` states unknowns and data, :mod:`v2hdm.adjust.model` every residual, which
:mod:`v2hdm.adjust.engine` evaluates and linearises; :mod:`v2hdm.adjust.kernels` does the same faster.
"""

from v2hdm.adjust.model import MIN_DEPRESSION_SINE
from v2hdm.adjust.problem import (
    ControlPoints,
    Drift,
    GroundPlanes,
    KnownLengths,
    Observations,
    PoseSigma,
    Problem,
    SolveOptions,
)  # fmt: skip
from v2hdm.adjust.selection import MODELS, estimate_noise, predicts_better, select_model, with_model
from v2hdm.adjust.solution import Solution, Status, Verdict, observability, pose_innovations
from v2hdm.adjust.solve import solve

__all__ = [
    "MIN_DEPRESSION_SINE", "MODELS", "ControlPoints", "Drift", "GroundPlanes", "KnownLengths",
    "Observations", "PoseSigma", "Problem", "Solution", "SolveOptions", "Status", "Verdict",
    "estimate_noise", "observability", "pose_innovations", "predicts_better", "select_model", "solve",
    "with_model",
]  # fmt: skip
