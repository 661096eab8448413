"""All checks before a run: poses, clocks, noise, road, cameras, images, and bare ground."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from v2hdm.ground.estimate import estimate_cameras
from v2hdm.ground.results import GroundEstimate
from v2hdm.io.drive import as_drive
from v2hdm.io.drive.road import unevenness
from v2hdm.records import Drive
from v2hdm.verdict.inputs import ground as ground_checks
from v2hdm.verdict.inputs.cameras import check_camera
from v2hdm.verdict.inputs.ground import check_ground, find_cause, path_of
from v2hdm.verdict.inputs.heading import check_heading
from v2hdm.verdict.inputs.poses import Motion, check_attitude, check_jumps, check_noise, check_path
from v2hdm.verdict.inputs.recording import check_clocks, check_images
from v2hdm.verdict.verdict import Finding, Status, Verdict, judge, passed

# Sigmas of roll and pitch that the mapping takes for noise, ground that leans more is bent; and sigmas
# beyond which markings on it are wrong by many times what the map states.
_ROAD_SIGMAS, _ROAD_BENT = 3.0, 10.0
_LEAST_SWAY_RAD = 0.003  # roll and pitch that every vehicle sways by, whatever pose_noise says
_STEPS = ("position jumps", "height jumps", "pose scatter", "image spacing", "pose gaps", "pose rate")
_MOUNTING = ("roi", "roi range", "ipm against camera matrix", "camera height", "survey against guess")
_SURVEY = ("survey height", "survey forward", "survey left")
_GROUND = ground_checks.CHECKS

HIDES: Mapping[str, tuple[str, ...]] = {
    "path length": (*_STEPS, *_GROUND),
    "speed": (*_STEPS, *_GROUND),
    "heading": ("heading offset", "attitude", "pitch sign", "road", "origin", *_STEPS, *_GROUND),
    "attitude": ("pitch sign", "road", *_GROUND),
    "repeated poses": (*_STEPS, *_GROUND),
    "pose scatter": ("position jumps", *_GROUND),
    "position jumps": _GROUND,
    "pose stamps": ("pose scatter", *_GROUND),
    "pose noise": _GROUND,
    "height jumps": ("road", "grade", "ground match", "ground residual", "poses against ground"),
    "origin": ("survey forward", "poses against ground"),
    "own images": ("frozen images", *_GROUND),
    "bright images": ("frozen images", "ground match"),
    "dark images": ("frozen images", "ground match"),
    "frozen images": _GROUND,
    "principal point": ("focal length", *_MOUNTING, *_GROUND),
    "focal length": (*_MOUNTING, *_GROUND),
    "square pixels": (
        "ipm against camera matrix", "ground residual", "focal length from ground", "distortion",
    ),
    "camera tilt": ("roi", "ground match"),
    "camera height": ("survey against guess", "ground match"),
    "roi": ("image spacing", "roi range", "ground match"),
    "survey against guess": _GROUND,
    "distortion": ("focal length from ground", "ground residual", *_SURVEY),
    "focal length from ground": ("ipm against camera matrix", "ground residual", *_SURVEY),
    "clock": ("survey forward", "survey left", "poses against ground"),
}  # fmt: skip
"""Checks that fail because another one did: the cause is reported, its consequences are not."""


def check_drive(
    drive: Drive | str | Path,
    *,
    ground: bool | Mapping[str, GroundEstimate] = True,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Verdict:
    """Check a drive before any long work: poses, clocks, noise, cameras, images, and bare ground.

    Args:
        drive: the drive, or its folder.
        ground: whether to match bare ground (seconds a camera), or the estimates where they are at hand.
        workers: processes that match ground.
        progress: called as ``progress(done, total)`` cameras.

    Returns:
        All findings, the worst first: each with value, limit, unit, cause and remedy.

    Raises:
        DriveError: the drive, or an image, cannot be read.

    >>> verdict = check_drive(port, ground=False)
    >>> verdict.status.value, len(verdict.raised)
    ('PASS', 0)
    """
    drive = as_drive(drive)
    if isinstance(ground, bool):
        ground = estimate_cameras(drive, workers, progress) if ground else {}
    return Verdict.of(input_findings(drive, ground))


def input_findings(drive: Drive, ground: Mapping[str, GroundEstimate] | None = None) -> list[Finding]:
    """The findings of :func:`check_drive`, causes without their consequences; raises DriveError as that."""
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
    explained = any("ground match" in HIDES.get(f.check, ()) for f in findings if f.status is not Status.PASS)
    # Where the ground never matches and nothing else explains that, usual mistakes are tried.
    findings += check_ground(drive, ground, None if explained else find_cause(drive, ground))
    return causes(findings)


def check_road(drive: Drive) -> Iterator[Finding]:
    """How far the ground deviates from the plane beneath the vehicle, within the ROIs' reach."""
    if drive.road is None or len(drive.road.points_map) < 2:
        yield passed("road", "poses", "the ground was recorded as the plane z = 0", 0.0, "deg")
        return
    reach_m = max(float(np.linalg.norm(one.roi_vehicle, axis=1).max()) for one in drive.cameras.values())
    worst = unevenness(drive.road, reach_m)
    lean_rad = worst.value_m / worst.distance_m
    sigma_rad = max(drive.pose_noise.roll_pitch_rad, _LEAST_SWAY_RAD)
    x, y = worst.at_map
    yield judge(
        "road", "poses", float(np.rad2deg(lean_rad)), float(np.rad2deg(_ROAD_SIGMAS * sigma_rad)), "deg",
        fine="the ground is plane as far as the cameras look",
        wrong=f"{worst.station_m:.0f} m along the route, at x {x:.0f} m, y {y:.0f} m, the ground bends "
        f"by {worst.value_m:.2f} m over {worst.distance_m:.0f} m (a ramp, a crest or a banked curve): "
        "a plane misplaces markings there; leave mapping.ground at auto, or end roi_vehicle nearer",
        status=Status.FAIL if lean_rad > _ROAD_BENT * sigma_rad else Status.WARN,
    )  # fmt: skip


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that another one explains (:data:`HIDES`), as bad as the worst of them."""
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
