"""A recording in nuScenes' tables ``sensor``, ``calibrated_sensor``, ``ego_pose``, ``sample_data`` (JSON).

The vehicle frame is the ego's, on the ground under the rear axle; images are rectified; times are in us.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import inverse, make_transform
from v2hdm.io.calibration.mounting import ipm_from_guess, roi_ahead
from v2hdm.io.drive.images import ImageFiles, ReadOptions, assemble_drive, select_cameras
from v2hdm.io.safe.fields import check_camera, take_size_px
from v2hdm.io.safe.texts import read_json, take_camera_name
from v2hdm.io.trajectory import checked_rotations, in_order
from v2hdm.records import Camera, CameraInfo, Drive, FloatArray, PoseNoise, Trajectory
from v2hdm.store.files import take_array, take_number, take_text

_TABLES = ("sensor", "calibrated_sensor", "ego_pose", "sample_data")

Row = dict[str, Any]


def is_nuscenes_drive(path: Path) -> bool:
    """Whether ``path``, or its only folder of tables, holds nuScenes' tables."""
    return _tables_folder(path) is not None


def read_nuscenes_drive(path: Path, options: ReadOptions) -> Drive:
    """Read the recording at ``path``; see :func:`v2hdm.io.drive.read_drive`."""
    folder = _tables_folder(path)
    if folder is None:
        raise DriveError(f"{path}: no tables {', '.join(f'{name}.json' for name in _TABLES)} in it")
    sensors, calibrated, egos, data = (_table(folder / f"{name}.json") for name in _TABLES)
    shots: dict[str, list[Row]] = {}
    for row in data.values():
        sensor = _of(sensors, _of(calibrated, row, "calibrated_sensor_token", folder), "sensor_token", folder)
        if sensor.get("modality") == "camera":
            name = take_camera_name(sensor.get("channel"), f"{folder}: sensor, channel", DriveError)
            shots.setdefault(name, []).append(row)
    if not shots:
        raise DriveError(f"{folder}: no image of a camera in sample_data.json")
    cameras: dict[str, Camera] = {}
    files: list[ImageFiles] = []
    for name in select_cameras(sorted(shots), options.cameras, path):
        rows = sorted(shots[name], key=lambda row: _stamp(row, f"{folder}: sample_data of {name}"))
        cameras[name] = _camera(name, rows, calibrated, folder)
        stamp_s = np.array([_stamp(row, str(folder)) for row in rows])
        if (np.diff(stamp_s) <= 0).any():
            raise DriveError(f"{folder}: two images of {name} at one time; give one recording, not several")
        at = f"{folder}: sample_data of {name}, filename"
        names = [take_text(row.get("filename"), at, DriveError) for row in rows]
        files.append(ImageFiles(name, stamp_s, [path / file for file in names]))
    where = f"{folder}: ego_pose"
    rows = sorted(egos.values(), key=lambda row: _stamp(row, where))
    stamp_s = np.array([_stamp(row, where) for row in rows])
    order = in_order(stamp_s, where, "row")
    recorded = Trajectory(stamp_s[order], np.array([_pose(rows[n], where) for n in order.tolist()]))
    noise = PoseNoise.as_far_as_stated()
    drive = Drive(path.resolve().name, path, cameras, (), noise, recorded=recorded)
    return assemble_drive(drive, files, options.max_gap_s, where)


def _tables_folder(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    folders = [path, *sorted(child for child in path.glob("v1.0-*") if child.is_dir())]
    whole = [folder for folder in folders if all((folder / f"{name}.json").is_file() for name in _TABLES)]
    return whole[0] if len(whole) == 1 else None


def _table(path: Path) -> dict[str, Row]:
    rows = read_json(path, DriveError)
    if not isinstance(rows, list) or not all(isinstance(row, dict) and "token" in row for row in rows):
        raise DriveError(f"{path}: expected a list of rows with a 'token' each; restore the table")
    return {str(row["token"]): row for row in rows}


def _of(table: dict[str, Row], row: Row, key: str, folder: Path) -> Row:
    found = table.get(str(row.get(key)))
    if found is None:
        raise DriveError(f"{folder}: row {row['token']}: {key} names no row; restore the tables")
    return found


def _stamp(row: Row, where: str) -> float:
    return take_number(row.get("timestamp"), f"{where}: timestamp", DriveError) / 1e6


def _camera(name: str, rows: list[Row], calibrated: dict[str, Row], folder: Path) -> Camera:
    where = f"{folder}: camera {name}"
    tokens = {str(row["calibrated_sensor_token"]) for row in rows}
    if len(tokens) > 1:
        raise DriveError(f"{where}: {len(tokens)} calibrations: these are several recordings; give one")
    row = calibrated[tokens.pop()]
    intrinsic = take_array(row.get("camera_intrinsic"), (3, 3), f"{where}, camera_intrinsic", DriveError)
    size = [take_size_px(rows[0].get(key), f"{where}, {key}", DriveError) for key in ("width", "height")]
    info = CameraInfo(name, size[0], size[1], intrinsic)
    check_camera(info, where, DriveError)
    vehicle_from_cam = _pose(row, where)
    ipm = {"estimated": ipm_from_guess(info, inverse(vehicle_from_cam), where)}
    return Camera(info, ipm, "estimated", roi_ahead(vehicle_from_cam))


def _pose(row: Row, where: str) -> FloatArray:
    """The transform (4 x 4) of a row's translation and its rotation, a quaternion w, x, y, z."""
    quaternion = take_array(row.get("rotation"), (4,), f"{where}, rotation", DriveError)
    rotation = checked_rotations(quaternion[None, [1, 2, 3, 0]], lambda k: f"{where}, rotation", "mend it")
    place = take_array(row.get("translation"), (3,), f"{where}, translation", DriveError)
    return make_transform(rotation[0], place)
