"""The paint of a real road, for :mod:`tests.benchmarks.real_drive`: read from a file that people drew.

A reference never comes from a map of our own: what the map lacks would be missing in it, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import MapFileError
from v2hdm.records import ARROW, LANE_DASH, FloatArray

TOLERANCE_M = 0.5
"""Distance between the centres of a dash and of what is taken for it, up to which they are one marking."""

ARROW_TOLERANCE_M = 1.0
"""The same of an arrow: its centre in a truth file is good to half a metre."""

REACH_M = 20.0
"""Distance from the route, m, beyond which no marking of a drive's own reference lies."""

_BEYOND_ROUTE_M = 30.0  # length, m, by which a route is continued straight at both ends


@dataclass(frozen=True)
class Painted:
    """A marking that is really there: ``polygon_map`` (N, 2) m, any simple polygon.

    ``other_road`` says that it lies on a road beside the one driven, which need not be in its plane;
    an ``optional`` one is neither missed where it is not found, nor false where it is. Something is taken
    for it whose centre lies within ``tolerance_m``.
    """

    kind: str
    polygon_map: FloatArray
    other_road: bool = False
    optional: bool = False
    tolerance_m: float = TOLERANCE_M

    @property
    def centre_map(self) -> FloatArray:
        """Its centre of area (2,), m."""
        return centre_of_area(self.polygon_map)


@dataclass(frozen=True)
class Reference:
    """All that is painted; of the classes ``whole`` it is really all, so that anything else is false.

    ``hidden`` are the boxes (u0, v0, u1, v1) of an image behind which something stands before the road;
    ``cam_from_map`` (4, 4) places the camera of an image better than the drive's own map does.
    """

    markings: tuple[Painted, ...]
    whole: frozenset[str]
    hidden: Mapping[int, list[FloatArray]] = field(default_factory=dict)
    cam_from_map: Mapping[int, FloatArray] = field(default_factory=dict)


def centre_of_area(polygon: FloatArray) -> FloatArray:
    """Centre of area (2,) of a polygon (N, 2) of any turning; its mean vertex if it has no area."""
    middle = polygon.mean(axis=0)
    moments = cv2.moments((polygon - middle).astype(np.float32))
    if abs(moments["m00"]) < 1e-6:
        return np.asarray(middle)
    return np.asarray(middle + np.array([moments["m10"], moments["m01"]]) / moments["m00"])


def read_reference(path: Path, route_map: FloatArray) -> Reference:
    """The reference in a JSON file, as drawn over pictures of the road or measured otherwise.

    A file has ``markings``, a list of ``{"kind", "polygon_map", "other_road", "optional"}``; ``whole``, true
    if nothing else is painted; ``hidden``, a list of ``{"image", "box_px"}``; ``cam_from_map``, a list of
    ``{"image", "matrix"}``. Lengths are metres in the map frame; a marking may give ``polygon_road``, ways
    along ``route_map`` (N, 2) and offsets to its left, instead of ``polygon_map``. All but ``markings`` may
    be left out. A truth file has instead ``dashes``, corners (M, 4, 2), and ``arrows``, centres (2,) by name:
    of these two classes it is whole.

    Raises:
        MapFileError: the file is missing, not of this form, or of another drive than the route's.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        reference = _truth(content) if "dashes" in content else _drawn(content, route_map)
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise MapFileError(f"{path}: no reference can be read ({error!r}); see read_reference") from error
    centres = np.array([painted.centre_map for painted in reference.markings]).reshape(-1, 2)
    offset_m = np.linalg.norm(centres[:, None] - route_map, axis=2)
    if len(centres) and offset_m.min() > REACH_M:
        raise MapFileError(
            f"{path}: none of its {len(centres)} markings lies within {REACH_M:g} m of the route, the "
            f"nearest {offset_m.min():.0f} m away: is it the reference of another drive?"
        )
    return reference


def _drawn(content: Mapping[str, Any], route_map: FloatArray) -> Reference:
    """The reference of a file with ``markings``."""
    markings = tuple(_painted(entry, route_map) for entry in content["markings"])
    hidden: dict[int, list[FloatArray]] = {}
    for entry in content.get("hidden", []):
        hidden.setdefault(int(entry["image"]), []).append(np.array(entry["box_px"], dtype=np.float64))
    cameras = {
        int(entry["image"]): np.array(entry["matrix"], dtype=np.float64).reshape(4, 4)
        for entry in content.get("cam_from_map", [])
    }
    whole = frozenset(PAINT_CLASSES if content.get("whole", False) else ())
    return Reference(markings, whole, hidden, cameras)


def _truth(content: Mapping[str, Any]) -> Reference:
    """The reference of a file with ``dashes`` and ``arrows``."""
    corners_map = np.array(content["dashes"], dtype=np.float64).reshape(-1, 4, 2)
    dashes = [Painted(LANE_DASH, corners) for corners in corners_map]
    centres_map = np.array(list(content["arrows"].values()), dtype=np.float64).reshape(-1, 2)
    # What is known of an arrow is its centre: it stands for all within its tolerance.
    angle_rad = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    disc = ARROW_TOLERANCE_M * np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    arrows = [Painted(ARROW, centre + disc, tolerance_m=ARROW_TOLERANCE_M) for centre in centres_map]
    return Reference((*dashes, *arrows), frozenset({LANE_DASH, ARROW}))


def _painted(entry: dict[str, object], route_map: FloatArray) -> Painted:
    on_road = "polygon_road" in entry
    polygon = np.array(entry["polygon_road" if on_road else "polygon_map"], dtype=np.float64)
    if entry["kind"] not in PAINT_CLASSES or polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
        raise ValueError(f"not a marking: {entry}")
    if on_road:
        polygon = Route(route_map).at(polygon)
    return Painted(str(entry["kind"]), polygon, bool(entry.get("other_road")), bool(entry.get("optional")))


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
