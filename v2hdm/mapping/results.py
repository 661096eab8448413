"""What a mapping method hands back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from v2hdm.io.maps.evidence import Residuals
from v2hdm.mapping.evidence import SolveEvidence
from v2hdm.records import BoolArray, Calibration, Changes, FloatArray, HdMap, Image, IntArray, Marking


@dataclass(frozen=True)
class Exclusion:
    """One candidate marking that did not enter the map: what, where (2,) in the map, and why."""

    kind: str
    position_map: FloatArray
    sightings: int
    reason: str


@dataclass(frozen=True)
class GrowthStep:
    """The state after the first markings of a drive: their map and the extrinsics by camera."""

    markings: tuple[Marking, ...]
    cam_from_vehicle: Mapping[str, FloatArray]


@dataclass(frozen=True)
class AdjustedPoses:
    """The vehicle's poses at the images' times, as a solve has adjusted them.

    Attributes:
        stamp_s: (F,) when images were taken, on the clock of the poses, rising within each visit.
        before: (F, 4, 4) ``map_from_vehicle`` as it went into the solve.
        map_from_vehicle: (F, 4, 4) adjusted; as before where no marking was seen.
        sigma: (F, 6) standard deviations along and about the vehicle's axes, m and rad; those stated by the
            drive where no marking was seen.
        seen: (F,) whether a marking was seen then.
        frame: which of them each image is of, by its path.
        visit: (F,) of which visit each is.
    """

    stamp_s: FloatArray
    before: FloatArray
    map_from_vehicle: FloatArray
    sigma: FloatArray
    seen: BoolArray
    frame: Mapping[Path, int]
    visit: IntArray

    def of_image(self, image: Image) -> FloatArray:
        """The adjusted pose (4, 4) of an image, that in its record where the solve knew nothing of it."""
        frame = self.frame.get(image.path)
        return image.map_from_vehicle if frame is None else np.asarray(self.map_from_vehicle[frame])


@dataclass(frozen=True)
class ClockOffset:
    """How much later than stamped a camera's images were taken, s, and how well that is known."""

    value_s: float
    sigma_s: float


class Corners(Protocol):
    """How the errors of a map's corners hang together."""

    def covariance(self, marking: IntArray, corner: IntArray) -> FloatArray:
        """Joint covariance (2N, 2N), m^2, of corners (N,) of markings (N,), stacked x0, y0, x1, ..."""


@dataclass(frozen=True)
class MethodResult:
    """The outcome of one method on one set of cameras.

    ``calibrations`` are per camera, empty where the method only has an IPM. ``reprojection_rmse_px``
    (and ``initial_reprojection_rmse_px``, under the extrinsic the optimisation started from) are
    over the same accepted corner observations; None for methods that do not reproject.
    ``growth`` is how the result came about, marking by marking, where that was asked for;
    ``diagnostics`` are named figures for the log and the report; ``certainty`` says of each camera
    in a sentence what the drive determined and what rests on the survey; ``evidence`` is what the checks
    after the solve rest on, ``poses`` the vehicle's poses as the solve has adjusted them, ``clocks`` of
    each visit the offsets of the cameras' clocks, corrections before the solve included; ``corners`` how the
    errors of the map's corners hang together, None where nothing tells; ``residuals`` are those of the corner
    observations that it accepted; ``changes`` what became of an earlier map that was brought up to date.
    """

    name: str
    cameras: tuple[str, ...]
    hd_map: HdMap
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    excluded: tuple[Exclusion, ...] = ()
    reprojection_rmse_px: float | None = None
    initial_reprojection_rmse_px: float | None = None
    growth: tuple[GrowthStep, ...] = ()
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    certainty: Mapping[str, str] = field(default_factory=dict)
    evidence: SolveEvidence | None = None
    poses: AdjustedPoses | None = None
    clocks: Sequence[Mapping[str, ClockOffset]] = ({},)
    corners: Corners | None = None
    residuals: Residuals | None = None
    changes: Changes | None = None
