"""Whether the recorded ground is plane as far as the cameras look."""

from __future__ import annotations

import numpy as np

from v2hdm.io.drive.road import unevenness
from v2hdm.records import Drive
from v2hdm.verdict.judgement import judge, passed
from v2hdm.verdict.verdict import Finding, Status

_SIGMAS = 3.0
"""Sigmas of roll and pitch that the mapping takes for noise: ground that leans more is bent."""

_BENT = 10.0
"""Sigmas beyond which markings seen from there are wrong by many times what the map says."""

_LEAST_RAD = 0.003
"""Roll and pitch that every vehicle sways by, whatever pose_noise says."""


def check_road(drive: Drive) -> list[Finding]:
    """How far the ground deviates from the plane beneath the vehicle, within the ROIs' reach."""
    if drive.road is None or len(drive.road.points_map) < 2:
        return [passed("road", "poses", "the ground was recorded as the plane z = 0", 0.0, "deg")]
    reach_m = max(
        float(np.linalg.norm(camera.roi_vehicle, axis=1).max()) for camera in drive.cameras.values()
    )
    worst = unevenness(drive.road, reach_m)
    lean_rad = worst.value_m / worst.distance_m
    sigma_rad = max(drive.pose_noise.roll_pitch_rad, _LEAST_RAD)
    x, y = worst.at_map
    return [
        judge(
            "road", "poses", float(np.rad2deg(lean_rad)), float(np.rad2deg(_SIGMAS * sigma_rad)), "deg",
            fine="the ground is plane as far as the cameras look",
            wrong=f"{worst.station_m:.0f} m along the route, at x {x:.0f} m, y {y:.0f} m, the ground bends "
            f"by {worst.value_m:.2f} m over {worst.distance_m:.0f} m (a ramp, a crest or a banked curve): "
            "markings there are off; leave that stretch out, or end roi_vehicle nearer",
            status=Status.FAIL if lean_rad > _BENT * sigma_rad else Status.WARN,
        )
    ]  # fmt: skip
