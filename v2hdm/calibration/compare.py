"""Whether a camera has moved on its vehicle between two calibrations, by how much, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc, chdtri, chndtr

from v2hdm.errors import MapFileError
from v2hdm.geometry.rigid import adjoint, camera_centre, inverse, log
from v2hdm.records import Calibration, FloatArray

# Probability that a camera at rest is said to have moved: once in 20 years, checked weekly.
FALSE_ALARM = 1e-3
_MISSED = 0.05  # probability with which a movement of the size reported as detectable would be missed

# Difference of the intrinsics, as a share of focal length or width, up to which they are of one lens: more of
# it turns into pitch, yaw and height.
_SAME_LENS = 2e-3


@dataclass(frozen=True)
class Movement:
    """How a camera has moved along and about the vehicle's axes: forward, left, up."""

    camera: str
    shift_m: FloatArray  # (3,)
    turn_rad: FloatArray  # (3,)
    covariance: FloatArray  # (6, 6) of both
    probability: float  # of differences at least as large where nothing has moved

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (6,) of shift, m, and turn, rad."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def detectable(self) -> FloatArray:
        """The least shifts, m, and turns, rad, each alone (6,), that would hardly be missed."""
        limit = chdtri(6, FALSE_ALARM)
        needed = brentq(lambda offset: _MISSED - chndtr(limit, 6, offset), 1.0, 1e3)
        return np.asarray(np.sqrt(needed / np.diag(np.linalg.inv(self.covariance))))

    @property
    def moved(self) -> bool:
        """Whether the difference is more than the two calibrations' own errors."""
        return self.probability < FALSE_ALARM


def compare_calibrations(
    before: Mapping[str, Calibration], after: Mapping[str, Calibration]
) -> list[Movement]:
    """The movements of the cameras that both hold; raises MapFileError where none, or as :func:`movement`."""
    common = [name for name in before if name in after]
    if not common:
        raise MapFileError(f"no camera in common: {', '.join(before)} and {', '.join(after)}; compare others")
    return [movement(before[name], after[name]) for name in common]


def movement(before: Calibration, after: Calibration) -> Movement:
    """The movement between two independent calibrations of one camera and lens; else MapFileError."""
    _check_comparable(before, after)
    assert before.covariance is not None
    assert after.covariance is not None
    change = after.cam_from_vehicle @ inverse(before.cam_from_vehicle)
    tangent = log(change)
    carried = adjoint(change)
    spread = after.covariance + carried @ before.covariance @ carried.T
    squared = float(tangent @ np.linalg.solve(spread, tangent))
    # A left perturbation (v, w) of cam_from_vehicle moves the centre by -R'v and turns the camera by -R'w.
    to_vehicle = -np.kron(np.eye(2), before.cam_from_vehicle[:3, :3].T)
    shift_m = camera_centre(after.cam_from_vehicle) - camera_centre(before.cam_from_vehicle)
    return Movement(
        camera=before.info.name,
        shift_m=np.asarray(shift_m),
        turn_rad=np.asarray(to_vehicle[3:, 3:] @ tangent[3:]),
        covariance=np.asarray(to_vehicle @ spread @ to_vehicle.T),
        probability=float(chdtrc(6, max(squared, 0.0))),
    )


def turned_alike(movements: Sequence[Movement]) -> bool:
    """Whether several cameras turned alike: then the heading changed, not the cameras."""
    if len(movements) < 2 or not all(movement.moved for movement in movements):
        return False
    first = movements[0]
    for other in movements[1:]:
        off = other.turn_rad - first.turn_rad
        spread = other.covariance[3:, 3:] + first.covariance[3:, 3:]
        if chdtrc(3, off @ np.linalg.solve(spread, off)) < FALSE_ALARM:
            return False
    return True


def _check_comparable(before: Calibration, after: Calibration) -> None:
    """Raise MapFileError for calibrations that are not of one camera and lens, or have no covariance."""
    first = before.info
    second = after.info
    who = f"camera '{first.name}'"
    if first.name != second.name:
        raise MapFileError(f"{who} and '{second.name}': two different cameras; give two calibrations of one")
    kinds = [(info.width, info.height, info.distortion_model) for info in (first, second)]
    if kinds[0] != kinds[1]:
        raise MapFileError(f"{who}: image sizes or lens models differ; calibrate with the same intrinsics")
    off = np.abs(first.intrinsic - second.intrinsic).max()
    if off > _SAME_LENS * max(first.intrinsic[0, 0], first.width):
        raise MapFileError(
            f"{who}: the intrinsics differ by {off:.1f} px, which looks like a movement; calibrate "
            "with the same intrinsics both times"
        )
    for calibration, which in ((before, "first"), (after, "second")):
        covariance = calibration.covariance
        if covariance is None or np.linalg.eigvalsh(covariance).min() <= 0:
            raise MapFileError(
                f"{who}: the {which} calibration has no covariance to compare a movement with; "
                "take one that v2hdm map or v2hdm calibrate ground wrote"
            )
