"""Writing a drive folder, as :mod:`v2hdm.io.drive.folder` reads it, and its truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.io.description import DRIVE_FILE, POSES_FILE
from v2hdm.io.drive.truth import LANE_VISIBLE, SIGHTINGS, TEXTS, TEXTS_FILE
from v2hdm.io.image_lists import write_image_list
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.records import Drive, Image, Trajectory, Truth
from v2hdm.store.files import dump_yaml, replace_text
from v2hdm.store.names import MAP


def write_drive(folder: Path, drive: Drive, trajectory: Trajectory) -> None:
    """Write all of a drive but its images, which lie in ``folder`` already, and its truth.

    ``drive.yaml`` comes last: a folder without it is not a drive yet. A reader interpolates the images' poses
    anew from ``trajectory``, the recorded ones at any rate. Image paths ``<camera>/...`` are written relative
    to their camera; ``drive.truth_dir``, if any, names a folder within ``folder`` for :func:`write_truth`.
    """
    entries: dict[str, Any] = {}
    for name, camera in drive.cameras.items():
        write_camera_info(camera.info, folder / name / "camera_info.yaml")
        mine = [image for image in drive.images if image.camera == name]
        names = [image.path.relative_to(folder / name).as_posix() for image in mine]
        write_image_list(np.array([image.stamp_s for image in mine]), names, folder / name / "images.txt")
        entry: dict[str, Any] = {
            "camera_info": f"{name}/camera_info.yaml",
            "images": f"{name}/images.txt",
            "linear_response": camera.linear_response,
            "initial_ipm": camera.initial_ipm,
            "ipm": {key: matrix.tolist() for key, matrix in camera.ipm.items()},
            "roi_vehicle": camera.roi_vehicle.tolist(),
        }
        if (prior := camera.centre_prior) is not None:
            surveyed = {"xyz": prior.centre_vehicle.tolist(), "sigma_m": prior.sigma_m.tolist()}
            entry["centre_prior"] = surveyed
        if camera.read_out_s:
            entry["read_out_s"] = camera.read_out_s
        if camera.frames.camera:
            entry["frame"] = camera.frames.camera
        entries[name] = entry
    write_tum(trajectory, folder / POSES_FILE)
    noise = asdict(drive.pose_noise)
    content: dict[str, Any] = {"name": drive.name, "poses": POSES_FILE, "pose_noise": noise}
    if drive.origin is not None:
        content["origin"] = asdict(drive.origin)
    if drive.truth_dir is not None:
        content["truth"] = drive.truth_dir.relative_to(folder).as_posix()
    if vehicle := next((camera.frames.vehicle for camera in drive.cameras.values()), ""):
        content["vehicle_frame"] = vehicle
    content["cameras"] = entries
    replace_text(folder / DRIVE_FILE, dump_yaml(content))


def write_truth(folder: Path, truth: Truth, images: Sequence[Image]) -> None:
    """Write ``truth``, whose rows belong to ``images``, into ``folder``."""
    write_geojson(truth.map, folder / MAP)
    cameras = {name: {"cam_from_vehicle": matrix.tolist()} for name, matrix in truth.cam_from_vehicle.items()}
    replace_text(folder / "cameras.yaml", dump_yaml(cameras))
    stamp_s, first = np.unique([image.stamp_s for image in images], return_index=True)
    write_tum(Trajectory(stamp_s, truth.map_from_vehicle[first]), folder / "poses.tum")
    visibility = truth.visibility
    if truth.symbol_visibility is not None:
        visibility = np.hstack([visibility, truth.symbol_visibility])
    sightings = (
        f"{images[i].camera},{images[i].stamp_s:.9f},{j},{visibility[i, j]:.4f}"
        for i, j in np.argwhere(visibility > 0)
    )
    replace_text(folder / "sightings.csv", "\n".join([",".join(SIGHTINGS), *sightings]) + "\n")
    lanes = enumerate(map(np.flatnonzero, truth.lane_visible))
    visible = (f"{lane},{vertex}" for lane, vertices in lanes for vertex in vertices)
    replace_text(folder / "lane_visible.csv", "\n".join([",".join(LANE_VISIBLE), *visible]) + "\n")
    if truth.texts:
        texts = [f"{symbol},{text}" for symbol, text in truth.texts.items()]
        replace_text(folder / TEXTS_FILE, "\n".join([",".join(TEXTS), *texts]) + "\n")
    disturbances = {key: float(value) for key, value in truth.disturbances.items()}
    replace_text(folder / "disturbances.yaml", dump_yaml(disturbances))
