"""What else a table of points could mean: columns exchanged, axes reversed, another unit, another image size.

Each reading is a hypothesis with a prior; the mounting that it leads to counts by how well it explains the
points and by where cameras sit on vehicles.

A mounting in words and angles, with standard deviations.

From a table of surveyed points to a calibration, a camera's entry for ``drive.yaml`` and a verdict.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from v2hdm.calibration.fit import Fit, Noise, Seen, fit_mountings
from v2hdm.calibration.picture import save_picture
from v2hdm.calibration.points import LEAST_POINTS, SurveyedPoints, check_points, read_points
from v2hdm.calibration.residuals import CHANCE, Residuals, judge_fit, residuals, scatter
from v2hdm.detection.image_file import read_bgr
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.mounting import angle_sigmas, mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.calibration.camera_info import write_camera_info
from v2hdm.io.calibration.document import Provenance, write_calibration
from v2hdm.io.calibration.intrinsics import read_intrinsics
from v2hdm.records import Calibration, CameraInfo, FloatArray
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.store.files import dump_yaml
from v2hdm.verdict.verdict import Status, Verdict

_MISREAD = 0.01
"""Prior probability of each way to write the table wrongly."""

_SURE = np.log(1e3)
"""Log odds from which a reading is told as the cause."""

_ROLL_RAD = np.radians(15.0)
"""Standard deviation of the roll of cameras on vehicles."""

_BESIDE_M = 1.5
"""Standard deviation of their place to the left."""

_UNUSUAL = 8.0
"""Log odds at most against an unusual mounting: some cameras hang on their side or head."""

_HEIGHT_M, _LOG_HEIGHT = 2.0, 0.7
"""Median height of cameras on vehicles, m, and the standard deviation of its logarithm."""

_SCALES = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)
"""Usual ratios of the sizes of one camera's images."""

_STARTS, _ROUNDS = 1, 6
"""Enough to tell a reading that explains the points from one that does not."""

UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}
"""Units other than metres, in m."""


@dataclass(frozen=True)
class Misreading:
    """A way in which the table explains itself better: what is wrong with it, and the fit without that."""

    cause: str
    fit: Fit


def misreading(
    points: SurveyedPoints, info: CameraInfo, noise: Noise, given: Fit | None
) -> Misreading | None:
    """The reading under which the points make sense, if they make none as they are.

    Args:
        points: the table.
        info: the camera.
        noise: as stated.
        given: the fit to the table as it is; None where there is none.
    """
    best: Misreading | None = None
    highest = -np.inf
    for cause, points_px, points_vehicle in _readings(points, info):
        seen = Seen.of(points.read_as(points_px, points_vehicle), info, noise)
        for fit in fit_mountings(seen, _STARTS, _ROUNDS):
            score = _score(fit)
            if score > highest:
                best, highest = Misreading(cause, fit), score
    as_given = -np.inf if given is None else _score(given)
    return best if best is not None and highest + np.log(_MISREAD) - as_given > _SURE else None


def unit_of(fit: Fit) -> str | None:
    """The unit of the ground points where it is not the metre, by the height that the camera comes out at."""
    height = camera_centre(fit.cam_from_vehicle)[2]

    def log_odds(metres: float, prior: float) -> float:
        return float(-0.5 * (np.log(height * metres / _HEIGHT_M) / _LOG_HEIGHT) ** 2 + np.log(prior))

    scores = {unit: log_odds(metres, _MISREAD) for unit, metres in UNITS.items()}
    best = max(scores, key=lambda unit: scores[unit])
    return best if scores[best] > log_odds(1.0, 1.0) else None


def _score(fit: Fit) -> float:
    """Log posterior, with how usual the mounting is."""
    roll = mounting_angles(fit.cam_from_vehicle)[0]
    beside = camera_centre(fit.cam_from_vehicle)[1]
    unusual = 0.5 * ((roll / _ROLL_RAD) ** 2 + (beside / _BESIDE_M) ** 2)
    return fit.log_posterior - min(float(unusual), _UNUSUAL)


def _readings(points: SurveyedPoints, info: CameraInfo) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Causes, and the pixels and places without them."""
    px, ground = points.points_px, points.points_vehicle
    mirrored = "y is counted to the right, or x backward; write y positive to the left, x forward"
    yield mirrored, px, ground * [1.0, -1.0]
    yield "x and y are exchanged; x is forward, y to the left", px, ground[:, ::-1].copy()
    swapped = px[:, ::-1].copy()
    yield "u and v are exchanged; u counts columns to the right, v rows down", swapped, ground
    upward = np.column_stack([px[:, 0], info.height - 1 - px[:, 1]])
    yield "v is counted upward from the image's lower edge; count it down from the upper one", upward, ground
    for scale in _SCALES:
        yield (
            f"the pixels are of an image {1 / scale:.3g} times as large as that of the intrinsics; give both "
            "for one size",
            (px + 0.5) * scale - 0.5,
            ground,
        )


def centre_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of the camera's centre in the vehicle frame, m."""
    # A left perturbation (v, w) of cam_from_vehicle moves the centre by -R'v.
    turn = cam_from_vehicle[:3, :3].T
    return np.asarray(np.sqrt(np.diag(turn @ covariance[:3, :3] @ turn.T)))


def mounting_lines(name: str, cam_from_vehicle: FloatArray, covariance: FloatArray) -> list[str]:
    """What the terminal shows of a mounting: angles and centre."""
    angles = np.degrees(mounting_angles(cam_from_vehicle))
    angle_sigma = np.degrees(angle_sigmas(cam_from_vehicle, covariance))
    centre, centre_sigma = camera_centre(cam_from_vehicle), centre_sigmas(cam_from_vehicle, covariance)
    turned = (
        f"{word} {angle:.2f} +- {sigma:.2f} deg"
        for word, angle, sigma in zip(("roll", "pitch", "yaw"), angles, angle_sigma, strict=True)
    )
    placed = (
        f"{word} {value:.3f} +- {sigma:.3f} m"
        for word, value, sigma in zip(("forward", "left", "height"), centre, centre_sigma, strict=True)
    )
    return [f"{name}: {', '.join(turned)}", f"  centre {', '.join(placed)}"]


ENTRY_FILE = "drive_camera.yaml"
POINTS_FILE = "points.csv"
PICTURE_FILE = "points.png"


def calibrate_camera(parsed: argparse.Namespace) -> bool:
    """Calibrate, print what came out with the verdict on it, and write it.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.calibrate`.

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
