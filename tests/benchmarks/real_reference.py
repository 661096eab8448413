"""What is painted on a real road, for :mod:`tests.benchmarks.real_drive`: read from a file, or from the map.

A real drive has no ground truth. Painted dashes repeat, though, so those that the map holds tell where the
others are; a file drawn by hand corrects that, or replaces it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import MapFileError
from v2hdm.records import LANE_DASH, FloatArray, Marking

MAX_FILLED_M = 30.0
"""Between dashes of the map farther apart than this, none are implied."""

MAX_BESIDE_M = 0.6
MAX_OFF_BEAT_M = 0.5
"""A dash this far beside its line, or from the beat of its line, is taken for another line's."""

_LEAST_DASHES = 3
_BEYOND_ROUTE_M = 30.0
_PERIODS_M = (2.0, 18.0)


@dataclass(frozen=True)
class Painted:
    """A marking that is really there: ``polygon_map`` (N, 2) m, any simple polygon.

    ``other_road`` says that it lies on a road beside the one driven, which need not be in its plane;
    an ``optional`` one is neither missed where it is not found, nor false where it is.
    """

    kind: str
    polygon_map: FloatArray
    other_road: bool = False
    optional: bool = False

    @property
    def centre_map(self) -> FloatArray:
        """Its centre of area (2,), m."""
        return centre_of_area(self.polygon_map)


@dataclass(frozen=True)
class Reference:
    """All that is painted; ``whole`` if that is really all, so that anything else is false.

    ``hidden`` are the boxes (u0, v0, u1, v1) of an image behind which something stands before the road;
    ``cam_from_map`` (4, 4) places the camera of an image better than the drive's own map does.
    """

    markings: tuple[Painted, ...]
    whole: bool
    hidden: dict[int, list[FloatArray]]
    cam_from_map: dict[int, FloatArray] = field(default_factory=dict)


def centre_of_area(polygon: FloatArray) -> FloatArray:
    """Centre of area (2,) of a polygon (N, 2) of any turning; its mean vertex if it has no area."""
    middle = polygon.mean(axis=0)
    moments = cv2.moments((polygon - middle).astype(np.float32))
    if abs(moments["m00"]) < 1e-6:
        return np.asarray(middle)
    return np.asarray(middle + np.array([moments["m10"], moments["m01"]]) / moments["m00"])


def make_reference(mapped: Sequence[Marking], route_map: FloatArray, path: Path | None) -> Reference:
    """The dashes of the map, completed along their lines, as the file at ``path`` corrects them.

    The file is JSON: ``markings``, a list of ``{"kind", "polygon_map", "other_road", "optional"}``, each of
    which takes the place of what it lies on; ``remove``, a list of places [x, y] where the map is wrong;
    ``whole``, true if nothing else is painted, whereupon the map is not asked; ``hidden``, a list of
    ``{"image", "box_px"}``; ``cam_from_map``, a list of ``{"image", "matrix"}``. Lengths are metres in the
    map frame; a marking may give ``polygon_road``, ways along ``route_map`` (N, 2) and offsets to its left,
    instead of ``polygon_map``. All but ``markings`` may be left out.

    Raises:
        MapFileError: the file is missing or not of this form.
    """
    if path is None:
        return Reference(tuple(complete_lines(mapped, route_map)), False, {})
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        drawn = [_painted(entry, route_map) for entry in content["markings"]]
        places = np.array(content.get("remove", []), dtype=np.float64).reshape(-1, 2)
        hidden: dict[int, list[FloatArray]] = {}
        for entry in content.get("hidden", []):
            hidden.setdefault(int(entry["image"]), []).append(np.array(entry["box_px"], dtype=np.float64))
        cameras = {
            int(entry["image"]): np.array(entry["matrix"], dtype=np.float64).reshape(4, 4)
            for entry in content.get("cam_from_map", [])
        }
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise MapFileError(f"{path}: no reference can be read ({error!r}); see make_reference") from error
    whole = bool(content.get("whole", False))
    implied = [] if whole else complete_lines(mapped, route_map)
    taken = np.concatenate([places, *[p.centre_map[None] for p in drawn]])
    kept = [p for p in implied if _nearest(p.centre_map, taken) > 1.0]
    return Reference((*drawn, *kept), whole, hidden, cameras)


def _painted(entry: dict[str, object], route_map: FloatArray) -> Painted:
    on_road = "polygon_road" in entry
    polygon = np.array(entry["polygon_road" if on_road else "polygon_map"], dtype=np.float64)
    if entry["kind"] not in PAINT_CLASSES or polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
        raise ValueError(f"not a marking: {entry}")
    if on_road:
        polygon = Route(route_map).at(polygon)
    return Painted(str(entry["kind"]), polygon, bool(entry.get("other_road")), bool(entry.get("optional")))


def _nearest(point: FloatArray, others: FloatArray) -> float:
    return float(np.linalg.norm(others - point, axis=1).min(initial=np.inf))


def complete_lines(mapped: Sequence[Marking], route_map: FloatArray) -> list[Painted]:
    """The markings of the map and the dashes that are missing between its dashes.

    Dashes are sorted by their way along the route (N, 2) and their offset from it into lines. On each the
    n-th dash is at a constant beat; where none is mapped, one of the line's mean shape is put in.
    """
    out = [Painted(m.kind, m.corners_map) for m in mapped]
    dashes = [m.corners_map for m in mapped if m.kind == LANE_DASH]
    if len(dashes) < _LEAST_DASHES:
        return out
    route = Route(route_map)
    way = route.along(np.array([centre_of_area(dash) for dash in dashes]))
    for line in _lines(way):
        size = np.median([_size(dashes[k]) for k in line], axis=0)
        missing = _missing(way[line])
        half_length = np.array([size[0] / 2, 0.0])
        ends = zip(route.at(missing - half_length), route.at(missing + half_length), strict=True)
        for start, end in ends:
            side = np.array([start[1] - end[1], end[0] - start[0]]) / np.linalg.norm(end - start)
            half = side * size[1] / 2
            out.append(Painted(LANE_DASH, np.array([start - half, end - half, end + half, start + half])))
    return out


class Route:
    """A driven path as a smooth curve: points as (way along it, offset to the left), m."""

    def __init__(self, route_map: FloatArray):
        step = np.linalg.norm(np.diff(route_map, axis=0), axis=1)
        moved = np.concatenate([[True], step > 0.05])
        points = route_map[moved]
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        degree = int(np.clip(way[-1] // 25 + 1, 1, 9))
        scale = max(way[-1], 1.0)
        curve = [np.polynomial.Polynomial.fit(way, points[:, k], degree) for k in (0, 1)]
        inside = np.arange(0.0, scale, 0.1)
        middle = np.column_stack([c(inside) for c in curve])
        first, last = (np.array([c.deriv()(s) for c in curve]) for s in (0.0, inside[-1]))
        ahead = np.arange(0.1, _BEYOND_ROUTE_M, 0.1)[:, None]
        self.points = np.concatenate([middle[0] - ahead[::-1] * first, middle, middle[-1] + ahead * last])
        self.way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])
        tangent = np.gradient(self.points, axis=0)
        self.tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)

    def along(self, points_map: FloatArray) -> FloatArray:
        """(way, offset) (N, 2) of points (N, 2)."""
        nearest = np.linalg.norm(points_map[:, None] - self.points[None], axis=2).argmin(axis=1)
        offset, tangent = points_map - self.points[nearest], self.tangent[nearest]
        forward = (offset * tangent).sum(axis=1)
        left = tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0]
        return np.column_stack([self.way[nearest] + forward, left])

    def at(self, way_offset: FloatArray) -> FloatArray:
        """Points (N, 2) at (way, offset) (N, 2)."""
        at = [np.interp(way_offset[:, 0], self.way, self.points[:, k]) for k in (0, 1)]
        tx, ty = (np.interp(way_offset[:, 0], self.way, self.tangent[:, k]) for k in (0, 1))
        return np.asarray(np.column_stack(at) + way_offset[:, 1:] * np.column_stack([-ty, tx]))


def _lines(way: FloatArray) -> list[list[int]]:
    """Indices of dashes at (way, offset) (N, 2) by line; lines of too few dashes are left out."""
    lines: list[list[int]] = []
    for k in np.argsort(way[:, 0]):
        for line in lines:
            ahead, beside = way[k] - way[line[-1]]
            if 0.5 < ahead <= MAX_FILLED_M and abs(beside) <= MAX_BESIDE_M:
                line.append(int(k))
                break
        else:
            lines.append([int(k)])
    return [line for line in lines if len(line) >= _LEAST_DASHES]


def _missing(way: FloatArray) -> FloatArray:
    """(way, offset) of the dashes that the beat of a line (N, 2), in order, has between its own."""
    steps = np.diff(way[:, 0])
    usual = steps[(steps > _PERIODS_M[0]) & (steps < _PERIODS_M[1])]
    if not len(usual):
        return np.empty((0, 2))
    period = float(np.median(usual[usual < 1.5 * usual.min()]))
    count = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / period), 1))])
    beat = np.polyfit(count, way[:, 0], 1)
    on_beat = np.abs(np.polyval(beat, count) - way[:, 0]) <= MAX_OFF_BEAT_M
    missing = np.setdiff1d(np.arange(count[-1]), count)
    # Painters drift: a dash lies where its neighbours say, not where the whole line's beat does.
    at = (
        np.interp(missing, count[on_beat], way[on_beat, 0])
        if on_beat.sum() > 1
        else np.polyval(beat, missing)
    )
    return np.column_stack([at, np.interp(at, way[:, 0], way[:, 1])])


def _size(corners: FloatArray) -> tuple[float, float]:
    """Length and width of a quadrilateral (4, 2)."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    first, second = (sides[0] + sides[2]) / 2, (sides[1] + sides[3]) / 2
    return float(max(first, second)), float(min(first, second))
