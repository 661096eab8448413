"""What the ground says of one camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from v2hdm.records import Calibration, FloatArray, IntArray

"""Indices."""


class GroundStatus(Enum):
    """Whether the ground gave an answer."""

    FOUND = "found"
    NO_MATCH = "no match"
    """Patches find no partner as the poses are given."""
    TOO_LITTLE = "too little"
    """Too little texture, motion or ground in view."""


class Reading(Enum):
    """How the recorded poses can be read."""

    AS_GIVEN = "as given"
    HEADING_FROM_PATH = "heading from path"
    """The vehicle heads along its path, whatever its recorded yaw."""
    MIRRORED = "mirrored"
    """x and y of the positions are swapped, which mirrors the world; the vehicle heads along its path."""
    BACKWARDS = "backwards"
    """The camera looks the other way than its guess: front and rear are swapped."""


@dataclass(frozen=True)
class Parameter:
    """One quantity that the ground may contradict, freed beside the mounting.

    ``name`` is one of: ``clock_s`` (an image was taken so much later on the poses' clock than its stamp
    says), ``focal_scale`` (focal length / given one - 1), ``distortion_k1`` (k1 - given one), ``grade`` (rise
    of the poses over the ground, m per m driven), ``up_m``, ``forward_m`` and ``left_m`` (camera centre -
    stated one). ``told`` says whether this drive can tell it at all; else ``why_not`` says which drive would.
    """

    name: str
    value: float
    sigma: float
    told: bool
    why_not: str = ""


@dataclass(frozen=True)
class MatchedGround:
    """Patches of ground found in both images of pairs, as raw pixels.

    ``pair_images`` (P, 2) are indices into ``Drive.images``; ``pair`` (N,) is each match's row of it;
    ``pair_poses`` (P, 2, 4, 4) are the ``map_from_vehicle`` of both with their estimated errors taken in.
    ``first_px`` and ``second_px`` (N, 2) are where the patch lies in the two images; ``correlation`` (N,).
    """

    pair_images: IntArray
    pair_poses: FloatArray
    pair: IntArray
    first_px: FloatArray
    second_px: FloatArray
    correlation: FloatArray


@dataclass(frozen=True)
class GroundEstimate:
    """What bare ground says of one camera's mounting and of what the drive states.

    ``shares``: of the patches, how many find a partner under each reading of the poses; ``reading`` is the
    best one. ``calibration`` has ``cam_from_vehicle`` with its covariance, None unless ``status`` is FOUND.
    ``median_residual`` is in units of :data:`v2hdm.ground.adjust.PIXEL_SIGMA`: .3 to .5 on a clean drive.
    ``pulls`` are the root mean squares of the poses' estimated errors in their stated sigmas.
    """

    camera: str
    status: GroundStatus
    shares: Mapping[Reading, float]
    reading: Reading
    calibration: Calibration | None
    guess_cam_from_vehicle: FloatArray
    parameters: Mapping[str, Parameter]
    median_residual: float
    pulls: Mapping[str, float]
    patches: MatchedGround | None
    seconds: float
