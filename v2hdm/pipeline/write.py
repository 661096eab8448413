"""A run's results as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.batch import read_image
from v2hdm.detection.camera.ground import ipm_from_extrinsic
from v2hdm.hdmap.calibration import write_calibration
from v2hdm.hdmap.geojson import write_geojson
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.evaluate import Judgement
from v2hdm.planar import ground_in_vehicle
from v2hdm.records import Drive, Image
from v2hdm.report.figures import save_birdseye, save_growth, save_overlay
from v2hdm.report.outputs import write_json

BEST = "Opt"
"""The method whose map and calibration are the run's result."""


def write_results(
    folder: Path,
    drive: Drive,
    methods: Mapping[str, MethodResult],
    judgement: Judgement,
    metrics: Mapping[str, Any],
) -> None:
    """Write map, calibrations, metrics and pictures of one camera set's ``methods`` into ``folder``."""
    best = methods[BEST]
    write_geojson(best.hd_map, folder / "map.geojson")
    for name, calibration in best.calibrations.items():
        write_calibration(calibration, folder / f"calibration_{name}.yaml")
    write_json(folder / "metrics.json", metrics)
    maps = {name: result.hd_map for name, result in methods.items()}
    route_map = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    save_birdseye(folder / "birdseye.png", maps, BEST, route_map, judgement.truth)
    if judgement.growth:
        save_growth(folder / "growth.png", judgement.growth)
    for name in best.calibrations:
        _save_overlay(folder / f"overlay_{name}.png", drive, name, best)


def _save_overlay(path: Path, drive: Drive, name: str, best: MethodResult) -> None:
    """The map in the image that shows most of it, through the initial and the optimised IPM."""
    camera = drive.cameras[name]
    calibration = best.calibrations[name]
    optimised = ipm_from_extrinsic(camera.info, calibration.cam_from_vehicle)
    initial = {"calibrated": "CNI", "estimated": "ENI"}.get(camera.initial_ipm, camera.initial_ipm)
    image = _fullest_image(drive, name, best)
    save_overlay(
        path,
        read_image(image, camera),
        camera.info,
        image.map_from_vehicle,
        best.hd_map,
        {initial: camera.ipm[camera.initial_ipm], BEST: optimised},
    )


def _fullest_image(drive: Drive, name: str, best: MethodResult) -> Image:
    """The image of a camera with most mapped marking centres inside its region of interest."""
    images = [image for image in drive.images if image.camera == name]
    centres = np.array([marking.corners_map.mean(axis=0) for marking in best.hd_map.markings]).reshape(-1, 2)
    low, high = (f(drive.cameras[name].roi_vehicle, axis=0) for f in (np.min, np.max))

    def shown(image: Image) -> int:
        points_vehicle = ground_in_vehicle(image.map_from_vehicle, centres)
        return int(((points_vehicle > low) & (points_vehicle < high)).all(axis=1).sum())

    return max(images, key=shown)
