"""A painted plane seen by a tilted camera with a bent lens, and the result folder of a run over it.

The images are made pixel by pixel from the ground, the other way round than the mosaic is.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.cameras import mounted
from v2hdm.geometry.ipm import apply_homography, ground_from_pinhole_px, ipm_from_extrinsic
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import exp, inverse
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import ReadOptions, told_of
from v2hdm.io.drive.writing import write_drive
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.records import (
    Calibration,
    Camera,
    CameraInfo,
    Drive,
    FloatArray,
    GeodeticOrigin,
    HDMap,
    Image,
    Marking,
    Trajectory,
)
from v2hdm.store.files import write_json
from v2hdm.store.names import METRICS
from v2hdm.store.results import result_folder

INFO = CameraInfo(
    "front",
    480,
    270,
    np.array([[340.0, 0, 240.0], [0, 340.0, 134.0], [0, 0, 1]]),
    "plumb_bob",
    (-0.11, 0.035, 0.0004, -0.0003, 0.0),
)
ROI = np.array([[5.0, 1.8], [5.0, -1.8], [11.0, -3.0], [11.0, 3.0]])
ORIGIN = GeodeticOrigin(29.95, 122.05, 12.0)
SQUARES = [
    np.add([[-0.4, -0.4], [0.4, -0.4], [0.4, 0.4], [-0.4, 0.4]], [x, y]) for x in (7, 9, 11) for y in (-1, 1)
]


def cam_from_vehicle() -> FloatArray:
    """The camera 2.2 m above the ground, 1.5 m ahead of the axle, 20 degrees down."""
    return mounted([1.5, 0.1, 2.2], pitch_deg=20)


def waves(points_map: FloatArray) -> FloatArray:
    """Grey values (...) of ground that changes slowly, so that every way of interpolation agrees on it."""
    x, y = points_map[..., 0], points_map[..., 1]
    return np.asarray(120 + 50 * np.sin(1.3 * x) + 40 * np.cos(1.7 * y + 0.4 * x))


def squares(points_map: FloatArray) -> FloatArray:
    """Grey values (...) of dark ground with bright :data:`SQUARES`."""
    out = np.full(points_map.shape[:-1], 60.0)
    for square in SQUARES:
        inside = ((points_map >= square.min(axis=0)) & (points_map <= square.max(axis=0))).all(axis=-1)
        out[inside] = 210.0
    return out


def picture(ground, map_from_vehicle: FloatArray) -> np.ndarray:
    """The camera's picture of ``ground`` from a pose, as (height, width, 3) uint8; 3 x 3 rays a pixel."""
    v, u = np.mgrid[: INFO.height, : INFO.width]
    cam_from_map = cam_from_vehicle() @ inverse(map_from_vehicle)
    total = np.zeros((INFO.height, INFO.width))
    for dv in (-1 / 3, 0, 1 / 3):
        for du in (-1 / 3, 0, 1 / 3):
            pixels = np.stack([u + du, v + dv], axis=-1).reshape(-1, 2).astype(float)
            points = apply_homography(
                ground_from_pinhole_px(INFO.intrinsic, cam_from_map), undistort_points(INFO, pixels)
            )
            total += ground(points).reshape(total.shape)
    return np.repeat(np.round(total / 9).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def true_poses(count: int = 7) -> FloatArray:
    """Poses (count, 4, 4) half a metre apart in a slight bend, the body rolling and pitching a little."""
    out = np.zeros((count, 4, 4))
    for k in range(count):
        out[k] = exp(np.array([0.5 * k, 0.03 * k, 0.01, 0.004 * (-1) ** k, 0.003 * (-1) ** k, 0.01 * k]))
    return out


def drive_of(folder: Path, ground, offset_m: float = 0.0) -> Drive:
    """A drive over ``ground`` whose recorded poses are off to and fro by ``offset_m``, with its images."""
    (folder / "front" / "images").mkdir(parents=True)
    images = []
    for k, pose in enumerate(true_poses()):
        path = folder / "front" / "images" / f"{k:03d}.png"
        cv2.imwrite(str(path), picture(ground, pose))
        recorded = pose.copy()
        recorded[:2, 3] += offset_m * (-1) ** k
        images.append(Image("front", 0.1 * k, path, recorded))
    ipm = ipm_from_extrinsic(INFO, cam_from_vehicle())
    camera = Camera(INFO, {"estimated": ipm}, "estimated", ROI)
    poses = Trajectory(
        np.array([image.stamp_s for image in images]), np.stack([image.map_from_vehicle for image in images])
    )
    return Drive("plane", folder, {"front": camera}, images, origin=ORIGIN, trajectory=poses, recorded=poses)


def result_of(folder: Path, drive: Drive) -> Path:
    """The result folder of a run over a drive that has found mounting, poses and squares exactly."""
    with result_folder(folder / "result") as out:
        write_drive(drive.root, drive, drive.recorded)
        write_tum(replace(drive.recorded, map_from_vehicle=true_poses()), out / "trajectory.tum")
        sigmas = np.zeros((len(drive.recorded.stamp_s), 8))
        np.savetxt(out / "trajectory_sigma.csv", sigmas, delimiter=",", header="one line to skip")
        write_calibration(
            Calibration(INFO, cam_from_vehicle()), out / "calibration_front.yaml", clock_s=(0.0, 0.001)
        )
        hd_map = HDMap(tuple(Marking("diamond", s, 7) for s in SQUARES), origin=ORIGIN)
        write_geojson(hd_map, out / "map.geojson")
        write_json(out / METRICS, {"drive": told_of(drive, [drive.root], ReadOptions())})
    return folder / "result"
