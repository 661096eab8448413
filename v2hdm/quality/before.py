"""All checks before a run: poses, clocks, noise, cameras, images, and what the ground says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from v2hdm.quality.cameras import check_camera
from v2hdm.quality.clocks import check_clocks
from v2hdm.quality.heading import check_heading
from v2hdm.quality.images import check_images
from v2hdm.quality.motion import Motion
from v2hdm.quality.noise import check_noise
from v2hdm.quality.path import check_attitude, check_jumps, check_path
from v2hdm.quality.verdict import Finding, Status
from v2hdm.records import Drive

HIDES: Mapping[str, tuple[str, ...]] = {
    "path length": ("speed", "position jumps", "height jumps", "pose scatter", "image spacing", "pose gaps"),
    "speed": ("position jumps", "height jumps", "pose scatter", "image spacing", "pose rate", "pose gaps"),
    "heading": ("heading offset", "attitude", "pitch sign", "origin", "pose scatter", "position jumps"),
    "repeated poses": ("position jumps", "height jumps", "pose scatter"),
    "pose scatter": ("position jumps",),
    "bright images": ("frozen images",),
    "dark images": ("frozen images",),
    "own images": ("frozen images",),
    "roi": ("image spacing", "roi range"),
    "attitude": ("pitch sign",),
    "principal point": (
        "focal length",
        "roi",
        "ipm against camera matrix",
        "camera height",
        "survey against guess",
    ),
    "focal length": ("roi", "ipm against camera matrix", "camera height", "survey against guess"),
    "square pixels": ("ipm against camera matrix",),
    "camera tilt": ("roi",),
}
"""Checks that fail because another one did: the cause is told, its consequences are not."""


def check_drive(drive: Drive) -> list[Finding]:
    """Everything that can be said of a drive before any long work; causes without their consequences."""
    motion = Motion.of(drive)
    findings = [
        *check_path(motion),
        *check_heading(motion),
        *check_attitude(motion),
        *check_jumps(motion, drive.pose_noise),
        *check_clocks(drive, motion),
        *check_noise(motion, drive.pose_noise),
    ]
    for name, camera in drive.cameras.items():
        findings += check_camera(name, camera)
    findings += check_images(drive)
    return causes(findings)


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that another one explains (:data:`HIDES`), about the same camera or poses."""
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
