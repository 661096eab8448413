"""A port's drive on disk: rendered once, in parallel, resumable, then read like any other drive.

Images are written one by one under their final names, each at once; `drive.yaml` is written last, so a
folder is a drive exactly when it is complete. A render that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.compiled import exact_kernel, exactly_inlined
from v2hdm.errors import DriveError
from v2hdm.executor import Executor
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import camera_centre, ground_in_vehicle
from v2hdm.io.description import DRIVE_FILE, TRUTH_FOLDER
from v2hdm.io.drive.writing import write_drive, write_truth
from v2hdm.io.image_lists import read_image_list
from v2hdm.progress import Steps
from v2hdm.records import BoolArray, CameraInfo, Drive, FloatArray, Image, Truth
from v2hdm.safe.pixels import read_header
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import PortConfig, ReliefConfig, SignsConfig
from v2hdm.simulate.port.route import measured_disturbances, pose_noise
from v2hdm.simulate.render.relief import Relief
from v2hdm.simulate.render.renderer import RENDERER_VERSION
from v2hdm.simulate.render.scene import Box
from v2hdm.store.files import refuse_url, whole_file
from v2hdm.store.folders import note_use

# By the truth, an image shows ground points as far from its camera as this, and of this depth or more.
_FARTHEST_M = 40.0
_NEAR_M = 0.3  # least depth


def points_seen(
    info: CameraInfo,
    cam_from_map: FloatArray,
    points_map: FloatArray,
    boxes: FloatArray,
    relief: Relief | None = None,
) -> BoolArray:
    """Flags (N,) of ground points (N, 2) that an image shows: inside its border, within 40 m, not hidden.

    ``boxes`` are those of :func:`placed_boxes`.
    """
    centre = camera_centre(cam_from_map)
    offset_map = points_map - centre[:2]
    visible = np.hypot(offset_map[:, 0], offset_map[:, 1]) < _FARTHEST_M
    visible[visible] = inside_image(info, cam_from_map, points_map[visible], relief)
    occluders = boxes[_may_hide(boxes, cam_from_map)]
    if visible.any() and (len(occluders) or relief is not None):
        points = _on_ground(points_map[visible], relief)
        hidden = _crossing(occluders, centre, points)
        visible[visible] = ~(hidden if relief is None else hidden | relief.hides(centre, points))
    return np.asarray(visible)


def placed_boxes(boxes: Sequence[Box]) -> FloatArray:
    """Boxes as rows (B, 11): their centre's x and y, yaw's cosine and sine, size, base, plane beneath; m."""
    placed = [
        (*box.centre_map, np.cos(box.yaw_rad), np.sin(box.yaw_rad), *box.size_m, box.base_m, *box.beneath)
        for box in boxes
    ]
    return np.array(placed).reshape(-1, 11)


def _may_hide(boxes: FloatArray, cam_from_map: FloatArray) -> BoolArray:
    """Flags (B,) of boxes before the camera, near enough, and not above all its sight lines to the ground."""
    x_m, y_m, _, _, length_m, width_m, _, base_m, beneath_m, slope_x, slope_y = boxes.T
    centre = camera_centre(cam_from_map)
    reach_m = np.hypot(length_m, width_m) / 2
    depth_m = np.column_stack([x_m, y_m, beneath_m]) @ cam_from_map[2, :3] + cam_from_map[2, 3]
    ground_m = beneath_m + (centre[0] - x_m) * slope_x + (centre[1] - y_m) * slope_y
    is_below = base_m < centre[2] - ground_m
    return np.asarray(is_below & (-reach_m < depth_m) & (depth_m < _FARTHEST_M + reach_m))


def _on_ground(points_map: FloatArray, relief: Relief | None) -> FloatArray:
    """Points (N, 2) with their heights, (N, 3)."""
    heights = np.zeros(len(points_map)) if relief is None else relief.height_m(points_map)
    return np.column_stack([points_map, heights])


def inside_image(
    info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray, relief: Relief | None = None
) -> BoolArray:
    """Flags (N,) of the ground points (N, 2) within the image's borders."""
    points_cam = _on_ground(points_map, relief) @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    inside = points_cam[:, 2] > _NEAR_M
    with np.errstate(divide="ignore", invalid="ignore"):
        pinhole = (points_cam @ info.intrinsic.T)[:, :2] / points_cam[:, 2:]
    # Far outside the image the lens polynomial folds back; only near it are its values meaningful.
    margin = np.array([info.width, info.height]) * 0.25
    inside &= ((pinhole > -margin) & (pinhole < 5.0 * margin)).all(axis=1)
    recorded = distort_points(info, pinhole[inside])
    inside[inside] = ((recorded >= 0) & (recorded <= (info.width - 1, info.height - 1))).all(axis=1)
    return np.asarray(inside)


def hidden_by(boxes: Sequence[Box], centre_map: FloatArray, points_map: FloatArray) -> BoolArray:
    """Flags (N,) of lines from ``centre_map`` (3,) to points (N, 2 or 3) through a box (Kay, Kajiya 1986)."""
    points = points_map if points_map.shape[1] == 3 else _on_ground(points_map, None)
    return _crossing(placed_boxes(boxes), centre_map, points)


def _crossing(boxes: FloatArray, centre_map: FloatArray, points_map: FloatArray) -> BoolArray:
    """Flags (N,) of lines from a centre (3,) to points (N, 3) through one of boxes (B, 11)."""
    hidden = np.zeros(len(points_map), dtype=np.bool_)
    lines = (np.asarray(centre_map), np.ascontiguousarray(points_map, dtype=np.float64))
    _cross_boxes(boxes, *lines, hidden)
    return hidden


@exactly_inlined
def _in_box(box: FloatArray, x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    """A point in a box's frame: along and across it from its middle, and above its lower side."""
    east = x_m - box[0]
    north = y_m - box[1]
    above_m = z_m - (box[8] + (east * box[9] + north * box[10])) - box[7]
    return east * box[2] + north * box[3], north * box[2] - east * box[3], above_m


@exactly_inlined
def _between(low: float, high: float, start: float, end: float) -> tuple[float, float]:
    """The shares of the way at which a line enters and leaves the space between two planes."""
    step = end - start
    if step == 0:
        return (-np.inf, np.inf) if low < start < high else (np.inf, -np.inf)
    first = (low - start) / step
    second = (high - start) / step
    return min(first, second), max(first, second)


@exact_kernel
def _cross_boxes(
    boxes: FloatArray, centre_map: FloatArray, points_map: FloatArray, hidden: BoolArray
) -> None:
    """Mark in ``hidden`` (N,) the lines from a centre (3,) to points (N, 3) through one of boxes (B, 11)."""
    for b in range(len(boxes)):
        box = boxes[b]
        half_length = box[4] / 2
        half_width = box[5] / 2
        eye = _in_box(box, centre_map[0], centre_map[1], centre_map[2])
        for n in range(len(points_map)):
            if hidden[n]:
                continue
            x, y, z = _in_box(box, points_map[n, 0], points_map[n, 1], points_map[n, 2])
            enter_x, leave_x = _between(-half_length, half_length, eye[0], x)
            enter_y, leave_y = _between(-half_width, half_width, eye[1], y)
            enter_z, leave_z = _between(0.0, box[6], eye[2], z)
            enter = max(enter_x, enter_y, enter_z)
            leave = min(leave_x, leave_y, leave_z)
            hidden[n] = enter < min(leave, 1.0) and leave > 0


class TrueDrive(NamedTuple):
    """A drive and its truth, whose rows belong to the drive's images."""

    drive: Drive
    truth: Truth


_Job = tuple[str, int, str]  # camera, frame and path of an image

_IMAGES_TOGETHER = 8  # most images that a process renders before it reports; chosen
_LANE_SIGHTINGS = 2  # least number of images that show a lane vertex which counts as seen
_worker_port: Port | None = None


def rendered_drive(config: PortConfig, cache: Path, executor: Executor, progress: Steps) -> Path:
    """The folder of a port's drive in a ``cache`` of such, rendered now unless it was rendered before.

    ``progress`` is called with the number of finished images and of all. Raises ConfigError when the
    configuration makes no port, DriveError when the cache cannot be written, WorkerError when a process died;
    what it had rendered is kept.
    """
    folder = folder_of_port(config, cache)
    if not (folder / DRIVE_FILE).is_file() or _lacks_clocks(folder) or _drop_damaged(folder):
        # Images that are there stay as they are.
        render_drive(config, folder, executor, progress)
    note_use(folder)
    return folder


def folder_of_port(config: PortConfig, cache: Path) -> Path:
    """The folder of a port's drive in a cache, named by the port and a hash of its configuration."""
    refuse_url(cache)
    content = asdict(config)
    # What was made before there were sessions, stencils, reliefs and correlations stays the same.
    if not config.session:
        del content["session"]
    if config.relief == ReliefConfig():
        del content["relief"]
    if not config.paint.stencils:
        del content["paint"]["stencils"]
    if config.paint.signs == SignsConfig():
        del content["paint"]["signs"]
    if not config.survey.length_km:
        del content["survey"]
    elif not config.survey.correlation:
        del content["survey"]["correlation"]
    text = json.dumps([RENDERER_VERSION, content], sort_keys=True)
    return cache / f"{config.name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def _lacks_clocks(folder: Path) -> bool:
    """Whether a drive was rendered by a version that did not state its clocks."""
    return "clock_s" not in (folder / DRIVE_FILE).read_text(encoding="utf-8")


def _drop_damaged(folder: Path) -> bool:
    """Remove damaged images from a rendered drive; returns whether any is missing."""
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


def render_drive(config: PortConfig, folder: Path, executor: Executor, progress: Steps) -> None:
    """Render a port's drive into ``folder`` with its truth; see :func:`rendered_drive`."""
    port = build_port(config)
    images = _images_of(port, folder)
    try:
        for name in port.cameras:
            (folder / name / "images").mkdir(parents=True, exist_ok=True)
        _render_all(port, images, executor, progress)
        noise = pose_noise(config.disturbance, config.route.speed_mps)
        truth_dir = folder / TRUTH_FOLDER
        drive = Drive(config.name, folder, port.cameras, images, noise, port.hd_map.origin, truth_dir)
        write_truth(truth_dir, _truth(port, images), images)
        write_drive(folder, drive, port.driven.recorded)
    except OSError as failure:
        problem = f"cannot write the rendered drive ({failure.strerror})"
        raise DriveError(f"{folder}: {problem}; free space or choose another cache") from None


def true_drive(config: PortConfig) -> TrueDrive:
    """A port's drive with its truth, of which nothing is rendered or written."""
    port = build_port(config)
    folder = Path(config.name)
    images = _images_of(port, folder)
    noise = pose_noise(config.disturbance, config.route.speed_mps)
    drive = Drive(config.name, folder, port.cameras, images, noise, port.hd_map.origin)
    return TrueDrive(drive, _truth(port, images))


def _images_of(port: Port, folder: Path) -> list[Image]:
    """All images of a port's drive below a folder, rendered or not."""
    driven = zip(port.driven.stamp_s, port.driven.map_from_vehicle, strict=True)
    return [
        Image(name, float(stamp), folder / name / "images" / f"{frame:06d}.jpg", pose)
        for frame, (stamp, pose) in enumerate(driven)
        for name in port.cameras
    ]


def _render_all(port: Port, images: list[Image], executor: Executor, progress: Steps) -> None:
    jobs = [
        (image.camera, k // len(port.cameras), str(image.path))
        for k, image in enumerate(images)
        if not image.path.is_file()
    ]
    done = count(len(images) - len(jobs))

    def report(_: object = None) -> None:
        progress(next(done), len(images))

    report()
    if executor.workers <= 1 or len(jobs) < 2 * executor.workers:
        for job in jobs:
            _write_picture(job, port)
            report()
    else:
        executor.share_out(
            _write_picture, jobs, _start_worker, (port.config,), report, together=_IMAGES_TOGETHER
        )


def _start_worker(config: PortConfig) -> None:
    global _worker_port
    cv2.setNumThreads(1)
    _worker_port = build_port(config)


def _write_picture(job: _Job, local_port: Port | None = None) -> None:
    port = local_port or _worker_port
    (camera, frame, target) = job
    assert port is not None
    data = port.jpeg(port.picture(camera, frame).image)
    with whole_file(Path(target)) as partial:
        partial.write_bytes(data)


def _truth(port: Port, images: list[Image]) -> Truth:
    """Ground truth for the report: what images show of markings and symbols, which lane vertices were passed.

    A lane vertex counts as seen when two images show it within their camera's region of interest.
    """
    outlines = [marking.corners_map for marking in port.hd_map.markings]
    outlines += [symbol.outline_map for symbol in port.hd_map.symbols]
    corners = np.array(outlines).reshape(-1, 4, 2)
    # A grid of points (J, 25, 2), each standing for an equal share of its quadrilateral.
    steps = (np.arange(5) + 0.5) / 5
    s, t = (axis.ravel()[None, :, None] for axis in np.meshgrid(steps, steps))
    a, b, c, d = (corners[:, k, None, :] for k in range(4))
    samples = (1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d
    per_marking = samples.shape[1]
    vertices = [lane.points_map for lane in port.hd_map.lanes]
    points = np.vstack([samples.reshape(-1, 2), *vertices])
    visibility = np.zeros((len(images), len(corners)))
    scene = port.renderer.scene
    relief = scene.relief
    passed = np.zeros(len(points) - samples.size // 2, dtype=int)
    at_rest = placed_boxes(scene.boxes)
    for i, image in enumerate(images):
        frame, first = divmod(i, len(port.cameras))
        camera = port.cameras[image.camera]
        if not first:
            boxes = np.concatenate([at_rest, placed_boxes(port.moving_boxes(frame))])
        visible = points_seen(camera.info, port.cam_from_map(image.camera, frame), points, boxes, relief)
        visibility[i] = visible[: samples.size // 2].reshape(-1, per_marking).mean(axis=1)
        on_lanes = visible[samples.size // 2 :]
        on_lane = _on_ground(points[samples.size // 2 :][on_lanes], relief)
        vertices_vehicle = ground_in_vehicle(image.map_from_vehicle, on_lane)
        on_lanes[on_lanes] = inside_convex(camera.roi_vehicle, vertices_vehicle)
        passed += on_lanes
    markings = len(port.hd_map.markings)
    flags = np.split(passed >= _LANE_SIGHTINGS, np.cumsum([len(v) for v in vertices])[:-1])
    return Truth(
        map=port.hd_map,
        cam_from_vehicle=port.cam_from_vehicle,
        map_from_vehicle=np.array([image.map_from_vehicle for image in images]),
        visibility=visibility[:, :markings],
        symbol_visibility=visibility[:, markings:],
        texts=port.texts,
        lane_visible=tuple(flags),
        disturbances=measured_disturbances(port.config.disturbance, port.driven),
    )
