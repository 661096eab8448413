"""What the door of the ground leaves: a calibration and a picture of each camera."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from v2hdm.errors import ConfigError
from v2hdm.files import whole_file
from v2hdm.ground.estimate import estimate_ground
from v2hdm.ground.picture import draw_matched_ground
from v2hdm.ground.results import GroundEstimate
from v2hdm.ground.say import lines
from v2hdm.hdmap.calibration import write_calibration
from v2hdm.records import Drive


def estimate_and_write(drive: Drive, output: Path) -> None:
    """Estimate every camera's mounting; print it and write it into ``output``, whole files only.

    Raises:
        ConfigError: the folder cannot be written.
        DriveError: an image cannot be read.
    """
    for number, camera in enumerate(drive.cameras, start=1):
        print(
            f"camera {number} of {len(drive.cameras)}: matching the ground of {camera} ...", file=sys.stderr
        )
        estimate = estimate_ground(drive, camera)
        for line in lines(estimate):
            print(line, flush=True)
        try:
            _write(drive, estimate, output)
        except OSError as error:
            raise ConfigError(
                f"output folder {output} cannot be written: {error.strerror}; name another with --output"
            ) from error
    print(f"results in {output}")


def _write(drive: Drive, estimate: GroundEstimate, output: Path) -> None:
    """One camera's files; those of an earlier estimate go where there is none."""
    calibration_path = output / f"calibration_{estimate.camera}.yaml"
    picture_path = output / f"ground_{estimate.camera}.png"
    picture = draw_matched_ground(drive, estimate)
    if estimate.calibration is None or picture is None:
        output.mkdir(parents=True, exist_ok=True)
        calibration_path.unlink(missing_ok=True)
        picture_path.unlink(missing_ok=True)
        return
    write_calibration(estimate.calibration, calibration_path)
    with whole_file(picture_path) as partial:
        partial.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
