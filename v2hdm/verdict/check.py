"""The pictures of a drive's check, which show a person the rest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from v2hdm.detection.frames import read_bgr
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.ground.motion import trajectory_of_images
from v2hdm.ground.results import GroundEstimate
from v2hdm.records import Drive
from v2hdm.report.figures import save_route
from v2hdm.report.photos import save_grid

_PICTURES = 3  # sample images of each camera: near the start, in the middle and near the end


def draw_check(drive: Drive, folder: Path, ground: Mapping[str, GroundEstimate]) -> None:
    """Draw the route, and the metric grid of guess and ground estimate in sample images of every camera."""
    save_route(folder / "route.png", drive.recorded or drive.trajectory or trajectory_of_images(drive))
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        mountings = {"guess": extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])}
        calibration = ground[name].calibration if name in ground else None
        if calibration is not None:
            mountings["ground"] = calibration.cam_from_vehicle
        for number in range(_PICTURES):
            image = images[(2 * number + 1) * len(images) // (2 * _PICTURES)]
            caption = f"{name}, {image.stamp_s:.2f} s"
            path = folder / f"{name}_{number + 1}.jpg"
            save_grid(path, read_bgr(image.path), camera, mountings, caption)
