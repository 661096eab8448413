"""What a solve says of its own inputs: how well everything fits, and which input would have to be wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from v2hdm.adjust import Fault
from v2hdm.records import FloatArray

WINDOW_OBSERVATIONS = 200
"""Observations of a window along the route: their median varies by a tenth by chance."""

CELLS = (4, 6)
"""Rows and columns that an image is divided into for the mean residual of each."""


@dataclass(frozen=True)
class Contradiction:
    """One input that would have to be wrong, as far as the residuals say.

    Attributes:
        fault: what would be wrong.
        cameras: of which cameras.
        axis: along which axis, 0 to 2, of the vehicle (survey, lever) or the map (slope, datum).
        about: the class of a known size and its length, a surveyed point, or the visit of a clock; empty for
            others.
        value: by how much, true minus stated: s, m, rad or a share.
        sigma: how well this drive tells, inf where it cannot.
        sigmas: the value in sigmas, by its chi-square: of one degree of freedom, of two for a surveyed point.
    """

    fault: Fault
    cameras: tuple[str, ...]
    axis: int
    about: str
    value: float
    sigma: float
    sigmas: float


@dataclass(frozen=True)
class CameraFit:
    """How well one camera's observations fit.

    Attributes:
        observations: how many there are.
        variance_factor: how many times as large as stated by the detector their variances are, by the median.
        rejected_share: share of them that the rest contradicts.
        bias_px: longest median residual of the cells of its image (see :data:`CELLS`), px.
    """

    observations: int
    variance_factor: float
    rejected_share: float
    bias_px: float


@dataclass(frozen=True)
class SolveEvidence:
    """What the joint optimisation of one set of cameras leaves to judge.

    Attributes:
        suspects: every input that was tested, as it stands in the result, the largest contradiction first.
        corrected: inputs that were contradicted, and dropped or put right before the result was solved.
        pose_model: what was estimated of the poses, of :data:`v2hdm.adjust.MODELS`.
        held_out: mean robust loss of held-out observations by pose model; a little below 2 without errors.
        fits: by camera.
        variance_factor: as in :class:`CameraFit`, of all cameras.
        along_route: (W,) the same of windows of :data:`WINDOW_OBSERVATIONS` in driving order.
        window_s: (W,) when each window begins, s.
        pose_pulls: root mean square by state of a pose, of what was taken off it, in the stated sigmas; at
            most 1 where these are right.
        worst_pull: the largest of them all, in sigmas.
        worst_pull_s: when, s.
        clock_s: of each visit, by camera its estimated clock offset and sigma, where the pose model has one.
    """

    suspects: tuple[Contradiction, ...]
    corrected: tuple[Contradiction, ...]
    pose_model: str
    held_out: Mapping[str, float]
    fits: Mapping[str, CameraFit]
    variance_factor: float
    along_route: FloatArray
    window_s: FloatArray
    pose_pulls: Mapping[str, float]
    worst_pull: float
    worst_pull_s: float
    clock_s: Sequence[Mapping[str, tuple[float, float]]] = ({},)

    @property
    def held_out_loss(self) -> float | None:
        """That of the chosen model, None where too little was seen to hold any of it out."""
        return self.held_out.get(self.pose_model)
