"""The library's functions that are no stage of :func:`v2hdm.map_drive`: one for each command.

They take a drive or its folder, print and write nothing, and return a verdict as data.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.io.drive import ReadOptions
from v2hdm.io.drive import read_drive as _read
from v2hdm.progress import Steps
from v2hdm.records import Calibration, CameraInfo, Drive, HdMap, ImageDetections
from v2hdm.verdict import Verdict

if TYPE_CHECKING:  # load torch or scipy
    from v2hdm.adjust.problem import Problem
    from v2hdm.calibration.from_ground import GroundCalibration
    from v2hdm.calibration.from_points import PointCalibration
    from v2hdm.localization.run import Localised
    from v2hdm.mapping.options import MappingOptions
    from v2hdm.simulate import PortConfig


def read_drive(path: str | Path, options: ReadOptions | None = None) -> Drive:
    """Read a drive: a folder with ``drive.yaml``, KITTI raw, nuScenes or a bag.

    Every image gets the vehicle's pose at its time, ``map_from_vehicle`` (4, 4): position linear, rotation
    slerp, never extrapolated. The frame ``map`` is east, north, up, m; a sloping road is laid flat.

    Raises:
        DriveError: names what is wrong, where, and what to do about it.

    >>> drive = read_drive(port.root)
    >>> list(drive.cameras), drive.images[0].map_from_vehicle.shape
    (['front'], (4, 4))
    """
    return _read(Path(path), options)


def check_drive(
    drive: Drive | str | Path, *, ground: bool = True, workers: int = 1, progress: Steps | None = None
) -> Verdict:
    """Check a drive before any long work: poses, clocks, noise, cameras, images, and bare ground.

    Args:
        drive: the drive, or its folder.
        ground: whether to match bare ground, which takes seconds a camera.
        workers: processes that match ground.
        progress: called as ``progress(done, total)`` cameras.

    Returns:
        All findings, the worst first: each with value, limit, unit, cause and remedy.

    Raises:
        DriveError: the drive, or an image, cannot be read.

    >>> verdict = check_drive(port, ground=False)
    >>> verdict.status.value, len(verdict.raised)
    ('PASS', 0)
    """
    from v2hdm import verdict

    return verdict.check_drive(_drive(drive), ground=ground, workers=workers, progress=progress)


def calibrate_from_points(
    points: str | Path, info: CameraInfo, *, pixel_sigma: float = 0.5, survey_sigma: float = 0.01
) -> PointCalibration:
    """Find a camera's mounting from surveyed ground points and their pixels.

    Args:
        points: CSV file with the columns u, v (recorded px), x, y (m in the frame ``vehicle``).
        info: the camera's intrinsics.
        pixel_sigma: standard deviation of clicking, px a coordinate.
        survey_sigma: standard deviation of surveying, m a coordinate.

    Returns:
        ``calibration.cam_from_vehicle`` (4, 4), its covariance (6, 6) in m and rad, and a verdict.

    Raises:
        DriveError: a point is impossible, or the points fit no mounting; the message names the cause.

    >>> found = calibrate_from_points(points, port.cameras["front"].info)
    >>> found.verdict.status.value, found.calibration.covariance.shape
    ('PASS', (6, 6))
    """
    from v2hdm.calibration import from_points

    return from_points.calibrate_from_points(points, info, pixel_sigma=pixel_sigma, survey_sigma=survey_sigma)


def calibrate_from_ground(
    drive: Drive | str | Path, *, workers: int = 1, progress: Steps | None = None
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
    from v2hdm.calibration import from_ground

    return from_ground.calibrate_from_ground(_drive(drive), workers=workers, progress=progress)


def localize(
    hd_map: HdMap,
    drive: Drive | str | Path,
    calibrations: Mapping[str, Calibration],
    *,
    detections: Sequence[ImageDetections] | None = None,
    workers: int = 0,
    progress: Steps | None = None,
) -> Localised:
    """Follow the vehicle through a drive by a map's markings; only the first recorded pose is used.

    Args:
        hd_map: in the frame of the drive's poses.
        drive: the drive, or its folder.
        calibrations: of its cameras, by name, as a result has them.
        detections: of the drive's images, made here if not given.
        workers: processes that detect; 0 takes one per core.
        progress: called as ``progress(done, total)`` images.

    Returns:
        ``states`` at ``stamp_s`` (F,), ``error`` against the recorded poses and ``sigma`` (F, 3): ahead, m,
        to the left, m, and heading, rad.

    Raises:
        MapFileError: map, calibrations and drive do not belong together.
        MappingError: the images hold no marking.

    >>> found = localize(result.map, port, result.calibrations, detections=result.detections)
    >>> found.error.shape == found.sigma.shape == (len(found.stamp_s), 3)
    True
    """
    from v2hdm.localization import run

    workers = workers or os.cpu_count() or 1
    return run.localize(
        hd_map, _drive(drive), calibrations, detections=detections, workers=workers, progress=progress
    )


def read_map(path: str | Path) -> HdMap:
    """Read a map: the folder of a result, or a ``map.geojson`` or ``map.gpkg``, edited or not.

    Raises:
        MapFileError: the file is missing, damaged or in another format.
        ConfigError: what reads the format is not installed.

    >>> hd_map = read_map(result.save(folder / "mapped"))
    >>> len(hd_map.markings) == len(result.map.markings)
    True
    """
    from v2hdm.io.maps import read_map as read

    path = Path(path)
    return read(path / "map.geojson" if path.is_dir() else path)[0]


def build_problem(
    drive: Drive, detections: Sequence[ImageDetections], options: MappingOptions | None = None
) -> Problem:
    """State the bundle adjustment of a drive: its sightings associated, with all that is known beforehand.

    Args:
        drive: the drive.
        detections: of its images.
        options: settings of association and adjustment.

    Returns:
        Cameras, frames and corners with their observations (recorded pixels, the lens undone) and priors.

    Raises:
        MappingError: there is nothing to map.

    >>> problem = build_problem(port, result.detections)
    >>> problem.map_from_vehicle.shape[1:], problem.cam_from_vehicle.shape
    ((4, 4), (1, 4, 4))
    >>> solve(problem).status.value
    'converged'
    """
    from v2hdm.mapping.options import MappingOptions
    from v2hdm.mapping.recovery import Inputs

    inputs = Inputs(drive, detections, tuple(drive.cameras), options or MappingOptions())
    return inputs.optimiser.settle(inputs.tracks).problem


def simulate_port(
    folder: str | Path, config: PortConfig | None = None, *, workers: int = 1, progress: Steps | None = None
) -> Drive:
    """Render a drive through a port, with ground truth, into a folder of its own below ``folder``, once.

    Args:
        folder: of all rendered drives, such as ``cache``.
        config: the port; None takes 46 m of one, with one camera of half the usual pixels.
        workers: processes to render in.
        progress: called as ``progress(done, total)`` images.

    Returns:
        The drive, read from there. Its truth is for evaluation only; mapping never looks at it.

    Raises:
        ConfigError: the settings make no port.
        DriveError: the folder cannot be written.

    >>> drive = simulate_port(folder)
    >>> drive.name, list(drive.cameras), len(drive.images)
    ('port', ['front'], 22)
    """
    from v2hdm.simulate import rendered_drive

    config = config or _short_port()
    return read_drive(rendered_drive(config, Path(folder), workers, progress or (lambda done, total: None)))


def _drive(drive: Drive | str | Path) -> Drive:
    return drive if isinstance(drive, Drive) else read_drive(drive)


def _short_port() -> PortConfig:
    from v2hdm.simulate import PortConfig
    from v2hdm.simulate.port.config import RouteConfig, YardConfig

    port = PortConfig(name="port", seed=11, initial_ipm="estimated")
    return replace(
        port,
        cameras={"front": replace(port.cameras["front"], width=640, height=360, focal_px=450.0)},
        route=RouteConfig(pieces=[[20.0, 0.0], [16.0, 70.0], [10.0, 0.0]], image_spacing_m=2.0),
        yard=YardConfig(parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0, shadow_strips=1),
    )
