"""A port's drive on disk: rendered once, in parallel, resumable, then read like any other drive.

Images are written one by one under their final names, each at once; `drive.yaml` is written last, so a
folder is a drive exactly when it is complete. A render that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import ground_in_vehicle
from v2hdm.io.drive import write_drive
from v2hdm.io.drive.folder import DRIVE_FILE, TRUTH_FOLDER
from v2hdm.io.drive.truth import write_truth
from v2hdm.io.drive.tum import read_image_list
from v2hdm.io.pixels import read_header
from v2hdm.records import Drive, Image, Truth
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import AlteredConfig, PortConfig
from v2hdm.simulate.port.disturbance import measured_disturbances, pose_noise
from v2hdm.simulate.port.visibility import points_seen, quad_samples
from v2hdm.simulate.render.renderer import RENDERER_VERSION
from v2hdm.store.files import whole_file
from v2hdm.store.folders import note_use
from v2hdm.workers import share_out

Progress = Callable[[int, int], None]
_Job = tuple[str, int, str]

_LANE_SIGHTINGS = 2
_worker_port: Port | None = None


def rendered_drive(config: PortConfig, cache: Path, workers: int, progress: Progress) -> Path:
    """The folder of a port's drive in a cache, rendered now unless it was rendered before.

    Args:
        config: The port.
        cache: Folder of all rendered drives; a drive's own folder is named by the port and a hash of its
            configuration and of the renderer's version.
        workers: Processes to render with; 1 renders in this one.
        progress: Called with the number of finished images and of all.

    Raises:
        ConfigError: when the configuration makes no port.
        DriveError: when the cache cannot be written.
        WorkerError: when a process died; what it had rendered is kept.
    """
    folder = folder_of_port(config, cache)
    if not (folder / DRIVE_FILE).is_file() or _drop_damaged(folder):
        render_drive(config, folder, workers, progress)
    note_use(folder)
    return folder


def folder_of_port(config: PortConfig, cache: Path) -> Path:
    """Where a port's drive belongs in a cache: named by the port and a hash of what it is rendered from."""
    content = asdict(config)
    # Ports that were rendered before there were visits, stencils and alterations stay the same.
    if not config.visit:
        del content["visit"]
    if not config.paint.stencils:
        del content["paint"]["stencils"]
    if config.altered == AlteredConfig():
        del content["altered"]
    text = json.dumps([RENDERER_VERSION, content], sort_keys=True)
    return cache / f"{config.name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def _drop_damaged(folder: Path) -> bool:
    """Remove images that are not whole from a rendered drive; whether any is missing."""
    missing = False
    for listing in folder.glob("*/images.txt"):
        for name in read_image_list(listing)[1]:
            path = listing.parent / name
            try:
                read_header(path)
            except DriveError:
                path.unlink(missing_ok=True)
                missing = True
    return missing


def render_drive(config: PortConfig, folder: Path, workers: int, progress: Progress) -> None:
    """Render a port's drive into ``folder`` with its truth; see :func:`rendered_drive`."""
    port = build_port(config)
    images = _images(port, folder)
    try:
        for name in port.cameras:
            (folder / name / "images").mkdir(parents=True, exist_ok=True)
        _render_all(port, images, workers, progress)
        drive = Drive(
            name=config.name,
            root=folder,
            cameras=port.cameras,
            images=images,
            pose_noise=pose_noise(config.disturbance, config.route.speed_mps),
            origin=port.hd_map.origin,
            truth_dir=folder / TRUTH_FOLDER,
        )
        write_truth(folder / TRUTH_FOLDER, _truth(port, images), images)
        write_drive(folder, drive, port.driven.recorded)
    except OSError as failure:
        raise DriveError(
            f"{folder}: cannot write the rendered drive ({failure.strerror}); "
            "free space or choose another cache"
        ) from None


def _images(port: Port, folder: Path) -> list[Image]:
    return [
        Image(
            name,
            float(stamp),
            folder / name / "images" / f"{frame:06d}.jpg",
            port.driven.map_from_vehicle[frame],
        )
        for frame, stamp in enumerate(port.driven.stamp_s)
        for name in port.cameras
    ]


def _render_all(port: Port, images: list[Image], workers: int, progress: Progress) -> None:
    jobs = [
        (image.camera, k // len(port.cameras), str(image.path))
        for k, image in enumerate(images)
        if not image.path.is_file()
    ]
    done = len(images) - len(jobs)
    progress(done, len(images))

    def count(_: object = None) -> None:
        nonlocal done
        done += 1
        progress(done, len(images))

    if workers <= 1 or len(jobs) < 2 * workers:
        for job in jobs:
            _write_picture(port, job)
            count()
    else:
        share_out(_work, jobs, workers, _start_worker, (port.config,), count)


def _start_worker(config: PortConfig) -> None:
    global _worker_port
    cv2.setNumThreads(1)
    _worker_port = build_port(config)


def _work(job: _Job) -> None:
    assert _worker_port is not None
    _write_picture(_worker_port, job)


def _write_picture(port: Port, job: _Job) -> None:
    camera, frame, target = job
    data = port.jpeg(port.picture(camera, frame).image)
    with whole_file(Path(target)) as partial:
        partial.write_bytes(data)


def _truth(port: Port, images: list[Image]) -> Truth:
    """Ground truth for the report: what each image shows of each marking, which lane vertices were passed.

    A lane vertex counts as seen when two images show it within their camera's region of interest.
    """
    corners = np.array([m.corners_map for m in port.hd_map.markings]).reshape(-1, 4, 2)
    samples = quad_samples(corners)
    per_marking = samples.shape[1]
    vertices = [lane.points_map for lane in port.hd_map.lanes]
    points = np.vstack([samples.reshape(-1, 2), *vertices])
    visibility = np.zeros((len(images), len(corners)))
    passed = np.zeros(len(points) - samples.size // 2, dtype=int)
    for i, image in enumerate(images):
        frame = i // len(port.cameras)
        camera = port.cameras[image.camera]
        boxes = port.renderer.scene.boxes + port.moving_boxes(frame)
        seen = points_seen(camera.info, port.cam_from_map(image.camera, frame), points, boxes)
        visibility[i] = seen[: samples.size // 2].reshape(-1, per_marking).mean(axis=1)
        on_lanes = seen[samples.size // 2 :]
        vertices_vehicle = ground_in_vehicle(image.map_from_vehicle, points[samples.size // 2 :][on_lanes])
        on_lanes[on_lanes] = inside_convex(camera.roi_vehicle, vertices_vehicle)
        passed += on_lanes
    flags = np.split(passed >= _LANE_SIGHTINGS, np.cumsum([len(v) for v in vertices])[:-1])
    return Truth(
        map=port.hd_map,
        cam_from_vehicle=port.cam_from_vehicle,
        map_from_vehicle=np.array([image.map_from_vehicle for image in images]),
        visibility=visibility,
        lane_visible=tuple(flags),
        disturbances=measured_disturbances(port.config.disturbance, port.driven),
    )
