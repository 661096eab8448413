"""A made-up yard: diamonds and dashes along a route with turns, and what two cameras see of them.

Everything is drawn from one generator, so a seed names a scene. The truth stays here; the mapping
gets a :class:`v2hdm.records.Drive` and detections.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.cameras import level, mounted
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import exp
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.records import (
    Camera,
    CameraInfo,
    CentrePrior,
    Drive,
    FloatArray,
    HDMap,
    Image,
    ImageDetections,
    Lane,
    LaneDetection,
    Marking,
    MarkingDetection,
    PoseNoise,
)


@dataclass(kw_only=True)
class SceneOptions:
    """The contents of the yard, and how badly it is seen."""

    seed: int = 0
    length_m: float = 200.0
    turns: bool = True
    step_m: float = 0.9
    cameras: tuple[str, ...] = ("front", "rear")
    pixel_sigma: float = 0.25
    detection_rate: float = 0.92
    hidden_corner_rate: float = 0.05
    false_rate: float = 0.01
    wild_rate: float = 0.01
    ipm_error_deg: float = 1.5
    ipm_error_m: float = 0.3
    jitter_deg: float = 0.1
    rtk_m: float = 0.01
    heading_deg: float = 0.05
    max_range_m: float = 20.0
    dashes_only: bool = False
    lines: tuple[float, ...] = (-3.2,)
    read_out_s: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A drive, its detections, and the truth that the mapping must not see."""

    drive: Drive
    detections: list[ImageDetections]
    markings: list[Marking]
    lanes: list[Lane]
    cam_from_vehicle: dict[str, FloatArray]


FRAME_S = 0.2
"""Time from image to image, s."""

MOUNTS = {
    "front": mounted((3.6, 0.1, 2.4), pitch_deg=16.0, yaw_deg=1.0, roll_deg=0.5),
    "rear": mounted((-0.9, -0.1, 2.6), pitch_deg=18.0, yaw_deg=181.0, roll_deg=-0.4),
}
"""``cam_from_vehicle`` of the cameras."""


def make_scene(options: SceneOptions, repaint: Callable[[list[Marking]], list[Marking]] = list) -> Scene:
    """Build the yard, drive through it and detect; equal options but for the seed are sessions of one yard.

    ``repaint`` takes the markings that the yard was laid out with to those that are there by now.
    """
    rng = np.random.default_rng(options.seed)
    route = _route(options)
    markings, lanes = _paint(route, options)
    markings = repaint(markings)
    truth = {name: MOUNTS[name] for name in options.cameras}
    cameras = {name: _camera(name, truth[name], options, rng) for name in options.cameras}
    true_poses, recorded = _poses(route, options, rng)
    images, detections, twist = [], [], _twists(route)
    for j in range(len(recorded)):
        for name in sorted(options.cameras):
            images.append(Image(name, FRAME_S * j, Path(f"{name}/{j:06d}.jpg"), recorded[j]))
            at = truth[name], true_poses[j], twist[j]
            look = _look(cameras[name].info, *at, markings, lanes, options, rng)
            detections.append(ImageDetections(len(images) - 1, *look))
    heading_rad, jitter_rad = (max(np.deg2rad(a), 2e-4) for a in (options.heading_deg, options.jitter_deg))
    none = dict.fromkeys(("position_drift_m", "heading_drift_rad", "roll_pitch_drift_rad"), 0.0)
    noise = PoseNoise(max(options.rtk_m, 0.005), heading_rad, jitter_rad, **none)
    drive = Drive("yard", Path(), cameras, images, noise)
    return Scene(drive, detections, markings, lanes, truth)


def _route(options: SceneOptions) -> FloatArray:
    """Poses (J, 3) x, y, heading: straight, a left and a right quarter turn of 12 m radius."""
    poses, x, y, heading = [], 0.0, 0.0, 0.3
    for travelled in np.arange(0.0, options.length_m, options.step_m):
        poses.append((x, y, heading))
        share = travelled / options.length_m
        if options.turns and 0.3 < share < 0.3 + 19.0 / options.length_m:
            heading += options.step_m / 12.0
        if options.turns and 0.65 < share < 0.65 + 19.0 / options.length_m:
            heading -= options.step_m / 12.0
        x += options.step_m * np.cos(heading)
        y += options.step_m * np.sin(heading)
    return np.array(poses)


def _beside(route: FloatArray, spacing_m: float, lateral_m: float) -> FloatArray:
    """Poses (N, 3) every ``spacing_m`` along the route, ``lateral_m`` to its left."""
    step = np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(step)])
    s = np.arange(0.0, at[-1], spacing_m)
    x, y, heading = (np.interp(s, at, route[:, i]) for i in range(3))
    return np.column_stack([x - lateral_m * np.sin(heading), y + lateral_m * np.cos(heading), heading])


def _placed(shape: FloatArray, pose: FloatArray) -> FloatArray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return shape @ np.array([[c, s], [-s, c]]) + pose[:2]


def _paint(route: FloatArray, options: SceneOptions) -> tuple[list[Marking], list[FloatArray]]:
    diamond = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
    dash = np.array([[1.5, -0.075], [1.5, 0.075], [-1.5, 0.075], [-1.5, -0.075]])
    rows = () if options.dashes_only else (1.5, -1.2)
    markings = [Marking("diamond", _placed(diamond, p), 0) for d in rows for p in _beside(route, 5.0, d)[1:]]
    sides = (1.8, -1.8) if options.dashes_only else (3.2,)
    markings += [Marking("lane_dash", _placed(dash, p), 0) for d in sides for p in _beside(route, 6.0, d)[1:]]
    lanes = [Lane("lane_line", _beside(route, 0.5, lateral)[:, :2], 0) for lateral in options.lines]
    return markings, lanes + [Lane("lane_dash", _beside(route, 0.5, d)[:, :2], 0) for d in sides]


def _camera(name: str, truth: FloatArray, options: SceneOptions, rng: np.random.Generator) -> Camera:
    intrinsic = np.array([[900.0, 0, 640], [0, 900, 350], [0, 0, 1]])
    info = CameraInfo(name, 1280, 720, intrinsic, "plumb_bob", (-0.1, 0.02, 1e-4, -2e-4, 0.0))
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.deg2rad(options.ipm_error_deg)).as_matrix()
    shift = rng.normal(size=3)
    centre = -truth[:3, :3].T @ truth[:3, 3]
    guess = np.eye(4)
    guess[:3, :3] = turn @ truth[:3, :3]
    guess[:3, 3] = -guess[:3, :3] @ (centre + shift / np.linalg.norm(shift) * options.ipm_error_m)
    sign = 1.0 if centre[0] > 1 else -1.0
    x = centre[0] + sign * np.array([4.5, 13.0, 13.0, 4.5])
    roi = np.column_stack([x, [-2.0, -4.0, 4.0, 2.0]])
    prior = CentrePrior(centre + rng.normal(size=3) * 0.02, np.full(3, 0.02))
    ipms = {"estimated": ipm_from_extrinsic(info, guess), "calibrated": ipm_from_extrinsic(info, truth)}
    return Camera(info, ipms, "estimated", roi, prior, read_out_s=options.read_out_s)


def _poses(
    route: FloatArray, options: SceneOptions, rng: np.random.Generator
) -> tuple[list[FloatArray], list[FloatArray]]:
    true, recorded = [], []
    for x, y, heading in route:
        tilt = rng.normal(size=2) * np.deg2rad(options.jitter_deg)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZYX", [heading, *tilt]).as_matrix()
        pose[:3, 3] = x, y, rng.normal() * 0.003
        true.append(pose)
        noisy = np.eye(4)
        measured = heading + rng.normal() * np.deg2rad(options.heading_deg)
        noisy[:3, :3] = Rotation.from_euler("Z", measured).as_matrix()
        noisy[:2, 3] = np.array([x, y]) + rng.normal(size=2) * options.rtk_m
        recorded.append(noisy)
    return true, recorded


def _twists(route: FloatArray) -> FloatArray:
    """Twists (J, 6) of the vehicle along a route of poses (J, 3) that are a frame apart."""
    return vehicle_twists(level(*route.T), FRAME_S * np.arange(len(route)))


def _project_rows(
    info: CameraInfo, cam_from_vehicle: FloatArray, pose: FloatArray, twist: FloatArray, read_out_s: float
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """:func:`_project` by the pose at which each point's row is read, which is found by turns."""

    def project(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        px, depth = _project(info, cam_from_vehicle @ np.linalg.inv(pose), points)
        for _ in range(6 if read_out_s else 0):
            late_s = read_out_s * (np.clip(px[:, 1] / (info.height - 1), 0, 1) - 0.5)
            px, depth = _project(
                info, cam_from_vehicle @ np.linalg.inv(pose @ exp(twist * late_s[:, None])), points
            )
        return px, depth

    return project


def _project(info: CameraInfo, cam_from_map: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Recorded pixels (N, 2) and depths (N,) of ground points (N, 2), by one pose or each by its own."""
    ground = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))])
    cam = (cam_from_map[..., :3, :] @ ground[..., None])[..., 0]
    depth = np.maximum(cam[:, 2], 1e-3)
    pinhole = cam[:, :2] / depth[:, None] * [900.0, 900.0] + [640.0, 350.0]
    is_visible = (cam[:, 2] > 1) & (np.abs(pinhole - [640, 350]) < [900, 600]).all(axis=1)
    return distort_points(info, np.where(is_visible[:, None], pinhole, 0.0)), np.where(
        is_visible, cam[:, 2], -1.0
    )


def _inside(px: FloatArray, depth: FloatArray, options: SceneOptions, margin: float = 5.0) -> np.ndarray:
    inside = (px > margin).all(axis=1) & (px < np.array([1280, 720]) - margin).all(axis=1)
    return inside & (depth > 0) & (depth < options.max_range_m)


def _look(
    info: CameraInfo,
    cam_from_vehicle: FloatArray,
    map_from_vehicle: FloatArray,
    twist: FloatArray,
    markings: list[Marking],
    lanes: list[Lane],
    options: SceneOptions,
    rng: np.random.Generator,
) -> tuple[tuple[MarkingDetection, ...], tuple[LaneDetection, ...]]:
    project = _project_rows(info, cam_from_vehicle, map_from_vehicle, twist, options.read_out_s)
    markings_found = []
    for marking in markings:
        if np.linalg.norm(marking.corners_map[0] - map_from_vehicle[:2, 3]) > options.max_range_m + 5:
            continue
        px, depth = project(marking.corners_map)
        inside = _inside(px, depth, options)
        if inside.sum() < 2 or rng.random() > options.detection_rate:
            continue
        markings_found.append(_detection(marking.kind, px, inside, options, rng))
    if rng.random() < options.false_rate * 6:
        px = np.array([640.0, 450.0]) + rng.uniform(-200, 200, 2)
        quad = np.array([[30.0, 0], [0, -15], [-30, 0], [0, 15]]) * rng.uniform(0.5, 2) + px
        markings_found.append(_detection("diamond", quad, np.ones(4, bool), options, rng))
    strips = [("lane_line", lane.points_map) for lane in lanes if lane.kind == "lane_line"]
    strips += [("lane_dash", _centre_line(m.corners_map)) for m in markings if m.kind == "lane_dash"]
    rows = []
    for kind, points in strips:
        px, depth = project(points)
        keep = _inside(px, depth, options)
        if keep.sum() >= 3:
            noise = rng.normal(size=(int(keep.sum()), 2)) * 2 * options.pixel_sigma
            near_to_far = np.argsort(depth[keep])
            rows.append(LaneDetection(kind, 0.9, (px[keep] + noise)[near_to_far]))
    return tuple(markings_found), tuple(rows)


def _centre_line(dash: FloatArray) -> FloatArray:
    """Points (N, 2) every 0.3 m from end to end of a dash whose corners 1 and 2 share a long side."""
    first, last = dash[[0, 1]].mean(axis=0), dash[[2, 3]].mean(axis=0)
    return first + np.linspace(0.0, 1.0, 11)[:, None] * (last - first)


def _detection(
    kind: str, px: FloatArray, inside: np.ndarray, options: SceneOptions, rng: np.random.Generator
) -> MarkingDetection:
    noisy = px + rng.normal(size=(4, 2)) * options.pixel_sigma
    valid = inside & (rng.random(4) > options.hidden_corner_rate)
    if rng.random() < options.wild_rate:
        noisy[rng.integers(4)] += rng.normal(size=2) * 8
    shift = int(rng.integers(4))
    covariance = np.eye(8) * options.pixel_sigma**2
    return MarkingDetection(kind, 0.9, np.roll(noisy, shift, axis=0), covariance, np.roll(valid, shift))


MATCH_M = 0.3
"""How far apart, m, a mapped and a true marking are one."""


def match(hd_map: HDMap, truth: list[Marking], gate_m: float) -> tuple[list[tuple[int, int]], float]:
    """Pairs (mapped, true) of nearest centres within the gate, and the corner RMSE over them."""
    centres = np.array([m.corners_map.mean(axis=0) for m in truth])
    pairs, squared = [], []
    for a, mapped in enumerate(hd_map.markings):
        distance = np.linalg.norm(centres - mapped.corners_map.mean(axis=0), axis=1)
        b = int(distance.argmin())
        if distance[b] <= gate_m and truth[b].kind == mapped.kind:
            errors = [np.roll(mapped.corners_map, s, axis=0) - truth[b].corners_map for s in range(4)]
            pairs.append((a, b))
            squared.append(min(np.sum(error**2) / 4 for error in errors))
    return pairs, float(np.sqrt(np.mean(squared)))


def rotation_error_deg(a: np.ndarray, b: np.ndarray) -> float:
    cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1) / 2
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


MOVED = {3: (0.1, 0.02), 7: (-0.25, 0.1), 12: (0.4, 0.5), 16: (0.0, -0.9)}
REMOVED = (5, 10, 14, 21)
ADDED = ((14.0, 3.0), (30.0, 9.5), (22.0, 6.0))
DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])


def repainted(markings: list[Marking]) -> list[Marking]:
    """Some diamonds moved, some removed, some added."""
    out = [
        replace(marking, corners_map=marking.corners_map + MOVED.get(k, (0.0, 0.0)))
        for k, marking in enumerate(markings)
        if k not in REMOVED
    ]
    return out + [Marking("diamond", DIAMOND + place, 0) for place in ADDED]
