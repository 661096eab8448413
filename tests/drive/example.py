"""A small but complete drive with two cameras, for the tests of reading and writing."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from tests.cameras import level, mounted
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive import Trajectory
from v2hdm.io.drive.writing import write_drive, write_truth
from v2hdm.records import (
    Camera,
    CameraInfo,
    CentrePrior,
    Drive,
    FloatArray,
    GeodeticOrigin,
    HDMap,
    Image,
    Lane,
    Marking,
    PoseNoise,
    Truth,
)

ORIGIN = GeodeticOrigin(latitude_deg=53.5, longitude_deg=9.9, altitude_m=45.0)


def camera_info(name: str = "front", width: int = 64, height: int = 48) -> CameraInfo:
    intrinsic = np.array([[60.0, 0.0, 31.5], [0.0, 61.0, 23.5], [0.0, 0.0, 1.0]])
    return CameraInfo(name, width, height, intrinsic, "plumb_bob", (-0.1, 0.02, 0.001, -0.001, 0.0))


def looking_forward(height_m: float = 2.0, pitch_rad: float = 0.3) -> FloatArray:
    """``cam_from_vehicle`` of a camera above the vehicle's origin, tilted down by ``pitch_rad``."""
    return mounted([0.0, 0.0, height_m], np.degrees(pitch_rad))


def straight_trajectory(end_s: float = 2.0, rate_hz: float = 10.0) -> Trajectory:
    """Five metres per second eastwards while slowly turning left."""
    stamp_s = 100.0 + np.arange(round(end_s * rate_hz) + 1) / rate_hz
    poses = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    zeros = np.zeros(len(stamp_s))
    poses[:, :3, :3] = rotation_from_euler(zeros, zeros, 0.1 * (stamp_s - 100.0))
    poses[:, 0, 3] = 5.0 * (stamp_s - 100.0)
    return Trajectory(stamp_s=stamp_s, map_from_vehicle=poses)


def make_drive(folder: Path, stamps: tuple[float, ...] = (100.05, 100.95, 101.25)) -> Drive:
    """Write a drive with its truth into ``folder`` and return what was written."""
    cameras, images = {}, []
    for number, name in enumerate(("front", "rear")):
        info = camera_info(name)
        ipm = ipm_from_extrinsic(info, looking_forward(2.0 + number))
        cameras[name] = Camera(
            info=info,
            ipm={"calibrated": ipm, "estimated": ipm_from_extrinsic(info, looking_forward(2.2))},
            initial_ipm="estimated",
            roi_vehicle=np.array([[3.0, -3.0], [9.0, -3.0], [9.0, 3.0], [3.0, 3.0]]),
            centre_prior=CentrePrior(np.array([0.0, 0.0, 2.0]), np.full(3, 0.02)),
        )
        (folder / name / "images").mkdir(parents=True)
        for index, stamp_s in enumerate(stamps):
            path = folder / name / "images" / f"{index:06d}.jpg"
            assert cv2.imwrite(str(path), np.full((info.height, info.width, 3), 40 * index, np.uint8))
            images.append(Image(name, stamp_s, path, np.eye(4)))
    drive = Drive(
        name="example",
        root=folder,
        cameras=cameras,
        images=sorted(images, key=lambda image: (image.stamp_s, image.camera)),
        pose_noise=PoseNoise(0.01, 0.0009, 0.002, position_drift_m=0.008, position_drift_over_m=25.0),
        origin=ORIGIN,
        truth_dir=folder / "truth",
    )
    (folder / "truth").mkdir()
    write_truth(folder / "truth", make_truth(drive), drive.images)
    write_drive(folder, drive, straight_trajectory())
    return drive


def make_map() -> HDMap:
    square = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
    lane = Lane("lane_line", np.array([[0.0, 2.0], [1 / 3, 2.0], [7.5, 2.25]]), sightings=4)
    rng = np.random.default_rng(3)
    half = rng.normal(size=(8, 8))
    markings = (
        Marking("diamond", square + 1 / 3, 5, half @ half.T),
        Marking("lane_dash", square - 1e6 / 7, 3),
    )
    return HDMap(markings, (lane,), ORIGIN)


def make_truth(drive: Drive) -> Truth:
    poses = level([5.0 * (image.stamp_s - 100.0) for image in drive.images])
    visibility = np.zeros((len(drive.images), 2))
    visibility[1:4, 0] = [0.25, 1.0, 0.5]
    return Truth(
        map=make_map(),
        cam_from_vehicle={"front": looking_forward(2.0), "rear": looking_forward(3.0)},
        map_from_vehicle=poses,
        visibility=visibility,
        lane_visible=(np.array([True, False, True]),),
        disturbances={"jitter_deg": 0.1},
    )


@contextmanager
def description(root: Path) -> Iterator[dict[str, Any]]:
    """The content of the drive's ``drive.yaml``, which is written back as it was changed."""
    content = yaml.safe_load((root / "drive.yaml").read_text())
    yield content
    (root / "drive.yaml").write_text(yaml.safe_dump(content))
