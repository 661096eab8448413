"""A KITTI raw drive: ``<date>/<date>_drive_<number>_sync`` with its calibration in ``<date>``.

Geiger, Lenz, Stiller and Urtasun, Vision meets robotics: the KITTI dataset, IJRR 2013, section IV. The
vehicle frame has its origin on the road under the IMU, which sits near the rear axle. The map is the local
tangent plane at the first pose, with the road laid flat into z = 0. docs/real-streets.md states what
the format leaves open.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import make_transform, rotation_from_euler
from v2hdm.io.drive.images import ImageFiles, KittiOptions, ReadOptions, assemble_drive, select_cameras
from v2hdm.io.drive.road import lay_flat
from v2hdm.io.trajectory import check_geodetic
from v2hdm.records import (
    Camera,
    CameraInfo,
    CentrePrior,
    Drive,
    FloatArray,
    GeodeticOrigin,
    PoseNoise,
    Trajectory,
)  # fmt: skip
from v2hdm.store.files import read_text

_log = logging.getLogger(__name__)


def _read_camera(folder: Path, name: str) -> tuple[CameraInfo, FloatArray]:
    """Intrinsics of the rectified camera ``name`` (``image_00`` to ``image_03``), and ``cam_from_imu``."""
    number = name.removeprefix("image_")
    cameras = _Entries(folder / "calib_cam_to_cam.txt")
    projection = cameras.matrix(f"P_rect_{number}", 3, 4)
    width, height = cameras.matrix(f"S_rect_{number}", 1, 2)[0]
    intrinsic = projection[:, :3] / projection[2, 2]
    rectified0_from_cam0 = make_transform(cameras.matrix("R_rect_00", 3, 3), np.zeros(3))
    # P = K [I | b]: the rectified cameras share cam 0's axes and differ by the offset b.
    rectified_from_rectified0 = make_transform(np.eye(3), np.linalg.solve(intrinsic, projection[:, 3]))
    cam0_from_velo = _Entries(folder / "calib_velo_to_cam.txt").rigid()
    velo_from_imu = _Entries(folder / "calib_imu_to_velo.txt").rigid()
    cam_from_imu = rectified_from_rectified0 @ rectified0_from_cam0 @ cam0_from_velo @ velo_from_imu
    return CameraInfo(name, round(width), round(height), intrinsic), cam_from_imu


class _Entries:
    """The ``key: numbers`` lines of one calibration file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        lines = (line.partition(":") for line in read_text(path, DriveError).splitlines())
        self._values = {key.strip(): value.split() for key, _, value in lines}

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        if key not in self._values:
            raise DriveError(f"{self._path}: no entry '{key}'; restore KITTI's own file")
        try:
            values = np.array(self._values[key], dtype=np.float64)
        except ValueError:
            values = np.empty(0)
        if values.size != rows * columns or not np.isfinite(values).all():
            raise DriveError(f"{self._path}: {key}: expected {rows * columns} numbers; restore KITTI's file")
        return values.reshape(rows, columns)

    def rigid(self) -> FloatArray:
        return make_transform(self.matrix("R", 3, 3), self.matrix("T", 1, 3)[0])


_CAMERAS = ("image_00", "image_01", "image_02", "image_03")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_OXTS_COLUMNS = 30  # numbers in a line of the IMU's files (KITTI's dataformat.txt)
_ROI_M = np.array([[5.0, -6.0], [20.0, -6.0], [20.0, 6.0], [5.0, 6.0]])  # trusted ground, from the camera
_POSE_NOISE = PoseNoise(
    position_m=0.032,
    position_drift_m=0.03,
    heading_rad=0.001,
    heading_drift_rad=0.0009,
    heading_drift_over_m=30.0,
    roll_pitch_rad=0.002,
    roll_pitch_drift_rad=0.0014,
)
"""Most of the data sheet's 0.1 m and 0.1 deg is drift that a stretch of road in view shares. The rest
wanders: steps of 1.1 m are 6 to 10 mm and 0.014 deg off the integrated velocity and turn rate (drive 0011),
as 3 cm and 0.05 deg that fade over 30 m are."""


def is_kitti_drive(path: Path) -> bool:
    """Whether ``path`` looks like the folder of one KITTI raw drive."""
    return (path / "oxts").is_dir() and any((path / name).is_dir() for name in _CAMERAS)


def read_kitti_drive(path: Path, options: ReadOptions) -> Drive:
    """Read the KITTI raw drive at ``path``; see :func:`v2hdm.io.drive.read_drive`."""
    path = path.resolve()
    available = [name for name in _CAMERAS if (path / name).is_dir()]
    if not available:
        raise DriveError(f"{path}: no folder image_00 to image_03; give the folder of one drive, ..._sync")
    names = select_cameras(available, options.cameras, path)
    files = [_list_images(path, name) for name in names]
    calibrations = {name: _read_camera(path.parent, name) for name in names}
    stamp_s, oxts = _read_oxts(path, names[0])

    check_geodetic(oxts[:, :3], f"{path / 'oxts'}")
    origin_imu = GeodeticOrigin(float(oxts[0, 0]), float(oxts[0, 1]), float(oxts[0, 2]))
    position_enu = enu_from_geodetic(origin_imu, oxts[:, :3])
    roll_imu, pitch_imu, yaw_imu = oxts[:, 3:6].T
    enu_from_imu = make_transform(rotation_from_euler(roll_imu, pitch_imu, yaw_imu), position_enu)
    by_imu = lay_flat(Trajectory(stamp_s, enu_from_imu), _POSE_NOISE.position_m)
    # The IMU's turn on the vehicle, and its height from that of the camera.
    roll, pitch = by_imu.mount_rad[:, None]
    vehicle_from_imu = make_transform(rotation_from_euler(roll, pitch, np.zeros(1))[0], np.zeros(3))
    camera_imu = np.linalg.inv(calibrations[names[0]][1])[:3, 3]
    vehicle_from_imu[2, 3] = options.kitti.camera_height_m - (vehicle_from_imu[:3, :3] @ camera_imu)[2]
    enu_from_vehicle = enu_from_imu @ np.linalg.inv(vehicle_from_imu)
    enu_from_vehicle[:, 2, 3] += vehicle_from_imu[2, 3]  # the map's origin is on the road
    cameras = {
        name: _mount(info, cam_from_imu @ np.linalg.inv(vehicle_from_imu), options.kitti)
        for name, (info, cam_from_imu) in calibrations.items()
    }
    on_road = geodetic_from_enu(origin_imu, np.array([[0.0, 0.0, -vehicle_from_imu[2, 3]]]))[0]
    recorded = Trajectory(stamp_s, enu_from_vehicle)
    where = f"{path / 'oxts'}"
    latitude_deg, longitude_deg, altitude_m = on_road.tolist()
    origin = GeodeticOrigin(latitude_deg, longitude_deg, altitude_m)
    drive = Drive(path.name, path, cameras, (), _POSE_NOISE, origin, recorded=recorded)
    return assemble_drive(drive, files, options.max_gap_s, where, by_imu.mount_rad)


def _list_images(path: Path, camera: str) -> ImageFiles:
    """The images of one camera; the file number k is the line number of its time stamp."""
    folder = path / camera
    paths = [path for path in _numbered(folder) if path.suffix.lower() in _SUFFIXES]
    if not paths:
        raise DriveError(f"{folder / 'data'}: no PNG or JPEG image; restore KITTI's images")
    stamp_s = _stamps_of(paths, folder / "timestamps.txt", "image")
    if (np.diff(stamp_s) <= 0).any():
        raise DriveError(f"{folder / 'timestamps.txt'}: times are not strictly increasing; restore the file")
    return ImageFiles(camera=camera, stamp_s=stamp_s, paths=paths)


def _read_oxts(path: Path, camera: str) -> tuple[FloatArray, FloatArray]:
    """Stamps (P,) and OXTS rows (P, 30); without stamps of its own, line k has those of image k."""
    folder = path / "oxts"
    paths = [path for path in _numbered(folder) if path.suffix == ".txt"]
    if not paths:
        raise DriveError(f"{folder / 'data'}: no OXTS file; restore KITTI's oxts folder")
    stamps_path = folder / "timestamps.txt"
    if not stamps_path.is_file():
        stamps_path = path / camera / "timestamps.txt"
    stamp_s = _stamps_of(paths, stamps_path, "OXTS file")
    oxts = np.array([_read_oxts_row(p) for p in paths])
    rising = np.concatenate([[True], stamp_s[1:] > np.maximum.accumulate(stamp_s)[:-1]])
    if not rising.all():
        _log.warning("%s: dropped %d poses whose time does not increase", stamps_path, int((~rising).sum()))
    return stamp_s[rising], oxts[rising]


def _numbered(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "data").glob("*") if path.stem.isdecimal())


def _stamps_of(paths: Sequence[Path], stamps_path: Path, thing: str) -> FloatArray:
    stamps = _read_stamps(stamps_path)
    numbers = [int(path.stem) for path in paths]
    if numbers[-1] >= len(stamps):
        raise DriveError(f"{stamps_path}: {len(stamps)} lines, but {thing} {numbers[-1]} exists; restore it")
    return stamps[numbers]


def _read_oxts_row(path: Path) -> FloatArray:
    try:
        row = np.array(read_text(path, DriveError).split(), dtype=np.float64)
    except ValueError:
        raise DriveError(f"{path}: contains a non-number; restore KITTI's own file") from None
    if len(row) != _OXTS_COLUMNS or not np.isfinite(row[:6]).all():
        raise DriveError(f"{path}: expected {_OXTS_COLUMNS} finite numbers, got {len(row)}; restore the file")
    return row


def _read_stamps(path: Path) -> FloatArray:
    """Seconds since 1970 of ``YYYY-MM-DD hh:mm:ss.fraction`` lines, the clock taken for UTC."""
    stamps = []
    for number, line in enumerate(read_text(path, DriveError).splitlines(), start=1):
        # datetime stops at microseconds; KITTI writes nanoseconds.
        whole, _, fraction = line.strip().partition(".")
        try:
            seconds = datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp()
            stamps.append(seconds + float(f"0.{fraction or 0}"))
        except ValueError:
            problem = f"expected 'YYYY-MM-DD hh:mm:ss.fraction', got {shown(line)}"
            raise DriveError(f"{path}: line {number}: {problem}; fix it") from None
    return np.array(stamps)


def _mount(info: CameraInfo, cam_from_vehicle: FloatArray, options: KittiOptions) -> Camera:
    centre_vehicle = np.asarray(np.linalg.inv(cam_from_vehicle)[:3, 3], dtype=np.float64)
    roi = _ROI_M + centre_vehicle[:2]
    prior = CentrePrior(centre_vehicle, np.full(3, options.centre_sigma_m))
    return Camera(info, {"estimated": ipm_from_extrinsic(info, cam_from_vehicle)}, "estimated", roi, prior)
