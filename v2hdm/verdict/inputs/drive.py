"""Whether the recorded ground is plane as far as the cameras look.

All checks before a run: poses, clocks, noise, cameras, images, and what the ground says.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from v2hdm.ground.results import GroundEstimate
from v2hdm.io.drive.unevenness import unevenness
from v2hdm.records import Drive
from v2hdm.verdict.inputs import ground as ground_checks
from v2hdm.verdict.inputs.cameras import check_camera
from v2hdm.verdict.inputs.ground import check_ground, find_suspect, path_of
from v2hdm.verdict.inputs.heading import check_heading
from v2hdm.verdict.inputs.poses import Motion, check_attitude, check_jumps, check_noise, check_path
from v2hdm.verdict.inputs.recording import check_clocks, check_images
from v2hdm.verdict.verdict import Finding, Status, judge, passed

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


_STEPS = ("position jumps", "height jumps", "pose scatter", "image spacing", "pose gaps", "pose rate")
_MOUNTING = ("roi", "roi range", "ipm against camera matrix", "camera height", "survey against guess")

_SURVEY = ("survey height", "survey forward", "survey left")

HIDES: Mapping[str, tuple[str, ...]] = {
    "path length": (*_STEPS, *ground_checks.CHECKS),
    "speed": (*_STEPS, *ground_checks.CHECKS),
    "heading": ("heading offset", "attitude", "pitch sign", "road", "origin", *_STEPS, *ground_checks.CHECKS),
    "attitude": ("pitch sign", "road", *ground_checks.CHECKS),
    "repeated poses": (*_STEPS, *ground_checks.CHECKS),
    "pose scatter": ("position jumps", *ground_checks.CHECKS),
    "position jumps": ground_checks.CHECKS,
    "pose noise": ground_checks.CHECKS,
    "height jumps": ("road", "grade", "ground match", "ground residual", "poses against ground"),
    "origin": ("survey forward", "poses against ground"),
    "own images": ("frozen images", *ground_checks.CHECKS),
    "bright images": ("frozen images", "ground match"),
    "dark images": ("frozen images", "ground match"),
    "frozen images": ground_checks.CHECKS,
    "principal point": ("focal length", *_MOUNTING, *ground_checks.CHECKS),
    "focal length": (*_MOUNTING, *ground_checks.CHECKS),
    "square pixels": (
        "ipm against camera matrix",
        "ground residual",
        "focal length from ground",
        "distortion",
    ),
    "camera tilt": ("roi", "ground match"),
    "camera height": ("survey against guess", "ground match"),
    "roi": ("image spacing", "roi range", "ground match"),
    "survey against guess": ground_checks.CHECKS,
    "distortion": ("focal length from ground", "ground residual", *_SURVEY),
    "focal length from ground": ("ipm against camera matrix", "ground residual", *_SURVEY),
    "clock": ("survey forward", "survey left", "poses against ground"),
}
"""Checks that fail because another one did: the cause is told, its consequences are not."""


def check_drive(drive: Drive, ground: Mapping[str, GroundEstimate] | None = None) -> list[Finding]:
    """Everything that can be said of a drive before any long work; causes without their consequences.

    Args:
        drive: the drive.
        ground: what bare ground says, by camera; cameras that it leaves out are checked without.

    Raises:
        DriveError: a sampled image cannot be decoded.
    """
    ground = ground or {}
    motion = Motion.of(drive)
    findings = [
        *check_path(motion),
        *check_heading(motion, path_of(ground)),
        *check_attitude(motion),
        *check_jumps(motion, drive.pose_noise),
        *check_clocks(drive, motion),
        *check_noise(motion, drive.pose_noise),
        *check_road(drive),
    ]
    for name, camera in drive.cameras.items():
        findings += check_camera(name, camera)
    findings += check_images(drive)
    return causes([*findings, *_of_ground(drive, ground, findings)])


def _of_ground(
    drive: Drive, ground: Mapping[str, GroundEstimate], findings: Iterable[Finding]
) -> list[Finding]:
    """What the ground says; where it never matches and nothing else explains that, suspects are tried."""
    explained = any("ground match" in HIDES.get(f.check, ()) for f in findings if f.status is not Status.PASS)
    return check_ground(drive, ground, None if explained else find_suspect(drive, ground))


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that another one explains (:data:`HIDES`).

    A cause hides its consequences about the same camera, one in the poses those about every camera. It is as
    bad as the worst of them.
    """
    findings = list(findings)
    raised = [finding for finding in findings if finding.status is not Status.PASS]
    explained: set[int] = set()
    worst: dict[int, Status] = {}
    for cause in raised:
        own = [finding for finding in raised if _explains(cause, finding)]
        explained |= {id(finding) for finding in own}
        worst[id(cause)] = max((finding.status for finding in (cause, *own)), key=lambda status: status.rank)
    return [
        replace(finding, status=worst.get(id(finding), finding.status))
        for finding in findings
        if id(finding) not in explained
    ]


def _explains(cause: Finding, finding: Finding) -> bool:
    same = cause.about == finding.about or cause.about.startswith("pose")
    return same and finding is not cause and finding.check in HIDES.get(cause.check, ())
