"""Symbols of the map (arrows, chevrons, users' own), as polygons from most of their sightings.

Under known cameras and poses every sighting's outline is projected to the ground; overlapping outlines are
one symbol. Ground that a good part of the images shows as paint, weighted towards near ones, gives the
initial vertices, which are then fitted to the outlines in the images (:mod:`v2hdm.site.polygons`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.draw import polygon
from skimage.measure import approximate_polygon, find_contours

from v2hdm.adjust import PoseSigma
from v2hdm.association.ground import BORDER_PX, outlines_on_ground
from v2hdm.association.sightings import Rig, Symbols
from v2hdm.association.tracks import LEAST_SIGHTINGS
from v2hdm.geometry.ipm import apply_in_front, pinhole_px_from_ground, project_ground
from v2hdm.geometry.planar import is_simple, signed_area
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    OUTLINE_SIGMA_PX,
    BoolArray,
    CameraInfo,
    Exclusion,
    FloatArray,
    IntArray,
    Marking,
    Symbol,
)
from v2hdm.site.candidates import LACKS_A_CORNER, TOO_UNCERTAIN
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import PointViews, measure_parallax
from v2hdm.site.polygons import LEAST_EXPLAINED, UNSEEN_M, Polygon, Traces, find_polygons

_CELL_M = 0.02
"""Cells of the average, m; its contour is interpolated between them and simplified by half a cell."""

_MOST_CELLS = 500  # most cells along the longer side of the average; larger symbols have larger cells
_PART = 0.3  # least weighted fraction of the images of a place that show paint there: some miss a part

NO_POLYGON = "no simple polygon explains its outline"

_MAX_SIGMA_M = 0.06  # largest sigma of a vertex, m; goes with the gate

_COARSE_M = 0.05  # cells, m, of the raster for measuring overlap
_COMMON = 0.5  # least overlap of outlines of one symbol, relative to the smaller area


def map_symbols(
    symbols: Symbols,
    rig: Rig,
    infos: Sequence[CameraInfo],
    jitter_rad: float,
    markings: Sequence[Marking],
    options: AcceptanceOptions,
) -> tuple[tuple[Symbol, ...], tuple[Exclusion, ...]]:
    """Symbols in at least three images, and rejected ones that are no polygons on the ground.

    ``infos`` are the rig's cameras; ``jitter_rad``, the standard deviation of the viewing direction, makes
    distant outlines uncertain. Paint of the map's ``markings`` is no symbol; ``options`` apply as to
    markings.
    """
    grounds = {
        row: outline for row, outline in enumerate(outlines_on_ground(symbols, rig)) if outline is not None
    }
    rows = np.array(list(grounds), dtype=np.int64)
    shapes = list(grounds.values())
    if not shapes:
        return (), ()
    places = np.array([marking.corners_map.mean(axis=0) for marking in markings]).reshape(-1, 2)
    symbols_found = []
    exclusions = []
    traces = []
    for members in _groups(shapes):
        image_of_member = np.stack([symbols.camera[rows[members]], symbols.frame[rows[members]]])
        (camera, frame), image = np.unique(image_of_member, axis=1, return_inverse=True)
        if len(camera) < LEAST_SIGHTINGS:
            continue
        eyes = _Eyes(camera, frame, rig, infos, jitter_rad)
        outlines = [shapes[n] for n in members]
        outline = _fused_outline(outlines, image.ravel(), eyes)
        if outline is None:
            continue
        middle = outline.mean(axis=0)
        size_m = np.ptp(outline, axis=0).max()
        ring = (outline - middle).astype(np.float32)
        in_reach = np.linalg.norm(places - middle, axis=1) < size_m
        if any(cv2.pointPolygonTest(ring, place.tolist(), False) >= 0 for place in places[in_reach] - middle):
            continue
        kind = Counter(symbols.kinds[n] for n in rows[members]).most_common(1)[0][0]
        # The border or a shadow may hide one end in some images: then the other is used.
        views = [_ends(outlines, image.ravel(), eyes, sign) for sign in (1, -1)]
        objections = [measure_parallax(view, 1).objections(options.min_probability)[0] for view in views]
        if None in objections:
            symbols_found.append(Symbol(kind, outline, len(camera)))
            sides = [symbols.seen_sides[n] for n in rows[members]]
            traces.append(eyes.traces(outlines, sides, image.ravel()))
        else:
            exclusions.append(Exclusion(kind, middle, len(camera), objections[0] or ""))
    kinds = [symbol.kind for symbol in symbols_found]
    polygons = find_polygons(kinds, traces, [symbol.outline_map for symbol in symbols_found])
    accepted = []
    for symbol, fitted in zip(symbols_found, polygons, strict=True):
        reason = _objection(fitted, _MAX_SIGMA_M)
        if reason is None:
            accepted.append(_with_vertices(symbol, fitted, markings))
        else:
            exclusions.append(Exclusion(symbol.kind, fitted.vertices.mean(axis=0), symbol.sightings, reason))
    return tuple(accepted), tuple(exclusions)


def _objection(polygon: Polygon, max_sigma_m: float) -> str | None:
    """Reason why a polygon is not the shape of a symbol, or None."""
    if polygon.explained < LEAST_EXPLAINED or not is_simple(polygon.vertices):
        return NO_POLYGON
    variance_m2 = np.diag(polygon.covariance).reshape(-1, 2).sum(axis=1)
    if variance_m2.max() > UNSEEN_M**2:
        return LACKS_A_CORNER
    return TOO_UNCERTAIN if variance_m2.max() > max_sigma_m**2 else None


def _with_vertices(symbol: Symbol, polygon: Polygon, markings: Sequence[Marking]) -> Symbol:
    """The symbol as the polygon, with the camera and pose errors of the nearest marking."""
    covariance = polygon.covariance
    certain = [marking for marking in markings if marking.covariance_m2 is not None]
    if certain:
        middle = polygon.vertices.mean(axis=0)
        nearest = min(
            certain, key=lambda marking: float(np.linalg.norm(marking.corners_map.mean(axis=0) - middle))
        )
        shared = np.asarray(nearest.covariance_m2).reshape(4, 2, 4, 2).mean(axis=(0, 2))
        covariance = covariance + np.tile(shared, 2 * (len(polygon.vertices),))
    sigma_m = float(np.sqrt(np.trace(covariance) / len(covariance)))
    return replace(symbol, outline_map=polygon.vertices, covariance_m2=covariance, sigma_m=sigma_m)


@dataclass(frozen=True)
class _Eyes:
    """I images, by ``camera`` and ``frame`` (I,) of a rig, and their views of the ground."""

    camera: IntArray
    frame: IntArray
    rig: Rig
    infos: Sequence[CameraInfo]
    jitter_rad: float

    @cached_property
    def centre_map(self) -> FloatArray:
        """Camera centres (I, 3)."""
        extrinsic = self.rig.cam_from_vehicle[self.camera]
        pose = self.rig.map_from_vehicle[self.frame]
        return np.asarray(np.einsum("nij,nj->ni", pose[:, :3, :3], camera_centre(extrinsic)) + pose[:, :3, 3])

    def sigma_m(self, points_map: FloatArray) -> FloatArray:
        """Standard deviation (I, ...), m, along the ray, of an outline at points (..., 2)."""
        by_image = (slice(None), *(None,) * (points_map.ndim - 1))
        range_m = np.linalg.norm(points_map - self.centre_map[(*by_image, slice(2))], axis=-1)
        height_m = self.rig.height_m[self.camera][by_image]
        direction_rad = np.hypot(self.jitter_rad, OUTLINE_SIGMA_PX / self.rig.intrinsic[self.camera, 0, 0])
        return np.asarray(direction_rad[by_image] * (range_m**2 + height_m**2) / height_m)

    def traces(
        self, shapes: Sequence[FloatArray], seen_sides: Sequence[BoolArray], image: IntArray
    ) -> Traces:
        """Ground outlines, each of an ``image`` (S,), as traces beside polygons in the images.

        Rolling shutters are treated as exposing all rows at the image's middle.
        """
        intrinsic = self.rig.intrinsic[self.camera]
        px_from_map = pinhole_px_from_ground(intrinsic, self.rig.cam_from_map(self.camera, self.frame))
        outlines_px = [
            apply_in_front(px_from_map[k], outline) for k, outline in zip(image, shapes, strict=True)
        ]
        return Traces.of(outlines_px, seen_sides, image, px_from_map, self.jitter_rad * intrinsic[:, 0, 0])

    def shows(self, points_map: FloatArray) -> BoolArray:
        """Whether points (N, 2) lie inside images (I, N), away from the border."""
        cam_from_map = self.rig.cam_from_map(self.camera, self.frame)
        pixel, depth_m = project_ground(self.rig.intrinsic[self.camera], cam_from_map, points_map[None])
        limit = np.array([[info.width, info.height] for info in self.infos])[self.camera, None] - BORDER_PX
        return np.asarray(((pixel > BORDER_PX) & (pixel < limit)).all(axis=2) & (depth_m > 0))


def _ends(shapes: Sequence[FloatArray], image: IntArray, eyes: _Eyes, sign: int) -> PointViews:
    """One end of a symbol in each of I images, ``image`` (S,) of the shapes.

    ``sign`` 1 is the far end, -1 the near one; seen from the other side it is another point. The points'
    scatter gives their uncertainty besides jitter.
    """
    ends = np.zeros((len(eyes.camera), 2))
    for number, eye in enumerate(eyes.centre_map[:, :2]):
        outlines = [outline for outline, k in zip(shapes, image, strict=True) if k == number]
        points = np.concatenate(outlines)
        ends[number] = points[(sign * np.linalg.norm(points - eye, axis=1)).argmax()]
    ray_map = ends - eyes.centre_map[:, :2]
    sigma = PoseSigma(_CELL_M, eyes.jitter_rad, eyes.jitter_rad, _CELL_M).by_state()
    return PointViews(
        group=np.zeros(len(ends), dtype=np.int64),
        camera=eyes.camera,
        points_map=np.repeat(ends[:, None], 2, axis=1),
        ray_map=np.repeat(ray_map[:, None], 2, axis=1),
        covariance_m2=np.tile(_CELL_M**2 * np.eye(2), (len(ends), 2, 1, 1)),
        used=np.eye(2, dtype=np.bool_)[(ray_map @ ray_map[0] < 0).astype(np.int64)],
        height_m=np.maximum(eyes.centre_map[:, 2], _COARSE_M),
        pose_sigma=np.tile(sigma, (len(ends), 1)),
    )


def _groups(shapes: Sequence[FloatArray]) -> list[IntArray]:
    """Indices of polygons connected by overlap."""
    middle = np.array([(shape.min(axis=0) + shape.max(axis=0)) / 2 for shape in shapes])
    reach_m = np.array([np.ptp(shape, axis=0).max() for shape in shapes])
    pairs = cKDTree(middle).query_pairs(float(reach_m.max()), output_type="ndarray").reshape(-1, 2)
    in_reach = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1) < reach_m[pairs].max(axis=1)
    linked = np.array(
        [(a, b) for a, b in pairs[in_reach] if _common(shapes[a], shapes[b]) >= _COMMON], np.int64
    )
    a, b = linked.reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(shapes), len(shapes)))
    count, label = connected_components(graph, directed=False)
    return [np.flatnonzero(label == group) for group in range(count)]


def _common(shape: FloatArray, other: FloatArray) -> float:
    """Common area of two polygons, relative to the smaller."""
    masks = _covered([shape, other], _COARSE_M)[0]
    return float((masks[0] & masks[1]).sum() / max(min(mask.sum() for mask in masks), 1))


def _covered(shapes: Sequence[FloatArray], cell_m: float) -> tuple[list[np.ndarray], FloatArray]:
    """Cells (h, w) that each polygon covers, with a margin of one cell, and the centre of the first."""
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


def _fused_outline(shapes: Sequence[FloatArray], image: IntArray, eyes: _Eyes) -> FloatArray | None:
    """Counter-clockwise outline (N, 2) of the paint in the images, or None.

    Each of I images, ``image`` (S,) of the shapes, votes on the ground in its view, weighted by its
    precision.
    """
    extent_m = float(np.ptp(np.concatenate(shapes), axis=0).max())
    cell_m = max(_CELL_M, extent_m / _MOST_CELLS)
    masks, first = _covered(shapes, cell_m)
    size = masks[0].shape
    painted = np.zeros((len(eyes.camera), *size), dtype=np.bool_)
    for mask, number in zip(masks, image, strict=True):
        painted[number] |= mask
    cells = first + cell_m * np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), axis=-1)
    shown = eyes.shows(cells.reshape(-1, 2)).reshape(painted.shape)
    weight = shown / np.hypot(eyes.sigma_m(cells), cell_m) ** 2
    share = (weight * painted).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    contours = find_contours(share, _PART)  # type: ignore[no-untyped-call]
    if not contours:
        return None
    largest = max(contours, key=lambda contour: abs(float(signed_area(contour))))
    simple = approximate_polygon(largest, 0.5)  # type: ignore[no-untyped-call]
    outline = simple[:-1, ::-1] * cell_m + first
    if len(outline) < 3:
        return None
    return np.asarray(outline if signed_area(outline) > 0 else outline[::-1])
