"""Symbols of the map (arrows, chevrons, users' own), as polygons from most of their sightings; and areas.

Under known cameras and poses every sighting's outline is projected to the ground; overlapping outlines are
one symbol. Ground that a good part of the images shows as paint, weighted towards near ones, gives the
initial vertices, which are then fitted to the outlines in the images (:mod:`v2hdm.site.polygons`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from v2hdm.adjust import PoseSigma
from v2hdm.association.ground import BORDER_PX, Views, easy_views, outlines_on_ground
from v2hdm.association.sightings import Rig, Symbols
from v2hdm.association.tracks import LEAST_SIGHTINGS
from v2hdm.catalogue import AREA, SHIPPED
from v2hdm.geometry.ipm import apply_in_front, pinhole_px_from_ground, project_ground
from v2hdm.geometry.planar import is_simple, signed_area, smallest_rectangle
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    BOX,
    OUTLINE_SIGMA_PX,
    BoolArray,
    Camera,
    CameraInfo,
    Exclusion,
    FloatArray,
    IntArray,
    Marking,
    Symbol,
)
from v2hdm.site.areas import LEAST_IMAGES, Rectangle, fit_rectangle
from v2hdm.site.candidates import FOUND_SELDOM, LACKS_A_CORNER, SEEN_SELDOM
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import PointViews, measure_parallax
from v2hdm.site.polygons import LEAST_EXPLAINED, UNSEEN_M, Polygon, Traces, find_polygons
from v2hdm.site.posterior import symbols_presence

_CELL_M = 0.02
"""Cells of the average, m; its contour is interpolated between them and simplified by half a cell."""

_MOST_CELLS = 500  # most cells along the longer side of the average; larger symbols have larger cells
_MOST_CELLS_OF_AREA = 120  # the same of an area, of which it gives the direction and the images' common part
_PART = 0.3  # least weighted fraction of the images of a place that show paint there: some miss a part

_CORE_M = 2.0  # extent of the middle of an area, m, whose view shows it: a box may be larger than any view
_USUAL = 0.85  # least area of a hull, in parts of the usual, that nothing hides

AREAS = SHIPPED.of_family(AREA)

NO_POLYGON = "no simple polygon explains its outline"

_COARSE_M = 0.05  # cells, m, of the raster for measuring overlap
_COMMON = 0.5  # least overlap of outlines of one symbol, relative to the smaller area


def map_symbols(
    symbols: Symbols,
    rig: Rig,
    views: Views,
    cameras: Sequence[Camera],
    jitter_rad: float,
    markings: Sequence[Marking],
    options: AcceptanceOptions,
) -> tuple[tuple[Symbol, ...], tuple[Exclusion, ...]]:
    """Symbols that are painted, in at least three images, and polygons on the ground; and rejected ones.

    ``views`` are all images of ``cameras``, the rig's; ``jitter_rad``, the standard deviation of the viewing
    direction, makes distant outlines uncertain. Paint of the map's ``markings`` is no symbol; ``options``
    apply as to markings. How well vertices are known is no reason against a symbol, unless it has no shape.
    """
    infos = [camera.info for camera in cameras]
    symbols = _with_areas_by_most_images(symbols, rig)
    kinds = np.array([kind if kind in AREAS else "" for kind in symbols.kinds])
    places = [
        place
        for kind in np.unique(kinds)
        for place in _places(symbols, kinds == kind, rig, infos, jitter_rad, () if kind else markings)
    ]
    reasons = _absences(places, views, rig, cameras, options.min_probability)
    for number, place in enumerate(places):
        if reasons[number] is None and place.kind != BOX:  # of a box each image shows other ends
            # The border or a shadow may hide one end in some images: then the other is used.
            ends = [_middle(place)] if place.kind in AREAS else [_ends(place, sign) for sign in (1, -1)]
            measured = [measure_parallax(end, 1, np.zeros(1, dtype=np.bool_)) for end in ends]
            objections = [parallax.objections(options.min_probability)[0] for parallax in measured]
            reasons[number] = None if None in objections else objections[0]
    standing = [place for place, reason in zip(places, reasons, strict=True) if reason is None]
    exclusions = [
        Exclusion(place.kind, place.outline_map.mean(axis=0), place.images, reason)
        for place, reason in zip(places, reasons, strict=True)
        if reason is not None
    ]
    accepted = []
    for place, fitted in _fitted(standing):
        reason = _objection(fitted)
        if reason is None:
            symbol = Symbol(place.kind, place.outline_map, place.images)
            accepted.append(_with_vertices(symbol, fitted, markings))
        else:
            exclusions.append(Exclusion(place.kind, fitted.vertices.mean(axis=0), place.images, reason))
    return tuple(accepted), tuple(exclusions)


def _fitted(places: Sequence[_Place]) -> list[tuple[_Place, Polygon | Rectangle]]:
    """The places with their polygons, or their rectangles where they are areas."""
    symbols = [place for place in places if place.kind not in AREAS]
    polygons = find_polygons(
        [place.kind for place in symbols],
        [place.eyes.traces(place.outlines_map, place.seen_sides, place.image) for place in symbols],
        [place.outline_map for place in symbols],
    )
    fitted: list[tuple[_Place, Polygon | Rectangle]] = list(zip(symbols, polygons, strict=True))
    for place in places:
        if place.kind in AREAS:
            eyes = place.eyes
            rectangle = fit_rectangle(
                place.outline_map, place.outlines_map, place.seen_sides, place.image, eyes.shows, eyes.sigma_m
            )
            fitted.append((place, rectangle))
    return fitted


def _objection(polygon: Polygon | Rectangle) -> str | None:
    """Reason why a polygon is not the shape of a symbol, or None."""
    if isinstance(polygon, Rectangle):
        return None if polygon.images.min() >= LEAST_IMAGES else LACKS_A_CORNER
    if polygon.explained < LEAST_EXPLAINED or not is_simple(polygon.vertices):
        return NO_POLYGON
    variance_m2 = np.diag(polygon.covariance).reshape(-1, 2).sum(axis=1)
    return LACKS_A_CORNER if variance_m2.max() > UNSEEN_M**2 else None


@dataclass(frozen=True)
class _Place:
    """Outlines (K, 2), m, on the ground that overlap, S of them; ``image`` (S,) numbers those of ``eyes``."""

    kind: str
    outline_map: FloatArray  # (N, 2) m, what they have in common
    outlines_map: Sequence[FloatArray]
    seen_sides: Sequence[BoolArray]
    image: IntArray
    eyes: _Eyes

    @property
    def images(self) -> int:
        """The number of images with such an outline."""
        return len(self.eyes.camera)


def _places(
    symbols: Symbols,
    chosen: BoolArray,
    rig: Rig,
    infos: Sequence[CameraInfo],
    jitter_rad: float,
    markings: Sequence[Marking],
) -> list[_Place]:
    """Places with a ``chosen`` outline (N,) in enough images for an average, except where a marking lies."""
    grounds = {
        row: outline
        for row, outline in enumerate(outlines_on_ground(symbols, rig))
        if outline is not None and chosen[row]
    }
    if not grounds:
        return []
    rows = np.array(list(grounds), dtype=np.int64)
    shapes = list(grounds.values())
    centres_map = np.array([marking.corners_map.mean(axis=0) for marking in markings]).reshape(-1, 2)
    places = []
    for members in _groups(shapes, _common):
        image_of_member = np.stack([symbols.camera[rows[members]], symbols.frame[rows[members]]])
        (camera, frame), image = np.unique(image_of_member, axis=1, return_inverse=True)
        if len(camera) < LEAST_SIGHTINGS:
            continue
        eyes = _Eyes(camera, frame, rig, infos, jitter_rad)
        outlines = [shapes[n] for n in members]
        kind = Counter(symbols.kinds[n] for n in rows[members]).most_common(1)[0][0]
        most_cells = _MOST_CELLS_OF_AREA if kind in AREAS else _MOST_CELLS
        outline = _fused_outline(outlines, image.ravel(), eyes, most_cells)
        if outline is None or _holds_any(outline, centres_map):
            continue
        sides = [symbols.seen_sides[n] for n in rows[members]]
        places.append(_Place(kind, outline, outlines, sides, image.ravel(), eyes))
    return places


def _with_areas_by_most_images(symbols: Symbols, rig: Rig) -> Symbols:
    """The same, but areas of one ground are of the class that most of their images name.

    The same ground is the same size: a word in a box is no box.
    """
    grounds = outlines_on_ground(symbols, rig)
    rows = [row for row, kind in enumerate(symbols.kinds) if kind in AREAS and grounds[row] is not None]
    if len({symbols.kinds[row] for row in rows}) < 2:
        return symbols
    kinds = list(symbols.kinds)
    shapes = [shape for row in rows if (shape := grounds[row]) is not None]
    for members in _groups(shapes, _shared):
        rows_of_ground = [rows[n] for n in members]
        most = Counter(kinds[row] for row in rows_of_ground).most_common(1)[0][0]
        for row in rows_of_ground:
            kinds[row] = most
    return replace(symbols, kinds=tuple(kinds))


def _holds_any(outline: FloatArray, points_map: FloatArray) -> bool:
    """Whether any of points (M, 2) lies within an outline (N, 2)."""
    middle = outline.mean(axis=0)
    ring = (outline - middle).astype(np.float32)
    offset_m = points_map - middle
    in_reach = np.linalg.norm(offset_m, axis=1) < np.ptp(outline, axis=0).max()
    return any(cv2.pointPolygonTest(ring, offset.tolist(), False) >= 0 for offset in offset_m[in_reach])


def _absences(
    places: Sequence[_Place], views: Views, rig: Rig, cameras: Sequence[Camera], min_probability: float
) -> list[str | None]:
    """Why each place has no paint, or None: it is found in too few of the images that show it well."""
    corners_map = np.array([_core(place) for place in places]).reshape(-1, 4, 2)
    number, image = easy_views(views, rig, cameras, corners_map)
    easy = np.bincount(number, minlength=len(places))
    row_of_image = {index: row for row, index in enumerate(views.image.tolist())}
    detected = np.zeros(len(places), dtype=np.int64)
    shown = [set(zip(place.eyes.camera.tolist(), place.eyes.frame.tolist(), strict=True)) for place in places]
    for place, index in zip(number.tolist(), image.tolist(), strict=True):
        row = row_of_image[index]
        detected[place] += (int(views.camera[row]), int(views.frame[row])) in shown[place]
    least = np.log(min_probability / (1 - min_probability))
    reasons: list[str | None] = [None] * len(places)
    kinds = np.array([place.kind for place in places])
    images = np.array([place.images for place in places])
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        judged = symbols_presence(images[members], easy[members], detected[members])
        for place, odds, evidence in zip(members, judged.log_odds, judged.evidence, strict=True):
            if odds < least:
                reasons[place] = (SEEN_SELDOM, FOUND_SELDOM)[int(evidence.argmin())]
    return reasons


def _core(place: _Place) -> FloatArray:
    """Corners (4, 2) of the ground that shows a place: its smallest rectangle, of a large area the middle."""
    box = smallest_rectangle(place.outline_map)
    if place.kind not in AREAS:
        return box
    middle = box.mean(axis=0)
    return np.asarray(middle + (box - middle) * min(1.0, _CORE_M / float(np.ptp(box, axis=0).max())))


def _with_vertices(symbol: Symbol, polygon: Polygon | Rectangle, markings: Sequence[Marking]) -> Symbol:
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


def _ends(place: _Place, sign: int) -> PointViews:
    """One end of a symbol in each of its images; seen from the other side it is another point.

    ``sign`` 1 is the far end, -1 the near one.
    """
    ends = np.zeros((place.images, 2))
    for number, eye in enumerate(place.eyes.centre_map[:, :2]):
        outlines = zip(place.outlines_map, place.image, strict=True)
        points = np.concatenate([outline for outline, k in outlines if k == number])
        ends[number] = points[(sign * np.linalg.norm(points - eye, axis=1)).argmax()]
    ray_map = ends - place.eyes.centre_map[:, :2]
    return _point_views(ends, np.arange(place.images), place.eyes, ray_map @ ray_map[0] < 0)


def _middle(place: _Place) -> PointViews:
    """The middle of an area in its images, as far as none is cut or smaller than usual."""
    area = np.array([abs(float(signed_area(outline))) for outline in place.outlines_map])
    is_whole = np.array([is_seen.all() for is_seen in place.seen_sides])
    is_usual = is_whole & (area > _USUAL * np.median(area[is_whole] if is_whole.any() else area))
    chosen = np.flatnonzero(is_usual) if is_usual.sum() > 1 else np.arange(len(area))
    middles = np.array([_centroid(place.outlines_map[k]) for k in chosen.tolist()])
    return _point_views(middles, place.image[chosen], place.eyes, np.zeros(len(chosen), dtype=np.bool_))


def _centroid(outline: FloatArray) -> FloatArray:
    """The middle (2,) of a polygon's area."""
    moments = cv2.moments((outline - outline[0]).astype(np.float32))
    return np.asarray(outline[0] + np.array([moments["m10"], moments["m01"]]) / max(moments["m00"], 1e-9))


def _point_views(points: FloatArray, image: IntArray, eyes: _Eyes, is_other: BoolArray) -> PointViews:
    """A point (N, 2) of a symbol in each of N images, in some of them the other one of two.

    The points' scatter gives their uncertainty besides jitter.
    """
    ray_map = points - eyes.centre_map[image, :2]
    sigma = PoseSigma(_CELL_M, eyes.jitter_rad, eyes.jitter_rad, _CELL_M).by_state()
    return PointViews(
        group=np.zeros(len(points), dtype=np.int64),
        camera=eyes.camera[image],
        points_map=np.repeat(points[:, None], 2, axis=1),
        ray_map=np.repeat(ray_map[:, None], 2, axis=1),
        covariance_m2=np.tile(_CELL_M**2 * np.eye(2), (len(points), 2, 1, 1)),
        used=np.eye(2, dtype=np.bool_)[is_other.astype(np.int64)],
        height_m=np.maximum(eyes.centre_map[image, 2], _COARSE_M),
        pose_sigma=np.tile(sigma, (len(points), 1)),
    )


def _groups(
    shapes: Sequence[FloatArray], overlap: Callable[[FloatArray, FloatArray], float]
) -> list[IntArray]:
    """Indices of polygons that are connected by enough ``overlap`` of two."""
    middle = np.array([(shape.min(axis=0) + shape.max(axis=0)) / 2 for shape in shapes])
    reach_m = np.array([np.ptp(shape, axis=0).max() for shape in shapes])
    pairs = cKDTree(middle).query_pairs(float(reach_m.max()), output_type="ndarray").reshape(-1, 2)
    in_reach = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1) < reach_m[pairs].max(axis=1)
    groups = DisjointSet(range(len(shapes)))
    for first, second in pairs[in_reach].tolist():
        # Of outlines that others connect already, the overlap says nothing new.
        if not groups.connected(first, second) and overlap(shapes[first], shapes[second]) >= _COMMON:
            groups.merge(first, second)
    return sorted((np.array(sorted(group)) for group in groups.subsets()), key=lambda group: int(group[0]))


def _common(shape: FloatArray, other: FloatArray) -> float:
    """Common area of two polygons, relative to the smaller."""
    masks = _covered([shape, other], _COARSE_M)[0]
    return float((masks[0] & masks[1]).sum() / max(min(mask.sum() for mask in masks), 1))


def _shared(shape: FloatArray, other: FloatArray) -> float:
    """Intersection over union of two polygons."""
    first, second = _covered([shape, other], _COARSE_M)[0]
    return float((first & second).sum() / max((first | second).sum(), 1))


def _covered(shapes: Sequence[FloatArray], cell_m: float) -> tuple[list[np.ndarray], FloatArray]:
    """Cells (h, w) that each polygon covers, with a margin of one cell, and the centre of the first."""
    first = np.min([shape.min(axis=0) for shape in shapes], axis=0) - 2 * cell_m
    last = np.max([shape.max(axis=0) for shape in shapes], axis=0) + 2 * cell_m
    columns, lines = (np.ceil((last - first) / cell_m).astype(int) + 1).tolist()
    return [cells_inside((shape - first) / cell_m, (lines, columns)) for shape in shapes], first


def cells_inside(ring: FloatArray, size: tuple[int, int]) -> BoolArray:
    """Cells (h, w) of ``size`` with their centres inside a polygon (N, 2), whose x and y count cells.

    Scikit-image asks each cell for all edges; here each line is crossed from left to right, once.
    """
    lines, columns = size
    (x, y), (next_x, next_y) = ring.T, np.roll(ring, -1, axis=0).T
    line = np.arange(lines)[:, None]
    number, edge = np.nonzero((y <= line) != (next_y <= line))
    share = (number - y[edge]) / (next_y - y)[edge]
    right_of = np.ceil(x[edge] + share * (next_x - x)[edge]).astype(np.int64).clip(0, columns)
    crossings = np.bincount(number * (columns + 1) + right_of, minlength=lines * (columns + 1))
    return np.asarray(crossings.reshape(lines, -1).cumsum(axis=1)[:, :-1] % 2 > 0)


def _fused_outline(
    shapes: Sequence[FloatArray], image: IntArray, eyes: _Eyes, most_cells: int
) -> FloatArray | None:
    """Counter-clockwise outline (N, 2) of the paint in the images, or None.

    Each of I images, ``image`` (S,) of the shapes, votes on the ground in its view, weighted by its
    precision.
    """
    extent_m = float(np.ptp(np.concatenate(shapes), axis=0).max())
    cell_m = max(_CELL_M, extent_m / most_cells)
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
    # OpenCV's, as scikit-image's loads all of scipy.signal. The last point is the first.
    simple = cv2.approxPolyDP(largest[:-1, None].astype(np.float32), 0.5, closed=True)[:, 0]
    outline = simple[:, ::-1].astype(np.float64) * cell_m + first
    if len(outline) < 3:
        return None
    return np.asarray(outline if signed_area(outline) > 0 else outline[::-1])
