"""Symbols of the map (arrows, chevrons, users' own): the outline that most of their sightings share.

A symbol has no corners to adjust. Once the cameras and poses are known, the outline of every sighting is laid
on the ground. Outlines that cover each other are sightings of one symbol. Its outline encloses what at least
half of them cover, near ones weighing more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.draw import polygon
from skimage.measure import approximate_polygon, find_contours

from v2hdm.adjust import PoseSigma
from v2hdm.association.ground import outlines_on_ground
from v2hdm.association.options import LEAST_SIGHTINGS
from v2hdm.association.sightings import Rig, Symbols
from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import FloatArray, IntArray, Marking, Symbol
from v2hdm.site.candidates import Exclusion
from v2hdm.site.parallax import PointViews, measure_parallax

_CELL_M = 0.01
"""Cells of the average, m; its outline is interpolated between them and simplified by half of one."""

_COARSE_M = 0.05  # cells, m, of the raster that overlaps are measured on
_COMMON = 0.5  # outlines are of one symbol if they share this part of the smaller one's area


def map_symbols(
    symbols: Symbols, rig: Rig, jitter_rad: float, markings: Sequence[Marking], min_probability: float
) -> tuple[tuple[Symbol, ...], tuple[Exclusion, ...]]:
    """The symbols that at least three images show, and those that do not lie on the ground.

    Far outlines are less certain by ``jitter_rad``, the standard deviation of the viewing direction; paint
    that is one of the map's ``markings`` is no symbol. A symbol lies on the ground with ``min_probability``.
    """
    grounds = {
        row: outline for row, outline in enumerate(outlines_on_ground(symbols, rig)) if outline is not None
    }
    rows, shapes = list(grounds), list(grounds.values())
    if not shapes:
        return (), ()
    centre = camera_centre(rig.cam_from_vehicle[symbols.camera[rows]])
    pose = rig.map_from_vehicle[symbols.frame[rows]]
    camera_map = np.einsum("nij,nj->ni", pose[:, :3, :3], centre) + pose[:, :3, 3]
    range_m = np.linalg.norm(np.array([shape.mean(axis=0) for shape in shapes]) - camera_map[:, :2], axis=1)
    height_m = np.maximum(centre[:, 2], _COARSE_M)
    weight = (jitter_rad * (range_m**2 + height_m**2) / height_m + _CELL_M) ** -2
    places = np.array([marking.corners_map.mean(axis=0) for marking in markings]).reshape(-1, 2)
    found, left_out = [], []
    for own in _groups(shapes):
        at = np.stack([symbols.camera, symbols.frame])[:, np.array(rows)[own]]
        images, first, image = np.unique(at, axis=1, return_index=True, return_inverse=True)
        if len(first) < LEAST_SIGHTINGS:
            continue
        outline = _shared_outline([shapes[n] for n in own], weight[own])
        if outline is None or _holds_any(outline, places):
            continue
        kind = Counter(symbols.kinds[rows[n]] for n in own).most_common(1)[0][0]
        centre_map, pieces = camera_map[own][first], [shapes[n] for n in own]
        views = _far_ends(pieces, image.ravel(), images[0], centre_map, jitter_rad)
        objection = measure_parallax(views, 1).objections(min_probability)[0]
        if objection is None:
            found.append(Symbol(kind, outline, len(first), _sigma_m([shapes[n] for n in own], weight[own])))
        else:
            left_out.append(Exclusion(kind, outline.mean(axis=0), len(first), objection))
    return tuple(found), tuple(left_out)


def _far_ends(
    shapes: Sequence[FloatArray], image: IntArray, camera: IntArray, centre_map: FloatArray, jitter_rad: float
) -> PointViews:
    """The farthest point of what each of I images, ``image`` (S,) of the shapes, shows of a symbol.

    The image's border cuts it last. From the other side it is another point. Images are taken by ``camera``
    (I,) from ``centre_map`` (I, 3); the points' scatter says how uncertain they are beside ``jitter_rad``.
    """
    ends = np.zeros((len(camera), 2))
    for number, at in enumerate(centre_map[:, :2]):
        points = np.concatenate([one for one, own in zip(shapes, image, strict=True) if own == number])
        ends[number] = points[np.linalg.norm(points - at, axis=1).argmax()]
    ray_map = ends - centre_map[:, :2]
    sigma = PoseSigma(_CELL_M, jitter_rad, jitter_rad, _CELL_M).by_state()
    return PointViews(
        group=np.zeros(len(camera), dtype=np.int64),
        camera=camera,
        points_map=np.repeat(ends[:, None], 2, axis=1),
        ray_map=np.repeat(ray_map[:, None], 2, axis=1),
        covariance_m2=np.tile(_CELL_M**2 * np.eye(2), (len(camera), 2, 1, 1)),
        used=np.eye(2, dtype=np.bool_)[(ray_map @ ray_map[0] < 0).astype(np.int64)],
        height_m=np.maximum(centre_map[:, 2], _COARSE_M),
        pose_sigma=np.tile(sigma, (len(camera), 1)),
    )


def _groups(shapes: Sequence[FloatArray]) -> list[IntArray]:
    """Indices of polygons that overlap, directly or by way of others."""
    middle = np.array([(shape.min(axis=0) + shape.max(axis=0)) / 2 for shape in shapes])
    reach_m = np.array([np.ptp(shape, axis=0).max() for shape in shapes])
    pairs = cKDTree(middle).query_pairs(float(reach_m.max()), output_type="ndarray").reshape(-1, 2)
    near = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1) < reach_m[pairs].max(axis=1)
    linked = np.array([(a, b) for a, b in pairs[near] if _common(shapes[a], shapes[b]) >= _COMMON], np.int64)
    a, b = linked.reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(shapes), len(shapes)))
    count, label = connected_components(graph, directed=False)
    return [np.flatnonzero(label == group) for group in range(count)]


def _common(one: FloatArray, other: FloatArray) -> float:
    """Common area of two polygons as a share of the smaller one's."""
    masks = _covered([one, other], _COARSE_M)[0]
    return float((masks[0] & masks[1]).sum() / max(min(mask.sum() for mask in masks), 1))


def _covered(shapes: Sequence[FloatArray], cell_m: float) -> tuple[list[np.ndarray], FloatArray]:
    """Which cells (h, w) each polygon covers, a cell of margin around all, and the centre of the first."""
    first = np.min([shape.min(axis=0) for shape in shapes], axis=0) - 2 * cell_m
    last = np.max([shape.max(axis=0) for shape in shapes], axis=0) + 2 * cell_m
    columns, lines = (np.ceil((last - first) / cell_m).astype(int) + 1).tolist()
    masks = []
    for shape in shapes:
        x, y = ((shape - first) / cell_m).T
        mask = np.zeros((lines, columns), dtype=np.bool_)
        mask[polygon(y, x, mask.shape)] = True  # type: ignore[no-untyped-call]
        masks.append(mask)
    return masks, first


def _shared_outline(shapes: Sequence[FloatArray], weight: FloatArray) -> FloatArray | None:
    """The outline (N, 2), counter-clockwise, of what half of the weight covers; None if that is nothing."""
    masks, first = _covered(shapes, _CELL_M)
    cover = np.zeros(masks[0].shape)
    for mask, share in zip(masks, weight / weight.sum(), strict=True):
        cover += share * mask
    contours = find_contours(cover, 0.5)  # type: ignore[no-untyped-call]
    if not contours:
        return None
    largest = max(contours, key=lambda contour: abs(float(signed_area(contour))))
    simple = approximate_polygon(largest, 0.5)  # type: ignore[no-untyped-call]
    outline = simple[:-1, ::-1] * _CELL_M + first
    if len(outline) < 3:
        return None
    return np.asarray(outline if signed_area(outline) > 0 else outline[::-1])


def _holds_any(outline: FloatArray, places: FloatArray) -> bool:
    """Whether one of some points (P, 2) lies within an outline."""
    ring = (outline - outline.mean(axis=0)).astype(np.float32)
    near = places[np.linalg.norm(places - outline.mean(axis=0), axis=1) < np.ptp(outline, axis=0).max()]
    return any(cv2.pointPolygonTest(ring, (p - outline.mean(axis=0)).tolist(), False) >= 0 for p in near)


def _sigma_m(shapes: Sequence[FloatArray], weight: FloatArray) -> float:
    """Standard deviation a coordinate of the mean place, by how the sightings scatter about it."""
    middle = np.array([_centroid(shape) for shape in shapes])
    share = weight / weight.sum()
    squared = ((middle - share @ middle) ** 2).mean(axis=1)
    effective = 1 / (share**2).sum()
    return float(np.sqrt((share @ squared) / max(effective - 1, 1)))


def _centroid(shape: FloatArray) -> FloatArray:
    """Centre (2,) of a polygon's area."""
    x, y = (shape - shape[0]).T
    cross = x * np.roll(y, -1) - y * np.roll(x, -1)
    pairs = np.array([x + np.roll(x, -1), y + np.roll(y, -1)])
    area = cross.sum() / 2
    return np.asarray(shape[0] + (pairs @ cross) / (6 * area) if abs(area) > 1e-9 else shape.mean(axis=0))
