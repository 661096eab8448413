"""The outline of a piece of paint as a polygon, and moved to where the image shows an edge."""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.detection.quads.blobs import Blob
from v2hdm.geometry.planar import signed_area
from v2hdm.records import BoolArray, FloatArray

_FINER = 4  # how many times as fine as the network's output an outline is drawn
_EDGE_SIGMA_PX = 2.0  # sigma, px, of the Gaussian weight of an edge at a distance from the outline
_REACH_PX = 6.0  # distance to either side of an outline, px, to which an edge is looked for
_STEP_PX = 0.5  # distance between the places, px, at which an edge is looked for
_EDGE_PX = 2.0  # half the width of an edge in the image, px: its blur
_BESIDE = 4  # points of an outline, px apart, to each side that its direction and its light are taken from

_LEAST_CONTRAST = 0.25
"""Share of an outline's median contrast that there is at an edge.

Beside paint that is half worn there is half of it, where paint runs on there is none.
"""


def outline_polygon(blob: Blob) -> FloatArray:
    """The soft outline as a closed polygon (N, 2) in recorded px, to a fifth of an element."""
    size = (blob.level.shape[1] * _FINER, blob.level.shape[0] * _FINER)
    fine = cv2.resize(blob.level, size, interpolation=cv2.INTER_LINEAR)
    if np.count_nonzero(fine > 0) < _FINER**2:  # hardly paint, and none between the cells' centres
        fine = cv2.resize(blob.level, size, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours((fine > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len)
    polygon = cv2.approxPolyDP(longest, 0.2 * _FINER, closed=True).reshape(-1, 2)
    cells = (polygon + 0.5) / _FINER - 0.5
    return np.asarray(blob.origin_px + blob.stride * cells)


def on_edges(outline_px: FloatArray, bgr: np.ndarray) -> tuple[FloatArray, BoolArray]:
    """An outline (N, 2), recorded px, of bright paint, moved to where the light falls fastest nearby.

    Returns:
        The outline (M, 2), and which of its sides (M,), each from its point to the next, lie along an edge:
        none does where other paint or the image's border cuts the paint.
    """
    points = _evenly(outline_px)
    ahead = np.roll(points, -_BESIDE, axis=0) - np.roll(points, _BESIDE, axis=0)
    outward = ahead @ [[0.0, -1.0], [1.0, 0.0]] * np.sign(signed_area(points))
    outward /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    off_px = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    x, y = np.moveaxis((points[:, None] + off_px[:, None] * outward[:, None]).astype(np.float32), 2, 0)
    light = cv2.remap(bgr, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).mean(axis=2)
    light = _with_neighbours(light).mean(axis=0)
    fall = np.maximum(-np.gradient(light, axis=1), 0.0)
    best = (fall**2 * np.exp(-0.5 * (off_px / _EDGE_SIGMA_PX) ** 2)).argmax(axis=1)
    from_edge_px = np.abs(off_px - off_px[best][:, None])
    fall = np.where(from_edge_px <= 2 * _STEP_PX, fall, 0.0)
    moved_px = fall @ off_px / np.maximum(fall.sum(axis=1), 1e-6)
    moved = points + np.median(_with_neighbours(moved_px), axis=0)[:, None] * outward
    # The ratio of the paint's light to the ground's is that of both materials, in the sun and in shadows.
    ratio = (-np.gradient(np.log(light + 1.0), axis=1) * (from_edge_px <= _EDGE_PX)).sum(axis=1)
    usual = np.median(_with_neighbours(ratio, round(_REACH_PX)), axis=0)
    is_edge = usual > _LEAST_CONTRAST * np.median(ratio)
    moved = moved.astype(np.float32)
    polygon = cv2.approxPolyDP(moved, _STEP_PX / 2, closed=True)[:, 0]
    corners = np.flatnonzero((moved[:, None] == polygon).all(axis=2).any(axis=1))
    first = int(corners[0])
    side_length = np.diff(corners, append=first + len(is_edge))
    edge_share = np.add.reduceat(np.roll(is_edge, -first), corners - first) / side_length
    return moved[corners].astype(np.float64), edge_share > 0.5


def _evenly(outline_px: FloatArray) -> FloatArray:
    """Points (P, 2) about a pixel apart along a closed outline (N, 2)."""
    ring = np.vstack([outline_px, outline_px[:1]])
    length_px = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    along_px = np.linspace(0.0, length_px[-1], max(round(float(length_px[-1])), 3), endpoint=False)
    return np.column_stack([np.interp(along_px, length_px, axis) for axis in ring.T])


def _with_neighbours(values: np.ndarray, reach: int = _BESIDE - 1) -> np.ndarray:
    """Values (N, ...) along a closed outline, and those beside them, (K, N, ...)."""
    return np.stack([np.roll(values, k, axis=0) for k in range(-reach, reach + 1)])
