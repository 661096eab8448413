"""A KITTI raw drive: ``<date>/<date>_drive_<number>_sync`` with its calibration in ``<date>``.

Geiger, Lenz, Stiller and Urtasun, Vision meets robotics: the KITTI dataset, IJRR 2013, section IV. The
vehicle frame has its origin on the road under the IMU, which sits near the rear axle. The map is the local
tangent plane at the first pose, with the road laid flat into z = 0. docs/kitti.md gives the reasons for what
the format leaves open.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive.images import ImageFiles, KittiOptions, ReadOptions, assemble_drive, select_cameras
from v2hdm.io.drive.road import lay_flat
from v2hdm.io.trajectory import check_geodetic, pose_matrices
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


@dataclass(frozen=True)
class KittiCamera:
    """One rectified camera: its pinhole intrinsics and where it sits in the IMU's frame."""

    info: CameraInfo
    cam_from_imu: FloatArray


def read_kitti_camera(folder: Path, name: str) -> KittiCamera:
    """Read the rectified camera ``name`` (``image_00`` to ``image_03``) from the date folder."""
    number = name.removeprefix("image_")
    cameras = _Entries(folder / "calib_cam_to_cam.txt")
    projection = cameras.matrix(f"P_rect_{number}", 3, 4)
    width, height = cameras.matrix(f"S_rect_{number}", 1, 2)[0]
    intrinsic = projection[:, :3] / projection[2, 2]
    rectified0_from_cam0 = np.eye(4)
    rectified0_from_cam0[:3, :3] = cameras.matrix("R_rect_00", 3, 3)
    # P = K [I | b]: the rectified cameras share cam 0's axes and differ by the offset b.
    rectified_from_rectified0 = np.eye(4)
    rectified_from_rectified0[:3, 3] = np.linalg.solve(intrinsic, projection[:, 3])
    cam0_from_velo = _Entries(folder / "calib_velo_to_cam.txt").rigid()
    velo_from_imu = _Entries(folder / "calib_imu_to_velo.txt").rigid()
    return KittiCamera(
        info=CameraInfo(name=name, width=round(width), height=round(height), intrinsic=intrinsic),
        cam_from_imu=rectified_from_rectified0 @ rectified0_from_cam0 @ cam0_from_velo @ velo_from_imu,
    )


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
            raise DriveError(
                f"{self._path}: {key}: expected {rows * columns} numbers; restore KITTI's own file"
            )
        return values.reshape(rows, columns)

    def rigid(self) -> FloatArray:
        return np.vstack([np.hstack([self.matrix("R", 3, 3), self.matrix("T", 3, 1)]), [0.0, 0.0, 0.0, 1.0]])


_CAMERAS = ("image_00", "image_01", "image_02", "image_03")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_OXTS_COLUMNS = 30
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
    as
3 cm and 0.05 deg that fade over 30 m are."""


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
    calibrations = {name: read_kitti_camera(path.parent, name) for name in names}
    stamp_s, oxts = _read_oxts(path, names[0])

    check_geodetic(oxts[:, :3], f"{path / 'oxts'}")
    origin_imu = GeodeticOrigin(float(oxts[0, 0]), float(oxts[0, 1]), float(oxts[0, 2]))
    position_enu = enu_from_geodetic(origin_imu, oxts[:, :3])
    enu_from_imu = pose_matrices(rotation_from_euler(*oxts[:, 3:6].T), position_enu)
    by_imu = lay_flat(Trajectory(stamp_s, enu_from_imu), _POSE_NOISE.position_m)
    vehicle_from_imu = _level_mount(calibrations[names[0]], by_imu.mount_rad, options.kitti.camera_height_m)
    enu_from_vehicle = enu_from_imu @ np.linalg.inv(vehicle_from_imu)
    enu_from_vehicle[:, 2, 3] += vehicle_from_imu[2, 3]  # the map's origin is on the road
    cameras = {
        name: _mount(calibration, vehicle_from_imu, options.kitti)
        for name, calibration in calibrations.items()
    }
    return assemble_drive(
        path.name,
        path,
        cameras,
        files,
        Trajectory(stamp_s, enu_from_vehicle),
        _POSE_NOISE,
        options.max_gap_s,
        f"{path / 'oxts'}",
        origin=_lower(origin_imu, float(vehicle_from_imu[2, 3])),
        mount_rad=by_imu.mount_rad,
    )


def _list_images(path: Path, camera: str) -> ImageFiles:
    """The images of one camera; the file number k is the line number of its time stamp."""
    folder = path / camera
    paths = [one for one in _numbered(folder) if one.suffix.lower() in _SUFFIXES]
    if not paths:
        raise DriveError(f"{folder / 'data'}: no PNG or JPEG image; restore KITTI's images")
    stamp_s = _stamps_of(paths, folder / "timestamps.txt", "image")
    if (np.diff(stamp_s) <= 0).any():
        raise DriveError(f"{folder / 'timestamps.txt'}: times are not strictly rising; restore the file")
    return ImageFiles(camera=camera, stamp_s=stamp_s, paths=paths)


def _read_oxts(path: Path, camera: str) -> tuple[FloatArray, FloatArray]:
    """Stamps (P,) and OXTS rows (P, 30); without stamps of its own, line k has those of image k."""
    folder = path / "oxts"
    paths = [one for one in _numbered(folder) if one.suffix == ".txt"]
    if not paths:
        raise DriveError(f"{folder / 'data'}: no OXTS file; restore KITTI's oxts folder")
    stamps_path = folder / "timestamps.txt"
    if not stamps_path.is_file():
        stamps_path = path / camera / "timestamps.txt"
    stamp_s = _stamps_of(paths, stamps_path, "OXTS file")
    oxts = np.array([_read_oxts_row(p) for p in paths])
    rising = np.concatenate([[True], stamp_s[1:] > np.maximum.accumulate(stamp_s)[:-1]])
    if not rising.all():
        _log.warning("%s: dropped %d poses whose time does not rise", stamps_path, int((~rising).sum()))
    return stamp_s[rising], oxts[rising]


def _numbered(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "data").glob("*") if path.stem.isdecimal())


def _stamps_of(paths: Sequence[Path], stamps_path: Path, thing: str) -> FloatArray:
    """The stamps (N,) of numbered files."""
    stamps = _read_stamps(stamps_path)
    numbers = [int(path.stem) for path in paths]
    if numbers[-1] >= len(stamps):
        raise DriveError(
            f"{stamps_path}: {len(stamps)} lines, but {thing} {numbers[-1]} exists; restore the file"
        )
    return stamps[numbers]


def _read_oxts_row(path: Path) -> FloatArray:
    try:
        row = np.array(read_text(path, DriveError).split(), dtype=np.float64)
    except ValueError:
        raise DriveError(f"{path}: holds something that is not a number; restore KITTI's own file") from None
    if len(row) != _OXTS_COLUMNS or not np.isfinite(row[:6]).all():
        raise DriveError(
            f"{path}: expected {_OXTS_COLUMNS} finite numbers, got {len(row)}; restore KITTI's own file"
        )
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
            raise DriveError(
                f"{path}: line {number}: expected 'YYYY-MM-DD hh:mm:ss.fraction', got '{line}'; mend it"
            ) from None
    return np.array(stamps)


def _level_mount(calibration: KittiCamera, mount_rad: FloatArray, camera_height_m: float) -> FloatArray:
    """``vehicle_from_imu``: the IMU's turn on the vehicle, and its height from that of the camera."""
    vehicle_from_imu = np.eye(4)
    roll, pitch = mount_rad[:, None]
    vehicle_from_imu[:3, :3] = rotation_from_euler(roll, pitch, np.zeros(1))[0]
    camera_imu = np.linalg.inv(calibration.cam_from_imu)[:3, 3]
    vehicle_from_imu[2, 3] = camera_height_m - (vehicle_from_imu[:3, :3] @ camera_imu)[2]
    return vehicle_from_imu


def _mount(calibration: KittiCamera, vehicle_from_imu: FloatArray, options: KittiOptions) -> Camera:
    cam_from_vehicle = calibration.cam_from_imu @ np.linalg.inv(vehicle_from_imu)
    centre_vehicle = np.linalg.inv(cam_from_vehicle)[:3, 3]
    near, far, half = options.roi_near_m, options.roi_far_m, options.roi_half_width_m
    roi = np.array([[near, -half], [far, -half], [far, half], [near, half]]) + centre_vehicle[:2]
    return Camera(
        info=calibration.info,
        ipm={"estimated": ipm_from_extrinsic(calibration.info, cam_from_vehicle)},
        initial_ipm="estimated",
        roi_vehicle=roi,
        centre_prior=CentrePrior(centre_vehicle, np.full(3, options.centre_sigma_m)),
    )


def _lower(origin: GeodeticOrigin, height_m: float) -> GeodeticOrigin:
    """``origin`` moved down to the road."""
    latitude, longitude, altitude = geodetic_from_enu(origin, np.array([[0.0, 0.0, -height_m]]))[0]
    return GeodeticOrigin(float(latitude), float(longitude), float(altitude))
