"""Lanes: the centre lines of lane paint, fused from all images into polylines."""

from __future__ import annotations

import numpy as np

from v2hdm.mapping.lanes.bridges import bridge_paths
from v2hdm.mapping.lanes.paths import Path, join_paths, string_nodes
from v2hdm.mapping.lanes.points import LaneCloud
from v2hdm.mapping.lanes.ridges import find_nodes
from v2hdm.mapping.options import LaneOptions
from v2hdm.records import LANE_DASH, LANE_LINE, FloatArray, Lane

_LEAST_LENGTH_M = 6.0
"""Length, m, at which a lane that just enough images saw is one; a shorter one must be seen more often."""


def map_lanes(cloud: LaneCloud, options: LaneOptions) -> tuple[Lane, ...]:
    """Polylines along the lane paint of ``cloud``, vertices ``options.node_spacing_m`` apart.

    Dashes of one line become one lane of kind ``lane_dash`` that runs on across their gaps.
    """
    if len(cloud.points_map) < 2:
        return ()
    paths = join_paths(string_nodes(find_nodes(cloud, options), options), options)
    paths = bridge_paths(paths, cloud.guides, options)
    return tuple(_lane(path, options) for path in paths if _is_seen_enough(path, options))


def _is_seen_enough(path: Path, options: LaneOptions) -> bool:
    """Whether a path is long enough, and a short one seen often enough."""
    image_metres = path.length_m * path.images
    return path.length_m >= options.min_length_m and image_metres >= _LEAST_LENGTH_M * options.min_images


def _lane(path: Path, options: LaneOptions) -> Lane:
    kind = LANE_DASH if path.dash > 0.5 else LANE_LINE
    points = _resample(_smooth(path.points_map), options.node_spacing_m)
    return Lane(kind, points, round(path.images))


def _smooth(points: FloatArray) -> FloatArray:
    """Binomial smoothing of the inner vertices: takes out the nodes' own lateral noise."""
    out = points.copy()
    out[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
    return out


def _resample(points: FloatArray, spacing_m: float) -> FloatArray:
    """Vertices at equal steps of about ``spacing_m`` along a polyline, both ends kept."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], max(round(float(along[-1]) / spacing_m), 1) + 1)
    return np.column_stack([np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])])
