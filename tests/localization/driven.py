"""A made-up vehicle on a made-up yard: what its cameras and its odometry say, with their errors."""

from dataclasses import dataclass, field, replace

import numpy as np

from tests.cameras import mounted
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.rigid import exp, heading_rad, rotation_from_euler
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import Motion
from v2hdm.localization.places import rough_position
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Look
from v2hdm.records import (
    Calibration,
    CameraInfo,
    HDMap,
    Lane,
    LaneDetection,
    Marking,
    MarkingDetection,
    Symbol,
)

INTRINSIC = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
WORD = np.array([[0.0, 0.6], [0.0, -0.6], [2.4, -0.6], [2.4, 0.6]])
DASH = np.array([[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]])
DIAMOND = np.array([[0.5, 0.0], [0.0, 0.4], [-0.5, 0.0], [0.0, -0.4]])
SIGMA_PX = 0.3
MAP_SIGMA_M = 0.006
MOUNT = np.diag(np.square([0.003, 0.003, 0.003, *(3 * [np.deg2rad(0.02)])]))
RATE_HZ = 10


def cameras():
    """Calibrations of a camera ahead and one back."""
    info = {name: CameraInfo(name, 1280, 720, INTRINSIC) for name in ("front", "rear")}
    ahead, back = mounted([1.5, 0.0, 2.4], pitch_deg=15), mounted([-1.0, 0.1, 2.4], pitch_deg=15, yaw_deg=180)
    return {"front": Calibration(info["front"], ahead, MOUNT), "rear": Calibration(info["rear"], back, MOUNT)}


def yard(seed, length_m=160.0, diamonds=True):
    """Dashes to the left and diamonds here and there to the right of a straight way along x."""
    rng = np.random.default_rng(seed)
    markings = [Marking("lane_dash", DASH + np.array([x, 1.8]), 10) for x in np.arange(0.0, length_m, 6.0)]
    for x in np.arange(0.0, length_m, 3.5) if diamonds else ():
        place = np.array([x + rng.uniform(-1, 1), rng.uniform(-4, -1.5)])
        markings.append(Marking("diamond", DIAMOND + place, 10))
    return HDMap(tuple(markings))


def lined(painted, length_m=160.0):
    """A yard with a solid line to the right of its way."""
    points_map = np.column_stack([np.arange(0.0, length_m, 0.5), np.full(int(2 * length_m), -1.7)])
    return replace(
        painted, lanes=(Lane("lane_line", points_map, 10, sigma_m=np.full(len(points_map), 0.01)),)
    )


def mapped(true, seed):
    """A yard as a drive has mapped it."""
    rng = np.random.default_rng([seed, 1])
    covariance = MAP_SIGMA_M**2 * (0.8 * np.tile(np.eye(2), (4, 4)) + 0.2 * np.eye(8))
    root = np.linalg.cholesky(covariance)
    return HDMap(
        tuple(
            replace(
                marking,
                corners_map=marking.corners_map + (root @ rng.standard_normal(8)).reshape(4, 2),
                covariance_m2=covariance,
                relative_sigma_m=MAP_SIGMA_M,
            )
            for marking in true.markings
        ),
        true.lanes,
    )


def moved(hd_map, share, by_m, seed=0, beyond_m=-np.inf):
    """A map of which a share of the markings, from a place on, was repainted so far away since."""
    rng = np.random.default_rng([seed, 2])
    markings = []
    for marking in hd_map.markings:
        angle = rng.uniform(0, 2 * np.pi)
        is_moved = rng.random() < share and marking.corners_map[:, 0].mean() > beyond_m
        off = by_m * np.array([np.cos(angle), np.sin(angle)]) * is_moved
        markings.append(replace(marking, corners_map=marking.corners_map + off))
    return HDMap(tuple(markings))


@dataclass
class Driven:
    """A drive along a yard: poses (F, 4, 4) at ``stamp_s`` (F,), and by moment ``looks`` and ``motion``."""

    stamp_s: np.ndarray
    poses: np.ndarray
    looks: list
    motion: list
    calibrations: dict = field(default_factory=cameras)

    def rough(self, rng):
        """A start that is known to 5 m and 20 deg."""
        x, y = self.poses[0, :2, 3] + rng.uniform(-3.5, 3.5, 2)
        return rough_position(x, y, np.degrees(heading_rad(self.poses[0])) + rng.uniform(-20, 20))

    def errors(self, pose, frame):
        """How far a pose is ahead, to the left, m, and turned, rad."""
        true = self.poses[frame]
        off = true[:2, :2].T @ (pose.map_from_vehicle[:2, 3] - true[:2, 3])
        turn = heading_rad(pose.map_from_vehicle) - heading_rad(true)
        return np.array([*off, (turn + np.pi) % (2 * np.pi) - np.pi])


def drive(painted, seed, seconds=8.0, speed=4.0, begin_m=12.0, turned=None, kmh=False, swerve_rad=0.05):
    """A swerving drive; ``turned`` is a camera, since when, s, and by how much (3,), rad, it was pushed."""
    rng = np.random.default_rng([seed, 3])
    stamp_s = np.arange(0, seconds, 0.02)
    heading = swerve_rad * np.sin(0.8 * stamp_s)
    step_m = 0.02 * speed * np.column_stack([np.cos(heading), np.sin(heading)])
    place = np.array([begin_m, 0.0]) + np.cumsum(step_m, axis=0) - step_m[0]
    roll, pitch = 0.002 * np.sin(3.0 * stamp_s + 1), 0.002 * np.sin(2.3 * stamp_s)
    poses = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    poses[:, :3, :3] = rotation_from_euler(roll, pitch, heading)
    poses[:, :2, 3] = place
    rate = np.gradient(heading, 0.02) + np.deg2rad(0.01) + 0.001 * rng.standard_normal(len(stamp_s))
    speeds = speed * 1.01 + 0.03 * rng.standard_normal(len(stamp_s))
    samples = [Motion(*row) for row in zip(stamp_s, speeds * (3.6 if kmh else 1.0), rate, strict=True)]
    every = 50 // RATE_HZ
    frames = np.arange(every, len(stamp_s), every)
    calibrations = cameras()
    mounts = {
        name: exp(rng.multivariate_normal(np.zeros(6), MOUNT)) @ calibration.cam_from_vehicle
        for name, calibration in calibrations.items()
    }
    looks = []
    for frame in frames.tolist():
        moment = []
        for name in calibrations:
            mount = mounts[name]
            if turned is not None and name == turned[0] and stamp_s[frame] > turned[1]:
                mount = exp(np.array([0, 0, 0, *turned[2]])) @ mount
            moment.append(_look(name, stamp_s[frame], mount @ np.linalg.inv(poses[frame]), painted, rng))
        looks.append(moment)
    motion = [samples[max(frame - every + 1, 0) : frame + 1] for frame in frames.tolist()]
    return Driven(stamp_s[frames], poses[frames], looks, motion)


def _look(camera, stamp_s, cam_from_map, painted, rng):
    """The whole markings within 14 m in an image, with noise; one in ten is missed."""
    corners = np.array([marking.corners_map for marking in painted.markings])
    pixels, depth_m = project_ground(INTRINSIC, np.tile(cam_from_map, (len(corners), 1, 1)), corners)
    inside = ((pixels > 0) & (pixels < [1280, 720])).all(axis=(1, 2)) & (depth_m > 0).all(axis=1)
    inside &= (depth_m < 14).all(axis=1) & (rng.random(len(corners)) > 0.1)
    markings = []
    for j in np.flatnonzero(inside).tolist():
        noisy = np.roll(pixels[j] + SIGMA_PX * rng.standard_normal((4, 2)), int(rng.integers(4)), axis=0)
        covariance = SIGMA_PX**2 * np.eye(8)
        markings.append(MarkingDetection(painted.markings[j].kind, 0.95, noisy, covariance, np.ones(4, bool)))
    lanes = tuple(_piece(cam_from_map, lane.points_map, rng) for lane in painted.lanes)
    return Look(camera, float(stamp_s), tuple(markings), tuple(lane for lane in lanes if lane is not None))


def _piece(cam_from_map, points_map, rng):
    """The piece of a line that an image shows within 14 m, with errors across that are alike along it."""
    pixels, depth_m = project_ground(
        INTRINSIC, np.tile(cam_from_map, (len(points_map), 1, 1)), points_map[:, None]
    )
    pixels, depth_m = pixels[:, 0], depth_m[:, 0]
    inside = ((pixels > 0) & (pixels < [1280, 720])).all(axis=1) & (depth_m > 2) & (depth_m < 14)
    if inside.sum() < 4:
        return None
    across_px = 0.2 * rng.standard_normal() + 0.2 * rng.standard_normal(int(inside.sum()))
    ahead = np.gradient(pixels[inside], axis=0)
    across = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    return LaneDetection("lane_line", 0.9, pixels[inside] + across_px[:, None] * across)


def word_at(x_m, y_m=0.0, kind="text"):
    return Symbol(kind, WORD + np.array([x_m, y_m]), 10, sigma_m=0.02)


def outlined(points_px, kind="text", is_seen=True):
    """A detection with an outline."""
    nothing = np.full((4, 2), np.nan)
    is_edge_seen = np.full(len(points_px), is_seen)
    return MarkingDetection(
        kind, 0.8, nothing, np.full((8, 8), np.nan), np.zeros(4, bool), points_px, is_edge_seen
    )


def with_words(look, pose, words):
    """A look with the words that the camera ahead shows whole, a letter's stroke off."""
    calibration = cameras()["front"]
    if look.camera != "front":
        return look
    cam_from_map = calibration.cam_from_vehicle @ np.linalg.inv(pose)
    outlines = []
    for word in words:
        cam = np.column_stack([word.outline_map, np.zeros(4), np.ones(4)]) @ cam_from_map[:3].T
        px = (cam @ calibration.info.intrinsic.T)[:, :2] / cam[:, 2:]
        if (cam[:, 2] > 2).all() and (cam[:, 2] < 20).all() and ((px > 0) & (px < [1280, 720])).all():
            outlines.append(outlined(px + 0.5))
    return replace(look, markings=(*look.markings, *outlines))


def follow(driven, hd_map, seed=0, prior=True, calibrations=None):
    """The poses after each moment."""
    start = driven.rough(np.random.default_rng(seed)) if prior else None
    localizer = Localizer(hd_map, calibrations or driven.calibrations, start)
    return [
        localizer.update(looks, motion) for looks, motion in zip(driven.looks, driven.motion, strict=True)
    ]


def tracked(driven, poses):
    """The errors (K, 3) of the tracked poses, and their bounds."""
    tracked_poses = [(k, pose) for k, pose in enumerate(poses) if pose.status == Status.TRACKING]
    errors = np.array([driven.errors(pose, k) for k, pose in tracked_poses]).reshape(-1, 3)
    bounds = np.array([(*pose.protection_m, pose.protection_rad) for _, pose in tracked_poses]).reshape(-1, 3)
    return errors, bounds
