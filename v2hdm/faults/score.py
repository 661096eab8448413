"""The score test of one fault: in a problem's indices, and in the user's terms."""

from __future__ import annotations

from dataclasses import dataclass, field

from scipy.special import ndtri  # scipy.stats takes as long to load as a short drive to be checked

from v2hdm.faults.table import FAULTS, Error, Fault

_LEAST_P = 1e-300  # a smaller p-value is zero in floating point


def sigmas_of(p_value: float) -> float:
    """Two-sided p-value as a number of standard deviations of a normal distribution."""
    return -float(ndtri(max(p_value, _LEAST_P) / 2))


@dataclass(frozen=True)
class ScoreTest:
    """The test of one fault."""

    fault_name: str  # by its name alone a fault is cached and comes from another process
    camera: int  # index in the problem; -1 for all together
    axis: int  # which of the fault's axes, sides or shapes, as its record says; 0 if it has one
    item: int  # of what the fault's own ``item`` names; -1: of none, or of all
    value: float = 0.0  # true minus stated
    sigma: float = float("inf")  # from the segments' disagreement; inf if unobservable
    model_sigma: float = float("inf")  # standard deviation under the model's own noise
    p_value: float = 1.0  # probability of such a value without the fault; 1 if unobservable
    # log-likelihood ratio of the fault, each segment predicted from the others; negative if they disagree.
    # Surveyed centres and planes of the ground belong to no segment and count as they are.
    gain: float = 0.0
    # Root mean square motion of the corners, m, for an error of 1; 0 except for lenses.
    moves_m: float = field(default=0.0, kw_only=True)

    @property
    def fault(self) -> Fault:
        """The hypothesis."""
        return FAULTS[self.fault_name]

    @property
    def sigmas(self) -> float:
        """The p-value as a number of standard deviations of a normal distribution."""
        return sigmas_of(self.p_value)


@dataclass(frozen=True)
class Contradiction(ScoreTest):
    """A possible error of one input, in the user's terms: its cameras, and what it is ``about``."""

    cameras: tuple[str, ...] = ()
    about: str = ""

    @property
    def sentence(self) -> str:
        """The error and its size, as a clause."""
        return self.fault.sentence(Error(self.value, self.axis, self.cameras, self.about))
