"""Detections in the images of a made drive, without a detector: true corners, projected, with its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from tests.benchmarks.made.world import World
from tests.cameras import apply
from v2hdm.association.sightings import row_shares
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    DIAMOND,
    LANE_DASH,
    STOP_LINE,
    BoolArray,
    CameraInfo,
    Drive,
    FloatArray,
    ImageDetections,
    MarkingDetection,
)
from v2hdm.simulate.port.drive import hidden_by

_RANGE_M = 22.0  # as the detector's max_range_m
_POINT_PX = 1.5  # as its max_corner_sigma_px for the mapping
_BORDER_PX = 4.0
_HIDDEN_PX = 200.0  # sigma of a corner in the direction that the image's border hides
_NEAR_M = 0.3
_BISECTIONS = 12
_TURNS = 5  # from row to pose and back: each leaves a twentieth of the step before
_TANGENT = 0.98  # share of the way to the border, from which on a side is straight
_IMAGES = 42  # stream of a seed


@dataclass(frozen=True)
class Projected:
    """The corners of all markings in one image: ``px`` (J, 4, 2), ``inside`` and ``distance_m`` (J, 4)."""

    px: FloatArray
    inside: BoolArray
    distance_m: FloatArray


def detect(world: World, drive: Drive) -> tuple[list[ImageDetections], FloatArray]:
    """The detections in every image of a drive, and the share (I, J) of each marking that it shows."""
    names, detections = sorted(world.cameras), []
    visibility = np.zeros((len(drive.images), len(world.corners_map)))
    for i, image in enumerate(drive.images):
        frame = world.frame_of(image)
        source = world
        if world.elsewhere is not None and frame in world.elsewhere[1]:
            source = world.elsewhere[0]
        rng = np.random.default_rng([source.recipe.seed, _IMAGES, names.index(image.camera), frame])
        markings, shown = _in_image(source, image.camera, frame, rng)
        if source is world:
            visibility[i] = shown
        detections.append(ImageDetections(i, tuple(markings), ()))
    return detections, visibility


def _in_image(
    world: World, camera: str, frame: int, rng: np.random.Generator
) -> tuple[list[MarkingDetection], FloatArray]:
    """The detections in one image, and the share (J,) of each marking that it shows."""
    errors, corners = world.recipe.detector, world.corners_map
    cam_from_map = world.cam_from_vehicle[camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
    lens = world.lenses[camera]
    pose = partial(world.cam_from_map, camera, frame) if world.read_out_s else cam_from_map
    projected = project(lens, pose, corners)
    candidates = (projected.distance_m.max(axis=1) < _RANGE_M) & (projected.inside.sum(axis=1) >= 2)
    covered = np.zeros_like(projected.inside)
    covered[candidates] = _covered(world, frame, camera_centre(cam_from_map), corners[candidates])
    shown = (projected.inside & ~covered).mean(axis=1)
    # All is drawn for all markings, so that a fault which hides some leaves the errors of the others alone.
    count = len(corners)
    light = np.exp(rng.normal(0.0, errors.sigma_spread))
    spread = np.exp(rng.normal(0.0, errors.sigma_spread, (count, 4)))
    sigma = errors.sigma_px * light * spread * (1 + (projected.distance_m / errors.doubled_at_m) ** 2)
    off = rng.standard_normal((count, 4, 2)) * sigma[..., None]
    missed, cut = rng.random(count) < errors.missed, rng.random(count) < errors.cut
    markings = []
    for j in np.flatnonzero(candidates & ~covered.any(axis=1) & ~missed):
        px, covariance = projected.px[j] + off[j], np.zeros((4, 2, 2))
        covariance[:] = np.square(sigma[j])[:, None, None] * np.eye(2)
        for k in np.flatnonzero(~projected.inside[j]):
            px[k], covariance[k] = _at_border(lens, pose, corners[j], projected, j, k, sigma[j, k])
            px[k] += rng.multivariate_normal(np.zeros(2), np.square(sigma[j, k]) * np.eye(2))
        if cut[j]:
            px = _cut(px, float(rng.uniform(0.2, 0.6)))
        covariance *= errors.stated_factor
        kind = world.port.hd_map.markings[j].kind
        markings.append(_detection(kind, px, covariance, projected.inside[j], lens))
    for _ in range(rng.poisson(errors.false * len(markings))):
        false = _false(world, camera, frame, pose, rng)
        if false is not None:
            markings.append(false)
    return markings, shown


def _covered(world: World, frame: int, centre_map: FloatArray, corners_map: FloatArray) -> BoolArray:
    """Which points (J, K, 3) a stack, a truck or a barrier hides from a camera."""
    close_boxes = [
        box
        for box in world.port.renderer.scene.boxes + world.port.moving_boxes(frame)
        if np.hypot(*(np.array(box.centre_map) - centre_map[:2])) < _RANGE_M + np.hypot(*box.size_m[:2])
        and box.base_m < centre_map[2]
    ]
    return hidden_by(close_boxes, centre_map, corners_map[..., :2].reshape(-1, 2)).reshape(
        corners_map.shape[:2]
    )


Pose = FloatArray | Callable[[FloatArray], FloatArray]
"""``cam_from_map`` of all rows (4, 4), or by when in the read-out they are read, -1/2 to 1/2 (N,)."""


def project(lens: CameraInfo, cam_from_map: Pose, points_map: FloatArray) -> Projected:
    """Points (J, K, 3) as a camera records them, each by the pose of its row where rows have their own."""
    if not callable(cam_from_map):
        return _project(lens, cam_from_map, points_map)
    row_share = np.zeros(points_map.shape[0] * points_map.shape[1])
    projected = _project(lens, cam_from_map(row_share), points_map)
    for _ in range(_TURNS):
        is_finite = np.isfinite(projected.px[..., 1].ravel())
        row_share[is_finite] = row_shares(lens, projected.px.reshape(-1, 2)[is_finite])
        projected = _project(lens, cam_from_map(row_share), points_map)
    return projected


def _project(lens: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray) -> Projected:
    """Points (J, K, 3) by one pose (4, 4), or each by its own."""
    points = points_map.reshape(-1, 3)
    cam = apply(cam_from_map, points[:, None] if cam_from_map.ndim == 3 else points).reshape(-1, 3)
    depth = cam[:, 2]
    ahead = depth > _NEAR_M
    with np.errstate(divide="ignore", invalid="ignore"):
        pinhole = (cam / depth[:, None]) @ lens.intrinsic.T
    # Far outside the image the lens polynomial folds back; only near it are its values meaningful.
    size = np.array([lens.width, lens.height])
    inside = ahead & ((pinhole[:, :2] > -0.25 * size) & (pinhole[:, :2] < 1.25 * size)).all(axis=1)
    px = np.full((len(cam), 2), np.nan)
    px[inside] = distort_points(lens, pinhole[inside, :2])
    inside[inside] = ((px[inside] >= 0) & (px[inside] <= size - 1)).all(axis=1)
    distance = np.linalg.norm(points[:, :2] - camera_centre(cam_from_map)[..., :2], axis=1)
    shape = points_map.shape[:2]
    return Projected(px.reshape(*shape, 2), inside.reshape(shape), distance.reshape(shape))


def _at_border(
    lens: CameraInfo,
    cam_from_map: Pose,
    corners: FloatArray,
    projected: Projected,
    j: int,
    k: int,
    sigma_px: float,
) -> tuple[FloatArray, FloatArray]:
    """Where a side leaves the image on its way to a corner outside, and the covariance of that corner."""
    beside = [n for n in ((k + 1) % 4, (k - 1) % 4) if projected.inside[j, n]]
    if not beside:
        corner = projected.px[j, projected.inside[j]].mean(axis=0)
        return corner, _HIDDEN_PX**2 * np.eye(2)
    start, end = corners[beside[0]], corners[k]
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        point = project(lens, cam_from_map, (start + middle * (end - start))[None, None])
        low, high = (middle, high) if point.inside[0, 0] else (low, middle)
    # The direction of the side where it leaves the image: the lens bends it on the way there.
    shares = np.array([_TANGENT * low, low])[:, None]
    before, px = project(lens, cam_from_map, (start + shares * (end - start))[None]).px[0]
    if len(beside) == 2:  # a tip of which the border hides all: two sides may end there or beyond
        return px, _HIDDEN_PX**2 * np.eye(2)
    along = (px - before) / max(float(np.linalg.norm(px - before)), 1e-9)
    return px, _HIDDEN_PX**2 * np.outer(along, along) + sigma_px**2 * np.eye(2)


def _cut(px: FloatArray, share: float) -> FloatArray:
    """Corners (4, 2) of a marking whose upper end in the image is hidden by this share."""
    order = np.argsort(px[:, 1])
    cut = px.copy()
    for k in order[:2]:
        neighbour = min(((k + 1) % 4, (k - 1) % 4), key=lambda n: -px[n, 1])
        cut[k] += share * (px[neighbour] - px[k])
    return cut


def _detection(
    kind: str, px: FloatArray, covariance: FloatArray, inside: BoolArray, lens: CameraInfo
) -> MarkingDetection:
    full = np.zeros((8, 8))
    for k in range(4):
        full[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = covariance[k]
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    size = np.array([lens.width, lens.height])
    clear = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all(axis=1)
    return MarkingDetection(kind, 0.95, px, full, inside & clear & (sigma <= _POINT_PX))


def _false(
    world: World, camera: str, frame: int, cam_from_map: Pose, rng: np.random.Generator
) -> MarkingDetection | None:
    """A quadrilateral on bare ground, where the camera's region of interest is."""
    roi = world.cameras[camera].roi_vehicle
    spot = rng.dirichlet(np.ones(len(roi))) @ roi
    length_m, width_m = rng.uniform(0.6, 2.0), rng.uniform(0.15, 0.8)
    turn = rng.uniform(-np.pi, np.pi)
    quad = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length_m, width_m)
    quad = quad @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + spot
    points = apply(world.map_from_vehicle[frame], np.column_stack([quad, np.zeros(4)]))
    projected = project(world.lenses[camera], cam_from_map, points[None])
    if not projected.inside.all():
        return None
    kind = str(rng.choice([DIAMOND, LANE_DASH, STOP_LINE]))
    sigma = 2.0 * world.recipe.detector.sigma_px
    px = projected.px[0] + rng.normal(0.0, sigma, (4, 2))
    covariance = np.tile(sigma**2 * np.eye(2), (4, 1, 1))
    return _detection(kind, px, covariance, projected.inside[0], world.lenses[camera])
