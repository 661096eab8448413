"""The mapper's mountings against those that bare ground gives, which no marking has a part in."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from v2hdm.geometry.rigid import camera_centre
from v2hdm.ground import GroundEstimate, GroundStatus
from v2hdm.records import Calibration
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.results.mountings import mounting_difference, mounting_sigmas
from v2hdm.verdict.verdict import Finding

GROUND_LIMIT_SIGMAS = 4.0
"""Root mean square of the six parameters' deviations, in the sigmas of both: one in a million by chance."""

LEAST_TURN_DEG = 0.2
LEAST_HEIGHT_M = 0.04
"""Where the mountings turn by less and their heights differ by less, the ground is no better judge."""


def check_against_ground(
    calibrations: Mapping[str, Calibration], ground: Mapping[str, GroundEstimate]
) -> list[Finding]:
    """Each camera's mounting as the mapper has it against that of the bare ground, where there is one."""
    findings = []
    for name, calibration in calibrations.items():
        estimate = ground.get(name)
        if estimate is None or estimate.status is not GroundStatus.FOUND or estimate.calibration is None:
            continue
        if calibration.covariance is None or estimate.calibration.covariance is None:
            continue
        findings.append(_compare(name, calibration, estimate.calibration))
    return findings


def _compare(name: str, mapped: Calibration, ground: Calibration) -> Finding:
    off = mounting_difference(ground, mapped)
    rotation = mapped.cam_from_vehicle[:3, :3]
    turn_deg = np.rad2deg(rotation.T @ off[3:])
    up_m = float(camera_centre(mapped.cam_from_vehicle)[2] - camera_centre(ground.cam_from_vehicle)[2])
    small = np.abs(turn_deg).max() < LEAST_TURN_DEG and abs(up_m) < LEAST_HEIGHT_M
    sigmas = mounting_sigmas(ground, mapped, of_both=True)
    roll, pitch, yaw = turn_deg
    return judge(
        "ground",
        name,
        0.0 if small else sigmas,
        GROUND_LIMIT_SIGMAS,
        "sigmas",
        fine=f"markings and bare ground agree on its mounting ({np.abs(turn_deg).max():.2f} deg at most)",
        wrong=f"markings and bare ground do not agree on its mounting (roll {roll:+.2f}, pitch "
        f"{pitch:+.2f}, yaw "
        f"{yaw:+.2f} deg, height {100 * up_m:+.0f} cm): wrong associations, or ground that is not flat; "
        f"look at "
        "the overlay",
    )
