"""The project's own drive folder (docs/drive-format.md): TUM poses, ROS camera_info, image lists."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.frames import frame_from_vehicle
from v2hdm.geometry.rigid import make_transform
from v2hdm.io.calibration import reading
from v2hdm.io.calibration.reading import Intrinsics
from v2hdm.io.description import DRIVE_FILE, POSES_FILE, CameraEntry, DriveDescription, keys_in, name_of
from v2hdm.io.drive.frames import plan_frames
from v2hdm.io.drive.images import ImageFiles, ReadOptions, assemble_drive, select_cameras
from v2hdm.io.drive.sources import Sources, plan_images, plan_info, plan_topic_poses
from v2hdm.io.importers.poses import Recorded, read_poses
from v2hdm.records import (
    DRIFTS,
    BoolArray,
    Camera,
    CameraFrames,
    CameraInfo,
    Drive,
    FloatArray,
    PoseNoise,
    Reception,
    Trajectory,
    unstated_clock_drift_s,
)
from v2hdm.safe.fields import take_origin
from v2hdm.safe.pixels import read_pixels
from v2hdm.safe.texts import shown, take_camera_name
from v2hdm.store.files import check_keys, load_yaml, take_mapping, take_number, take_text


def read_folder_drive(path: Path, options: ReadOptions) -> Drive:
    """Read the drive at ``path``; see :func:`v2hdm.io.drive.read_drive`."""
    where = path / DRIVE_FILE
    return read_description(load_yaml(where, DriveError), path, str(where), options)


def read_description(content: dict[str, Any], path: Path, where: str, options: ReadOptions) -> Drive:
    """Read the drive that the ``content`` of a ``drive.yaml`` describes, with files relative to ``path``."""
    drive_keys = keys_in(DriveDescription)
    check_keys(content, drive_keys.required, drive_keys.optional, where, DriveError)
    cameras_at = f"{where}: cameras"
    entries = take_mapping(content["cameras"], cameras_at, DriveError)
    entries = {take_camera_name(name, cameras_at, DriveError): entry for name, entry in entries.items()}
    if not entries:
        raise DriveError(f"{where}: has no camera; add one under 'cameras'")
    bag = None
    if "bag" in content:
        bag = path / take_text(content["bag"], f"{where}: bag", DriveError)
        if not bag.exists():
            raise DriveError(f"{where}: bag: {bag}: no such bag; check the path or drop the key")
    sources = Sources(path, Path(options.cache), bag, options.max_gap_s)
    planned = {
        name: _plan_camera(name, entries[name], sources, f"{where}: camera '{name}'")
        for name in select_cameras(list(entries), options.cameras, Path(where))
    }
    poses_at = f"{where}: poses"
    poses = content.get("poses", POSES_FILE)
    if not isinstance(poses, dict):
        poses = take_text(poses, poses_at, DriveError)
    read_topic = plan_topic_poses(poses, sources, poses_at)
    origin = take_origin(content.get("origin"), f"{where}: origin", DriveError)
    entries = {name: plan.entry for name, plan in planned.items()}
    read_frames = plan_frames(content, entries, sources, where)

    cameras: dict[str, Camera] = {}
    files: list[ImageFiles] = []
    frames = read_frames()
    for name, plan in planned.items():
        # Many tools call every camera they calibrate alike: the drive's own name for it holds.
        intrinsics = plan.read_info()
        named = replace(intrinsics.info, name=name)
        listed = plan.list_images()
        place = f"{where}: camera '{name}'"
        read_out_s = _take_read_out(plan.entry, listed.stamp_s, f"{place}, read_out_s")
        turned = replace(frames[name], rectified_from_camera=intrinsics.rectified_from_camera)
        camera = _read_camera(plan.entry, named, path, place, turned)
        cameras[name] = replace(camera, read_out_s=read_out_s)
        files.append(listed)
    near_s = _middle_of(files)
    recorded = read_poses(poses, path, origin, options.max_gap_s, poses_at, read_topic, near_s)
    pose_noise = _read_pose_noise(content.get("pose_noise"), recorded.noise, files, f"{where}: pose_noise")
    truth = None
    if content.get("truth") is not None:
        truth = path / take_text(content["truth"], f"{where}: truth", DriveError)
        if not truth.is_dir():
            raise DriveError(f"{where}: truth: no such folder {truth}; restore it or drop the key")
    name = name_of(content, path)
    on_ground = _on_ground(recorded.trajectory, next(iter(frames.values())).height_m)
    drive = Drive(
        name, path, cameras, (), pose_noise, recorded.origin, truth, recorded=on_ground,
        reception=_reception(recorded, files), headed_by_course=recorded.headed_by_course,
    )  # fmt: skip
    return assemble_drive(drive, files, options.max_gap_s, poses_at)


class _PlannedCamera(NamedTuple):
    """A camera's ``entry`` of the description, and how its intrinsics and images are read."""

    entry: dict[str, Any]
    read_info: Callable[[], Intrinsics]
    list_images: Callable[[], ImageFiles]


def _plan_camera(name: str, content: object, sources: Sources, where: str) -> _PlannedCamera:
    """Check a camera's entry; its files and topics are read once all sources are planned."""
    keys = keys_in(CameraEntry)
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, keys.required, keys.optional, where, DriveError)
    read_info = plan_info(entry["camera_info"], name, entry["images"], sources, f"{where}, camera_info")
    list_images = plan_images(entry["images"], name, sources, f"{where}, images")
    return _PlannedCamera(entry, read_info, list_images)


def _reception(recorded: Recorded, files: Sequence[ImageFiles]) -> Reception | None:
    """The stated quality of the positions from the first image to the last."""
    listed = [entry.stamp_s for entry in files if len(entry.stamp_s)]
    if recorded.fixes is None or not listed:
        return None
    first_s = min(float(stamp_s[0]) for stamp_s in listed)
    last_s = max(float(stamp_s[-1]) for stamp_s in listed)
    return recorded.fixes.between(first_s, last_s, recorded.geoid_m)


def _on_ground(poses: Trajectory, height_m: float) -> Trajectory:
    """The poses of the vehicle's origin on the ground, ``height_m`` below the frame that they are of."""
    return Trajectory(poses.stamp_s, poses.map_from_vehicle @ frame_from_vehicle(height_m))


def _middle_of(files: Sequence[ImageFiles]) -> float | None:
    """The time in the middle of a drive's images; None where there are none, or none is finite."""
    stamps = np.concatenate([entry.stamp_s for entry in files])
    middle_s = float(np.median(stamps)) if len(stamps) else np.nan
    return middle_s if np.isfinite(middle_s) else None


def _read_camera(
    entry: dict[str, Any], info: CameraInfo, root: Path, where: str, frames: CameraFrames
) -> Camera:
    frame_from_ground = frame_from_vehicle(frames.height_m)
    guesses = [key for key in ("mounting", "cam_from_vehicle", "ipm") if key in entry]
    if len(guesses) != 1:
        raise DriveError(f"{where}: give one of 'mounting', 'cam_from_vehicle' and 'ipm'; got {len(guesses)}")
    if "ipm" in entry:
        matrices = take_mapping(entry["ipm"], f"{where}, ipm", DriveError)
        check_keys(matrices, (), reading.IPM_NAMES, f"{where}, ipm", DriveError)
        ipm = {name: reading.take_ipm(matrix, f"{where}, ipm, {name}") for name, matrix in matrices.items()}
        if not ipm:
            raise DriveError(f"{where}, ipm: no matrix; give one of: {', '.join(reading.IPM_NAMES)}")
    else:
        (key,) = guesses
        guess = entry[guesses[0]]
        take = reading.take_mounting if key == "mounting" else reading.take_rigid
        guess = take(guess, f"{where}, {key}") @ frame_from_ground
        if frames.rectified_from_camera is not None:
            guess = make_transform(frames.rectified_from_camera, np.zeros(3)) @ guess
        ipm = {"estimated": reading.ipm_from_guess(info, guess, f"{where}, {key}", frames.vehicle)}
    linear = entry.get("linear_response", False)
    if not isinstance(linear, bool):
        raise DriveError(f"{where}, linear_response: expected true or false, got {shown(linear)}")
    prior = None
    if entry.get("centre_prior") is not None:
        prior = reading.take_centre_prior(entry["centre_prior"], f"{where}, centre_prior")
        prior = replace(prior, centre_vehicle=prior.centre_vehicle - frame_from_ground[:3, 3])
    initial_ipm = reading.choose_initial(entry.get("initial_ipm"), ipm, where)
    if "roi_vehicle" in entry:
        roi_vehicle = reading.take_roi(entry["roi_vehicle"], f"{where}, roi_vehicle")
        reading.check_roi_in_view(info, ipm[initial_ipm], roi_vehicle, f"{where}, roi_vehicle")
    else:
        roi_vehicle = reading.roi_where_it_looks(info, ipm[initial_ipm], f"{where}, {guesses[0]}")
    return Camera(
        info=info,
        ipm=ipm,
        initial_ipm=initial_ipm,
        roi_vehicle=roi_vehicle,
        centre_prior=prior,
        linear_response=linear,
        own_vehicle=_read_mask(entry, root, info, where),
        frames=replace(frames, states_height="ipm" not in entry),
    )


def _take_read_out(entry: Mapping[str, Any], stamp_s: FloatArray, where: str) -> float:
    """The time from an image's first row to its last, over before the next image begins; 0 without."""
    read_out_s = take_number(entry.get("read_out_s", 0.0), where, DriveError)
    period_s = float(np.median(np.diff(stamp_s))) if len(stamp_s) > 1 else np.inf
    if not 0 <= read_out_s <= period_s:
        most = "" if np.isinf(period_s) else f" to {period_s:g}, the time from image to image"
        raise DriveError(f"{where}: {read_out_s:g} s is not a read-out time; give seconds, from 0{most}")
    return read_out_s


def _read_mask(entry: dict[str, Any], root: Path, info: CameraInfo, where: str) -> BoolArray | None:
    """Pixels that show the vehicle itself: not black in the file of the key ``mask``; None without."""
    if "mask" not in entry:
        return None
    path = root / take_text(entry["mask"], f"{where}, mask", DriveError)
    mask = read_pixels(path, cv2.IMREAD_GRAYSCALE)
    if mask.shape != (info.height, info.width):
        raise DriveError(
            f"{where}, mask: {path} is not an image of {info.width} x {info.height} px; draw the vehicle "
            "white on black over one of the camera's images"
        )
    return np.asarray(mask > 0)


def _read_pose_noise(
    content: object, of_source: Mapping[str, float], files: Sequence[ImageFiles], where: str
) -> PoseNoise:
    """The noise as the drive states it, else as the source of its poses does, or the images' stamps show."""
    entry = {} if content is None else take_mapping(content, where, DriveError)
    check_keys(entry, (), [field.name for field in fields(PoseNoise)], where, DriveError)
    values = {key: take_number(value, f"{where}, {key}", DriveError) for key, value in entry.items()}
    for key, value in values.items():
        if value < 0:
            raise DriveError(f"{where}, {key}: a standard deviation cannot be negative; fix it")
        if key.endswith("_over_m") and value == 0:
            raise DriveError(f"{where}, {key}: an error that fades over 0 m is not a drift; leave it out")
    # A drift is part of its total: where the drive states one of both, the source's other one does not fit.
    replaced = {key for pair in DRIFTS.items() if set(pair) & set(values) for key in pair} | set(values)
    stated = {key: value for key, value in of_source.items() if key not in replaced}
    if not {"clock_s", "clock_drift_s"} & {*stated, *values}:
        stated["clock_drift_s"] = unstated_clock_drift_s([entry.stamp_s for entry in files])
    noise = PoseNoise.from_stated(**stated, **values)
    for total, drift in DRIFTS.items():
        if getattr(noise, drift) > getattr(noise, total):
            raise DriveError(f"{where}, {drift}: is part of {total}, so not above it; fix one of them")
    return noise
