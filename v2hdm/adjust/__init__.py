"""Bundle adjustment of marking corners, camera extrinsics and vehicle poses on the ground plane.

``solve(problem, options) -> solution``: numpy in, numpy out; torch's LBFGS on whitened variables
inside. :mod:`v2hdm.adjust.problem` states the model. What is done to every observation torch does, or
:mod:`v2hdm.adjust.engines.numba` where numba is installed.
"""

from v2hdm.adjust.observability import Observability, observability, observed
from v2hdm.adjust.problem import (
    ControlPoints,
    Drift,
    KnownLengths,
    Observations,
    PoseSigma,
    Problem,
    SolveOptions,
)
from v2hdm.adjust.pulls import PosePulls, pose_pulls
from v2hdm.adjust.score_tests import Fault, Suspect, suspects
from v2hdm.adjust.selection import MODELS, Model, Selection, select_model, with_model
from v2hdm.adjust.solution import Solution, Status
from v2hdm.adjust.solve import solve
from v2hdm.adjust.validation import Excluded, Verdict

__all__ = [
    "MODELS",
    "ControlPoints",
    "Drift",
    "Excluded",
    "Fault",
    "KnownLengths",
    "Model",
    "Observability",
    "Observations",
    "PosePulls",
    "PoseSigma",
    "Problem",
    "Selection",
    "Solution",
    "SolveOptions",
    "Status",
    "Suspect",
    "Verdict",
    "observability",
    "observed",
    "pose_pulls",
    "select_model",
    "solve",
    "suspects",
    "with_model",
]
