"""Behind boxes: what a detector finds of the markings that stacks, trucks and barriers hide in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.benchmarks.made.detect import _HIDDEN_PX, _RANGE_M, _covered, _detection, detect, project
from tests.benchmarks.made.draw import Recipe
from tests.benchmarks.made.world import World, beside, make
from v2hdm.geometry.planar import Quad
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import LANE_DASH, BoolArray, Drive, FloatArray, ImageDetections, IntArray
from v2hdm.simulate.render.scene import Box

_PIECES = 53  # stream of a seed
_CELLS = 8  # along each side of a marking, to the nearest of which a piece ends
_LEAST = 0.25  # share of a marking from which a piece is found

_BOX_M, _INWARDS_M = (2.0, 2.4, 1.2), 0.2  # length, width and height, and how far it juts out to the route
_HIDDEN = 0.2  # share of a dash on which a box stands
_PERIOD = 2  # every second dash has one


def make_boxes(recipe: Recipe) -> World:
    """The world of a drive past boxes of one size, each on the far end of a dash at the right."""
    world = make(recipe)
    dashes = np.array([m.corners_map for m in world.port.hd_map.markings if m.kind == LANE_DASH])
    station_m, left_m = beside(world.port.route, dashes.reshape(-1, 2))
    station_m, right = station_m.reshape(-1, 4), left_m.reshape(-1, 4).mean(axis=1) < 0
    boxes = []
    for dash in np.flatnonzero(right)[1::_PERIOD]:
        near_end, far = dashes[dash][np.argsort(station_m[dash])].reshape(2, 2, 2).mean(axis=1)
        along = (far - near_end) / np.linalg.norm(far - near_end)
        centre = near_end + (1 - _HIDDEN) * (far - near_end) + _BOX_M[0] / 2 * along
        centre = centre + (_BOX_M[1] / 2 - _INWARDS_M) * np.array([along[1], -along[0]])
        yaw = float(np.arctan2(along[1], along[0]))
        boxes.append(Box(centre_map=(centre[0], centre[1]), size_m=_BOX_M, yaw_rad=yaw))
    renderer = world.port.renderer
    scene = replace(renderer.scene, boxes=(*renderer.scene.boxes, *boxes))
    return replace(world, port=replace(world.port, renderer=replace(renderer, scene=scene)))


def detect_pieces(
    world: World, drive: Drive, share_known: float = 0.0
) -> tuple[list[ImageDetections], FloatArray]:
    """The detections of :func:`detect`, and of pieces; the share of each marking shown.

    A piece is the largest part in view between parallels to a marking's sides. Of a share of the images,
    ``known``, it is known where these sides are hidden; in the others its corners look like any.
    """
    detections, visibility = detect(world, drive)
    out, errors, corners = [], world.recipe.detector, world.corners_map
    s, t = np.meshgrid(*2 * [np.linspace(0.0, 1.0, _CELLS + 1)], indexing="ij")
    points = Quad(corners).at(s.ravel(), t.ravel())
    for in_image in detections:
        image = drive.images[in_image.image]
        frame, lens = world.frame_of(image), world.lenses[image.camera]
        rng = np.random.default_rng([world.recipe.seed, _PIECES, len(image.camera), frame])
        pose = world.cam_from_vehicle[image.camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
        projected = project(lens, pose, corners)
        markings = np.flatnonzero(
            (projected.distance_m.max(axis=1) < _RANGE_M) & projected.inside.all(axis=1)
        )
        pieces = []
        if len(markings):
            markings = markings[_covered(world, frame, camera_centre(pose), corners[markings]).any(axis=1)]
        hidden = _covered(world, frame, camera_centre(pose), points[markings])
        for j, of_marking in zip(markings.tolist(), hidden, strict=True):
            piece, share = largest(~of_marking.reshape(s.shape))
            if share < _LEAST or rng.random() < errors.missed:
                continue
            projected = project(lens, pose, points[j].reshape(*s.shape, 3)[tuple(piece.T)][None])
            sigma = errors.sigma_px * (1 + (projected.distance_m[0] / errors.doubled_at_m) ** 2)
            px = projected.px[0] + rng.standard_normal((4, 2)) * sigma[:, None]
            covariance = errors.stated_factor * sigma[:, None, None] ** 2 * np.eye(2)
            if rng.random() < share_known:
                covariance += _hidden(px, piece)
            kind = world.port.hd_map.markings[j].kind
            pieces.append(_detection(kind, px, covariance, projected.inside[0], lens))
        out.append(replace(in_image, markings=(*in_image.markings, *pieces)))
    return out, visibility


def _hidden(px: FloatArray, piece: IntArray) -> FloatArray:
    """Covariance (4, 2, 2), px^2, of the corners of a ``piece`` (4, 2) along the sides that go on behind."""
    out = np.zeros((4, 2, 2))
    for axis, neighbour in enumerate(([1, 0, 3, 2], [3, 2, 1, 0])):
        along = px - px[neighbour]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        goes_on = (piece[:, axis] > 0) & (piece[:, axis] < _CELLS)
        out[goes_on] += _HIDDEN_PX**2 * (along[:, :, None] * along[:, None, :])[goes_on]
    return out


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
