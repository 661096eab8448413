"""Before the long work: what the images and the ground say about a drive, and what they correct."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from v2hdm.calibration.compare import movement
from v2hdm.errors import MapFileError
from v2hdm.executor import Executor
from v2hdm.ground.results import GROUND_IPM, GroundEstimate, GroundStatus, better_start
from v2hdm.io.drive import join_drives, with_clock_offsets
from v2hdm.pipeline.config import Contents
from v2hdm.pipeline.context import Context
from v2hdm.records import Calibration, Camera, Drive
from v2hdm.verdict import Finding, Status, clock_corrections, input_findings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Inspection:
    """A drive as it is mapped, its cameras as it describes them, and all findings before the run."""

    drive: Drive  # clocks corrected by the ground, cameras where it puts them
    described_cameras: Mapping[str, Camera]
    ground: tuple[Mapping[str, GroundEstimate], ...]  # by session and camera, what bare ground says
    findings: tuple[Finding, ...]

    @property
    def drive_as_described(self) -> Drive:
        """The drive with corrected clocks, and its cameras as they were described."""
        return replace(self.drive, cameras=self.described_cameras)


def inspect(
    drive: Drive, max_gap_s: float, executor: Executor, progress: Callable[[int, int], None]
) -> Inspection:
    """Check a drive and correct what can be corrected; ``max_gap_s`` bounds the gaps between poses."""
    from v2hdm.ground.estimate import estimate_cameras

    ground = estimate_cameras(drive, executor, progress) if drive.has_pictures else {}
    findings = tuple(input_findings(drive, ground))
    for finding in findings:
        if finding.status is not Status.PASS:
            log.warning("%s", finding.line)
        elif finding.is_unobservable:
            log.info("%s", finding.line)
    offset_s = clock_corrections(ground)
    corrected = better_start(with_clock_offsets(drive, offset_s, max_gap_s), ground)
    return Inspection(corrected, drive.cameras, (ground,), findings)


def inspect_each(
    drives: Sequence[Drive], contents: Contents, max_gap_s: float, context: Context
) -> list[Inspection]:
    """As :func:`inspect` of each drive, or what it found before of the same, with the same log."""
    inspections = []
    cache = context.cache
    for drive in drives:
        steps = context.steps("check" if len(drives) == 1 else f"check {drive.name}")
        work = partial(inspect, drive, max_gap_s, context.executor, steps)
        key = cache.key(contents.key(drive), max_gap_s)
        inspections.append(cache.get_or_make("check", key, Inspection, work))
    return inspections


def join(inspections: Sequence[Inspection]) -> Inspection:
    """Inspect several drives one by one and join the findings; each finding names its drive.

    A camera that the bare ground of two drives puts on two mountings is two cameras. Raises DriveError where
    they are not of one frame or site.
    """
    if len(inspections) == 1:
        return inspections[0]
    moved = [
        (number, name)
        for number, inspection in enumerate(inspections)
        for name in inspection.described_cameras
        if any(_has_moved(name, before, inspection) for before in inspections[:number])
    ]
    described = join_drives([inspection.drive_as_described for inspection in inspections], moved)
    drive = replace(described, cameras=_started(described, inspections))
    ground = []
    findings = []
    for session, inspection in zip(drive.joined, inspections, strict=True):
        ground.append({session.cameras[name]: estimate for name, estimate in inspection.ground[0].items()})
        findings += [
            replace(finding, about=f"{finding.about} of {session.name}") for finding in inspection.findings
        ]
    return Inspection(drive, described.cameras, tuple(ground), tuple(findings))


def _started(drive: Drive, inspections: Sequence[Inspection]) -> dict[str, Camera]:
    """Each camera with the start and the plane that the ground gave it on the first session where it did.

    Planes of further sessions share the errors of the lens with it; the map is held against them.
    """
    cameras = dict(drive.cameras)
    for session, inspection in reversed(list(zip(drive.joined, inspections, strict=True))):
        for own_name, name in session.cameras.items():
            camera = inspection.drive.cameras[own_name]
            described = cameras[name]
            if camera.ground_plane is not None:
                described = replace(described, ground_plane=camera.ground_plane)
            if camera.initial_ipm == GROUND_IPM:
                ipm = {**described.ipm, GROUND_IPM: camera.ipm[GROUND_IPM]}
                described = replace(described, ipm=ipm, initial_ipm=GROUND_IPM)
            cameras[name] = described
    return cameras


def _has_moved(camera: str, before: Inspection, after: Inspection) -> bool:
    """Whether the ground of two drives says that a camera sits elsewhere, by the odds of the drift alarm."""
    earlier = _calibration_of(camera, before)
    later = _calibration_of(camera, after)
    try:
        return earlier is not None and later is not None and movement(earlier, later).moved
    except MapFileError:  # the lenses differ, which the descriptions say as well
        return False


def _calibration_of(camera: str, inspection: Inspection) -> Calibration | None:
    """A camera's calibration by bare ground, with its covariance; None where the ground gives none."""
    estimate = inspection.ground[0].get(camera)
    if estimate is None or estimate.status is not GroundStatus.FOUND:
        return None
    calibration = estimate.calibration
    return calibration if calibration is not None and calibration.covariance is not None else None
