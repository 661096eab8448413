"""Areas in a drawing (DXF): closed polylines, hatches, filled faces and wide lines, also in its blocks.

A block's parts on layer 0 are on the layer of the block's insert, as CAD shows them. Arcs of polylines are
drawn as chords.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import ConfigError, MapFileError, need, shown
from v2hdm.geometry.planar import turned_left
from v2hdm.records import FOOT_M, US_FOOT_M, FloatArray
from v2hdm.store.inputs import note_input

UNITS_M: Mapping[str, float] = {
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": FOOT_M, "us-ft": US_FOOT_M, "in": FOOT_M / 12,
}  # fmt: skip
"""Metres of the units of a drawing."""

_STATED_UNITS: Mapping[int, str] = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 21: "us-ft"}
"""Units by their number in the header variable INSUNITS (DXF reference)."""

_FEET = ("ft", "us-ft")  # units that programs state for each other
_SAME_PLACE = 1e-9  # distance, in units of a drawing, of a last vertex that repeats the first
_ARC_M = 1e-3  # largest distance, m, of an arc from its chords; chosen
_LAYER_OF_INSERT = "0"  # layer of a block's parts that are on the layer of the insert
_MOST_NESTED = 16  # levels of blocks within blocks; drawings have three or four
_MOST_ENTITIES = 1_000_000  # entities of a drawing with those in its blocks: a bomb has more

_OUTLINED = ("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE", "SPLINE")  # closed ones are outlines
_LINES = ("LINE", "ARC", "XLINE", "RAY")  # entities that are open lines
_FACES = ("SOLID", "TRACE", "3DFACE")  # entities of three or four corners, filled
_FILLED = ("HATCH", "MPOLYGON")  # entities with boundaries
_UNREADABLE = (
    "3DSOLID", "ACAD_PROXY_ENTITY", "BODY", "EXTRUDEDSURFACE", "MESH", "PLANESURFACE", "REGION", "SURFACE",
)  # fmt: skip
"""Entities that may be areas, whose outline a reader does not get."""


class Area(NamedTuple):
    """A closed outline (N, 2), in units of its drawing, the layer that it is on, and its name in messages."""

    outline: FloatArray
    layer: str
    name: str


class Drawing(NamedTuple):
    """The areas of a drawing, its unit, and the count of other entities."""

    areas: list[Area]
    unit: str  # one of UNITS_M
    crs: str | None  # as our own drawings state it
    lines: int  # open lines
    unreadable: Mapping[str, int]  # entities that may be areas, by their type


class _Placed(NamedTuple):
    """An entity in the coordinates of the drawing."""

    entity: Any
    layer: str
    name: str


def read_drawing(path: Path, unit: str | None) -> Drawing:
    """Read the areas of a DXF file; ``unit`` overrides the one that the file states.

    Raises MapFileError for a damaged file, ConfigError where the unit is unknown or not stated.
    """
    ezdxf = need("ezdxf", "gis", "designs in DXF", ConfigError)
    note_input(path)
    if unit is not None and unit not in UNITS_M:
        raise ConfigError(f"--unit {shown(unit)}: is not a unit of a drawing; give {', '.join(UNITS_M)}")
    try:
        document = ezdxf.readfile(path)
        stated_crs = document.header.custom_vars.get("crs") if document.header.custom_vars else None
        number = int(document.header.get("$INSUNITS", 0))
        placed = list(_placed(document.modelspace(), None, 0))
    except (ezdxf.DXFError, OSError, ValueError, TypeError, UnicodeError, RecursionError) as failure:
        # What is no DXF file at all is an OSError, too.
        reason = getattr(failure, "strerror", None) or failure
        raise MapFileError(f"{path}: is not a readable drawing ({reason}); check the file") from None
    if len(placed) > _MOST_ENTITIES:
        raise MapFileError(
            f"{path}: has more than {_MOST_ENTITIES} entities with its blocks; give the markings only"
        )
    unit = unit or _STATED_UNITS.get(number)
    if unit is None:
        problem = f"its unit (INSUNITS {number}) is none of these" if number else "does not state its unit"
        raise ConfigError(f"{path}: {problem}; give --unit {', '.join(UNITS_M)}")
    return _drawing(placed, unit, stated_crs, path)


def _placed(entities: Iterable[Any], insert: _Placed | None, level: int) -> Iterator[_Placed]:
    """The entities of a layout or of a block's insert, those of blocks in it included."""
    count = 0
    for entity in entities:
        layer = str(entity.dxf.layer)
        if insert is not None and layer == _LAYER_OF_INSERT:
            layer = insert.layer
        kind = entity.dxftype()
        if insert is None:
            name = f"{kind} {entity.dxf.handle} on {layer}"
        else:
            name = f"{kind} on {layer} of {insert.name}"
        if kind != "INSERT":
            count = count + 1
            yield _Placed(entity, layer, name)
        elif level < _MOST_NESTED:
            if insert is None:
                name = f"block {entity.dxf.name} {entity.dxf.handle}"
            here = _Placed(entity, layer, name if insert is None else insert.name)
            for single in entity.multi_insert() if entity.mcount > 1 else (entity,):
                for part in _placed(single.virtual_entities(), here, level + 1):
                    count = count + 1
                    yield part
                    if count > _MOST_ENTITIES:
                        return
        if count > _MOST_ENTITIES:
            return


def _drawing(placed: Iterable[_Placed], unit: str, crs: str | None, path: Path) -> Drawing:
    areas = []
    lines = 0
    unreadable: Counter[str] = Counter()
    for entity, layer, name in placed:
        kind = entity.dxftype()
        try:
            outlines = _outlines(entity, _ARC_M / UNITS_M[unit])
        except (TypeError, ValueError, LookupError, ArithmeticError, RecursionError):
            unreadable[kind] += 1
            continue
        areas += [Area(outline, layer, name) for outline in outlines]
        if not outlines and kind in (*_OUTLINED, *_LINES):
            lines = lines + 1
        if kind in _UNREADABLE:
            unreadable[kind] += 1
    for area in areas:
        if not np.isfinite(area.outline).all():
            raise MapFileError(f"{path}: {area.name}: a coordinate is not finite; fix or drop it")
    return Drawing(areas, unit, crs, lines, unreadable)


def _outlines(entity: Any, chord: float) -> list[FloatArray]:
    """The outlines (N, 2) of an entity; none where it encloses nothing. Chords are that far from arcs."""
    from ezdxf import path as paths

    kind = entity.dxftype()
    if kind in _FACES:
        return [np.array([tuple(vertex)[:2] for vertex in entity.wcs_vertices()], dtype=np.float64)]
    if kind in _FILLED:
        return _outer([_ring(boundary, chord) for boundary in paths.from_hatch(entity)])
    if kind not in _OUTLINED or (kind == "POLYLINE" and not (entity.is_2d_polyline or entity.is_3d_polyline)):
        return []
    drawn_path = paths.make_path(entity)
    if drawn_path.is_closed or (kind in ("LWPOLYLINE", "POLYLINE") and entity.is_closed):
        ring = _ring(drawn_path, chord)
        return [ring] if len(ring) > 2 else []
    return _wide(entity, kind, _ring(drawn_path, chord))


def _outer(rings: list[FloatArray]) -> list[FloatArray]:
    """The rings (N, 2) of a hatch that are no holes of others."""
    shapely = need("shapely", "gis", "designs in DXF", ConfigError)
    rings = [ring for ring in rings if len(ring) > 2]
    inner, _ = shapely.STRtree([shapely.Polygon(ring) for ring in rings]).query(
        shapely.points([ring[0] for ring in rings]), predicate="within"
    )
    depth = np.bincount(inner, minlength=len(rings))
    return [ring for ring, level in zip(rings, depth.tolist(), strict=True) if level % 2 == 0]


def _ring(drawn: Any, chord: float) -> FloatArray:
    """The vertices (N, 2) of a path, without a last one that repeats the first."""
    points = np.array([tuple(point)[:2] for point in drawn.flattening(chord)], dtype=np.float64).reshape(
        -1, 2
    )
    if len(points) > 1 and np.abs(points[0] - points[-1]).max() < _SAME_PLACE:
        return points[:-1]
    return points


def _wide(entity: Any, kind: str, points: FloatArray) -> list[FloatArray]:
    """The outline of a straight polyline with a width, such as a dash of paint."""
    if len(points) != 2 or kind not in ("LWPOLYLINE", "POLYLINE"):
        return []
    if kind == "LWPOLYLINE":
        width = float(entity.dxf.const_width) or float(next(iter(entity.get_points("s")))[0])
    else:
        width = float(entity.dxf.default_start_width) or float(entity.vertices[0].dxf.start_width)
    length = float(np.linalg.norm(points[1] - points[0]))
    if not width > 0 or not length > 0:
        return []
    aside = turned_left((points[1] - points[0])[None])[0] * width / (2 * length)
    return [np.array([points[0] - aside, points[1] - aside, points[1] + aside, points[0] + aside])]


def units_per_system(unit: str, system_unit_m: float) -> float:
    """Units of a coordinate system, ``system_unit_m`` long, that the unit of a drawing in it is.

    Programs state feet of either length for feet: over a grid's false easting their difference is metres.
    """
    is_system_of_feet = min(abs(system_unit_m - UNITS_M[foot]) for foot in _FEET) < _SAME_UNIT_M
    if unit in _FEET and is_system_of_feet:
        return 1.0
    return UNITS_M[unit] / system_unit_m


_SAME_UNIT_M = 1e-6  # largest difference, m, of a unit from a foot that it is
