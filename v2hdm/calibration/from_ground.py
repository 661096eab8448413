"""From a drive to its cameras' mountings by bare ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from v2hdm.ground import GroundEstimate, estimate_cameras
from v2hdm.ground.show import draw_matched_ground, lines
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import as_drive
from v2hdm.io.safe.pixels import png
from v2hdm.records import Calibration, Drive
from v2hdm.report.outputs import write_json
from v2hdm.verdict import Verdict, check_drive


@dataclass(frozen=True)
class GroundCalibration:
    """Cameras calibrated from bare ground: the estimates by camera, and the verdict on their drive."""

    drive: Drive
    estimates: Mapping[str, GroundEstimate]
    verdict: Verdict

    @property
    def calibrations(self) -> dict[str, Calibration]:
        """By camera, where the ground gave a mounting."""
        found = {name: estimate.calibration for name, estimate in self.estimates.items()}
        return {name: calibration for name, calibration in found.items() if calibration is not None}


def calibrate_from_ground(
    drive: Drive | str | Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> GroundCalibration:
    """Find every camera's mounting from bare ground, without a marking, and check the drive by it.

    Args:
        drive: the drive, or its folder.
        workers: processes, one camera each at a time.
        progress: called as ``progress(done, total)`` cameras.

    Returns:
        Calibrations of the cameras whose mounting the ground shows, and the verdict on the drive.

    Raises:
        DriveError: the drive, or an image, cannot be read.

    >>> found = calibrate_from_ground(port)
    >>> found.verdict.status.value
    'PASS'
    >>> [one.cam_from_vehicle.shape for one in found.calibrations.values()]
    [(4, 4)]
    """
    drive = as_drive(drive)
    estimates = estimate_cameras(drive, workers, progress)
    return GroundCalibration(drive, estimates, check_drive(drive, ground=estimates))


def summary_lines(found: GroundCalibration) -> list[str]:
    """Every camera's mounting and the verdict, for a terminal."""
    cameras = [line for estimate in found.estimates.values() for line in lines(estimate)]
    return [*cameras, found.verdict.lines[0], *(finding.line for finding in found.verdict.raised)]


def write_ground_calibration(found: GroundCalibration, folder: Path) -> None:
    """Write the verdict, and the calibration and matched ground of each camera that has one."""
    verdict = found.verdict.as_json()
    write_json(folder / "verdict.json", verdict)
    about = Provenance.today(found.drive.name, verdict)
    for name, calibration in found.calibrations.items():
        picture = draw_matched_ground(found.drive, found.estimates[name])
        if picture is not None:
            path = folder / f"calibration_{name}.yaml"
            write_calibration(calibration, path, verdict=verdict, about=about)
            (folder / f"ground_{name}.png").write_bytes(png(picture))
