"""A run's results as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.batch import read_image
from v2hdm.detection.camera.ground import ipm_from_extrinsic
from v2hdm.hdmap.calibration import write_calibration
from v2hdm.hdmap.geojson import write_geojson
from v2hdm.hdmap.heights import with_heights
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.evaluate import Judgement
from v2hdm.quality import Verdict
from v2hdm.records import Drive, Image, ImageDetections
from v2hdm.report.figures import save_birdseye, save_growth, save_overlay
from v2hdm.report.outputs import write_json

BEST = "Opt"
"""The method whose map and calibration are the run's result."""


def write_results(
    folder: Path,
    drive: Drive,
    detections: Sequence[ImageDetections],
    methods: Mapping[str, MethodResult],
    judgement: Judgement,
    metrics: Mapping[str, Any],
    verdict: Verdict,
) -> None:
    """Write map, calibrations, metrics and pictures of one camera set's ``methods`` into ``folder``."""
    best = methods[BEST]
    write_geojson(with_heights(best.hd_map, drive.road), folder / "map.geojson")
    for name, calibration in best.calibrations.items():
        write_calibration(calibration, folder / f"calibration_{name}.yaml")
    write_json(folder / "metrics.json", metrics)
    maps = {name: result.hd_map for name, result in methods.items()}
    route_map = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    save_birdseye(folder / "birdseye.png", maps, BEST, route_map, judgement.truth)
    if judgement.growth:
        save_growth(folder / "growth.png", judgement.growth)
    for name in best.calibrations:
        image = _fullest_image(drive, name, detections)
        _save_overlay(folder / f"overlay_{name}.png", drive, image, best)


def _save_overlay(path: Path, drive: Drive, image: Image, best: MethodResult) -> None:
    """The map in an image, through the initial and the optimised IPM."""
    camera = drive.cameras[image.camera]
    calibration = best.calibrations[image.camera]
    optimised = ipm_from_extrinsic(camera.info, calibration.cam_from_vehicle)
    initial = {"calibrated": "CNI", "estimated": "ENI"}.get(camera.initial_ipm, camera.initial_ipm)
    save_overlay(
        path,
        read_image(image, camera),
        camera.info,
        image.map_from_vehicle,
        best.hd_map,
        {initial: camera.ipm[camera.initial_ipm], BEST: optimised},
    )


def _fullest_image(drive: Drive, name: str, detections: Sequence[ImageDetections]) -> Image:
    """The image of a camera in which most corners were found; its first one where there are none."""
    images = [index for index, image in enumerate(drive.images) if image.camera == name]
    corners = dict.fromkeys(images, 0)
    for found in detections:
        if found.image in corners:
            corners[found.image] = sum(int(marking.corner_valid.sum()) for marking in found.markings)
    return drive.images[max(images, key=corners.__getitem__)]
