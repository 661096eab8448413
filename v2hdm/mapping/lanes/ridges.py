"""The centre lines of a cloud of lane points: nodes on its ridges, half a metre apart.

Seeds spread over the cloud are moved across their line onto the local regression line of the points
around them, a mean shift that is one-dimensional because every point carries its direction; points
of a crossing or a parallel line take no part. What is left is thinned to single nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.mapping.lanes.points import LaneCloud
from v2hdm.mapping.options import LaneOptions
from v2hdm.records import FloatArray, IntArray

_SEED_CELL_M = 0.25
_DIRECTION_BINS = 8
_SAME_DIRECTION = np.cos(np.deg2rad(20.0))
_ITERATIONS = 4


@dataclass(frozen=True)
class Nodes:
    """N points on the ridges.

    ``points_map`` (N, 2), unit ``tangent`` (N, 2) of either sense, ``images`` (N,) that support a
    node and ``dash`` (N,), the share of its points that were seen as a dash.
    """

    points_map: FloatArray
    tangent: FloatArray
    images: IntArray
    dash: FloatArray


def find_nodes(cloud: LaneCloud, options: LaneOptions) -> Nodes:
    """Nodes on the ridges of ``cloud``, about ``options.node_spacing_m`` apart."""
    seeds = _seeds(cloud)
    points, tangent = cloud.points_map[seeds].copy(), cloud.tangent[seeds].copy()
    pairs = _neighbours(points, cloud, options)
    for _ in range(_ITERATIONS):
        points, tangent = _shift(points, tangent, cloud, pairs, options)
    images, dash = _support(points, tangent, cloud, pairs, options)
    supported = np.flatnonzero(images >= options.min_images)
    kept = supported[_thin(points[supported], tangent[supported], images[supported], options)]
    return Nodes(points[kept], tangent[kept], images[kept], dash[kept])


def _seeds(cloud: LaneCloud) -> IntArray:
    """One point of the cloud per cell of position and direction."""
    angle = np.mod(np.arctan2(cloud.tangent[:, 1], cloud.tangent[:, 0]), np.pi)
    cell = np.column_stack(
        [np.floor(cloud.points_map / _SEED_CELL_M), np.floor(angle / np.pi * _DIRECTION_BINS)]
    )
    _, first = np.unique(cell.astype(np.int64), axis=0, return_index=True)
    return np.asarray(first)


def _neighbours(points: FloatArray, cloud: LaneCloud, options: LaneOptions) -> tuple[IntArray, IntArray]:
    """Pairs (seed, point of the cloud) that may ever lie in a seed's neighbourhood."""
    reach_m = float(np.hypot(options.half_length_m, 2 * options.half_width_m))
    near = cKDTree(points).sparse_distance_matrix(cKDTree(cloud.points_map), reach_m, output_type="ndarray")
    return near["i"].astype(np.int64), near["j"].astype(np.int64)


def _coordinates(
    points: FloatArray, tangent: FloatArray, cloud: LaneCloud, pairs: tuple[IntArray, IntArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each pair: position of the point along and across the seed's line, cosine of directions."""
    seed, point = pairs
    offset = cloud.points_map[point] - points[seed]
    along = np.einsum("pi,pi->p", offset, tangent[seed])
    across = offset[:, 1] * tangent[seed, 0] - offset[:, 0] * tangent[seed, 1]
    cosine = np.abs(np.einsum("pi,pi->p", cloud.tangent[point], tangent[seed]))
    return along, across, cosine


def _shift(
    points: FloatArray,
    tangent: FloatArray,
    cloud: LaneCloud,
    pairs: tuple[IntArray, IntArray],
    options: LaneOptions,
) -> tuple[FloatArray, FloatArray]:
    """Move each seed across its line onto the weighted regression line of its neighbourhood."""
    along, across, cosine = _coordinates(points, tangent, cloud, pairs)
    near = (np.abs(along) <= options.half_length_m) & (np.abs(across) <= options.half_width_m)
    near &= cosine >= _SAME_DIRECTION
    x, y = along[near], across[near]
    # Gaussian across, so that of two lines within reach the nearer one wins.
    kernel = np.exp(-0.5 * (2.0 * y / options.half_width_m) ** 2) * (1 - (x / options.half_length_m) ** 2)
    weight = cloud.weight[pairs[1][near]] * kernel
    count = len(points)

    def total(value: FloatArray) -> FloatArray:
        return np.bincount(pairs[0][near], weights=value, minlength=count).astype(np.float64)

    w, wx, wy, wxx, wxy = (total(weight * v) for v in (np.ones_like(x), x, y, x * x, x * y))
    safe = np.maximum(w, 1e-12)
    # A little stiffness keeps the direction where all neighbours lie at one place.
    spread = wxx - wx**2 / safe + 1e-3 * safe
    slope = np.clip((wxy - wx * wy / safe) / np.maximum(spread, 1e-12), -0.5, 0.5)
    offset = np.clip((wy - slope * wx) / safe, -options.half_width_m, options.half_width_m)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    turned = tangent + slope[:, None] * normal
    return points + offset[:, None] * normal, turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _support(
    points: FloatArray,
    tangent: FloatArray,
    cloud: LaneCloud,
    pairs: tuple[IntArray, IntArray],
    options: LaneOptions,
) -> tuple[IntArray, FloatArray]:
    """Distinct images (N,) around each node, and the share (N,) of points seen as a dash."""
    along, across, cosine = _coordinates(points, tangent, cloud, pairs)
    near = (np.abs(along) <= options.node_spacing_m) & (np.abs(across) <= 0.5 * options.half_width_m)
    near &= cosine >= _SAME_DIRECTION
    seed, point = pairs[0][near], pairs[1][near]
    key = np.unique(seed * (int(cloud.image.max(initial=0)) + 1) + cloud.image[point])
    images = np.bincount(key // (int(cloud.image.max(initial=0)) + 1), minlength=len(points))
    total = np.maximum(np.bincount(seed, minlength=len(points)), 1)
    dash = np.bincount(seed, weights=cloud.dash[point].astype(float), minlength=len(points)) / total
    return images.astype(np.int64), dash


def _thin(points: FloatArray, tangent: FloatArray, images: IntArray, options: LaneOptions) -> IntArray:
    """Indices of nodes such that no two of one line are closer than 0.7 of the spacing.

    The best supported node stays and suppresses those around it along its line, and those beside it
    within half the neighbourhood's width, which are the same line.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    reach_m = 0.7 * options.node_spacing_m
    near = cKDTree(points).query_ball_point(points, reach_m)
    alive = np.ones(len(points), dtype=bool)
    kept = []
    for node in np.argsort(-images, kind="stable").tolist():
        if not alive[node]:
            continue
        kept.append(node)
        others = np.array(near[node])
        offset = points[others] - points[node]
        across = offset[:, 1] * tangent[node, 0] - offset[:, 0] * tangent[node, 1]
        same = np.abs(tangent[others] @ tangent[node]) >= _SAME_DIRECTION
        alive[others[same & (np.abs(across) <= 0.5 * options.half_width_m)]] = False
    return np.array(kept, dtype=np.int64)
