"""The files of a result: maps, calibrations, trajectories, evidence, pictures and the report.

Mapping loads none of what is imported here: neither the writers nor the mosaic nor the report's page.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from v2hdm.detection.frames import read_image
from v2hdm.errors import ConfigError, DriveError, MapFileError
from v2hdm.geometry.ipm import apply_in_front, facing_ipm, flat_motion, pinhole_px_from_ground
from v2hdm.geometry.rigid import interpolate, inverse
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import CALIBRATION_FORMATS, write_calibration, write_calibration_as
from v2hdm.io.maps.evidence import write_exclusions, write_residuals
from v2hdm.io.maps.features import with_heights
from v2hdm.io.maps.formats import check_crs, with_data, write_map
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features, write_geojson
from v2hdm.io.maps.geopackage import write_qgis
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.mapping.results import AdjustedPoses, MethodResult
from v2hdm.mosaic.result import write_mosaic
from v2hdm.pipeline.base import change_json
from v2hdm.pipeline.context import Context
from v2hdm.records import BEST, Changes, Drive, FloatArray, HDMap, Image, ImageDetections, Trajectory
from v2hdm.report.coverage import REACH_M, coverage_of, write_coverage
from v2hdm.report.job import Job, StatedJob, write_job
from v2hdm.report.page.document import write_page
from v2hdm.report.paper import write_paper
from v2hdm.report.photos import save_overlay
from v2hdm.store import names
from v2hdm.store.files import replace_text, write_json
from v2hdm.survey.check_points import write_check_points
from v2hdm.verdict import known_frames

if TYPE_CHECKING:
    from v2hdm.pipeline.result import Result

_log = logging.getLogger(__name__)


_OF_OTHER_FILES = ("qgis", "mcap")  # formats that hold or open what is written after the map


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Parts of a result that are written: see :meth:`v2hdm.pipeline.result.Result.save`."""

    formats: Sequence[str] = ("geojson",)
    all_maps: bool = False
    mosaic: bool = True
    crs: str | None = None
    background: str | None = None  # under the report's map: a GeoTIFF or a folder of XYZ tiles
    job: Job = field(default_factory=Job)  # what people state for the report
    pdf: bool = False
    reach_m: float = REACH_M  # from a camera's nadir, to which markings were mapped


def write_result(result: Result, folder: Path, outputs: Outputs, context: Context) -> None:
    """Write a result into a folder that is still unfinished."""
    drive = result.drive
    if result.methods:
        _write_map(folder, result, outputs)
        if outputs.all_maps:
            _write_all_maps(folder, result)
    write_json(folder / names.METRICS, result.metrics)
    if outputs.mosaic and result.methods and drive.has_pictures and not drive.joined:
        with context.timed("mosaic"):
            try:
                steps = context.steps("mosaic")
                write_mosaic(folder, drive, progress=steps, executor=context.executor)
            except (ConfigError, DriveError) as failure:  # a picture is no reason to lose a map
                _log.warning("no mosaic was made: %s", failure)
    if "qgis" in outputs.formats and result.methods:  # it opens the mosaic, too
        grid = check_crs(outputs.crs, ["qgis"], result.map.origin, "crs").get("qgis")
        write_qgis(result.map, folder / names.PROJECT, grid=grid)
    if "mcap" in outputs.formats and result.methods:
        _write_recording(result.map, folder)
    write_job(folder, StatedJob(outputs.job, outputs.crs))
    with context.timed("report"):
        if result.methods:
            mountings = {name: camera.cam_from_vehicle for name, camera in result.calibrations.items()}
            write_coverage(folder, coverage_of(drive, mountings, outputs.reach_m))
        try:
            write_page(folder, drive, None if outputs.background is None else Path(outputs.background))
        except MapFileError as failure:
            if outputs.background is None:
                raise
            _log.warning("no picture lies under the report's map: %s", failure)
            write_page(folder, drive)
        if outputs.pdf:
            write_paper(folder, drive)


def _write_recording(hd_map: HDMap, folder: Path) -> None:
    """The map with the adjusted poses and the overlays that are in ``folder``."""
    driven = [read_tum(path) for path in sorted(folder.glob(names.TRAJECTORIES))]
    overlays = sorted(folder.glob(names.OVERLAYS))
    write_map(hd_map, folder, "map", ["mcap"], trajectories=driven, pictures=overlays)


def _write_all_maps(folder: Path, result: Result) -> None:
    for name, methods in result.methods.items():
        for method, mapped in methods.items():
            path = folder / "maps" / f"{name}_{method}.geojson"
            write_geojson(with_heights(mapped.hd_map, result.drive.road), path)


def _write_map(folder: Path, result: Result, outputs: Outputs) -> None:
    drive = result.drive
    best = result.best
    verdict = result.verdict.as_json()
    geojson = [
        name for name in outputs.formats if name == "geojson"
    ]  # longitude and latitude, whatever the others have
    write_map(result.map, folder, "map", geojson, verdict)
    others = [name for name in with_data(outputs.formats) if name not in ("geojson", *_OF_OTHER_FILES)]
    driven = drive.paths
    write_map(
        result.map,
        folder,
        "map",
        others,
        verdict,
        crs=outputs.crs,
        trajectories=driven,
        answers=result.answers,
    )
    about = Provenance.today(drive.name, verdict)
    for name, calibration in best.calibrations.items():
        clock = None if drive.joined else best.clocks[0].get(name)
        clock_s = None if clock is None else (clock.value_s, clock.sigma_s)
        path = folder / names.calibration_file(name)
        read_out_s = None if best.evidence is None else best.evidence.read_out_s.get(name)
        noted: dict[str, Any] = {"clock_s": clock_s, "read_out_s": read_out_s, "verdict": verdict}
        calibration = replace(calibration, frames=known_frames(drive.cameras[name], result.verdict))
        write_calibration(calibration, path, about=about, **noted)
        for form in CALIBRATION_FORMATS:  # of other tools, into a folder named like the file
            try:
                write_calibration_as(form, calibration, about, path.with_suffix(""), calibration.info.name)
            except MapFileError as error:
                _log.info("no %s calibration is written: %s", form, error)
    write_trajectories(result.trajectory, drive, folder)
    if best.surface is not None:
        write_json(folder / names.GROUND, best.surface.stored())
    if best.residuals is not None:
        write_residuals(best.residuals, folder / names.RESIDUALS)
    if best.changes is not None:
        _write_changes(best.changes, best.hd_map, folder)
    if result.check_points is not None:
        write_check_points(result.check_points, folder / names.CHECK_POINTS)
    sets = result.methods.items()
    excluded = [
        replace(exclusion, cameras=name) for name, methods in sets for exclusion in methods[BEST].excluded
    ]
    write_exclusions(excluded, folder / names.EXCLUDED, drive.origin, drive.road)
    for name in best.calibrations if drive.has_pictures else ():
        image = _fullest_image(drive, name, result.detections)
        _save_overlay(folder / names.overlay_file(name), drive, image, best)


_HEADER = "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"


def write_trajectories(poses: AdjustedPoses, drive: Drive, folder: Path) -> None:
    """Write ``trajectory.tum`` and ``trajectory_sigma.csv``, a line for each time of an image.

    Of joined drives each has its own, such as ``trajectory_monday.tum``. Poses are in the frame of the
    recorded ones, whose road is not flat: moved as the solve has moved the flat ones. ``seen`` says whether a
    marking was seen then; else pose and sigmas are those of the drive.
    """
    for number, session in enumerate(drive.sessions):
        is_in_session = poses.session == number
        poses_file, sigma_file = names.trajectory_files(session.name if drive.joined else None)
        stamp_s = poses.stamp_s[is_in_session]
        before = poses.before[is_in_session]
        moved = np.linalg.inv(before) @ poses.map_from_vehicle[is_in_session]
        recorded = before  # laid flat, where the session has no others
        if session.recorded is not None:
            recorded, _ = interpolate(session.recorded, stamp_s, float("inf"))
        write_tum(Trajectory(stamp_s, recorded @ moved), folder / poses_file)
        rows = [
            f"{stamp:.9f},{int(is_seen)}," + ",".join(f"{value:.6g}" for value in sigma)
            for stamp, is_seen, sigma in zip(
                stamp_s, poses.has_marking[is_in_session], poses.sigma[is_in_session], strict=True
            )
        ]
        replace_text(folder / sigma_file, "\n".join([_HEADER, *rows]) + "\n")


def _write_changes(changes: Changes, hd_map: HDMap, folder: Path) -> None:
    """Write ``changes.geojson``: a feature is an outline now, or that which it had if it is gone."""
    features = []
    for change in changes.changes:
        corners = change.before if change.after is None else change.after
        assert corners is not None
        ring = geojson_positions(corners, None, hd_map.origin)
        features.append(
            geojson_feature(f"changes/{change.id}", "Polygon", [[*ring, ring[0]]], change_json(change))
        )
    write_features(folder / names.CHANGES, features, hd_map.origin, {"same": changes.same})


def _save_overlay(path: Path, drive: Drive, image: Image, best: MethodResult) -> None:
    """The map in an image: by the initial IPM and the recorded pose, and by what the solve has adjusted."""
    camera = drive.cameras[image.camera]
    adjusted = image.map_from_vehicle if best.poses is None else best.poses.of_image(image)
    initial = {"calibrated": "CNI", "estimated": "ENI"}.get(camera.initial_ipm, camera.initial_ipm)
    cam_from_map = best.calibrations[image.camera].cam_from_vehicle @ np.linalg.inv(adjusted)
    ipm = facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0))
    before = np.linalg.inv(ipm) @ flat_motion(inverse(image.map_from_vehicle))
    after = pinhole_px_from_ground(camera.info.intrinsic, cam_from_map)
    ground = None if best.surface is None else best.surface.seen_from(adjusted[None])

    def optimised(points_map: FloatArray) -> FloatArray:
        if ground is not None:
            points_map = ground.on_plane(points_map, cam_from_map, 0)
        return apply_in_front(after, points_map)

    views: dict[str, Callable[[FloatArray], FloatArray]] = {
        initial: partial(apply_in_front, before),
        BEST: optimised,
    }
    save_overlay(path, read_image(image, camera), camera.info, best.hd_map, adjusted[:2, 3], views)


def _fullest_image(drive: Drive, name: str, detections: Sequence[ImageDetections]) -> Image:
    """The image of a camera in which most corners were found; its first one where there are none."""
    corners = {index: 0 for index, image in enumerate(drive.images) if image.camera == name}
    for in_image in detections:
        if in_image.image in corners:
            corners[in_image.image] = sum(int(marking.corner_valid.sum()) for marking in in_image.markings)
    return drive.images[max(corners, key=corners.__getitem__)]
