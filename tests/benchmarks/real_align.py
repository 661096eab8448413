"""Move the camera of an image until what is drawn of a road lies on its paint.

The pose of a map is a few centimetres and tenths of a degree off in single images: some pixels at 15 m. The
edges of the drawn polygons are looked for along their normals in the image, as in model-based tracking
(Drummond and Cipolla, PAMI 2002), and the camera takes the small motion that brings them there. A prior holds
what they leave open: a single line of dashes tells neither roll, nor a shift sideways from a turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tests.benchmarks.real_view import View
from v2hdm.records import FloatArray

MAX_RANGE_M = 22.0
"""Farther paint is a pixel or two high: its blur, not its edges, would place it."""

_EVERY_M = 0.1
_BORDER_PX = 6.0
_REACHES_PX = (10.0, 6.0, 4.0, 3.0, 2.0, 2.0)
"""How far from where it should be an edge is looked for, step by step."""

_STEP_PX = 0.25
_LEAST_FALL = 6.0
"""Grey levels of 255 over two pixels: less is texture and noise."""

_LEAST_EDGES = 30
_EDGE_SIGMA_PX = 0.25
_ALIKE = 10.0
"""Neighbouring edges err together: so many of them count as one."""

_SIGMA = np.array([*np.radians([0.3, 0.3, 0.3]), 0.05, 0.02, 0.05])
"""Prior of the motion: a turn about the camera's axes (right, down, forward), then a shift along them, m."""


@dataclass(frozen=True)
class Edges:
    """Places (N, 2) m on the outlines of what is drawn, and the directions (N, 2) away from the paint."""

    points_map: FloatArray
    outward_map: FloatArray


@dataclass(frozen=True)
class Alignment:
    """A camera in its place.

    ``motion`` (6,) brought it there from its start: a turn, rad, and a shift, m, along its axes. ``edges``
    says how many edges it was seen by, ``spread_px`` how far they lie from what is drawn (weighted RMS).
    """

    view: View
    motion: FloatArray
    edges: int
    spread_px: float


def align(
    view: View, grey: np.ndarray, polygons: Sequence[FloatArray], hidden: Sequence[FloatArray] = ()
) -> Alignment:
    """Move a camera by little until polygons (N, 2) m of bright paint lie on an image (H, W) uint8.

    Boxes (u0, v0, u1, v1) px of ``hidden`` are not looked at. A camera that sees too few edges stays.
    """
    edges = _visible(edges_of(polygons), view, hidden)
    if len(edges.points_map) < _LEAST_EDGES:
        return Alignment(view, np.zeros(6), 0, float("nan"))
    start, moved = np.linalg.inv(view.cam_from_map), view
    weight, offset_px = np.empty(0), np.empty(0)
    for reach_px in _REACHES_PX:
        at_px, normal = _on_image(moved, edges)
        offset_px, fall = edge_offsets(grey, at_px, normal, reach_px)
        is_visible = np.isfinite(offset_px) & (fall >= _LEAST_FALL)
        offset_px = np.where(is_visible, offset_px, 0.0)
        weight = is_visible / (1 + (offset_px / (0.3 * reach_px)) ** 2) ** 2
        step = 1e-5
        jacobian = np.column_stack(
            [
                ((_moved(moved, motion).project(edges.points_map) - at_px) * normal).sum(axis=1) / step
                for motion in step * np.eye(6)
            ]
        )
        precision = weight / (_ALIKE * _EDGE_SIGMA_PX**2)
        so_far = motion_of(moved.cam_from_map @ start)
        normal_matrix = jacobian.T @ (precision[:, None] * jacobian) + np.diag(_SIGMA**-2)
        gradient = jacobian.T @ (precision * offset_px) - so_far / _SIGMA**2
        moved = _moved(moved, np.linalg.solve(normal_matrix, gradient))
    spread_px = float(np.sqrt((weight * offset_px**2).sum() / max(weight.sum(), 1e-9)))
    return Alignment(
        moved, motion_of(moved.cam_from_map @ start), int(np.count_nonzero(weight > 0)), spread_px
    )


def edges_of(polygons: Sequence[FloatArray]) -> Edges:
    """Places on the sides of polygons (N, 2) of either turning, a decimetre apart."""
    points, outward = [np.empty((0, 2))], [np.empty((0, 2))]
    for polygon in polygons:
        ahead = np.roll(polygon, -1, axis=0)
        from_first = polygon - polygon[0]
        after = ahead - polygon[0]
        turning = np.sign((from_first[:, 0] * after[:, 1] - from_first[:, 1] * after[:, 0]).sum())
        for start, side in zip(polygon, ahead - polygon, strict=True):
            length = float(np.linalg.norm(side))
            count = max(int(length / _EVERY_M), 2)
            points.append(start + (np.arange(count)[:, None] + 0.5) / count * side)
            outward.append(np.tile(turning * np.array([side[1], -side[0]]) / max(length, 1e-9), (count, 1)))
    return Edges(np.concatenate(points), np.concatenate(outward))


def edge_offsets(
    grey: np.ndarray, at_px: FloatArray, normal: FloatArray, reach_px: float
) -> tuple[FloatArray, FloatArray]:
    """How far along its normal (N, 2) the grey value falls most beside each place (N, 2) of an image.

    Returns:
        Offsets (N,) px, nan where the fall is steepest at the end of the reach, and the falls (N,) in grey
        levels over two pixels.
    """
    along = np.arange(-reach_px - 1, reach_px + 1 + _STEP_PX / 2, _STEP_PX)
    u, v = np.moveaxis(at_px[:, None] + along[:, None] * normal[:, None], 2, 0).astype(np.float32)
    # Between pixels grey values are cubic: linear ones would fall most at whole pixels only.
    profile = cv2.remap(grey, u, v, cv2.INTER_CUBIC).astype(np.float64)
    pixel = round(1 / _STEP_PX)
    fall = profile[:, : -2 * pixel] - profile[:, 2 * pixel :]
    best, row = fall.argmax(axis=1), np.arange(len(fall))
    last = fall.shape[1] - 1
    before, peak = fall[row, np.maximum(best - 1, 0)], fall[row, best]
    after = fall[row, np.minimum(best + 1, last)]
    bend = np.minimum(before - 2 * peak + after, -1e-9)
    vertex = np.clip((before - after) / (2 * bend), -0.5, 0.5)
    offset_px = along[pixel] + (best + vertex) * _STEP_PX
    return np.where((best > 0) & (best < last), offset_px, np.nan), peak


def _visible(edges: Edges, view: View, hidden: Sequence[FloatArray]) -> Edges:
    """The edges well inside the image, near and not hidden."""
    at_px = view.project(edges.points_map)
    limit = np.array([view.info.width, view.info.height]) - 1 - _BORDER_PX
    is_visible = ((at_px > _BORDER_PX) & (at_px < limit)).all(axis=1)
    is_visible &= view.ranges_m(edges.points_map) <= MAX_RANGE_M
    for box in hidden:
        is_visible &= ~((at_px >= box[:2]) & (at_px <= box[2:])).all(axis=1)
    return Edges(edges.points_map[is_visible], edges.outward_map[is_visible])


def _on_image(view: View, edges: Edges) -> tuple[FloatArray, FloatArray]:
    """Where edges lie in the image (N, 2) px, and the unit normals (N, 2) of their lines there."""
    step_m = 1e-3
    side = step_m * np.column_stack([-edges.outward_map[:, 1], edges.outward_map[:, 0]])
    along = view.project(edges.points_map + side) - view.project(edges.points_map - side)
    out = view.project(edges.points_map + step_m * edges.outward_map) - view.project(edges.points_map)
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal *= np.sign((normal * out).sum(axis=1) / np.linalg.norm(normal, axis=1) ** 2)[:, None]
    return view.project(edges.points_map), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _moved(view: View, motion: FloatArray) -> View:
    """A camera whose frame makes a small motion (6,), turn in rad and shift in m along its own axes."""
    moved = np.eye(4)
    moved[:3, :3] = cv2.Rodrigues(motion[:3])[0]
    moved[:3, 3] = motion[3:]
    return replace(view, cam_from_map=moved @ view.cam_from_map)


def motion_of(moved_from_start: FloatArray) -> FloatArray:
    """The motion (6,) of :func:`_moved` that a transform (4, 4) is."""
    return np.concatenate([cv2.Rodrigues(moved_from_start[:3, :3])[0].ravel(), moved_from_start[:3, 3]])
