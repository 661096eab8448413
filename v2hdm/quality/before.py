"""All checks before a run: poses, clocks, noise, cameras, images, and what the ground says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from v2hdm.ground.results import GroundEstimate
from v2hdm.quality import ground as ground_checks
from v2hdm.quality.cameras import check_camera
from v2hdm.quality.clocks import check_clocks
from v2hdm.quality.ground import check_ground, path_of
from v2hdm.quality.heading import check_heading
from v2hdm.quality.images import check_images
from v2hdm.quality.motion import Motion
from v2hdm.quality.noise import check_noise
from v2hdm.quality.path import check_attitude, check_jumps, check_path
from v2hdm.quality.road import check_road
from v2hdm.quality.verdict import Finding, Status
from v2hdm.records import Drive

_STEPS = ("position jumps", "height jumps", "pose scatter", "image spacing", "pose gaps", "pose rate")
_MOUNTING = ("roi", "roi range", "ipm against camera matrix", "camera height", "survey against guess")

HIDES: Mapping[str, tuple[str, ...]] = {
    "path length": (*_STEPS, *ground_checks.CHECKS),
    "speed": (*_STEPS, *ground_checks.CHECKS),
    "heading": ("heading offset", "attitude", "pitch sign", "road", "origin", *_STEPS, *ground_checks.CHECKS),
    "attitude": ("pitch sign", "road", *ground_checks.CHECKS),
    "repeated poses": (*_STEPS, *ground_checks.CHECKS),
    "pose scatter": ("position jumps", *ground_checks.CHECKS),
    "position jumps": ground_checks.CHECKS,
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
    "distortion": ("focal length from ground", "ground residual", "survey height"),
    "focal length from ground": ("ipm against camera matrix", "ground residual", "survey height"),
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
    findings += [*check_images(drive), *check_ground(drive, ground)]
    return causes(findings)


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that another one explains, about the same camera or the poses."""
    findings = list(findings)
    raised = [finding for finding in findings if finding.status is not Status.PASS]
    hidden = {(check, cause.about) for cause in raised for check in HIDES.get(cause.check, ())}
    everywhere = {check for check, about in hidden if about == "poses"}
    return [
        finding
        for finding in findings
        if finding.status is Status.PASS
        or ((finding.check, finding.about) not in hidden and finding.check not in everywhere)
    ]
