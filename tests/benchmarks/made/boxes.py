"""Behind boxes: what a detector finds of the markings that stacks, trucks and barriers hide in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.benchmarks.made.detect import _RANGE_M, _covered, _detection, detect, project
from tests.benchmarks.made.world import World
from v2hdm.geometry.planar import Quad
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, Drive, FloatArray, ImageDetections, IntArray

_PIECES = 53  # stream of a seed
_CELLS = 8  # along each side of a marking, to the nearest of which a piece ends
_LEAST = 0.25  # share of a marking from which a piece is found


def detect_pieces(world: World, drive: Drive) -> tuple[list[ImageDetections], FloatArray]:
    """The detections of :func:`detect`, and of pieces; the share of each marking shown.

    A piece is the largest part in view between parallels to a marking's sides; its corners look like any.
    """
    found, visibility = detect(world, drive)
    out, errors, corners = [], world.recipe.detector, world.corners_map
    s, t = np.meshgrid(*2 * [np.linspace(0.0, 1.0, _CELLS + 1)], indexing="ij")
    points = Quad(corners).at(s.ravel(), t.ravel())
    for one in found:
        image = drive.images[one.image]
        frame, lens = world.frame_of(image), world.lenses[image.camera]
        rng = np.random.default_rng([world.recipe.seed, _PIECES, len(image.camera), frame])
        pose = world.cam_from_vehicle[image.camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
        seen = project(lens, pose, corners)
        near = np.flatnonzero((seen.distance_m.max(axis=1) < _RANGE_M) & seen.inside.all(axis=1))
        pieces = []
        if len(near):
            near = near[_covered(world, frame, camera_centre(pose), corners[near]).any(axis=1)]
        for j in near.tolist():
            hidden = _covered(world, frame, camera_centre(pose), points[j][None])
            piece, share = largest(~hidden.reshape(s.shape))
            if share < _LEAST or rng.random() < errors.missed:
                continue
            seen = project(lens, pose, points[j].reshape(*s.shape, 3)[tuple(piece.T)][None])
            sigma = errors.sigma_px * (1 + (seen.distance_m[0] / errors.doubled_at_m) ** 2)
            px = seen.px[0] + rng.standard_normal((4, 2)) * sigma[:, None]
            covariance = errors.stated_factor * sigma[:, None, None] ** 2 * np.eye(2)
            kind = world.port.hd_map.markings[j].kind
            pieces.append(_detection(kind, px, covariance, seen.inside[0], lens))
        out.append(replace(one, markings=(*one.markings, *pieces)))
    return out, visibility


def largest(visible: BoolArray) -> tuple[IntArray, float]:
    """Corners (4, 2) of the largest rectangle of a grid's points that is in view, and its share."""
    count = np.pad(visible.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    low, high = np.triu_indices(len(visible), 1)
    (a, b), (c, d) = (low[:, None], high[:, None]), (low, high)
    inside = count[b + 1, d + 1] - count[a, d + 1] - count[b + 1, c] + count[a, c]
    area = (b - a) * (d - c) * (inside == (b - a + 1) * (d - c + 1))
    first, second = np.unravel_index(area.argmax(), area.shape)
    (a, b), (c, d) = (low[first], high[first]), (low[second], high[second])
    return np.array([[a, c], [b, c], [b, d], [a, d]]), float(area.max() / (len(visible) - 1) ** 2)
