"""The result of a mapped drive, and its files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm import __version__
from v2hdm.detection.batch import read_image
from v2hdm.errors import ConfigError, DriveError, MapFileError, MappingError
from v2hdm.geometry.ipm import apply_in_front, facing_ipm, flat_motion, pinhole_px_from_ground
from v2hdm.geometry.planar import length_along
from v2hdm.geometry.rigid import interpolate, inverse
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import CALIBRATION_FORMATS, write_calibration, write_calibration_as
from v2hdm.io.drive import ReadOptions, told_of
from v2hdm.io.maps.evidence import write_exclusions, write_residuals
from v2hdm.io.maps.features import with_heights
from v2hdm.io.maps.formats import check_crs, with_data, write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_qgis
from v2hdm.io.trajectory import write_tum
from v2hdm.mapping.results import AdjustedPoses, MethodResult
from v2hdm.pipeline.base import write_changes
from v2hdm.pipeline.config import Contents, made_of_drives
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.evaluate import CameraSets
from v2hdm.records import BEST, Calibration, Drive, FloatArray, HDMap, Image, ImageDetections, Trajectory
from v2hdm.report.photos import save_overlay
from v2hdm.store import names
from v2hdm.store.cache import library_versions
from v2hdm.store.files import replace_text, write_json
from v2hdm.store.results import result_folder
from v2hdm.survey.check_points import CheckTable, write_check_points
from v2hdm.verdict import Verdict


def describe_run(name: str, drive: Drive, paths: Sequence[Path], options: ReadOptions) -> dict[str, Any]:
    """The beginning of ``metrics.json``: name, version, date (UTC), the drive at ``paths`` as it was read."""
    stamp_s = [image.stamp_s for image in drive.images]
    return {
        "name": name,
        "version": __version__,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "drive": {
            **told_of(drive, paths, options),
            "duration_s": round(float(np.ptp(stamp_s)), 3),
            "length_m": round(float(length_along(drive.route_map)[-1]), 2),
            "position_sigma_m": drive.pose_noise.position_m,
            "heading_sigma_deg": round(float(np.rad2deg(drive.pose_noise.heading_rad)), 4),
        },
        "versions": {"v2hdm": __version__, **library_versions()},
    }


_HEADER = "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"


def write_trajectories(poses: AdjustedPoses, drive: Drive, folder: Path) -> None:
    """Write ``trajectory.tum`` and ``trajectory_sigma.csv``, a line for each time of an image.

    Of joined drives each has its own, such as ``trajectory_monday.tum``. Poses are in the frame of the
    recorded ones, whose road is not flat: moved as the solve has moved the flat ones. ``seen`` says whether a
    marking was seen then; else pose and sigmas are those of the drive.
    """
    for number, session in enumerate(drive.sessions):
        own = poses.session == number
        poses_file, sigma_file = names.trajectory_files(session.name if drive.joined else None)
        stamp_s = poses.stamp_s[own]
        before = poses.before[own]
        moved = np.linalg.inv(before) @ poses.map_from_vehicle[own]
        recorded = before  # laid flat, where the session has no others
        if session.recorded is not None:
            recorded, _ = interpolate(session.recorded, stamp_s, float("inf"))
        write_tum(Trajectory(stamp_s, recorded @ moved), folder / poses_file)
        rows = [
            f"{stamp:.9f},{int(seen)}," + ",".join(f"{value:.6g}" for value in sigma)
            for stamp, seen, sigma in zip(stamp_s, poses.seen[own], poses.sigma[own], strict=True)
        ]
        replace_text(folder / sigma_file, "\n".join([_HEADER, *rows]) + "\n")


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """The map of a drive, its calibrations, trajectory and verdict.

    Attributes:
        about: name, date, versions and the drive, as ``metrics.json`` begins.
        drives: as they were read.
        contents: digests of their images.
        drive: what was mapped, several drives as one; its clocks are corrected.
        seconds: how long each step took, s.
        device: what torch computed on.
        verdict: all findings, the worst first; ``verdict.status`` is PASS, WARN or FAIL.
        figures: those of ``metrics.json`` beside what it begins with.
        headlines: sentences for a reader.
        detections: in each image of ``drive``.
        methods: results by camera set, then by method, those of all cameras last; empty where no map came.
        check_points: a survey's check points against the map; None without any.

    >>> saved = result.save(folder / "port")
    >>> sorted(path.name for path in saved.glob("*.geojson"))
    ['excluded.geojson', 'map.geojson']
    >>> result.trajectory.map_from_vehicle.shape[1:], result.trajectory.sigma.shape[1:]
    ((4, 4), (6,))
    """

    about: Mapping[str, Any]
    drives: tuple[Drive, ...]
    contents: Contents
    drive: Drive
    seconds: dict[str, float]
    device: str = "cpu"
    verdict: Verdict = field(default_factory=lambda: Verdict(()))
    figures: Mapping[str, Any] = field(default_factory=dict)
    headlines: Sequence[str] = ()
    detections: Sequence[ImageDetections] = ()
    methods: CameraSets = field(default_factory=dict)
    check_points: CheckTable | None = None

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        return {**self.about, "verdict": self.verdict.as_json(), **self.figures}

    @property
    def best(self) -> MethodResult:
        """The joint optimisation with all cameras.

        Raises:
            MappingError: no map came of the drive; the verdict says why.
        """
        if not self.methods:
            raise MappingError(f"{self.about['name']}: this drive gave no map; its verdict says why")
        return list(self.methods.values())[-1][BEST]

    @property
    def map(self) -> HDMap:
        """The map, in the frame ``map``: m, its lane lines in the direction in which they were passed."""
        return _along_route(with_heights(self.best.hd_map, self.drive.road), self.drive)

    @property
    def calibrations(self) -> Mapping[str, Calibration]:
        """By camera ``cam_from_vehicle`` (4, 4) and the covariance (6, 6) of its tangent."""
        return self.best.calibrations

    @property
    def trajectory(self) -> AdjustedPoses:
        """``map_from_vehicle`` (F, 4, 4) at the images' times, on the flat road; sigmas (F, 6): m, rad."""
        poses = self.best.poses
        assert poses is not None  # of the joint optimisation they always are
        return poses

    def save(
        self,
        folder: Path | str,
        formats: Sequence[str] = ("geojson",),
        all_maps: bool = False,
        mosaic: bool = True,
        crs: str | None = None,
    ) -> Path:
        """Write all that ``v2hdm map`` writes into ``folder``, whole or not at all; returns the folder.

        Args:
            folder: is made, or has an earlier result, which is replaced; nobody else's file is.
            formats: of the map: ``geojson``, ``csv``, ``gpkg``, ``lanelet2``, ``dxf``, ...
            all_maps: whether the map of every method and camera set is written, into ``maps/``.
            mosaic: whether the ground of a single drive is shown from above, too.
            crs: the system of coordinates of the formats but ``geojson``, as ``EPSG:25832`` or ``local``.

        Raises:
            ConfigError: there is something else in the folder, or a format cannot be written.
        """
        with result_folder(Path(folder), "folder", made_of_drives(self.about["drive"]["paths"])) as partial:
            self.write(partial, formats, all_maps, mosaic, Context(seconds=self.seconds), crs)
        return Path(folder)

    def write(
        self,
        folder: Path,
        formats: Sequence[str],
        all_maps: bool,
        mosaic: bool,
        context: Context,
        crs: str | None = None,
        background: str | None = None,
    ) -> None:
        """Write what :meth:`save` does into a folder that is still unfinished."""
        from v2hdm.mosaic.result import write_mosaic
        from v2hdm.report.page.document import write_page

        if self.methods:
            _write_map(folder, self, formats, crs)
            for name, methods in self.methods.items() if all_maps else ():
                for method, made in methods.items():
                    path = folder / "maps" / f"{name}_{method}.geojson"
                    write_geojson(with_heights(made.hd_map, self.drive.road), path)
        write_json(folder / names.METRICS, self.metrics)
        if mosaic and self.methods and not self.drive.joined:
            with context.timed("mosaic"):
                try:
                    write_mosaic(folder, self.drive, device=self.device, progress=context.steps("mosaic"))
                except (ConfigError, DriveError) as failure:  # a picture is no reason to lose a map
                    _log.warning("no mosaic was made: %s", failure)
        if "qgis" in formats and self.methods:  # it opens the mosaic, too
            grid = check_crs(crs, ["qgis"], self.map.origin, "crs").get("qgis")
            write_qgis(self.map, folder / names.PROJECT, grid=grid)
        with context.timed("report"):
            write_page(folder, self.drive, None if background is None else Path(background))


def _write_map(folder: Path, result: Result, formats: Sequence[str], crs: str | None) -> None:
    drive = result.drive
    best = result.best
    verdict = result.verdict.as_json()
    geojson = [one for one in formats if one == "geojson"]  # longitude and latitude, whatever the others have
    write_map(result.map, folder, "map", geojson, verdict)
    others = [one for one in with_data(formats) if one not in ("geojson", "qgis")]
    write_map(result.map, folder, "map", others, verdict, crs=crs)
    about = Provenance.today(drive.name, verdict)
    for name, calibration in best.calibrations.items():
        clock = None if drive.joined else best.clocks[0].get(name)
        clock_s = None if clock is None else (clock.value_s, clock.sigma_s)
        path = folder / names.calibration_file(name)
        read_out_s = None if best.evidence is None else best.evidence.read_out_s.get(name)
        noted: dict[str, Any] = {"clock_s": clock_s, "read_out_s": read_out_s, "verdict": verdict}
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
        write_changes(best.changes, best.hd_map, folder)
    if result.check_points is not None:
        write_check_points(result.check_points, folder / names.CHECK_POINTS)
    sets = result.methods.items()
    excluded = [replace(one, cameras=name) for name, methods in sets for one in methods[BEST].excluded]
    write_exclusions(excluded, folder / names.EXCLUDED, drive.origin, drive.road)
    for name in best.calibrations:
        image = _fullest_image(drive, name, result.detections)
        _save_overlay(folder / names.overlay_file(name), drive, image, best)


_BY_VERTEX = ("points_map", "heights_m", "sigma_m", "heights_sigma_m")


def _along_route(hd_map: HDMap, drive: Drive) -> HDMap:
    """The map with every lane line in the direction in which the drive passed it: that of its lanelets."""
    route_map = drive.route_map
    ahead = np.array([image.map_from_vehicle[:2, 0] for image in drive.images])
    lanes = []
    for lane in hd_map.lanes:
        offset = lane.points_map[:, None] - route_map
        passed = ahead[np.argmin((offset**2).sum(axis=2), axis=1)]
        if (passed * np.gradient(lane.points_map, axis=0)).sum() < 0:
            by_vertex = {name: getattr(lane, name) for name in _BY_VERTEX}
            turned: dict[str, Any] = {name: one[::-1] for name, one in by_vertex.items() if one is not None}
            lane = replace(lane, **turned)
        lanes.append(lane)
    return replace(hd_map, lanes=tuple(lanes))


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
    for found in detections:
        if found.image in corners:
            corners[found.image] = sum(int(marking.corner_valid.sum()) for marking in found.markings)
    return drive.images[max(corners, key=corners.__getitem__)]
