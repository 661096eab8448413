"""The paint that a site is meant to have, and the paint of its map, as shapes that can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.datums import is_same_datum
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.geometry.planar import centroid, is_simple, signed_area
from v2hdm.records import (
    UNSTATED_SIGMA_M,
    FloatArray,
    GeodeticOrigin,
    HDMap,
    Marking,
    PaintLeft,
    Symbol,
)


@dataclass(frozen=True)
class DesignShape:
    """A piece of paint in the design: a closed ``outline_map`` (N, 2), m, counter-clockwise."""

    name: str  # of its feature in the file
    kind: str | None  # class, None where the file does not tell
    outline_map: FloatArray


@dataclass(frozen=True)
class Design:
    """The shapes of a design in the frame of the map, and their source."""

    shapes: tuple[DesignShape, ...]
    source: str = "the design"
    lines: int = 0  # open lines that the source has besides, which are not compared


class Outline(NamedTuple):
    """Four corners (4, 2), counter-clockwise, and whether they are the shape's own, not a box about it."""

    corners_map: FloatArray
    has_size: bool


@dataclass(frozen=True)
class BuiltShape:
    """A marking or symbol of a map: its ``corners_map`` (4, 2), m, and their covariance (8, 8), m^2.

    Of a symbol of any shape they are the corners of the smallest box about it, known as well as its place.
    """

    id: int
    kind: str
    corners_map: FloatArray
    covariance_m2: FloatArray
    has_size: bool
    relative_sigma_m: float | None
    paint: PaintLeft | None = None


def outline_of(outline_map: FloatArray) -> Outline:
    """The four corners of a shape (N, 2): its own, or those of the smallest rectangle about it."""
    if len(outline_map) == 4:
        turns_left = signed_area(outline_map) > 0
        return Outline(outline_map if turns_left else outline_map[::-1], True)
    middle = outline_map.mean(axis=0)
    box = cv2.boxPoints(cv2.minAreaRect((outline_map - middle).astype(np.float32)))
    corners = np.asarray(box, dtype=np.float64)
    # The box says how the shape lies; its middle is that of the shape's area.
    centred = corners - corners.mean(axis=0) + centroid(outline_map)
    return Outline(centred if signed_area(centred) > 0 else centred[::-1], False)


def built_shapes(hd_map: HDMap) -> tuple[BuiltShape, ...]:
    """The markings and symbols of a map; their ids are the map's."""
    shapes = [_built_marking(marking, number) for number, marking in enumerate(hd_map.markings, 1)]
    first = len(shapes) + 1
    return (*shapes, *(_built_symbol(symbol, number) for number, symbol in enumerate(hd_map.symbols, first)))


def _built_marking(marking: Marking, number: int) -> BuiltShape:
    covariance = marking.covariance_m2
    return BuiltShape(
        id=marking.id or number,
        kind=marking.kind,
        corners_map=marking.corners_map,
        covariance_m2=UNSTATED_SIGMA_M**2 * np.eye(8) if covariance is None else covariance,
        has_size=True,
        relative_sigma_m=marking.relative_sigma_m,
        paint=marking.paint,
    )


def _built_symbol(symbol: Symbol, number: int) -> BuiltShape:
    corners, has_size = outline_of(symbol.outline_map)
    covariance = symbol.covariance_m2
    if covariance is None or not has_size:
        # Its place is known to sigma, and each corner to as much besides: of the box they are not stated.
        variance_m2 = (symbol.sigma_m or UNSTATED_SIGMA_M) ** 2
        place = np.tile(np.eye(2), (4, 1))
        covariance = variance_m2 * (place @ place.T + np.eye(8))
    return BuiltShape(symbol.id or number, symbol.kind, corners, covariance, has_size, None)


def design_of_map(hd_map: HDMap, origin: GeodeticOrigin | None, source: str) -> Design:
    """A map as a design, in the frame of a map with that ``origin``.

    Raises MapFileError where one of the two has a place on the earth and the other has not.
    """
    paints: Sequence[Marking | Symbol] = [*hd_map.markings, *hd_map.symbols]
    if (hd_map.origin is None) != (origin is None):
        which = "the design" if origin is None else "the map"
        raise MapFileError(f"{source}: only {which} has an origin on the earth; compare maps of one frame")
    shapes = []
    for number, paint in enumerate(paints, 1):
        outline = paint.corners_map if isinstance(paint, Marking) else paint.outline_map
        if hd_map.origin is not None and origin is not None and hd_map.origin != origin:
            outline = moved_to(outline, hd_map.origin, origin)
        shapes.append(DesignShape(f"{paint.kind} {paint.id or number}", paint.kind, outline))
    return Design(tuple(shapes), source, len(hd_map.lanes))


def moved_to(points_map: FloatArray, old: GeodeticOrigin, new: GeodeticOrigin) -> FloatArray:
    """Points (N, 2) of the map of an ``old`` origin in that of a ``new`` one; MapFileError between datums."""
    if not is_same_datum(old.datum, new.datum):
        raise MapFileError(
            f"the design is on {old.datum}, the map on {new.datum}, which differ by decimetres; bring both "
            "to one datum"
        )
    raised = np.column_stack([points_map, np.zeros(len(points_map))])
    return enu_from_geodetic(new, geodetic_from_enu(old, raised))[:, :2]


def check_shapes(design: Design) -> Design:
    """The design with its shapes counter-clockwise; MapFileError names one that has no area or crosses."""
    shapes = []
    for shape in design.shapes:
        area_m2 = float(signed_area(shape.outline_map))
        if abs(area_m2) < _LEAST_AREA_M2:
            raise MapFileError(f"{design.source}: {shape.name} encloses nothing; fix or drop it")
        if not is_simple(shape.outline_map):
            raise MapFileError(f"{design.source}: the outline of {shape.name} crosses itself; fix or drop it")
        outline = shape.outline_map if area_m2 > 0 else shape.outline_map[::-1]
        shapes.append(replace(shape, outline_map=outline))
    return replace(design, shapes=tuple(shapes))


_LEAST_AREA_M2 = 1e-4  # least area of a shape, m^2: a centimetre squared


def check_place(places: FloatArray, others: FloatArray, source: str, called: str) -> None:
    """Raise MapFileError where all ``places`` (N, 2) of a source lie far from ``others`` (M, 2), m.

    ``called`` names the others. The message names swapped axes where they explain it.
    """
    low = others.min(axis=0)
    high = others.max(axis=0)
    gap_m, swapped_m = (
        float(np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1).min())
        for points in (places, places[:, ::-1])
    )
    if gap_m > _ELSEWHERE_M:
        hint = "its axes are swapped" if swapped_m < _ELSEWHERE_M else "check its system and its units"
        raise MapFileError(f"{source}: all of it lies at least {gap_m:,.0f} m from {called}; {hint}")


_ELSEWHERE_M = 100.0  # least distance, m, between a map and a design that is not of its site
