"""The data of a run: files of its result folder, its drive, and its residuals on the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px
from v2hdm.geometry.planar import length_along
from v2hdm.geometry.rigid import camera_centre, interpolate, inverse
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.evidence import Residuals, read_exclusions, read_residuals
from v2hdm.io.maps.features import features_of, map_of
from v2hdm.io.maps.written import read_written
from v2hdm.io.metrics import read_metrics
from v2hdm.io.trajectory import read_tum
from v2hdm.records import (
    BEST,
    BoolArray,
    Calibration,
    Drive,
    Exclusion,
    FloatArray,
    HDMap,
    IntArray,
    Lane,
    Marking,
    Reception,
    Symbol,
    Truth,
)
from v2hdm.report.coverage import Coverage, read_coverage
from v2hdm.report.job import NO_JOB, StatedJob, read_job
from v2hdm.store import names
from v2hdm.store.files import load_json, load_yaml, read_csv, read_text, take_number

if TYPE_CHECKING:  # loads scipy, for the few results with a ground of their own
    from v2hdm.surface.surface import Surface


@dataclass(frozen=True)
class Route:
    """The adjusted poses of a run."""

    stamp_s: FloatArray  # (F,) rising
    map_from_vehicle: FloatArray  # (F, 4, 4) adjusted, in the frame of the recorded poses
    recorded: FloatArray | None  # (F, 4, 4) as recorded, None without the drive
    flat: FloatArray  # (F, 4, 4) adjusted, on the flattened road of the map, if there is a drive
    sigma: FloatArray  # (F, 6) forward, left, up in m, roll, pitch, heading in rad

    @property
    def way_m(self) -> FloatArray:
        """Distance driven (F,), m."""
        return length_along(self.map_from_vehicle[:, :2, 3])

    def frames_of(self, residuals: Residuals) -> IntArray:
        """Index (I,) of the pose of each image."""
        return np.searchsorted((self.stamp_s[1:] + self.stamp_s[:-1]) / 2, residuals.taken_s)


@dataclass(frozen=True)
class CameraFacts:
    """Calibration of a camera; clock offset, read-out time and their sigmas, s, None if unknown."""

    calibration: Calibration
    clock_offset_s: float | None
    clock_sigma_s: float | None
    read_out_s: float | None
    read_out_sigma_s: float | None


class Occasion(NamedTuple):
    """When images were taken, by their stamps: first and last of each session, s."""

    sessions_s: tuple[tuple[float, float], ...]
    images: int


_NO_OCCASION = Occasion((), 0)  # of a result that holds no images' stamps


@dataclass(frozen=True)
class Facts:
    """The content of a result folder; missing parts are None or empty."""

    folder: Path
    metrics: Mapping[str, Any]
    config: str
    hd_map: HDMap | None
    excluded: tuple[Exclusion, ...]  # candidates excluded by the map of all cameras
    cameras: Mapping[str, CameraFacts]
    route: Route | None
    surface: Surface | None  # under the poses of ``route``, None for a plane
    residuals: Residuals | None
    check_points: tuple[Mapping[str, str], ...]  # rows of ``check_points.csv`` by its columns
    drive: Drive | None
    truth: Truth | None  # of a rendered drive
    job: StatedJob = NO_JOB  # what people state for the document
    occasion: Occasion = _NO_OCCASION
    reception: Reception | None = None
    coverage: Coverage | None = None

    @property
    def results(self) -> Mapping[str, Any]:
        """Figures of the methods with all cameras; empty without a map."""
        sets = self.metrics.get("results") or {}
        return list(sets.values())[-1] if sets else {}

    @property
    def best(self) -> Mapping[str, Any]:
        """Figures of the result."""
        return dict(self.results.get(BEST, {}))


def read_facts(folder: Path, drive: Drive | None) -> Facts:
    """Read a run's result folder and the data of its ``drive``; MapFileError for damaged files."""
    metrics = read_metrics(folder)
    residuals = folder / names.RESIDUALS
    config = folder / names.CONFIG
    points = folder / names.CHECK_POINTS
    route = _route(folder, drive)
    heading, *checked = (read_csv(points, MapFileError) if points.is_file() else []) or [[]]
    return Facts(
        folder=folder,
        metrics=metrics,
        config=read_text(config, MapFileError).strip() if config.is_file() else "",
        hd_map=read_map_of(folder),
        excluded=read_excluded(folder, metrics),
        cameras=read_cameras(folder),
        route=route,
        surface=None if route is None else read_surface(folder, route.flat),
        residuals=read_residuals(residuals) if residuals.is_file() else None,
        check_points=tuple(dict(zip(heading, row, strict=False)) for row in checked if row),
        drive=drive,
        truth=read_truth(drive) if drive is not None and drive.truth_dir is not None else None,
        job=read_job(folder),
        occasion=_occasion(metrics, drive),
        reception=_reception(metrics) if drive is None else drive.reception,
        coverage=read_coverage(folder),
    )


def _occasion(metrics: Mapping[str, Any], drive: Drive | None) -> Occasion:
    """The times of the drive's images, or as ``metrics.json`` has kept them."""
    if drive is not None:
        return Occasion(drive.spans_s, len(drive.images))
    stated = metrics.get("drive") or {}
    sessions = tuple((float(first), float(last)) for first, last in stated.get("sessions_s") or [])
    return Occasion(sessions, int(stated.get("images", 0)))


def _reception(metrics: Mapping[str, Any]) -> Reception | None:
    stated = (metrics.get("drive") or {}).get("reception")
    return None if stated is None else Reception(**stated)


def read_map_of(folder: Path) -> HDMap | None:
    """The map of a result folder, None where it has none; MapFileError if damaged."""
    if not (folder / names.MAP).is_file():
        return None
    hd_map = read_written(folder / names.MAP)
    paints: list[Marking | Lane | Symbol] = [*hd_map.markings, *hd_map.lanes, *hd_map.symbols]
    if all(paint.id for paint in paints):
        return hd_map
    features = features_of(hd_map)
    return map_of(features, [feature.id for feature in features], hd_map.origin)


def read_excluded(folder: Path, metrics: Mapping[str, Any]) -> tuple[Exclusion, ...]:
    """The candidates of a result folder that the map of all cameras left out; MapFileError if damaged."""
    if not (folder / names.EXCLUDED).is_file():
        return ()
    sets = list(metrics.get("results") or {})
    excluded = read_exclusions(folder / names.EXCLUDED)
    return tuple(candidate for candidate in excluded if not sets or candidate.cameras == sets[-1])


def read_cameras(folder: Path) -> dict[str, CameraFacts]:
    """Calibrations of a result folder by camera; raises MapFileError for damaged files."""
    cameras = {}
    for path in sorted(folder.glob(names.CALIBRATIONS)):
        content = load_yaml(path, MapFileError)
        calibration = read_calibration(path)
        times_s = {
            key: take_number(content[key], f"{path}: {key}", MapFileError) if key in content else None
            for key in ("clock_offset_s", "clock_sigma_s", "read_out_s", "read_out_sigma_s")
        }
        cameras[calibration.info.name] = CameraFacts(calibration, **times_s)
    return cameras


def _route(folder: Path, drive: Drive | None) -> Route | None:
    if not (folder / names.TRAJECTORY).is_file():
        return None
    adjusted = read_tum(folder / names.TRAJECTORY)
    path = folder / names.TRAJECTORY_SIGMA
    rows = [row for row in read_csv(path, MapFileError)[1:] if row]
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(adjusted.stamp_s), 8)
        if not np.isfinite(table).all():
            raise ValueError
    except ValueError:
        raise MapFileError(f"{path}: not one line of 8 numbers per pose of {names.TRAJECTORY}") from None
    stamp_s = adjusted.stamp_s
    poses = adjusted.map_from_vehicle
    recorded = None
    moved = poses
    if drive is not None and drive.trajectory is not None:
        recorded, flat = (
            interpolate(trajectory, stamp_s, float("inf"))[0]
            for trajectory in (drive.recorded or drive.trajectory, drive.trajectory)
        )
        moved = flat @ inverse(recorded) @ poses
    elif drive is not None and drive.recorded is not None:
        recorded = interpolate(drive.recorded, stamp_s, float("inf"))[0]
    return Route(stamp_s, poses, recorded, moved, table[:, 2:])


def read_surface(folder: Path, map_from_vehicle: FloatArray) -> Surface | None:
    """The ground of a result under vehicle poses (F, 4, 4), None for a plane; MapFileError if damaged."""
    path = folder / names.GROUND
    if not path.is_file():
        return None
    from v2hdm.surface.surface import Surface

    try:
        return Surface.from_stored(load_json(path, MapFileError), map_from_vehicle)
    except ValueError as damage:
        raise MapFileError(f"{path}: {damage}; map the drive again") from None


@dataclass(frozen=True)
class GroundResiduals:
    """K corner observations, as in :class:`Residuals`; nan above the horizon."""

    cameras: tuple[str, ...]
    camera: IntArray  # (K,) into ``cameras``
    marking: IntArray
    corner: IntArray
    is_point: BoolArray
    taken_s: FloatArray
    observed_px: FloatArray
    residual_px: FloatArray
    distance_sigma: FloatArray
    range_m: FloatArray  # (K,) from the camera's nadir to the observed corner
    ground_m: FloatArray  # (K, 2) projected minus observed, in the map

    @property
    def size_px(self) -> FloatArray:
        """Norms (K,) of the residuals."""
        return np.asarray(np.linalg.norm(self.residual_px, axis=1))


def ground_residuals(facts: Facts) -> GroundResiduals | None:
    """Residuals of a run for its calibrated cameras; None without any."""
    if facts.residuals is None or facts.route is None or not len(facts.residuals):
        return None
    residuals = facts.residuals
    calibrations = {name: camera.calibration for name, camera in facts.cameras.items()}
    cameras = tuple(sorted(set(residuals.camera) & calibrations.keys()))
    if not cameras:
        return None
    number = {name: n for n, name in enumerate(cameras)}
    of_image = np.array([number.get(name, -1) for name in residuals.camera])
    rows = np.flatnonzero(of_image[residuals.row_image] >= 0)
    row_image = residuals.row_image[rows]
    cam_from_map = cams_from_map(residuals, facts.route, calibrations)
    observed = residuals.observed_px[rows]
    off = residuals.residual_px[rows]
    calibrated = np.flatnonzero(of_image >= 0)
    intrinsic = np.array([calibrations[residuals.camera[i]].info.intrinsic for i in calibrated])
    map_from_px = np.full((len(of_image), 3, 3), np.nan)
    foot_map = np.full((len(of_image), 2), np.nan)
    map_from_px[calibrated] = ground_from_pinhole_px(intrinsic, cam_from_map[calibrated])
    foot_map[calibrated] = camera_centre(cam_from_map[calibrated])[:, :2]
    ground = map_from_px[row_image]
    observed_map = apply_in_front(ground, observed[:, None])[:, 0]
    projected_map = apply_in_front(ground, (observed + off)[:, None])[:, 0]
    return GroundResiduals(
        cameras=cameras,
        camera=of_image[row_image],
        marking=residuals.marking[rows],
        corner=residuals.corner[rows],
        is_point=residuals.is_point[rows],
        taken_s=residuals.taken_s[row_image],
        observed_px=observed,
        residual_px=off,
        distance_sigma=residuals.distance_sigma[rows],
        range_m=np.linalg.norm(observed_map - foot_map[row_image], axis=1),
        ground_m=projected_map - observed_map,
    )


def cams_from_map(residuals: Residuals, route: Route, calibrations: Mapping[str, Calibration]) -> FloatArray:
    """``cam_from_map`` (I, 4, 4) of each image under the adjusted poses; nan for uncalibrated cameras."""
    nearest = route.frames_of(residuals)
    out = np.full((len(residuals.image), 4, 4), np.nan)
    for i, name in enumerate(residuals.camera):
        if name in calibrations:
            out[i] = calibrations[name].cam_from_vehicle @ inverse(route.flat[nearest[i]])
    return out
