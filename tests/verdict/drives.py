"""Tiny drives without images: a straight stretch and a circle to the left, at 5 m/s and 20 poses a second."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.cameras import level, mounted
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.ground.results import GroundEstimate, GroundStatus, Parameter, Reading
from v2hdm.records import (
    Calibration,
    Camera,
    CameraInfo,
    CentrePrior,
    Drive,
    FloatArray,
    Image,
    Marking,
    PoseNoise,
    Trajectory,
)
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.inputs.poses import Motion

SPEED_MPS = 5.0
RADIUS_M = 10.0
NOISE = PoseNoise(position_m=0.01, heading_rad=0.001)
CENTRE = np.array([2.0, 0.1, 2.5])


def poses(straight_s: float = 8.0, turn_s: float = 8.0, rate_hz: float = 20.0, seed: int = 0) -> Trajectory:
    """Eastwards, then around a circle of 10 m; with the noise of ``NOISE``."""
    rng = np.random.default_rng(seed)
    stamp_s = np.arange(0.0, straight_s + turn_s, 1 / rate_hz)
    turned = np.maximum(stamp_s - straight_s, 0.0) * SPEED_MPS / RADIUS_M
    along = np.minimum(stamp_s, straight_s) * SPEED_MPS
    position = np.column_stack(
        [along + RADIUS_M * np.sin(turned), RADIUS_M * (1 - np.cos(turned)), np.zeros(len(stamp_s))]
    )
    position[:, :2] += rng.normal(0, NOISE.position_m, (len(stamp_s), 2))
    return trajectory(stamp_s, position, turned + rng.normal(0, NOISE.heading_rad, len(stamp_s)))


def trajectory(stamp_s: FloatArray, position: FloatArray, yaw_rad: FloatArray) -> Trajectory:
    """Poses at places (P, 3) with headings (P,)."""
    matrices = level(*position.T[:2], yaw_rad)
    matrices[:, 2, 3] = position[:, 2]
    return Trajectory(stamp_s, matrices)


def yaw_of(recorded: Trajectory) -> FloatArray:
    return np.asarray(np.arctan2(recorded.map_from_vehicle[:, 1, 0], recorded.map_from_vehicle[:, 0, 0]))


def with_yaw(recorded: Trajectory, yaw_rad: FloatArray) -> Trajectory:
    return trajectory(recorded.stamp_s, recorded.map_from_vehicle[:, :3, 3], yaw_rad)


def motion(recorded: Trajectory) -> Motion:
    return Motion(
        recorded.stamp_s,
        recorded.map_from_vehicle[:, :3, 3].copy(),
        recorded.map_from_vehicle[:, :3, :3].copy(),
    )


def camera(pitch_deg: float = 15.0, centre: FloatArray = CENTRE) -> Camera:
    """A camera that looks ahead and down, 900 px of focal length, 1280 x 720 px."""
    cam_from_vehicle = mounted(centre, pitch_deg)
    intrinsic = np.array([[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1]])
    info = CameraInfo("front", 1280, 720, intrinsic, "plumb_bob", (-0.1, 0.02, 0.0, 0.0, 0.0))
    return Camera(
        info=info,
        ipm={"estimated": ipm_from_extrinsic(info, cam_from_vehicle)},
        initial_ipm="estimated",
        roi_vehicle=np.array([[7.0, -3.0], [14.0, -3.0], [14.0, 3.0], [7.0, 3.0]]),
        centre_prior=CentrePrior(CENTRE, np.full(3, 0.02)),
    )


def with_k(described: Camera, **entries: float) -> Camera:
    """A camera with other entries fx, fy, cx, cy in its camera matrix, and the IPM as it was."""
    intrinsic = described.info.intrinsic.copy()
    for name, value in entries.items():
        intrinsic[{"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}[name]] = value
    return replace(described, info=replace(described.info, intrinsic=intrinsic))


def drive(recorded: Trajectory, cameras: tuple[str, ...] = ("front",), every: int = 4) -> Drive:
    """A drive with an image at every fourth pose; their files do not exist."""
    images = [
        Image(name, float(recorded.stamp_s[k]), Path(f"{name}/{k}.jpg"), recorded.map_from_vehicle[k])
        for k in range(0, len(recorded.stamp_s), every)
        for name in cameras
    ]
    return Drive(
        name="tiny",
        root=Path(),
        cameras={name: camera() for name in cameras},
        images=images,
        pose_noise=NOISE,
        trajectory=recorded,
        recorded=recorded,
    )


def raised(findings: list[Finding]) -> dict[str, str]:
    """Sentences of the findings that did not pass, by check."""
    return {finding.check: finding.says for finding in findings if finding.status is not Status.PASS}


def noisy(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(60, 160, (720, 1280), dtype=np.uint8)


def pictured(
    folder: Path, paint: Callable[[int], np.ndarray], suffix: str = ".png", recorded: Trajectory | None = None
) -> Drive:
    """A drive with an image every 2.5 m, nine of them if its poses are not given."""
    bare = drive(recorded or poses(straight_s=4.0, turn_s=0.5), every=10)
    images = []
    for k, image in enumerate(bare.images):
        path = folder / f"{k}{suffix}"
        cv2.imwrite(str(path), paint(k))
        images.append(replace(image, path=path))
    return replace(bare, images=images)


SIGMA = {
    "clock_s": 0.001, "focal_scale": 0.002, "distortion_k1": 0.001, "grade": 0.0002,
    "up_m": 0.008, "forward_m": 0.04, "left_m": 0.04,
}  # fmt: skip


def estimate(name: str = "front", **values: float) -> GroundEstimate:
    """A clean camera, apart from some parameters."""
    parameters = {
        key: Parameter(key, values.get(key, 0.0), sigma, observable=True) for key, sigma in SIGMA.items()
    }
    guess = np.eye(4)
    guess[:3, :3] = [[0, -1, 0], [-0.26, 0, -0.966], [0.966, 0, -0.26]]  # 15 deg down
    return GroundEstimate(
        camera=name,
        status=GroundStatus.FOUND,
        shares={Reading.AS_GIVEN: 0.9, Reading.MIRRORED: 0.3},
        reading=Reading.AS_GIVEN,
        calibration=Calibration(camera().info, guess, np.eye(6)),
        parameters=parameters,
        median_residual=0.35,
        innovations={"heading": 1.2, "position": 1.0},
        seconds=3.0,
    )


INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))


def square_at(x, y):
    return Marking("diamond", np.array([[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]]), 5)
