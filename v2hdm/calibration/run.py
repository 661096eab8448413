"""From a table of surveyed points to a calibration, a camera's entry for ``drive.yaml`` and a verdict."""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from v2hdm.calibration.angles import centre_sigmas, mounting_lines
from v2hdm.calibration.findings import CHANCE, judge_fit
from v2hdm.calibration.fit import Fit, fit_mountings
from v2hdm.calibration.likelihood import Noise, Seen
from v2hdm.calibration.picture import save_picture
from v2hdm.calibration.points import LEAST_POINTS, SurveyedPoints, check_points, read_points
from v2hdm.calibration.readings import UNITS, misreading, unit_of
from v2hdm.calibration.residuals import Residuals, residuals, scatter
from v2hdm.detection.image_file import read_bgr
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.calibration.camera_info import write_camera_info
from v2hdm.io.calibration.document import Provenance, write_calibration
from v2hdm.io.calibration.intrinsics import read_intrinsics
from v2hdm.records import Calibration, CameraInfo, FloatArray
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.store.files import dump_yaml
from v2hdm.verdict.verdict import Status, Verdict

ENTRY_FILE = "drive_camera.yaml"
POINTS_FILE = "points.csv"
PICTURE_FILE = "points.png"


def calibrate_camera(parsed: argparse.Namespace) -> bool:
    """Calibrate, print what came out with the verdict on it, and write it.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.calibrate_points`.

    Returns:
        Whether the verdict is FAIL.

    Raises:
        V2hdmError: the points or the intrinsics cannot be used, or the results cannot be written.
    """
    cv2.setNumThreads(1)
    noise = _noise(parsed)
    info = read_intrinsics(parsed.intrinsics, parsed.camera_name, "--camera-name")
    info = replace(info, name=parsed.name or info.name)
    if "/" in info.name or info.name in ("", ".", ".."):
        raise ConfigError(f"the camera is called {info.name!r}, which is no file name; give another --name")
    points = read_points(parsed.points)
    image = None if parsed.image is None else _image(parsed.image, info)
    check_points(points, info)
    fits = solve(points, info, noise)
    fit, off = fits[0], residuals(fits[0])
    verdict = Verdict.of(judge_fit(points, fits, off))
    folder = parsed.output or Path("outputs") / f"{info.name}-calibrate"
    with result_folder(folder) as unfinished:
        settings = {
            "points": str(parsed.points),
            "intrinsics": str(parsed.intrinsics),
            "image": None if parsed.image is None else str(parsed.image),
            "pixel_sigma": noise.pixel_px,
            "survey_sigma": noise.survey_m,
        }
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        write_json(unfinished / "verdict.json", verdict.as_json())
        _write(points, fit, off, unfinished, verdict, image)
    for line in _lines(points, fit, off):
        print(line)
    for line in (verdict.lines[0], *(finding.line for finding in verdict.raised)):
        print(line)
    print(f"results in {folder}")
    return verdict.status is Status.FAIL


def solve(points: SurveyedPoints, info: CameraInfo, noise: Noise) -> list[Fit]:
    """The mountings that explain the points, the most likely first.

    Raises:
        DriveError: none does: they lie on a line, or the table is written otherwise than its columns say.
    """
    fits = fit_mountings(Seen.of(points, info, noise))
    if _doubtful(fits):
        found = misreading(points, info, noise, fits[0] if fits else None)
        if found is not None:
            raise DriveError(f"{points.path}: the points fit no mounting of this camera: {found.cause}")
    if not fits or not np.isfinite(fits[0].covariance).all() or _height_m(fits[0]) <= 0:
        raise DriveError(
            f"{points.path}: the points fix no camera: they lie about on a line, or all but one do; "
            "survey some to the left and to the right of it"
        )
    unit = unit_of(fits[0])
    if unit is not None:
        height = _height_m(fits[0])
        raise DriveError(
            f"{points.path}: the camera comes out {height:.4g} m above the ground: x and y look like {unit}; "
            f"write metres, in which that is {height * UNITS[unit]:.2f} m"
        )
    return fits


def _height_m(fit: Fit) -> float:
    return float(camera_centre(fit.cam_from_vehicle)[2])


def _doubtful(fits: list[Fit]) -> bool:
    """Whether the points explain no mounting well, so that other readings of the table are worth a look."""
    if not fits:
        return True
    right = int(fits[0].is_right.sum())
    if right < LEAST_POINTS or 2 * right <= fits[0].seen.count:
        return True
    return scatter(fits[0], CHANCE).probability < CHANCE


def roi_of(fit: Fit) -> FloatArray:
    """The convex hull (M, 2) of the right points, counter-clockwise, m."""
    points = fit.seen.points_vehicle[fit.is_right]
    return np.asarray(points[ConvexHull(points).vertices])


def camera_entry(fit: Fit, info_file: str) -> dict[str, Any]:
    """The camera's entry for ``drive.yaml``, but for the file names of a real drive."""
    info, mounting = fit.seen.info, fit.cam_from_vehicle
    sigma = centre_sigmas(mounting, fit.covariance)
    return {
        "camera_info": info_file,
        "images": f"{info.name}/images.txt",
        "ipm": {"calibrated": ipm_from_extrinsic(info, mounting).tolist()},
        "roi_vehicle": roi_of(fit).tolist(),
        "centre_prior": {"xyz": camera_centre(mounting).tolist(), "sigma_m": sigma.tolist()},
    }


def _noise(parsed: argparse.Namespace) -> Noise:
    for option, value in (("--pixel-sigma", parsed.pixel_sigma), ("--survey-sigma", parsed.survey_sigma)):
        if not (np.isfinite(value) and value >= 0):
            raise ConfigError(f"{option} {value:g}: give a standard deviation, 0 or more")
    if parsed.pixel_sigma == parsed.survey_sigma == 0:
        raise ConfigError("--pixel-sigma and --survey-sigma are both 0: nothing is measured without error")
    return Noise(parsed.pixel_sigma, parsed.survey_sigma)


def _image(path: Path, info: CameraInfo) -> np.ndarray:
    image = read_bgr(path)
    rows, columns = image.shape[:2]
    if (columns, rows) != (info.width, info.height):
        raise DriveError(
            f"{path}: the image is {columns} x {rows}, but the intrinsics of '{info.name}' are for "
            f"{info.width} x {info.height}; give both for one size"
        )
    return image


def _write(
    points: SurveyedPoints,
    fit: Fit,
    off: Residuals,
    folder: Path,
    verdict: Verdict,
    image: np.ndarray | None,
) -> None:
    info = fit.seen.info
    told = verdict.as_json()
    write_calibration(
        Calibration(info, fit.cam_from_vehicle, fit.covariance),
        folder / f"calibration_{info.name}.yaml",
        verdict=told,
        about=Provenance.today(points.path.stem, told),
    )
    write_camera_info(info, folder / info.name / "camera_info.yaml")
    entry = dump_yaml({"cameras": {info.name: camera_entry(fit, f"{info.name}/camera_info.yaml")}})
    (folder / ENTRY_FILE).write_text(
        "# For drive.yaml. images: name the list of your images (docs/drive-format.md).\n" + entry,
        encoding="utf-8",
    )
    with (folder / POINTS_FILE).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        table.writerows(_rows(points, fit, off))
    save_picture(folder / PICTURE_FILE, image, points.labels, fit, off, roi_of(fit))


_COLUMNS = (
    "point", "u", "v", "x", "y", "off_u_px", "off_v_px", "off_x_m", "off_y_m", "sigmas", "probability_right",
    "known_m",
)  # fmt: skip


def _rows(points: SurveyedPoints, fit: Fit, off: Residuals) -> list[list[object]]:
    return [
        [
            points.names[k],
            *points.points_px[k].tolist(),
            *points.points_vehicle[k].tolist(),
            *(f"{value:.3f}" for value in off.off_px[k]),
            *(f"{value:.4f}" for value in off.off_m[k]),
            f"{off.sigmas[k]:.2f}",
            f"{fit.right[k]:.3g}",
            f"{off.known_m[k]:.4f}",
        ]
        for k in range(len(points.names))
    ]


def _lines(points: SurveyedPoints, fit: Fit, off: Residuals) -> list[str]:
    lines = mounting_lines(fit.seen.info.name, fit.cam_from_vehicle, fit.covariance)
    right = fit.is_right
    off_px, off_cm = (np.hypot(*part.T) for part in (off.off_px, 100 * off.off_m))
    px, cm = (float(np.sqrt(np.mean(part[right] ** 2))) for part in (off_px, off_cm))
    known = 100 * off.known_m[right]
    lines.append(
        f"  {right.sum()} of {len(right)} points agree: {px:.2f} px and {cm:.1f} cm on the ground rms; "
        f"IPM known to {known.min():.1f} cm at the best of them, {known.max():.1f} cm at the worst"
    )
    width = max(len(name) for name in points.names)
    lines += [
        f"  {name:{width}}  off {_number(off_px[k], 6, 2)} px {_number(off_cm[k], 7, 1)} cm "
        f"{off.sigmas[k]:6.1f} sigmas"
        for k, name in enumerate(points.names)
    ]
    return lines


def _number(value: float, width: int, digits: int) -> str:
    """The number; a dash where there is none, as for what is behind the camera."""
    return f"{value:{width}.{digits}f}" if np.isfinite(value) else f"{'-':>{width}}"
