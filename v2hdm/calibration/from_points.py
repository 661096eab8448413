"""From a table of surveyed points to a calibration, a camera's entry for ``drive.yaml`` and a verdict.

A table that fits no mounting is read in other ways: columns exchanged, axes reversed, another unit, another
image size. Each reading is a hypothesis with a prior; the mounting that it leads to counts by how well it
explains the points and by where cameras sit on vehicles. Another is that the pixels may be anywhere in the
image. The likeliest one is named in the error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from v2hdm.calibration.fit import Fit, Noise, SeenPoints, fit_mountings
from v2hdm.calibration.points import (
    CHANCE,
    LEAST_POINTS,
    Residuals,
    SurveyedPoints,
    check_points,
    judge_fit,
    read_points,
    residuals,
    scatter,
)
from v2hdm.doors import checked
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import centre_sigmas, ipm_from_extrinsic, mounting_angles, mounting_words
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.records import Calibration, CameraInfo, FloatArray
from v2hdm.report.photos import save_points
from v2hdm.store.files import dump_yaml, replace_csv, write_json
from v2hdm.store.names import VERDICT, calibration_file
from v2hdm.verdict.verdict import Verdict

ENTRY_FILE = "drive_camera.yaml"
POINTS_FILE = "points.csv"
PICTURE_FILE = "points.png"

UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}  # units other than metres, in m
_MISREAD = 0.01  # prior probability of each way to write the table wrongly
_SURE = np.log(1e3)  # log odds from which a reading is reported as the cause
_ROLL_RAD = np.radians(15.0)  # standard deviation of the roll of cameras on vehicles
_ASIDE = float(np.log(3.0))  # log odds against a camera that looks aside: three look ahead or back; chosen
_BESIDE_M = 1.5  # standard deviation of the place of cameras on vehicles to the left, m
_HEIGHT_M = 2.0  # median height of cameras on vehicles, m
_LOG_HEIGHT = 0.7  # standard deviation of the logarithm of that height
_UNUSUAL = 8.0  # log odds at most against an unusual mounting: some cameras hang on their side or head
_SCALES = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)  # usual ratios of the sizes of one camera's images

_STARTS = 1  # starts that are refined under a reading of the table
_ROUNDS = 6  # rounds of a refinement that tell a reading that explains the points from one that does not
_TOLD = 300  # points, at most, that readings are compared by
_UNRELATED = "pixels and places are unrelated; check which pixel belongs to which place"


@dataclass(frozen=True)
class PointCalibration:
    """A camera calibrated from surveyed points."""

    points: SurveyedPoints  # the table
    fit: Fit  # the mounting, its covariance, and the probability of each point to be right
    residuals: Residuals  # of the points
    verdict: Verdict  # whether points, intrinsics and mounting agree

    @property
    def calibration(self) -> Calibration:
        """Intrinsics, ``cam_from_vehicle`` (4, 4) and the covariance (6, 6) of its left tangent."""
        return Calibration(self.fit.points.info, self.fit.cam_from_vehicle, self.fit.covariance)

    @property
    def roi_vehicle(self) -> FloatArray:
        """The convex hull (M, 2) of the right points, counter-clockwise, m."""
        right = self.fit.points.points_vehicle[self.fit.is_right]
        return np.asarray(right[ConvexHull(right).vertices])

    def camera_entry(self, info_file: str) -> dict[str, Any]:
        """The camera's entry for ``drive.yaml``, but for the file names of a real drive."""
        info = self.fit.points.info
        mounting = self.fit.cam_from_vehicle
        sigma = centre_sigmas(mounting, self.fit.covariance)
        return {
            "camera_info": info_file,
            "images": f"{info.name}/images.txt",
            "ipm": {"calibrated": ipm_from_extrinsic(info, mounting).tolist()},
            "roi_vehicle": self.roi_vehicle.tolist(),
            "centre_prior": {"xyz": camera_centre(mounting).tolist(), "sigma_m": sigma.tolist()},
        }


@checked
def calibrate_from_points(
    points: SurveyedPoints | Path | str,
    info: CameraInfo,
    *,
    pixel_sigma: float = Noise.pixel_px,
    survey_sigma: float = Noise.survey_m,
) -> PointCalibration:
    """Find a camera's mounting from surveyed ground points and their pixels.

    Args:
        points: N points, or a CSV file with the columns u, v (recorded px), x, y (vehicle frame, m).
        info: the camera's intrinsics.
        pixel_sigma: standard deviation of clicking, px a coordinate.
        survey_sigma: standard deviation of surveying, m a coordinate.

    Returns:
        ``calibration.cam_from_vehicle`` (4, 4), its covariance (6, 6) in m and rad, and a verdict.

    Raises:
        DriveError: a point is impossible, or the points fit no mounting; the message names the cause.
        ConfigError: a standard deviation is no number, negative, or both are 0.

    >>> calibrated = calibrate_from_points(points, port.cameras["front"].info)
    >>> calibrated.verdict.status.value, calibrated.calibration.covariance.shape
    ('PASS', (6, 6))
    """
    for option, value in (("--pixel-sigma", pixel_sigma), ("--survey-sigma", survey_sigma)):
        if not (np.isfinite(value) and value >= 0):
            raise ConfigError(f"{option} {value:g}: give a standard deviation, 0 or more")
    if pixel_sigma == survey_sigma == 0:
        raise ConfigError("--pixel-sigma and --survey-sigma are both 0: no measurement is without error")
    table = points if isinstance(points, SurveyedPoints) else read_points(Path(points))
    check_points(table, info)
    fits = solve(table, info, Noise(pixel_sigma, survey_sigma))
    off = residuals(fits[0])
    return PointCalibration(table, fits[0], off, Verdict.of(judge_fit(table, fits, off)))


def solve(points: SurveyedPoints, info: CameraInfo, noise: Noise) -> list[Fit]:
    """The mountings that explain the points, the most likely first; DriveError, with why, where none does."""
    fits = _above_ground(fit_mountings(SeenPoints.of(points.points_px, points.points_vehicle, info, noise)))
    if _doubtful(fits):
        cause = _misreading(points, info, noise)
        if cause is not None:
            raise DriveError(f"{points.path}: the points fit no mounting of this camera: {cause}")
    if not fits or not np.isfinite(fits[0].covariance).all():
        raise DriveError(
            f"{points.path}: the points do not determine a camera: all, or all but one, lie about on a line; "
            "survey some to its left and right"
        )
    height = _height_m(fits[0])

    def log_odds(metres: float, prior: float) -> float:
        return float(-0.5 * (np.log(height * metres / _HEIGHT_M) / _LOG_HEIGHT) ** 2 + np.log(prior))

    unit = max(UNITS, key=lambda unit: log_odds(UNITS[unit], _MISREAD))
    if log_odds(UNITS[unit], _MISREAD) > log_odds(1.0, 1.0):
        raise DriveError(
            f"{points.path}: the camera would be {height:.4g} m above the ground: x and y look like {unit}; "
            f"write metres, in which that is {height * UNITS[unit]:.2f} m"
        )
    return fits


def _above_ground(fits: list[Fit]) -> list[Fit]:
    """The mountings that a camera can have: from below, mirrored points look right."""
    return [fit for fit in fits if _height_m(fit) > 0]


def _height_m(fit: Fit) -> float:
    """Height of the camera, m."""
    return float(camera_centre(fit.cam_from_vehicle)[2])


def _doubtful(fits: list[Fit]) -> bool:
    """Whether no mounting explains the points well, so that other readings of the table should be tried."""
    if not fits:
        return True
    right = int(fits[0].is_right.sum())
    if right < LEAST_POINTS or 2 * right <= fits[0].points.count:
        return True
    return scatter(fits[0], CHANCE).probability < CHANCE


def _misreading(points: SurveyedPoints, info: CameraInfo, noise: Noise) -> str | None:
    """The likeliest reason why the points make no sense as they are; None where none is likely."""
    some = slice(None, None, -(-len(points.names) // _TOLD))
    px = points.points_px[some]
    ground = points.points_vehicle[some]

    given_fits = fit_mountings(SeenPoints.of(px, ground, info, noise))
    as_given = _best_score(_above_ground(given_fits))
    causes = {}
    for reading in _readings(px, ground, info):
        read_points = SeenPoints.of(reading.points_px, reading.points_vehicle, info, noise)
        fits = _above_ground(fit_mountings(read_points, starts=_STARTS, rounds=_ROUNDS))
        # Pixels that are scaled have another density: by scale^2 each in those of the table.
        causes[reading.cause] = _best_score(fits) + 2 * len(px) * float(np.log(reading.scale))
    if given_fits:
        causes[_UNRELATED] = -len(px) * float(np.log(info.width * info.height))
    cause = max(causes, key=lambda words: causes[words])
    return cause if causes[cause] > as_given + _SURE - np.log(_MISREAD) else None


def _best_score(fits: list[Fit]) -> float:
    """The highest score of mountings, -inf for none."""
    return max((_score(fit) for fit in fits), default=-np.inf)


def _score(fit: Fit) -> float:
    """Log posterior, with how usual the mounting is."""
    roll, _, yaw = mounting_angles(fit.cam_from_vehicle)
    beside = camera_centre(fit.cam_from_vehicle)[1]
    unusual = 0.5 * ((roll / _ROLL_RAD) ** 2 + (beside / _BESIDE_M) ** 2) + _ASIDE * np.sin(yaw) ** 2
    return fit.log_posterior - min(float(unusual), _UNUSUAL)


class _Reading(NamedTuple):
    """The points of a table, read as if it was written wrongly in one way."""

    cause: str
    points_px: FloatArray  # (N, 2) pixels as meant
    points_vehicle: FloatArray  # (N, 2) places as meant, m
    scale: float = 1.0  # of these pixels


def _readings(px: FloatArray, ground: FloatArray, info: CameraInfo) -> Iterator[_Reading]:
    """The other readings of a table of pixels (N, 2) and places (N, 2)."""
    mirrored = "y counts to the right, or x backward; write y positive to the left, x forward"
    yield _Reading(mirrored, px, ground * [1.0, -1.0])
    exchanged = "x and y are exchanged; x is forward, y to the left"
    yield _Reading(exchanged, px, ground[:, ::-1].copy())
    swapped = "u and v are exchanged; u counts columns to the right, v rows down"
    yield _Reading(swapped, px[:, ::-1].copy(), ground)
    upward = "v counts upward from the image's lower edge; count it down from the upper one"
    yield _Reading(upward, np.column_stack([px[:, 0], info.height - 1 - px[:, 1]]), ground)
    for scale in _SCALES:
        size = f"the pixels are of an image {1 / scale:.3g} times as large as that of the intrinsics"
        yield _Reading(f"{size}; give both at the same size", (px + 0.5) * scale - 0.5, ground, scale)


_COLUMNS = (
    "point", "u", "v", "x", "y", "off_u_px", "off_v_px", "off_x_m", "off_y_m", "sigmas", "probability_right",
    "known_m",
)  # fmt: skip


def write_point_calibration(
    calibrated: PointCalibration, folder: Path, image: np.ndarray | None = None
) -> None:
    """Write calibration, drive entry, table, verdict and picture, in the image (H, W, 3) BGR if given."""
    info = calibrated.fit.points.info
    verdict = calibrated.verdict.as_json()
    write_json(folder / VERDICT, verdict)
    path = folder / calibration_file(info.name)
    about = Provenance.today(calibrated.points.path.stem, verdict)
    write_calibration(calibrated.calibration, path, verdict=verdict, about=about)
    write_camera_info(info, folder / info.name / "camera_info.yaml")
    entry = dump_yaml({"cameras": {info.name: calibrated.camera_entry(f"{info.name}/camera_info.yaml")}})
    (folder / ENTRY_FILE).write_text(
        "# For drive.yaml. Under images, name the list of your images (docs/drive-format.md).\n" + entry,
        encoding="utf-8",
    )
    points = calibrated.points
    off = calibrated.residuals
    rows = []
    for k, name in enumerate(points.names):
        shift = [*(f"{px:.3f}" for px in off.off_px[k]), *(f"{m:.4f}" for m in off.off_m[k])]
        sureness = [f"{off.sigmas[k]:.2f}", f"{calibrated.fit.right[k]:.3g}", f"{off.known_m[k]:.4f}"]
        place = [*points.points_px[k].tolist(), *points.points_vehicle[k].tolist()]
        rows.append([name, *place, *shift, *sureness])
    replace_csv(folder / POINTS_FILE, [_COLUMNS, *rows])
    is_right = calibrated.fit.is_right.tolist()
    drawn = list(zip(points.labels, points.points_px, off.off_px, is_right, strict=True))
    mounting = calibrated.fit.cam_from_vehicle
    save_points(folder / PICTURE_FILE, image, info, mounting, calibrated.roi_vehicle, drawn)


def summary_lines(calibrated: PointCalibration) -> list[str]:
    """The mounting, every point's residual and the verdict, for a terminal."""
    fit = calibrated.fit
    off = calibrated.residuals
    verdict = calibrated.verdict
    turned, placed = mounting_words(fit.cam_from_vehicle, fit.covariance)
    right = fit.is_right
    off_px, off_cm = (np.hypot(part[:, 0], part[:, 1]) for part in (off.off_px, 100 * off.off_m))
    px, cm = (float(np.sqrt(np.mean(part[right] ** 2))) for part in (off_px, off_cm))
    known_cm = 100 * off.known_m[right]
    width = max(len(name) for name in calibrated.points.names)
    return [
        f"{fit.points.info.name}: {', '.join(turned)}",
        f"  centre {', '.join(placed)}",
        f"  {right.sum()} of {len(right)} points agree: {px:.2f} px and {cm:.1f} cm on the ground rms; "
        f"IPM known to {known_cm.min():.1f} cm at the best of them, {known_cm.max():.1f} cm at the worst",
        *(
            f"  {name:{width}}  off {_number(off_px[k], 6, 2)} px {_number(off_cm[k], 7, 1)} cm "
            f"{off.sigmas[k]:6.1f} sigmas"
            for k, name in enumerate(calibrated.points.names)
        ),
        verdict.lines[0],
        *(finding.line for finding in verdict.raised),
    ]


def _number(value: float, width: int, digits: int) -> str:
    """The number; a dash where there is none, as for points behind the camera."""
    return f"{value:{width}.{digits}f}" if np.isfinite(value) else f"{'-':>{width}}"
