"""Before the long work: what the images and the ground say about a drive, and what they correct."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from v2hdm.drive import with_clock_offsets
from v2hdm.ground import GroundEstimate, better_start, estimate_cameras
from v2hdm.quality import Finding, Status, check_drive, clock_corrections
from v2hdm.records import Camera, Drive

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Inspection:
    """A drive as it is mapped, and the findings so far.

    Attributes:
        drive: with the clocks that the ground contradicts corrected, and the ground's better start.
        given: cameras as the drive describes them.
        ground: by camera, what the bare ground says.
        clock_offset_s: by camera, how much later than stamped its images are taken to be, s.
        findings: of all checks before the run.
    """

    drive: Drive
    given: Mapping[str, Camera]
    ground: Mapping[str, GroundEstimate]
    clock_offset_s: Mapping[str, float]
    findings: tuple[Finding, ...]

    @property
    def drive_as_described(self) -> Drive:
        """The drive with corrected clocks, and its cameras as they were described."""
        return replace(self.drive, cameras=self.given)

    @property
    def has_failed(self) -> bool:
        """Whether a check says that no right map can come of this drive."""
        return any(finding.status is Status.FAIL for finding in self.findings)


def inspect(drive: Drive, max_gap_s: float, workers: int, progress: Callable[[int, int], None]) -> Inspection:
    """Check a drive and correct what can be corrected.

    Args:
        drive: as it was read.
        max_gap_s: longest gap between two poses that is interpolated across, s.
        workers: processes to work in.
        progress: told how many cameras are done, and of how many.
    """
    ground = estimate_cameras(drive, workers, progress)
    findings = tuple(check_drive(drive, ground))
    for finding in findings:
        if finding.status is not Status.PASS:
            log.warning("%s", finding.line)
        elif finding.is_untold:
            log.info("%s", finding.line)
    offset_s = clock_corrections(ground)
    corrected = better_start(with_clock_offsets(drive, offset_s, max_gap_s), ground)
    return Inspection(corrected, drive.cameras, ground, offset_s, findings)
