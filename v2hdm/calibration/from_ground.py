"""From a drive to its cameras' mountings by bare ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from v2hdm.doors import checked
from v2hdm.executor import open_executor
from v2hdm.geometry.ipm import mounting_words
from v2hdm.ground.estimate import estimate_cameras
from v2hdm.ground.results import GroundEstimate, GroundStatus, Reading
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import as_drive, need_pictures
from v2hdm.records import Calibration, Drive
from v2hdm.settings import Processes
from v2hdm.store.files import write_json
from v2hdm.store.names import VERDICT, calibration_file
from v2hdm.verdict import Finding, Status, Verdict, check_drive, known_frames
from v2hdm.verdict.inputs.ground import MATCH, PATH

# Each parameter's name, and the factor and unit that people read it in.
_NAMES = {
    "clock_s": ("clock", 1e3, "ms"),
    "focal_scale": ("focal length", 1e2, "%"),
    "distortion_k1": ("distortion k1", 1.0, ""),
    "grade": ("grade of the poses", 1e2, "%"),
    "up_m": ("centre up", 1e2, "cm"),
    "forward_m": ("centre forward", 1e2, "cm"),
    "left_m": ("centre left", 1e2, "cm"),
}

_WHY = {
    GroundStatus.NO_MATCH: "the ground does not match between images: check poses, clock and guess",
    GroundStatus.NO_TEXTURE: "the ground is too dark or too smooth to match: drive in better light",
    GroundStatus.TOO_LITTLE: "too little ground appears in two images: drive farther, or enlarge roi_vehicle",
}


@dataclass(frozen=True)
class GroundCalibration:
    """Cameras calibrated from bare ground: the estimates by camera, and the verdict on their drive."""

    drive: Drive
    estimates: Mapping[str, GroundEstimate]
    verdict: Verdict

    @property
    def calibrations(self) -> dict[str, Calibration]:
        """By camera, where the ground gave a mounting."""
        of_camera = {name: estimate.calibration for name, estimate in self.estimates.items()}
        return {name: calibration for name, calibration in of_camera.items() if calibration is not None}


@checked
def calibrate_from_ground(
    drive: Drive | str | Path,
    *,
    workers: Processes = 1,
    progress: Callable[[int, int], None] | None = None,
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

    >>> calibrated = calibrate_from_ground(port)
    >>> calibrated.verdict.status.value
    'PASS'
    >>> [calibration.cam_from_vehicle.shape for calibration in calibrated.calibrations.values()]
    [(4, 4)]
    """
    drive = as_drive(drive)
    need_pictures(drive, "a calibration by bare ground")
    with open_executor(workers) as executor:
        estimates = estimate_cameras(drive, executor, progress)
    return GroundCalibration(drive, estimates, _judged(check_drive(drive, ground=estimates), estimates))


def _judged(of_drive: Verdict, estimates: Mapping[str, GroundEstimate]) -> Verdict:
    """The verdict on a drive, in which a camera without a mounting fails: it was asked for."""
    missing = {name for name, estimate in estimates.items() if estimate.calibration is None}
    told = {finding.about for finding in of_drive.raised if finding.check in (MATCH, PATH)}
    others = [f for f in of_drive.findings if not (f.check == MATCH and f.about in missing - told)]
    failures = [
        Finding(MATCH, Status.FAIL, None, None, "", f"no mounting: {_WHY[estimates[name].status]}", name)
        for name in estimates
        if name in missing - told
    ]
    return Verdict.of([*failures, *others])


def summary_lines(calibrated: GroundCalibration) -> list[str]:
    """Every camera's mounting and the verdict, for a terminal."""
    cameras = [line for estimate in calibrated.estimates.values() for line in _lines(estimate)]
    return [*cameras, calibrated.verdict.lines[0], *(finding.line for finding in calibrated.verdict.raised)]


def _lines(estimate: GroundEstimate) -> Iterator[str]:
    """The estimate for a terminal: a line of figures, and a line for each unobservable quantity."""
    calibration = estimate.calibration
    if calibration is None or calibration.covariance is None:
        reading = estimate.reading
        other = "" if reading is Reading.AS_GIVEN else f"; it does if the poses are read as: {reading.value}"
        yield f"{estimate.camera}: {_WHY[estimate.status]}{other}"
        return
    angles, place = mounting_words(calibration.cam_from_vehicle, calibration.covariance)
    yield f"{estimate.camera}: {', '.join((*angles, place[2]))}"
    observed = []
    for parameter in estimate.parameters.values():
        if parameter.observable:
            name, factor, unit = _NAMES[parameter.name]
            value = factor * parameter.value
            sigma = factor * parameter.sigma
            observed.append(f"{name} {value:+.2g} +- {sigma:.2g} {unit}".rstrip())
    if observed:
        yield f"  also: {', '.join(observed)}"
    for parameter in estimate.parameters.values():
        if not parameter.observable:
            yield f"  cannot tell {_NAMES[parameter.name][0]}: {parameter.why_not}"


def write_ground_calibration(calibrated: GroundCalibration, folder: Path) -> None:
    """Write the verdict, and the calibration of each camera that has one."""
    verdict = calibrated.verdict.as_json()
    write_json(folder / VERDICT, verdict)
    about = Provenance.today(calibrated.drive.name, verdict)
    for name, calibration in calibrated.calibrations.items():
        frames = known_frames(calibrated.drive.cameras[name], calibrated.verdict)
        calibration = replace(calibration, frames=frames)
        write_calibration(calibration, folder / calibration_file(name), verdict=verdict, about=about)
