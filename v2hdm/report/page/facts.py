"""What is known of a run: the files of its result folder, and the drive that it mapped."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.rigid import inverse
from v2hdm.io.calibration.document import read_calibration
from v2hdm.io.drive.trajectory import interpolate
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.drive.tum import read_tum
from v2hdm.io.maps.exclusions import ExcludedMarking, read_exclusions
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.geojson import read_geojson
from v2hdm.io.maps.residuals import FILE as RESIDUALS
from v2hdm.io.maps.residuals import Residuals, read_residuals
from v2hdm.records import BoolArray, Calibration, Drive, FloatArray, HdMap, Trajectory, Truth
from v2hdm.store.files import load_json, load_yaml, read_text

BEST = "Opt"
"""The method whose map is the run's result, as ``metrics.json`` names it."""


@dataclass(frozen=True)
class Route:
    """The adjusted poses of a run.

    Attributes:
        stamp_s: (F,) rising.
        map_from_vehicle: (F, 4, 4) adjusted, in the frame of the recorded poses.
        recorded: (F, 4, 4) the same as recorded, None without the drive.
        flat: (F, 4, 4) adjusted, with the road laid flat as the map is; as recorded without the drive.
        sigma: (F, 6) forward, left, up in m, roll, pitch, heading in rad.
        seen: (F,) whether a marking was seen then.
    """

    stamp_s: FloatArray
    map_from_vehicle: FloatArray
    recorded: FloatArray | None
    flat: FloatArray
    sigma: FloatArray
    seen: BoolArray

    @property
    def way_m(self) -> FloatArray:
        """How far the vehicle has driven (F,), m."""
        steps = np.linalg.norm(np.diff(self.map_from_vehicle[:, :2, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class CameraFacts:
    """One camera's calibration, and its clock offset and sigma, s, None where they are not known."""

    calibration: Calibration
    clock_offset_s: float | None
    clock_sigma_s: float | None


@dataclass(frozen=True)
class Facts:
    """A result folder, read; what is not in it is None or empty.

    Attributes:
        folder: it.
        metrics: ``metrics.json``.
        config: ``config.yaml`` as text.
        hd_map: the map, with ids.
        excluded: what the map of all cameras left out.
        cameras: by name.
        route: the adjusted poses.
        residuals: of the corner observations.
        check_points: the rows of ``check_points.csv`` by its columns.
        drive: that was mapped.
        truth: of the drive, if it was rendered.
    """

    folder: Path
    metrics: Mapping[str, Any]
    config: str
    hd_map: HdMap | None
    excluded: tuple[ExcludedMarking, ...]
    cameras: Mapping[str, CameraFacts]
    route: Route | None
    residuals: Residuals | None
    check_points: tuple[Mapping[str, str], ...]
    drive: Drive | None
    truth: Truth | None

    @property
    def results(self) -> Mapping[str, Any]:
        """The figures of the methods with all cameras; empty where no map came."""
        sets = self.metrics.get("results") or {}
        return list(sets.values())[-1] if sets else {}

    @property
    def best(self) -> Mapping[str, Any]:
        """The figures of the result."""
        return dict(self.results.get(BEST, {}))

    @property
    def ids(self) -> list[int]:
        """The ids of the map's markings, then lanes, then symbols."""
        return [one.id for one in features_of(self.hd_map)] if self.hd_map else []


def read_facts(folder: Path, drive: Drive | None) -> Facts:
    """Read the result folder of a run; ``drive`` is the one that it mapped, if it is at hand.

    Raises:
        MapFileError: the folder is no result, or a file in it is damaged.
        DriveError: the drive's truth is damaged.
    """
    if not (folder / "metrics.json").is_file():
        raise MapFileError(f"{folder}: no result of v2hdm map (no metrics.json in it); give its folder")
    metrics = load_json(folder / "metrics.json", MapFileError)
    sets = list(metrics.get("results") or {})
    has_map = (folder / "map.geojson").is_file()
    excluded = read_exclusions(folder / "excluded.geojson") if (folder / "excluded.geojson").is_file() else []
    residuals = folder / RESIDUALS
    config = folder / "config.yaml"
    return Facts(
        folder=folder,
        metrics=metrics,
        config=read_text(config, MapFileError) if config.is_file() else "",
        hd_map=_with_ids(read_geojson(folder / "map.geojson")) if has_map else None,
        excluded=tuple(one for one in excluded if not sets or one.cameras == sets[-1]),
        cameras=_cameras(folder),
        route=_route(folder, drive),
        residuals=read_residuals(residuals) if residuals.is_file() else None,
        check_points=_rows(folder / "check_points.csv"),
        drive=drive,
        truth=read_truth(drive) if drive is not None and drive.truth_dir is not None else None,
    )


def _with_ids(hd_map: HdMap) -> HdMap:
    ids = iter([one.id for one in features_of(hd_map)])
    return replace(
        hd_map,
        markings=tuple(replace(one, id=next(ids)) for one in hd_map.markings),
        lanes=tuple(replace(one, id=next(ids)) for one in hd_map.lanes),
        symbols=tuple(replace(one, id=next(ids)) for one in hd_map.symbols),
    )


def _cameras(folder: Path) -> dict[str, CameraFacts]:
    found = {}
    for path in sorted(folder.glob("calibration_*.yaml")):
        content = load_yaml(path, MapFileError)
        calibration = read_calibration(path)
        clock_s = (content.get("clock_offset_s"), content.get("clock_sigma_s"))
        found[calibration.info.name] = CameraFacts(
            calibration, *(float(one) if isinstance(one, int | float) else None for one in clock_s)
        )
    return found


def _route(folder: Path, drive: Drive | None) -> Route | None:
    if not (folder / "trajectory.tum").is_file():
        return None
    adjusted = read_tum(folder / "trajectory.tum")
    path = folder / "trajectory_sigma.csv"
    rows = _table(path)[1:]
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(adjusted.stamp_s), 8)
    except ValueError:
        raise MapFileError(f"{path}: not a line of 8 numbers for each pose of trajectory.tum") from None
    recorded = flat = None
    if drive is not None:
        recorded = _at(drive.recorded or drive.trajectory, adjusted.stamp_s)
        flat = _at(drive.trajectory, adjusted.stamp_s)
    moved = adjusted.map_from_vehicle
    if recorded is not None and flat is not None:
        moved = flat @ inverse(recorded) @ moved
    return Route(adjusted.stamp_s, adjusted.map_from_vehicle, recorded, moved, table[:, 2:], table[:, 1] > 0)


def _at(trajectory: Trajectory | None, stamp_s: FloatArray) -> FloatArray | None:
    return None if trajectory is None else interpolate(trajectory, stamp_s, float("inf"))[0]


def _table(path: Path) -> tuple[tuple[str, ...], ...]:
    if not path.is_file():
        return ()
    return tuple(tuple(row) for row in csv.reader(io.StringIO(read_text(path, MapFileError))) if row)


def _rows(path: Path) -> tuple[Mapping[str, str], ...]:
    heading, *rows = _table(path) or ((),)
    return tuple(dict(zip(heading, row, strict=False)) for row in rows)
