"""The results of a mapping method, and the evidence of its solve about its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from v2hdm.adjust import ScoreTest
from v2hdm.association.surface import Surface
from v2hdm.io.maps.evidence import Residuals
from v2hdm.records import (
    BoolArray,
    Calibration,
    Changes,
    Exclusion,
    FloatArray,
    HdMap,
    Image,
    IntArray,
    JointCovariance,
)
from v2hdm.site.markings import Suspicion


@dataclass(frozen=True)
class Contradiction(ScoreTest):
    """One input that would have to be wrong, in the user's words: of which cameras, and ``about`` what."""

    cameras: tuple[str, ...] = ()
    about: str = ""


@dataclass(frozen=True)
class CameraFit:
    """How well a camera fits: its median variance over the stated, and the share that is contradicted."""

    observations: int
    variance_factor: float
    rejected_share: float


@dataclass(frozen=True)
class SolveEvidence:
    """The evidence that the joint optimisation of one set of cameras leaves for the checks."""

    # every input that was tested, as it stands in the result, the largest contradiction first
    score_tests: tuple[Contradiction, ...]
    # inputs that were contradicted, and dropped or corrected before the result was solved
    corrected: tuple[Contradiction, ...]
    pose_model: str  # what was estimated of the poses, of :data:`v2hdm.adjust.MODELS`
    # mean robust loss of held-out observations by pose model; a little below 2 without errors
    held_out: Mapping[str, float]
    fits: Mapping[str, CameraFit]  # by camera
    variance_factor: float  # as in :class:`CameraFit`, of all cameras
    # how many times as large as stated the drive shows the noise of the poses to be, by kind
    pose_noise: Mapping[str, float]
    worst_innovation: float  # the largest of them all, in sigmas
    worst_innovation_s: float  # when, s
    # by visit and camera the estimated clock offset and sigma, where the pose model has one
    clock_s: Sequence[Mapping[str, tuple[float, float]]] = ({},)
    # by camera the read-out time and its sigma, where it is estimated
    read_out_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    jitter_s: float = 0.0  # by how much stamps would scatter, s, were all noise of the positions from them
    along_over_across: float = 1.0  # how many times as much positions err anew along the way as across it
    # as :func:`v2hdm.mapping.foreign.foreign_stretch` finds it
    foreign: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def held_out_loss(self) -> float | None:
        """The held-out loss of the chosen model, None where too little was seen to hold any of it out."""
        return self.held_out.get(self.pose_model)


@dataclass(frozen=True)
class AdjustedPoses:
    """The vehicle's poses at the images' times, as a solve has adjusted them."""

    stamp_s: FloatArray  # (F,) when images were taken, on the clock of the poses, rising within each visit
    before: FloatArray  # (F, 4, 4) ``map_from_vehicle`` as it went into the solve
    map_from_vehicle: FloatArray  # (F, 4, 4) adjusted; as before where no marking was seen
    # (F, 6) along and about the vehicle's axes, m and rad; as stated where no marking was seen
    sigma: FloatArray
    seen: BoolArray  # (F,) whether a marking was seen then
    frame: Mapping[Path, int]  # which of them each image is of, by its path
    visit: IntArray  # (F,) of which visit each is

    def of_image(self, image: Image) -> FloatArray:
        """The adjusted pose (4, 4) of an image, that in its record where the solve knew nothing of it."""
        frame = self.frame.get(image.path)
        return image.map_from_vehicle if frame is None else np.asarray(self.map_from_vehicle[frame])


@dataclass(frozen=True)
class ClockOffset:
    """How much later than stamped a camera's images were taken, s, and how well that is known."""

    value_s: float
    sigma_s: float


@dataclass(frozen=True)
class MethodResult:
    """The outcome of one method on one set of cameras."""

    name: str
    cameras: tuple[str, ...]
    hd_map: HdMap
    # by camera, empty where the method only has an IPM
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    excluded: tuple[Exclusion, ...] = ()
    # over the accepted corner observations; None for methods that do not reproject
    reprojection_rmse_px: float | None = None
    # the same under the extrinsic that the optimisation started from
    initial_reprojection_rmse_px: float | None = None
    diagnostics: Mapping[str, float] = field(default_factory=dict)  # named figures for the log and the report
    # by camera, a sentence on what the drive determined and what rests on the survey
    certainty: Mapping[str, str] = field(default_factory=dict)
    evidence: SolveEvidence | None = None  # for the checks after the solve
    poses: AdjustedPoses | None = None  # as the solve has adjusted them
    # by visit the offsets of the cameras' clocks, corrections before the solve included
    clocks: Sequence[Mapping[str, ClockOffset]] = ({},)
    joint_covariance: JointCovariance | None = None  # of the map's corners, None where unknown
    residuals: Residuals | None = None  # of the accepted corner observations
    suspicions: Sequence[Suspicion] = ()  # of the most suspicious markings, the worst first
    changes: Changes | None = None  # of an earlier map that was brought up to date
    surface: Surface | None = None  # of the ground, None where it is a plane
