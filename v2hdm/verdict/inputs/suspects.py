"""Why ground never matches: usual mistakes undone one at a time, until it does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.ground import GroundEstimate, GroundOptions, GroundStatus, Reading, estimate_ground
from v2hdm.records import Camera, Drive, FloatArray, Trajectory

_FOOT_M = 0.3048

_QUICK = GroundOptions(pairs=12, free=(), readings=False)
"""A third of the usual pairs: whether the ground matches shows at once."""


@dataclass(frozen=True)
class Suspect:
    """A mistake that explains why nothing matches: ``undo`` makes the drive as it should have been."""

    undo: Callable[[Drive], Drive]
    says: str


def find_suspect(drive: Drive, ground: Mapping[str, GroundEstimate]) -> str | None:
    """The sentence of the mistake after whose undoing the ground of a camera that never matched does.

    None where all cameras match, or no mistake explains it.

    Raises:
        DriveError: an image cannot be read.
    """
    lost = [name for name, estimate in ground.items() if _never_matches(estimate)]
    if not lost or len(lost) < len(ground):
        return None
    for suspect in SUSPECTS:
        estimate = estimate_ground(suspect.undo(drive), lost[0], _QUICK)
        if estimate.status is GroundStatus.FOUND:
            return suspect.says
    return None


def _never_matches(estimate: GroundEstimate) -> bool:
    return estimate.status is GroundStatus.NO_MATCH and estimate.reading is Reading.AS_GIVEN


def scaled(drive: Drive, factor: float) -> Drive:
    """The drive with all positions multiplied by ``factor``."""
    return replace(
        drive,
        images=[
            replace(image, map_from_vehicle=_scaled(image.map_from_vehicle, factor)) for image in drive.images
        ],
        trajectory=_scaled_trajectory(drive.trajectory, factor),
        recorded=_scaled_trajectory(drive.recorded, factor),
        road=None,
    )


def upside_down(drive: Drive) -> Drive:
    """The drive as if all its images had been turned by 180 deg: their lenses and IPMs turned instead."""
    return replace(drive, cameras={name: _turned(camera) for name, camera in drive.cameras.items()})


def _turned(camera: Camera) -> Camera:
    info = camera.info
    turn = np.array([[-1.0, 0, info.width - 1], [0, -1.0, info.height - 1], [0, 0, 1]])
    intrinsic = info.intrinsic.copy()
    intrinsic[:2, 2] = np.array([info.width - 1, info.height - 1]) - intrinsic[:2, 2]
    distortion = list(info.distortion)
    if info.distortion_model != "equidistant":
        distortion[2:4] = [-distortion[2], -distortion[3]]  # p1 and p2 are even in the point, k1 ... odd
    return replace(
        camera,
        info=replace(info, intrinsic=intrinsic, distortion=tuple(distortion)),
        ipm={name: ipm @ turn for name, ipm in camera.ipm.items()},  # turn is its own inverse
    )


def _scaled_trajectory(trajectory: Trajectory | None, factor: float) -> Trajectory | None:
    if trajectory is None:
        return None
    return replace(trajectory, map_from_vehicle=_scaled(trajectory.map_from_vehicle, factor))


def _scaled(map_from_vehicle: FloatArray, factor: float) -> FloatArray:
    matrices = map_from_vehicle.copy()
    matrices[..., :3, 3] *= factor
    return matrices


SUSPECTS: tuple[Suspect, ...] = (
    Suspect(
        lambda drive: scaled(drive, _FOOT_M),
        "the ground matches once positions are taken for feet; multiply them by 0.3048 to give metres",
    ),
    Suspect(
        upside_down,
        "the ground matches once the images are turned by 180 deg: they are upside down; turn them, or the "
        "calibration",
    ),
)
"""The mistakes that are tried, the likelier first; each costs some seconds on a drive that fails anyway."""
