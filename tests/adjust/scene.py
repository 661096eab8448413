"""A synthetic street: diamonds beside a route, seen by one or two cameras with known truth."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.cameras import mounted
from v2hdm.adjust import GroundPlanes, Observations, PoseSigma, Problem
from v2hdm.geometry.rigid import exp
from v2hdm.ground.planes import plane_of
from v2hdm.records import Calibration, CameraInfo

WIDTH, HEIGHT, FOCAL = 1280, 720, 900.0
PIXEL_SIGMA = 0.7


@dataclass(frozen=True)
class Scene:
    """A problem and its truth."""

    problem: Problem
    cam_from_vehicle: np.ndarray
    map_from_vehicle: np.ndarray
    corners_map: np.ndarray

    def corner_rmse_m(self, corners_map: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum((corners_map - self.corners_map) ** 2, axis=1))))

    def rotation_error_deg(self, cam_from_vehicle: np.ndarray) -> np.ndarray:
        off = cam_from_vehicle[:, :3, :3] @ self.cam_from_vehicle[:, :3, :3].transpose(0, 2, 1)
        return np.rad2deg(
            np.linalg.norm(Rotation.from_matrix(off.reshape(-1, 3, 3)).as_rotvec(), axis=1)
        ).reshape(off.shape[:-2])


def route(frames: int, step_m: float, turn_deg_per_m: float, straight_m: float) -> np.ndarray:
    """``map_from_vehicle``: straights and, if wanted, alternating turns in between."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    heading, position = 0.3, np.array([5.0, -3.0])
    for j in range(frames):
        phase, which = (j * step_m) % straight_m / straight_m, int(j * step_m // straight_m)
        if phase > 0.5:
            heading += np.deg2rad(turn_deg_per_m) * step_m * (1 if which % 2 == 0 else -1)
        c, s = np.cos(heading), np.sin(heading)
        position = position + step_m * np.array([c, s])
        poses[j, :2, :2], poses[j, :2, 3] = [[c, -s], [s, c]], position
    return poses


def diamonds(map_from_vehicle: np.ndarray, every_m: float, rng: np.random.Generator) -> np.ndarray:
    """Corners (N, 2) of diamonds scattered left and right of the route."""
    path = map_from_vehicle[:, :2, 3]
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    corners = []
    for s in np.arange(0, along[-1] + 12, every_m):
        j = min(int(np.searchsorted(along, s)), len(path) - 1)
        local = [s - along[j] + rng.uniform(-1, 1), rng.uniform(-4, 4)]
        centre = map_from_vehicle[j, :2, :2] @ local + path[j]
        angle = rng.uniform(0, np.pi)
        for quarter in range(4):
            a = angle + quarter * np.pi / 2
            corners.append(centre + 0.35 * np.array([np.cos(a), np.sin(a)]))
    return np.array(corners)


def correlated(rng: np.random.Generator, count: int, width: int, memory: float) -> np.ndarray:
    """A unit-variance Gauss-Markov sequence (count, width)."""
    out = rng.standard_normal((count, width))
    for j in range(1, count):
        out[j] = memory * out[j - 1] + np.sqrt(1 - memory**2) * out[j]
    return out


def pose_errors(
    map_from_vehicle: np.ndarray, sigma: PoseSigma, step_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Tangents (J, 6) of the errors that ``sigma`` describes: white noise and drifts."""
    count = len(map_from_vehicle)
    drift_sigma = np.array([drift.sigma for drift in sigma.drift_by_state()])
    memory = np.exp([-step_m / drift.over_m for drift in sigma.drift_by_state()])
    out = rng.standard_normal((count, 6)) * np.sqrt(sigma.by_state() ** 2 - drift_sigma**2)
    if drift_sigma.any():
        drift = np.column_stack([correlated(rng, count, 1, share) for share in memory])
        out += drift * drift_sigma
    # The receiver's error keeps its direction in the map while the vehicle turns.
    out[:, :2] = (map_from_vehicle[:, :2, :2].transpose(0, 2, 1) @ out[:, :2, None])[..., 0]
    return out


MOUNTS = np.stack([mounted((1.5, 0.0, 2.4), 18), mounted((-1.0, 0.2, 2.6), 22, yaw_deg=180)])


def with_outliers(pixel: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Pixels (K, 2), a share of which are up to 60 px off.

    Outliers have a generator of their own: the same street without them has the same noise.
    """
    rng = np.random.default_rng([seed, 1])
    is_wrong = rng.random(len(pixel)) < share
    pixel = pixel.copy()
    pixel[is_wrong] += rng.uniform(-60, 60, (int(is_wrong.sum()), 2))
    return pixel


class Seen(NamedTuple):
    """K observations of the corners (N, 2) that are seen often enough, by their numbers among these."""

    camera: np.ndarray
    frame: np.ndarray
    corner: np.ndarray
    corners_map: np.ndarray


def seen_often(
    truth: np.ndarray, recorded: np.ndarray, corners: np.ndarray, max_range_m: float, min_views: int
) -> Seen:
    """Observations of the corners that ``min_views`` images show at least."""
    camera, frame, corner, _ = observe(truth, recorded, corners, max_range_m)
    is_often = np.bincount(corner, minlength=len(corners)) >= min_views
    keep = is_often[corner]
    rank = np.cumsum(is_often) - 1
    return Seen(camera[keep], frame[keep], rank[corner[keep]], corners[is_often])


def off_start(truth: np.ndarray, error_deg: float, error_m: float, rng: np.random.Generator) -> np.ndarray:
    """Extrinsics (C, 4, 4), each turned about a random axis, and moved."""
    axis = rng.standard_normal((len(truth), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    start = exp(np.concatenate([np.zeros_like(axis), np.deg2rad(error_deg) * axis], 1)) @ truth
    start[:, :3, 3] += rng.uniform(-error_m, error_m, axis.shape)
    return start


def make_scene(
    seed: int = 0,
    *,
    frames: int = 120,
    step_m: float = 0.5,
    turn_deg_per_m: float = 4.0,
    straight_m: float = 20.0,
    every_m: float = 2.0,
    cameras: int = 2,
    start_error_deg: float = 3.0,
    start_error_m: float = 0.1,
    jitter: PoseSigma | None = None,
    outliers: float = 0.0,
    pixel_sigma: float = PIXEL_SIGMA,
    prior_sigma_m: float = 0.03,
    max_range_m: float = 15.0,
    min_views: int = 2,
    noise_seed: int | None = None,
    driven: np.ndarray | None = None,
    mounts: np.ndarray | None = None,
) -> Scene:
    """A street whose recorded poses are off by ``jitter`` and whose start is off as stated.

    Corners seen fewer than ``min_views`` times are left out. ``noise_seed`` draws other noise on the same
    street; that of pixels and survey is then the same whether poses are disturbed or not. ``driven``
    (J, 4, 4), ``map_from_vehicle``, takes the place of the route, ``mounts`` (C, 4, 4) that of the cameras.
    """
    rng = np.random.default_rng(seed)
    mounts = MOUNTS[:cameras] if mounts is None else mounts
    cameras = len(mounts)
    truth = exp(np.concatenate([np.zeros((cameras, 3)), rng.normal(0, 0.02, (cameras, 3))], 1)) @ mounts
    recorded = route(frames, step_m, turn_deg_per_m, straight_m) if driven is None else driven
    frames = len(recorded)
    corners = diamonds(recorded, every_m, rng)
    pose_rng = rng
    if noise_seed is not None:
        rng, pose_rng = np.random.default_rng(noise_seed), np.random.default_rng([noise_seed, 2])
    state = np.zeros((frames, 6)) if jitter is None else pose_errors(recorded, jitter, step_m, pose_rng)
    map_from_vehicle = recorded @ exp(state)
    camera, frame, corner, corners = seen_often(truth, recorded, corners, max_range_m, min_views)
    pixel = project(truth[camera] @ np.linalg.inv(map_from_vehicle)[frame], corners[corner])
    pixel = pixel + pixel_sigma * rng.standard_normal(pixel.shape)
    pixel = with_outliers(pixel, outliers, seed)
    start = off_start(truth, start_error_deg, start_error_m, rng)
    centre = -np.einsum("cji,cj->ci", truth[:, :3, :3], truth[:, :3, 3])
    problem = Problem(
        intrinsic=np.tile([FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5], (cameras, 1)),
        cam_from_vehicle=start,
        map_from_vehicle=recorded,
        observations=Observations(
            camera, frame, corner, pixel, np.tile(max(pixel_sigma, 0.1) ** 2 * np.eye(2), (len(pixel), 1, 1))
        ),
        corner_count=len(corners),
        centre_vehicle=centre + prior_sigma_m * rng.standard_normal((cameras, 3)),
        centre_sigma_m=np.full((cameras, 3), prior_sigma_m),
        pose_sigma=jitter or PoseSigma(),
    )
    return Scene(problem, truth, map_from_vehicle, corners)


def with_ground(scene: Scene, sigma_deg: float, sigma_m: float, seed: int = 0) -> Scene:
    """The scene with what texture shows of the ground in each camera, off by such errors."""
    rng = np.random.default_rng([seed, 3])
    planes, roots = [], []
    for matrix in scene.cam_from_vehicle:
        tilted = exp(np.concatenate([np.zeros(3), np.deg2rad(sigma_deg) * rng.standard_normal(3)])) @ matrix
        covariance = np.diag([sigma_m**2] * 3 + [np.deg2rad(sigma_deg) ** 2] * 3)
        info = CameraInfo("front", width=WIDTH, height=HEIGHT, intrinsic=np.diag([FOCAL, FOCAL, 1.0]))
        plane = plane_of(Calibration(info, tilted, covariance), np.zeros((2, 6)))
        assert plane is not None
        off = np.array([0.0, 0.0, 0.0, sigma_m * rng.standard_normal()])
        planes.append(plane.plane_cam + off)
        roots.append(plane.root_information)
    ground = GroundPlanes(np.array(planes), np.array(roots), np.zeros((len(planes), 2, 4)))
    return replace(scene, problem=replace(scene.problem, ground=ground))


def rows_of(observations: Observations, rows: np.ndarray | slice) -> Observations:
    """Some of the observations."""
    parts = (
        observations.camera,
        observations.frame,
        observations.corner,
        observations.pinhole_px,
        observations.covariance_px,
    )
    return Observations(*(part[rows] for part in parts))


def with_late_clocks(scene: Scene, offset_s: np.ndarray) -> Scene:
    """The scene, its poses exact, in images taken ``offset_s`` (C,) later than they say.

    The speed swings by half, so that an offset in time is no offset in place.
    """
    poses, observations = scene.problem.map_from_vehicle, scene.problem.observations
    step = np.linalg.inv(poses[:-1]) @ poses[1:]
    step = np.concatenate([step, step[-1:]])
    speed = 6.0 * (1 + 0.5 * np.sin(np.arange(len(poses)) / 7))
    length = np.linalg.norm(step[:, :2, 3], axis=1)
    twist = np.zeros((len(poses), 6))
    twist[:, 0], twist[:, 5] = speed, np.arctan2(step[:, 1, 0], step[:, 0, 0]) / length * speed
    then = poses[observations.frame] @ exp(twist[observations.frame] * offset_s[observations.camera, None])
    cam_from_map = scene.cam_from_vehicle[observations.camera] @ np.linalg.inv(then)
    pixel = project(cam_from_map, scene.corners_map[observations.corner])
    pixel += np.random.default_rng(0).normal(0, PIXEL_SIGMA, pixel.shape)
    problem = replace(
        scene.problem,
        twist_vehicle=twist,
        clock_sigma_s=0.05,
        observations=replace(observations, pinhole_px=pixel),
    )
    return replace(scene, problem=problem, map_from_vehicle=poses)


def project(cam_from_map: np.ndarray, points_map: np.ndarray, z_m: np.ndarray | float = 0.0) -> np.ndarray:
    """Pixels (K, 2) of points (K, 2) at heights, each by a transform of its own."""
    ground = np.column_stack([points_map, np.broadcast_to(z_m, len(points_map)), np.ones(len(points_map))])
    points = (cam_from_map @ ground[..., None])[:, :3, 0]
    return FOCAL * points[:, :2] / points[:, 2:] + np.array([WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5])


def observe(
    cam_from_vehicle: np.ndarray, map_from_vehicle: np.ndarray, corners: np.ndarray, max_range_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Camera, frame, corner (K,) and pixel (K, 2) of all corners in view."""
    ground = np.column_stack([corners, np.zeros(len(corners)), np.ones(len(corners))])
    parts = []
    for c, mount in enumerate(cam_from_vehicle):
        points = ground @ (mount @ np.linalg.inv(map_from_vehicle)).transpose(0, 2, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = FOCAL * points[..., 0] / points[..., 2] + WIDTH / 2 - 0.5
            v = FOCAL * points[..., 1] / points[..., 2] + HEIGHT / 2 - 0.5
        inside = (u > 0) & (u < WIDTH - 1) & (v > 0) & (v < HEIGHT - 1)
        visible = (points[..., 2] > 0.5) & (points[..., 2] < max_range_m) & inside
        j, n = np.nonzero(visible)
        parts.append((np.full(len(j), c), j, n, np.column_stack([u[j, n], v[j, n]])))
    camera, frame, corner, pixel = (np.concatenate(part) for part in zip(*parts, strict=True))
    return camera, frame, corner, pixel
