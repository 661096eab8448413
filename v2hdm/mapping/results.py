"""Results of a mapping method, and its solve's evidence on the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.faults import Contradiction
from v2hdm.io.maps.corrections import Heard
from v2hdm.io.maps.evidence import Residuals
from v2hdm.records import (
    BoolArray,
    Calibration,
    Changes,
    Exclusion,
    FloatArray,
    GroundPlane,
    HDMap,
    Image,
    IntArray,
    JointCovariance,
)
from v2hdm.site.markings import Suspicion
from v2hdm.surface.surface import Surface


@dataclass(frozen=True)
class CameraFit:
    """Fit of a camera: median variance factor, and contradicted fraction of its observations."""

    observations: int
    variance_factor: float
    rejected_share: float  # weighted by the corners' information
    sightings: float  # effective number: as many of equal information would tell as much about the share
    # Of each candidate, (J, 2): sightings, which add up to all, and those of them that are contradicted.
    by_candidate: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


class ForeignSegment(NamedTuple):
    """Images between two times that may be those of another drive."""

    begin_s: float
    end_s: float
    gain: float  # log-odds that they are


NO_SEGMENT = ForeignSegment(0.0, 0.0, 0.0)
"""No image is foreign: times, s, of an empty segment, and even odds."""


@dataclass(frozen=True)
class SolveEvidence:
    """Evidence from the joint optimisation of one set of cameras, for the checks."""

    score_tests: tuple[Contradiction, ...]  # every tested input as in the result, largest contradiction first
    corrected: tuple[Contradiction, ...]  # contradicted inputs, dropped or corrected before the result
    pose_model: str  # the estimated pose states, of :data:`v2hdm.adjust.MODELS`
    held_out: Mapping[str, float]  # mean robust loss by pose model; a little below 2 without errors
    fits: Mapping[str, CameraFit]  # by camera
    variance_factor: float  # as in :class:`CameraFit`, of all cameras
    pose_noise: Mapping[str, float]  # estimated over stated pose noise, by kind
    worst_innovation: float  # the largest, in sigmas
    worst_innovation_s: float  # its time, s
    clock_s: Sequence[Mapping[str, tuple[float, float]]] = ({},)  # by session and camera, with sigma
    read_out_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by camera, with sigma
    jitter_s: float = 0.0  # scatter of stamps, s, that would explain all noise of the positions
    along_over_across: float = 1.0  # ratio of white position errors along and across the path
    foreign: ForeignSegment = NO_SEGMENT
    clock_m: float | None = None  # 95 % radius of the corners by what clocks may err alone; None: they do not

    @property
    def held_out_loss(self) -> float | None:
        """Held-out loss of the chosen model; None if too few observations repeat."""
        return self.held_out.get(self.pose_model)


@dataclass(frozen=True)
class AdjustedPoses:
    """The vehicle's poses at the images' times, adjusted by a solve."""

    stamp_s: FloatArray  # (F,) exposure times on the poses' clock, rising within each session
    before: FloatArray  # (F, 4, 4) ``map_from_vehicle`` before the solve
    map_from_vehicle: FloatArray  # (F, 4, 4) adjusted; unchanged without markings
    sigma: FloatArray  # (F, 6) in vehicle axes, m and rad; as stated without markings
    has_marking: BoolArray  # (F,) whether a marking was seen
    frame: Mapping[Path, int]  # frame of each image, by its path
    session: IntArray  # (F,) session

    def of_image(self, image: Image) -> FloatArray:
        """Adjusted pose (4, 4) of an image; the recorded one if not in the solve."""
        frame = self.frame.get(image.path)
        return image.map_from_vehicle if frame is None else np.asarray(self.map_from_vehicle[frame])


@dataclass(frozen=True)
class ClockOffset:
    """Exposure minus stamp of a camera's images, s, with its standard deviation."""

    value_s: float
    sigma_s: float


@dataclass(frozen=True)
class OffGround:
    """A camera's mounting from markings, minus that from bare ground."""

    turn_deg: FloatArray  # (3,) in roll, pitch and yaw
    up_m: float
    sigmas: float  # root mean square, in the sigmas of both
    plane: GroundPlane | None = None  # the ground that a solve has taken in

    def is_of(self, plane: GroundPlane | None) -> bool:
        """Whether it is the ground of an estimate's ``plane``, which a surface may have moved since."""
        if plane is None or self.plane is None:
            return False
        return bool(np.array_equal(plane.root_information, self.plane.root_information))


@dataclass(frozen=True)
class MethodResult:
    """The result of one method for one set of cameras."""

    name: str
    cameras: tuple[str, ...]
    hd_map: HDMap
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)  # empty for an IPM alone
    excluded: tuple[Exclusion, ...] = ()
    reprojection_rmse_px: float | None = None  # of accepted corners; None without reprojection
    initial_reprojection_rmse_px: float | None = None  # under the initial extrinsic
    diagnostics: Mapping[str, float] = field(default_factory=dict)  # named figures for log and report
    certainty: Mapping[str, str] = field(default_factory=dict)  # by camera, on what determined it
    evidence: SolveEvidence | None = None  # for the checks after the solve
    poses: AdjustedPoses | None = None  # adjusted by the solve
    clocks: Sequence[Mapping[str, ClockOffset]] = ({},)  # by session and camera, with earlier corrections
    joint_covariance: JointCovariance | None = None  # of the map's corners, None if unknown
    residuals: Residuals | None = None  # of the accepted corner observations
    suspicions: Sequence[Suspicion] = ()  # worst markings first
    changes: Changes | None = None  # to an earlier map
    heard: tuple[Heard, ...] = ()  # corrections of markings that the map follows
    surface: Surface | None = None  # of the ground, None for a plane
    off_ground: Mapping[str, OffGround] = field(default_factory=dict)  # by camera whose ground was taken in
    alone: Mapping[str, MethodResult] = field(default_factory=dict)  # by camera, its observations alone
