"""Simulated drives on disk: those of a survey, as detections, or a port's one, as pictures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from v2hdm.errors import ConfigError, DriveError
from v2hdm.executor import Executor
from v2hdm.io.description import DRIVE_FILE, TRUTH_FOLDER
from v2hdm.io.detections import write_detections
from v2hdm.io.drive.writing import write_drive, write_truth
from v2hdm.progress import Steps
from v2hdm.records import Drive, Image, ImageDetections, Truth
from v2hdm.simulate.port.build import ORIGIN, cam_from_vehicle, surveyed_cameras
from v2hdm.simulate.port.config import PortConfig, ReliefConfig
from v2hdm.simulate.port.drive import folder_of_port, rendered_drive
from v2hdm.simulate.port.route import DrivenPoses, drive_along, measured_disturbances, pose_noise
from v2hdm.simulate.survey.network import Network, build_network
from v2hdm.simulate.survey.sightings import Paint, detect
from v2hdm.store.folders import note_use

_log = logging.getLogger(__name__)

# Streams of a seed; a network's paint is 7, a port's own are 0 to 6.
_POSES, _IMAGES, _ALIKE = 8, 9, 10

_MOST_SIGHTINGS = 20_000_000
"""Images times markings up to which a drive names its truth: the comparison takes 8 bytes for each."""


def simulated_drives(
    config: PortConfig, cache: Path, executor: Executor, progress: Steps
) -> tuple[Path, ...]:
    """The folders of all drives of a configuration in a ``cache``, made now unless they were before.

    Raises as :func:`v2hdm.simulate.port.drive.rendered_drive`.
    """
    if not config.survey.length_km:
        return (rendered_drive(config, cache, executor, progress),)
    check_survey(config)
    folders = folders_of(config, cache)
    missing = [number for number, folder in enumerate(folders) if not (folder / DRIVE_FILE).is_file()]
    if missing:
        network = build_network(config, ORIGIN)
        driven = {number: _driven(config, network, number) for number in missing}
        total = len(config.cameras) * sum(len(poses.stamp_s) for poses in driven.values())
        done = count(1)
        progress(0, total)
        for number in missing:
            _write(
                config, network, number, driven[number], folders[number], lambda: progress(next(done), total)
            )
    for folder in folders:
        note_use(folder)
    return folders


def write_simulated(config: PortConfig, network: Network, folder: Path, progress: Steps) -> None:
    """Write the first drive through a network into a folder; DriveError when that cannot be written."""
    driven = _driven(config, network, 0)
    total = len(config.cameras) * len(driven.stamp_s)
    done = count(1)
    _write(config, network, 0, driven, folder, lambda: progress(next(done), total))


def folders_of(config: PortConfig, cache: Path) -> tuple[Path, ...]:
    """The folders of all drives of a configuration in a cache, there or not."""
    if not config.survey.length_km:
        return (folder_of_port(config, cache),)
    return tuple(
        folder_of_port(replace(config, session=config.session + number), cache)
        for number in range(config.survey.drives)
    )


def check_survey(config: PortConfig) -> None:
    """Raise ConfigError for a survey of ground that is no plane: it has no pictures that would show it."""
    if config.relief != ReliefConfig():
        raise ConfigError(
            "simulate.relief and simulate.survey.length_km are both set: a survey is of level ground; "
            "leave one of them out"
        )


def _driven(config: PortConfig, network: Network, number: int) -> DrivenPoses:
    rng = np.random.default_rng([config.seed, _POSES, config.session + number])
    return drive_along(network.way(number), config.route, config.disturbance, rng)


def _write(
    config: PortConfig, network: Network, number: int, driven: DrivenPoses, folder: Path, report: object
) -> None:
    """Write one drive; ``drive.yaml`` comes last."""
    assert callable(report)
    cameras = surveyed_cameras(config)
    true = {name: cam_from_vehicle(config.cameras[name].mount) for name in cameras}
    alike_rng = np.random.default_rng([config.seed, _ALIKE])
    paint = Paint.of(network.hd_map, config.survey.correlation, alike_rng)
    images: list[Image] = []
    whole: list[np.ndarray] = []
    try:
        for name in cameras:
            (folder / name / "detections").mkdir(parents=True, exist_ok=True)
        for frame, (stamp_s, pose) in enumerate(zip(driven.stamp_s, driven.map_from_vehicle, strict=True)):
            for place, name in enumerate(cameras):
                path = folder / name / "detections" / f"{frame:06d}.json"
                rng = np.random.default_rng([config.seed, _IMAGES, config.session + number, place, frame])
                shown = detect(paint, cameras[name].info, true[name] @ np.linalg.inv(pose), rng)
                write_detections(path, ImageDetections(len(images), shown.markings, ()))
                images.append(Image(name, float(stamp_s), path, pose))
                whole.append(shown.whole)
                report()
        truth_dir = _write_truth(config, network, driven, folder, images, whole)
        noise = pose_noise(config.disturbance, config.route.speed_mps)
        name = f"{config.name}-{config.session + number}"
        drive = Drive(name, folder, cameras, images, noise, network.hd_map.origin, truth_dir)
        write_drive(folder, drive, driven.recorded)
    except OSError as failure:
        problem = f"cannot write the simulated drive ({failure.strerror})"
        raise DriveError(f"{folder}: {problem}; free space or choose another cache") from None


def _write_truth(
    config: PortConfig,
    network: Network,
    driven: DrivenPoses,
    folder: Path,
    images: Sequence[Image],
    whole: Sequence[np.ndarray],
) -> Path | None:
    """Write the truth of a drive; returns its folder, None if it is too large to be compared with."""
    markings = len(network.hd_map.markings)
    is_compared = len(images) * markings <= _MOST_SIGHTINGS
    visibility = np.zeros((len(images), markings) if is_compared else (len(images), 0))
    for row, visible in enumerate(whole if is_compared else ()):
        visibility[row, visible] = 1.0
    true = {name: cam_from_vehicle(camera.mount) for name, camera in config.cameras.items()}
    truth = Truth(
        map=network.hd_map,
        cam_from_vehicle=true,
        map_from_vehicle=np.array([image.map_from_vehicle for image in images]),
        visibility=visibility,
        lane_visible=tuple(np.zeros(len(lane.points_map), dtype=bool) for lane in network.hd_map.lanes),
        disturbances=measured_disturbances(config.disturbance, driven),
    )
    truth_dir = folder / TRUTH_FOLDER
    truth_dir.mkdir(exist_ok=True)
    write_truth(truth_dir, truth, images)
    if is_compared:
        return truth_dir
    _log.warning(
        "%s: %d images of %d markings are too many for the report's comparison: drive.yaml does not name %s",
        folder, len(images), markings, truth_dir,
    )  # fmt: skip
    return None
