"""Faults of the inputs: what each is, its score test at a solution, its odds, and what corrects it."""

from v2hdm.faults.score import Contradiction, ScoreTest, sigmas_of
from v2hdm.faults.table import FAULTS, Fault, Item, Recovery

__all__ = ["FAULTS", "Contradiction", "Fault", "Item", "Recovery", "ScoreTest", "sigmas_of"]
