"""The calibration files of a KITTI raw date folder: intrinsics and the chain IMU to camera.

Geiger, Lenz, Stiller and Urtasun, Vision meets robotics: the KITTI dataset, IJRR 2013, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.store.files import read_text

_CAM_TO_CAM = "calib_cam_to_cam.txt"
_VELO_TO_CAM = "calib_velo_to_cam.txt"
_IMU_TO_VELO = "calib_imu_to_velo.txt"


@dataclass(frozen=True)
class KittiCamera:
    """One rectified camera: its pinhole intrinsics and where it sits in the IMU's frame."""

    info: CameraInfo
    cam_from_imu: FloatArray


def read_kitti_camera(folder: Path, name: str) -> KittiCamera:
    """Read the rectified camera ``name`` (``image_00`` to ``image_03``) from the date folder.

    Raises:
        DriveError: when a calibration file or an entry in it is missing or damaged.
    """
    number = name.removeprefix("image_")
    cameras = _Entries(folder / _CAM_TO_CAM)
    projection = cameras.matrix(f"P_rect_{number}", 3, 4)
    width, height = cameras.matrix(f"S_rect_{number}", 1, 2)[0]
    intrinsic = projection[:, :3] / projection[2, 2]
    rectified0_from_cam0 = np.eye(4)
    rectified0_from_cam0[:3, :3] = cameras.matrix("R_rect_00", 3, 3)
    # P = K [I | b]: the rectified cameras share cam 0's axes and differ by the offset b.
    rectified_from_rectified0 = np.eye(4)
    rectified_from_rectified0[:3, 3] = np.linalg.solve(intrinsic, projection[:, 3])
    cam0_from_velo = _Entries(folder / _VELO_TO_CAM).rigid()
    velo_from_imu = _Entries(folder / _IMU_TO_VELO).rigid()
    return KittiCamera(
        info=CameraInfo(name=name, width=round(width), height=round(height), intrinsic=intrinsic),
        cam_from_imu=rectified_from_rectified0 @ rectified0_from_cam0 @ cam0_from_velo @ velo_from_imu,
    )


class _Entries:
    """The ``key: numbers`` lines of one calibration file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        lines = (line.partition(":") for line in read_text(path, DriveError).splitlines())
        self._values = {key.strip(): value for key, _, value in lines}

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        if key not in self._values:
            raise DriveError(f"{self._path}: no entry '{key}'; restore KITTI's own file")
        try:
            values = np.array(self._values[key].split(), dtype=np.float64)
        except ValueError:
            values = np.empty(0)
        if values.size != rows * columns or not np.isfinite(values).all():
            raise DriveError(
                f"{self._path}: {key}: expected {rows * columns} numbers; restore KITTI's own file"
            )
        return values.reshape(rows, columns)

    def rigid(self) -> FloatArray:
        transform = np.eye(4)
        transform[:3, :3] = self.matrix("R", 3, 3)
        transform[:3, 3] = self.matrix("T", 1, 3)[0]
        return transform
