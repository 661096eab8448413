"""Detected lane paint as a cloud of directed ground points, and nodes on its ridges.

Seeds over the cloud move across their line onto the local regression line of the points around them: a mean
shift in one dimension, as every point has a direction and points of crossing or parallel lines are excluded.
They are then thinned to single nodes, half a metre apart. Two lines of a double line are told apart by the
images that show both at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.association.ground import ground_points, ground_points_with_jacobian
from v2hdm.association.sightings import LEAST_HEIGHT_M, Rig, frames_of, row_shares
from v2hdm.geometry.ipm import direction_covariance, facing_ipm, flat_motion, ground_from_pinhole_px
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.planar import cross, turned_left
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    LANE_BOUNDARY,
    LANE_DASH,
    BoolArray,
    Drive,
    FloatArray,
    ImageDetections,
    IntArray,
    LaneDetection,
)
from v2hdm.site.composed import APART_M
from v2hdm.surface.surface import Surface

NODE_SPACING_M = 0.5  # distance, m, between the vertices of a polyline
HALF_WIDTH_M = 0.3  # half width, m, across its line of the neighbourhood that is averaged
_HALF_LENGTH_M = 0.8  # half length, m, along its line of the neighbourhood that is averaged

CENTRE_SIGMA_PX = 1.0  # noise of a detected centre across its line: a cell of the network's output
OWN_SIGMA_M = 0.01  # sigma, m, besides pixel noise: the nearest image must not outvote all others

_TANGENT_REACH = 2  # points to either side whose difference gives the direction
_GUIDE_RANGE = 1.8  # range of whole lines relative to paint's: they only show what is one line


@dataclass(frozen=True)
class Guides:
    """Whole lines of single images, gaps included: points (G, 2), m, line and image indices."""

    points_map: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    line: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    image_of_line: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


@dataclass(frozen=True)
class LaneCloud:
    """P points on lane paint."""

    points_map: FloatArray  # (P, 2) m
    tangent: FloatArray  # (P, 2) unit, of either sign
    weight: FloatArray  # (P,) 1 / variance across the line, 1 / m^2
    image: IntArray  # (P,) image index
    dash: BoolArray  # (P,) whether detected as a dash
    guides: Guides = field(default_factory=Guides)
    row_share: FloatArray = field(default_factory=lambda: np.zeros(0))  # (P,) of their pixels
    # (P,) distance, m, of a parallel line that the same image shows beside the point, nan for none; empty for
    # none at all
    beside_m: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class ImageGround:
    """Ground mapping of each image of a drive; nan for unused cameras."""

    map_from_pinhole_px: FloatArray  # (I, 3, 3)
    centre_map: FloatArray  # (I, 3) of the camera
    moved_map: FloatArray | None = None  # (I, 2, 3) from (x, y, 1) to its motion during read-out
    # moves pinhole px (P, 2) of images (P,) to those of the plane z = 0
    flattened_px: Callable[[IntArray, FloatArray], FloatArray] = lambda image, points_px: points_px

    @classmethod
    def of_images(
        cls, count: int, rows: IntArray, homographies: FloatArray, extrinsic: FloatArray, poses: FloatArray
    ) -> ImageGround:
        """The mapping of the images ``rows``, of ``count``."""
        ground = cls(np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan))
        centre = (poses[:, :3, :3] @ camera_centre(extrinsic)[..., None])[..., 0] + poses[:, :3, 3]
        ground.map_from_pinhole_px[rows] = homographies
        ground.centre_map[rows] = centre
        return ground

    def rolling(
        self, rows: IntArray, camera: IntArray, frame: IntArray, poses: FloatArray, rig: Rig
    ) -> ImageGround:
        """With the images ``rows`` read out row by row as in ``rig``, from vehicle ``poses``."""
        if rig.read_out_s is None or rig.twist_vehicle is None:
            return self
        moved = rig.twist_vehicle[frame] * rig.read_out_s[camera, None]
        moved_map = np.zeros((len(self.centre_map), 2, 3))
        turn = moved[:, 5, None, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
        moved_map[rows, :, :2] = turn
        moved_map[rows, :, 2] = (poses[:, :2, :2] @ moved[:, :2, None] - turn @ poses[:, :2, 3:])[..., 0]
        return replace(self, moved_map=moved_map)

    def at_rows(self, points_map: FloatArray, image: IntArray, row_share: FloatArray) -> FloatArray:
        """Points (..., 2) of images (...) under the poses at their rows' read-out, to first order."""
        if self.moved_map is None:
            return points_map
        motion = self.moved_map[image]
        moved = (motion[..., :2] @ points_map[..., None])[..., 0] + motion[..., 2]
        return np.asarray(points_map + row_share[..., None] * moved)


def ground_by_ipm(
    drive: Drive, ipm: Mapping[str, FloatArray], cam_from_vehicle: Mapping[str, FloatArray], rig: Rig
) -> ImageGround:
    """From an IPM per camera and the recorded poses; read-out times and twists are ``rig``'s."""
    rows, camera = _rows(drive, list(ipm))
    poses = np.stack([drive.images[i].map_from_vehicle for i in rows])
    forward = [facing_ipm(ipm[name], drive.cameras[name].roi_vehicle.mean(axis=0)) for name in ipm]
    extrinsic = np.stack([cam_from_vehicle[name] for name in ipm])[camera]
    homographies = flat_motion(poses) @ np.stack(forward)[camera]
    ground = ImageGround.of_images(len(drive.images), rows, homographies, extrinsic, poses)
    return ground.rolling(rows, camera, frames_of(drive).frame_of_image[rows], poses, rig)


def ground_by_rig(
    drive: Drive, cameras: Sequence[str], rig: Rig, surface: Surface | None = None
) -> ImageGround:
    """From optimised extrinsics and the adjusted pose of each frame; ``rig`` is over ``cameras``."""
    rows, camera = _rows(drive, cameras)
    frame = frames_of(drive).frame_of_image[rows]
    poses = rig.map_from_vehicle[frame]
    extrinsic = rig.cam_from_vehicle[camera]
    homographies = ground_from_pinhole_px(rig.intrinsic[camera], extrinsic @ np.linalg.inv(poses))
    ground = ImageGround.of_images(len(drive.images), rows, homographies, extrinsic, poses)
    ground = ground.rolling(rows, camera, frame, poses, rig)
    if surface is None:
        return ground
    of_image = np.full(len(drive.images), -1)
    frame_of_image = frames_of(drive).frame_of_image
    of_image[rows] = camera

    def flattened_px(image: IntArray, points_px: FloatArray) -> FloatArray:
        camera = of_image[image]
        frame = frame_of_image[image]
        cam_from_map = rig.cam_from_map(camera, frame)
        return surface.flattened_px(rig.intrinsic[camera], cam_from_map, frame, points_px)

    return replace(ground, flattened_px=flattened_px)


def collect_lane_points(
    drive: Drive,
    detections: Sequence[ImageDetections],
    ground: ImageGround,
    max_range_m: float,
    jitter_rad: float,
) -> LaneCloud:
    """Back-project lane detections up to ``max_range_m``, weighted by pixel noise and direction jitter."""
    guides = _guides(drive, detections, ground, _GUIDE_RANGE * max_range_m)
    lanes = _lanes(detections, ground, whole=False)
    if not lanes:
        return LaneCloud(
            points_map=np.zeros((0, 2)),
            tangent=np.zeros((0, 2)),
            weight=np.zeros(0),
            image=np.zeros(0, int),
            dash=np.zeros(0, bool),
            guides=guides,
        )
    points = _points(drive, lanes)
    piece = points.lane
    image = points.image
    points_px = ground.flattened_px(image, points.pinhole_px)
    homographies = ground.map_from_pinhole_px[image]
    points_map, jacobian = ground_points_with_jacobian(homographies, points_px[:, None])
    points_map = ground.at_rows(points_map[:, 0], image, points.row_share)
    jacobian = jacobian[:, 0]
    tangent = _tangents(points_map, piece)
    centre = ground.centre_map[image]
    ray = points_map - centre[:, :2]
    covariance = CENTRE_SIGMA_PX**2 * jacobian @ np.swapaxes(jacobian, 1, 2)
    covariance += direction_covariance(ray, np.maximum(centre[:, 2], LEAST_HEIGHT_M), jitter_rad)
    normal = turned_left(tangent)
    variance = np.einsum("pi,pij,pj->p", normal, covariance, normal)
    with np.errstate(invalid="ignore"):
        is_usable = (np.linalg.norm(ray, axis=1) <= max_range_m) & np.isfinite(tangent).all(axis=1)
        is_usable &= np.isfinite(variance)
    beside_m = distance_beside_m(
        points_map[is_usable], tangent[is_usable], image[is_usable], piece[is_usable]
    )
    dash = np.array([lane.kind == LANE_DASH for _, lane in lanes])[piece]
    return LaneCloud(
        points_map=points_map[is_usable],
        tangent=tangent[is_usable],
        weight=1.0 / (variance[is_usable] + OWN_SIGMA_M**2),
        image=image[is_usable],
        dash=dash[is_usable],
        guides=guides,
        row_share=points.row_share[is_usable],
        beside_m=beside_m,
    )


def distance_beside_m(
    points_map: FloatArray, tangent: FloatArray, image: IntArray, piece: IntArray
) -> FloatArray:
    """Distances (P,), m, to the nearest other piece that runs beside a point in its image, nan for none.

    Pieces nearer than the two lines of a double line are readings of the same paint.
    """
    reach_m = float(np.hypot(NODE_SPACING_M, APART_M[1]))
    apart_by_image = np.column_stack([points_map, 2.0 * reach_m * image])
    pairs = cKDTree(apart_by_image).query_pairs(reach_m, output_type="ndarray")
    point, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    offset = points_map[other] - points_map[point]
    along_m = np.abs(np.einsum("pi,pi->p", offset, tangent[point]))
    across_m = np.abs(cross(tangent[point], offset))
    cosine = np.abs(np.einsum("pi,pi->p", tangent[point], tangent[other]))
    is_beside = (piece[point] != piece[other]) & (along_m <= NODE_SPACING_M) & (cosine >= SAME_DIRECTION)
    is_beside &= (across_m >= APART_M[0]) & (across_m <= APART_M[1])
    beside_m = np.full(len(points_map), np.nan)
    np.fmin.at(beside_m, point[is_beside], across_m[is_beside])
    return beside_m


def _lanes(
    detections: Sequence[ImageDetections], ground: ImageGround, whole: bool
) -> list[tuple[int, LaneDetection]]:
    """Images and lane detections, ``whole`` lines or pieces, of the images that ``ground`` covers."""
    covered = np.isfinite(ground.centre_map[:, 0])
    return [
        (detected.image, lane)
        for detected in detections
        if covered[detected.image]
        for lane in detected.lanes
        if (lane.kind == LANE_BOUNDARY) == whole and (whole or len(lane.points_px) >= 2)
    ]


class _Points(NamedTuple):
    """P points of lane detections."""

    lane: IntArray  # (P,) index of the detection
    image: IntArray  # (P,) image index
    pinhole_px: FloatArray  # (P, 2)
    row_share: FloatArray  # (P,) read-out time of the rows, see :func:`row_shares`


def _points(drive: Drive, lanes: Sequence[tuple[int, LaneDetection]]) -> _Points:
    """All points of ``lanes``, images and detections, without lens distortion."""
    of_lane = np.repeat(np.arange(len(lanes)), [len(lane.points_px) for _, lane in lanes])
    image = np.array([i for i, _ in lanes], dtype=np.int64)[of_lane]
    camera = np.array([image_of_drive.camera for image_of_drive in drive.images])[image]
    points_px = np.concatenate([lane.points_px for _, lane in lanes]).astype(np.float64)
    row_share = np.zeros(len(points_px))
    for name in np.unique(camera):
        is_of_camera = camera == name
        info = drive.cameras[str(name)].info
        row_share[is_of_camera] = row_shares(info, points_px[is_of_camera])
        points_px[is_of_camera] = undistort_points(info, points_px[is_of_camera])
    return _Points(of_lane, image, points_px, row_share)


def _guides(
    drive: Drive, detections: Sequence[ImageDetections], ground: ImageGround, max_range_m: float
) -> Guides:
    """Whole lines of the images that ``ground`` covers, up to ``max_range_m``."""
    lanes = _lanes(detections, ground, whole=True)
    if not lanes:
        return Guides()
    points = _points(drive, lanes)
    image = points.image
    points_px = ground.flattened_px(image, points.pinhole_px)
    points_map = ground_points(ground.map_from_pinhole_px[image], points_px[:, None])[:, 0]
    points_map = ground.at_rows(points_map, image, points.row_share)
    with np.errstate(invalid="ignore"):
        in_reach = np.linalg.norm(points_map - ground.centre_map[image, :2], axis=1) <= max_range_m
    return Guides(
        points_map[in_reach], points.lane[in_reach], np.array([i for i, _ in lanes], dtype=np.int64)
    )


def _rows(drive: Drive, cameras: Sequence[str]) -> tuple[IntArray, IntArray]:
    """The images of ``cameras``, and the camera index of each."""
    index = {name: c for c, name in enumerate(cameras)}
    rows = [(i, index[image.camera]) for i, image in enumerate(drive.images) if image.camera in index]
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


def _tangents(points: FloatArray, piece: IntArray) -> FloatArray:
    """Unit direction (P, 2) at each point of its piece, from points up to two places away."""
    length = np.bincount(piece)
    first = (np.cumsum(length) - length)[piece]
    last = first + length[piece] - 1
    row = np.arange(len(points))
    difference = (
        points[np.minimum(row + _TANGENT_REACH, last)] - points[np.maximum(row - _TANGENT_REACH, first)]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(difference / np.linalg.norm(difference, axis=1, keepdims=True))


_SEED_CELL_M = 0.25  # side of the cells with one seed each, m
_DIRECTION_BINS = 8  # directions distinguished within a cell, over half a circle
SAME_DIRECTION = np.cos(np.deg2rad(20.0))  # least cosine of directions within one line; crossing ones differ
_ITERATIONS = 4  # mean shifts of each seed
_KERNEL_SIGMA_M = HALF_WIDTH_M / 2  # sigma, m, across a line of the weights of points around a seed
_BESIDE_SIGMAS = 4.0  # sigmas of these weights at which the other line of two lies, at least
_SHOW_BOTH = 0.25  # least share of a place's images that must show two lines: far ones see them as one
_THIN_SPACINGS = 0.7  # radius, in spacings, in which the best supported node suppresses others of its line


@dataclass(frozen=True)
class Nodes:
    """N points on the ridges."""

    points_map: FloatArray  # (N, 2)
    tangent: FloatArray  # (N, 2) unit, of either sign
    images: IntArray  # (N,) number of supporting images
    dash: FloatArray  # (N,) fraction of its points from dashes

    def subset(self, rows: BoolArray) -> Nodes:
        """The nodes at ``rows`` (N,)."""
        return Nodes(**{name: values[rows] for name, values in vars(self).items()})


def find_nodes(cloud: LaneCloud, least_images: int) -> Nodes:
    """Nodes on the ridges of ``cloud`` in at least ``least_images``, about :data:`NODE_SPACING_M` apart."""
    seeds = _seeds(cloud)
    points = cloud.points_map[seeds]
    tangent = cloud.tangent[seeds]
    # Pairs of seeds and points that can be neighbours in any iteration.
    reach_m = float(np.hypot(_HALF_LENGTH_M, 2 * HALF_WIDTH_M))
    distances = cKDTree(points).sparse_distance_matrix(
        cKDTree(cloud.points_map), reach_m, output_type="ndarray"
    )
    pairs = _Pairs(distances["i"].astype(np.int64), distances["j"].astype(np.int64))
    sigma_m = _kernel_sigma_m(points, tangent, cloud, pairs, least_images)
    for _ in range(_ITERATIONS):
        points, tangent = _shift(points, tangent, cloud, pairs, sigma_m)
    neighbours = _near(points, tangent, cloud, pairs, (NODE_SPACING_M, 0.5 * HALF_WIDTH_M))
    images = _images_of(neighbours.seed, cloud.image[neighbours.point], len(points))
    total = np.bincount(neighbours.seed, minlength=len(points))
    dashes = np.bincount(neighbours.seed, cloud.dash[neighbours.point].astype(float), len(points))
    dash = dashes / np.maximum(total, 1)
    supported = np.flatnonzero(images >= least_images)
    chosen = supported[_thin(points[supported], tangent[supported], images[supported])]
    return Nodes(points[chosen], tangent[chosen], images[chosen], dash[chosen])


def _seeds(cloud: LaneCloud) -> IntArray:
    """The first point in each cell of position and direction, ascending by cell."""
    angle = np.mod(np.arctan2(cloud.tangent[:, 1], cloud.tangent[:, 0]), np.pi)
    place = np.floor(cloud.points_map / _SEED_CELL_M).astype(np.int64)
    east, north = (place - place.min(axis=0)).T
    direction = np.floor(angle / np.pi * _DIRECTION_BINS).astype(np.int64)
    # One number for each cell: rows of three sort several times slower.
    cell = (east * (north.max() + 1) + north) * (_DIRECTION_BINS + 1) + direction
    return np.asarray(np.unique(cell, return_index=True)[1], dtype=np.int64)


def _images_of(seed: IntArray, image: IntArray, count: int) -> IntArray:
    """Number of different images (N,) that pairs of a seed and an image (K,) name for each of N seeds."""
    numbers = int(image.max(initial=0)) + 1
    return np.bincount(np.unique(seed * numbers + image) // numbers, minlength=count)


class _Pairs(NamedTuple):
    """K pairs of a seed and a point of the cloud that may be neighbours."""

    seed: IntArray  # (K,)
    point: IntArray  # (K,)


class _Near(NamedTuple):
    """The points that lie beside their seeds and run along them, of K pairs."""

    seed: IntArray  # (K,)
    point: IntArray  # (K,)
    along_m: FloatArray  # (K,) coordinate along the seed's line
    across_m: FloatArray  # (K,) coordinate to the left of it


def _near(
    points: FloatArray, tangent: FloatArray, cloud: LaneCloud, pairs: _Pairs, reach_m: tuple[float, float]
) -> _Near:
    """The points of ``pairs`` within ``reach_m``, along and across, of the lines through seeds.

    The seeds are at ``points`` (N, 2), and their lines run along ``tangent`` (N, 2).
    """
    seed, point = pairs
    along_seed = _complex(tangent).conj()
    turned = (_complex(cloud.points_map)[point] - _complex(points)[seed]) * along_seed[seed]
    beside = np.flatnonzero((np.abs(turned.real) <= reach_m[0]) & (np.abs(turned.imag) <= reach_m[1]))
    seed = seed[beside]
    point = point[beside]
    cosine = np.abs((_complex(cloud.tangent)[point] * along_seed[seed]).real)
    is_along = cosine >= SAME_DIRECTION
    offset = turned[beside[is_along]]
    return _Near(seed[is_along], point[is_along], offset.real.copy(), offset.imag.copy())


def _complex(vectors: FloatArray) -> NDArray[np.complex128]:
    """Vectors (N, 2) as complex numbers (N,): one is gathered, and turned, faster than two coordinates."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def _kernel_sigma_m(
    points: FloatArray, tangent: FloatArray, cloud: LaneCloud, pairs: _Pairs, least_images: int
) -> FloatArray:
    """Sigmas (N,), m, across their lines of the weights about seeds: less where images show two lines."""
    count = len(points)
    usual_m = np.full(count, _KERNEL_SIGMA_M)
    if not len(cloud.beside_m):
        return usual_m
    neighbours = _near(points, tangent, cloud, pairs, (_HALF_LENGTH_M, HALF_WIDTH_M))
    image = cloud.image[neighbours.point]
    beside_m = cloud.beside_m[neighbours.point]
    shows_both = np.isfinite(beside_m)
    of_both = neighbours.seed[shows_both]
    double_count = _images_of(of_both, image[shows_both], count)
    image_count = _images_of(neighbours.seed, image, count)
    is_double = (double_count >= max(least_images, 1)) & (double_count >= _SHOW_BOTH * image_count)
    total_m = np.bincount(of_both, beside_m[shows_both], count)
    mean_m = total_m / np.maximum(np.bincount(of_both, minlength=count), 1)
    return np.where(is_double, np.minimum(usual_m, mean_m / _BESIDE_SIGMAS), usual_m)


def _shift(
    points: FloatArray, tangent: FloatArray, cloud: LaneCloud, pairs: _Pairs, sigma_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Move each seed across its line onto the regression line of its neighbourhood, weighted by ``sigma_m``.

    ``sigma_m`` (N,) is that of the weights across the line.
    """
    seed, point, x, y = _near(points, tangent, cloud, pairs, (_HALF_LENGTH_M, HALF_WIDTH_M))
    # Gaussian across, so that the nearer of two lines wins.
    across = y / sigma_m[seed]
    kernel = np.exp(-0.5 * across**2) * (1 - (x / _HALF_LENGTH_M) ** 2)
    weight = cloud.weight[point] * kernel
    count = len(points)

    def total(value: FloatArray) -> FloatArray:
        return np.bincount(seed, weights=value, minlength=count).astype(np.float64)

    w, wx, wy, wxx, wxy = (total(weight * v) for v in (np.ones_like(x), x, y, x * x, x * y))
    safe = np.maximum(w, 1e-12)
    # A little regularisation keeps the direction if all neighbours coincide.
    spread = wxx - wx**2 / safe + 1e-3 * safe
    slope = np.clip((wxy - wx * wy / safe) / np.maximum(spread, 1e-12), -0.5, 0.5)
    offset = np.clip((wy - slope * wx) / safe, -HALF_WIDTH_M, HALF_WIDTH_M)
    normal = turned_left(tangent)
    turned = tangent + slope[:, None] * normal
    return points + offset[:, None] * normal, turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _thin(points: FloatArray, tangent: FloatArray, images: IntArray) -> IntArray:
    """Indices of the best supported nodes, at least 0.7 of the spacing apart along and beside a line."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    pairs = cKDTree(points).query_pairs(_THIN_SPACINGS * NODE_SPACING_M, output_type="ndarray")
    node, neighbour = np.concatenate([pairs, pairs[:, ::-1]]).T
    across_m = cross(tangent[node], points[neighbour] - points[node])
    same = np.abs(np.einsum("pi,pi->p", tangent[node], tangent[neighbour])) >= SAME_DIRECTION
    same &= np.abs(across_m) <= 0.5 * HALF_WIDTH_M
    node = node[same]
    order = np.argsort(node, kind="stable")
    ends = np.searchsorted(node[order], np.arange(1, len(points)))
    neighbours = np.split(neighbour[same][order], ends)
    alive = np.ones(len(points), dtype=bool)
    chosen = []
    for number in np.argsort(-images, kind="stable").tolist():
        if alive[number]:
            chosen.append(number)
            alive[neighbours[number]] = False
    return np.array(chosen, dtype=np.int64)
