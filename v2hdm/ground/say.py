"""An estimate in words: one line of figures, and a line for each thing that a drive cannot tell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from v2hdm.geometry.mounting import angle_sigmas, mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.ground.results import GroundEstimate, GroundStatus, Reading

_NAMES = {
    "clock_s": ("clock", 1e3, "ms"),
    "focal_scale": ("focal length", 1e2, "%"),
    "distortion_k1": ("distortion k1", 1.0, ""),
    "grade": ("grade of the poses", 1e2, "%"),
    "up_m": ("centre up", 1e2, "cm"),
    "forward_m": ("centre forward", 1e2, "cm"),
    "left_m": ("centre left", 1e2, "cm"),
}
"""What each parameter is called, and the factor and unit that people read it in."""

_WHY = {
    GroundStatus.NO_MATCH: "the ground does not match between images: check poses, clock and guess",
    GroundStatus.TOO_LITTLE: "too little ground is seen by two images: drive further, or widen roi_vehicle",
}


def lines(estimate: GroundEstimate) -> Iterator[str]:
    """What the terminal shows of one camera."""
    calibration = estimate.calibration
    if calibration is None or calibration.covariance is None:
        reading = estimate.reading
        other = "" if reading is Reading.AS_GIVEN else f"; it does with the poses read as: {reading.value}"
        yield f"{estimate.camera}: {_WHY[estimate.status]}{other}"
        return
    matrix = calibration.cam_from_vehicle
    angles = np.rad2deg(mounting_angles(matrix))
    sigmas = np.rad2deg(angle_sigmas(matrix, calibration.covariance))
    height_m = camera_centre(matrix)[2]
    up = matrix[:3, 2]
    height_sigma_m = float(np.sqrt(up @ calibration.covariance[:3, :3] @ up))
    parts = [
        f"{name} {angle:.2f} +- {sigma:.2f} deg"
        for name, angle, sigma in zip(("roll", "pitch", "yaw"), angles, sigmas, strict=True)
    ]
    parts.append(f"height {height_m:.3f} +- {height_sigma_m:.3f} m")
    yield f"{estimate.camera}: {', '.join(parts)}"
    told = [p for p in estimate.parameters.values() if p.told]
    if told:
        yield "  beside it: " + ", ".join(
            f"{_NAMES[p.name][0]} {_NAMES[p.name][1] * p.value:+.2g} +- "
            f"{_NAMES[p.name][1] * p.sigma:.2g} {_NAMES[p.name][2]}".rstrip()
            for p in told
        )
    for parameter in estimate.parameters.values():
        if not parameter.told:
            yield f"  cannot tell {_NAMES[parameter.name][0]}: {parameter.why_not}"
