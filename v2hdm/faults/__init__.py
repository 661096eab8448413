"""Faults of the inputs: what each is, its score test at a solution, its odds, and what corrects it."""

from v2hdm.faults.score_tests import CHANGES, Fault, ScoreTest, score_faults, sigmas_of
from v2hdm.faults.sensitivity import height_information, moves_with_heights

__all__ = [
    "CHANGES", "Fault", "ScoreTest", "height_information", "moves_with_heights", "score_faults", "sigmas_of",
]  # fmt: skip
