"""Roads and the outlines of objects in an OpenDRIVE file (ASAM OpenDRIVE 1.7, chapters 9 and 13)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.records import FloatArray
from v2hdm.store.files import read_text

_SAME_PLACE_M = 1e-6  # distance, m, of a last corner that repeats the first
_PAINT_M = 0.1  # largest height, m, of an object that may be paint: posts and barriers are higher; chosen
_MOST_REPEATED = 100_000  # repetitions of an object; a road of 100 km has fewer dashes
_STEP_M = 0.05  # integration step of a spiral, m: exact to a micrometre in bends of roads


class ObjectOutline(NamedTuple):
    """The outline of an object: positions (N, 2), m, what names it in messages, and what it is called."""

    positions: FloatArray
    name: str
    called: str | None


class Pose(NamedTuple):
    """A place on a reference line: x, y and heading."""

    position: FloatArray
    heading_rad: float

    def beside(self, points: FloatArray) -> FloatArray:
        """Points (N, 2), ahead and left of it, in the file's coordinates."""
        cos = np.cos(self.heading_rad)
        sin = np.sin(self.heading_rad)
        return np.asarray(self.position + points @ np.array([[cos, sin], [-sin, cos]]))


class ObjectOutlines(NamedTuple):
    """The outlines in a file, the system of its coordinates, if stated, and its frame in that system."""

    outlines: list[ObjectOutline]
    crs: str | None
    frame: Pose


@dataclass(frozen=True)
class Piece:
    """A geometry of a reference line, from ``s_m`` on."""

    s_m: float
    length_m: float
    start: Pose
    shape: ET.Element

    def at(self, along_m: float) -> Pose:
        """The place ``along_m`` from its start."""
        kind = self.shape.tag
        if kind == "paramPoly3":
            return self._of_polynomials(along_m)
        if kind == "poly3":
            across = cubic(self.shape, "", along_m)
            heading = np.arctan(_slope(self.shape, "", along_m))
            return Pose(
                self.start.beside(np.array([[along_m, across]]))[0], self.start.heading_rad + float(heading)
            )
        if kind not in ("line", "arc", "spiral"):
            raise MapFileError(f"a geometry {kind} is unknown to OpenDRIVE; fix the file")
        begin = number_in(self.shape, "curvature" if kind == "arc" else "curvStart", 0.0)
        end = number_in(self.shape, "curvature" if kind == "arc" else "curvEnd", begin)
        steps = 1 if kind == "line" else max(1, int(np.ceil(abs(along_m) / _STEP_M)))
        middle = (np.arange(steps) + 0.5) * along_m / steps
        change = (end - begin) / self.length_m
        turned = begin * middle + change * middle**2 / 2
        ahead = np.array([np.cos(turned).sum(), np.sin(turned).sum()]) * along_m / steps
        heading_rad = self.start.heading_rad + begin * along_m + change * along_m**2 / 2
        return Pose(self.start.beside(ahead[None])[0], heading_rad)

    def _of_polynomials(self, along_m: float) -> Pose:
        is_normalised = self.shape.get("pRange", "normalized") == "normalized"
        parameter = along_m / self.length_m if is_normalised else along_m
        place = np.array([[cubic(self.shape, axis, parameter) for axis in "UV"]])
        slope = [_slope(self.shape, axis, parameter) for axis in "UV"]
        heading_rad = self.start.heading_rad + float(np.arctan2(slope[1], slope[0]))
        return Pose(self.start.beside(place)[0], heading_rad)


def read_root(path: Path) -> ET.Element:
    """The root of an OpenDRIVE file; raises MapFileError for other files."""
    text = read_text(path, MapFileError)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise MapFileError(f"{path}: declares a document type, which OpenDRIVE has not; take it out")
    try:
        root = ET.fromstring(text.encode())
    except (ET.ParseError, ValueError) as failure:
        raise MapFileError(f"{path}: is not readable XML ({failure}); save it again") from None
    if root.tag != "OpenDRIVE":
        raise MapFileError(f"{path}: is not an OpenDRIVE file (its root is {root.tag[:40]}); give one")
    return root


def outlines_of(path: Path) -> ObjectOutlines:
    """The closed outlines of the objects in a file; MapFileError where it is damaged."""
    root = read_root(path)
    reference = root.findtext("header/geoReference")
    outlines = []
    for road in root.findall("road"):
        where = f"{path}: road {road.get('id', '')[:40]}"
        try:
            pieces = pieces_of(road)
            outlines += [
                outline for entry in road.findall("objects/object") for outline in _outlines(entry, pieces)
            ]
        except (TypeError, ValueError, ZeroDivisionError, LookupError) as failure:
            raise MapFileError(f"{where}: {failure}; fix the file") from None
        except MapFileError as failure:
            raise MapFileError(f"{where}: {failure}") from None
    crs = reference.strip() if reference and reference.strip() else None
    try:
        return ObjectOutlines(outlines, crs, _frame_of(root))
    except (ValueError, MapFileError) as failure:
        raise MapFileError(f"{path}: header: {failure}; fix the file") from None


def _frame_of(root: ET.Element) -> Pose:
    """The place of the file's coordinates in its system, which the header may state as an offset."""
    offset = root.find("header/offset")
    if offset is None:
        return Pose(np.zeros(2), 0.0)
    place = np.array([number_in(offset, "x", 0.0), number_in(offset, "y", 0.0)])
    return Pose(place, number_in(offset, "hdg", 0.0))


def pieces_of(road: ET.Element) -> list[Piece]:
    """The geometries of a road's reference line, in order; MapFileError where one has no shape."""
    pieces = []
    for entry in road.findall("planView/geometry"):
        start = Pose(np.array([number_in(entry, "x"), number_in(entry, "y")]), number_in(entry, "hdg"))
        if not len(entry):
            raise MapFileError("a geometry has no shape; fix the file")
        pieces.append(Piece(number_in(entry, "s"), number_in(entry, "length"), start, entry[0]))
    return sorted(pieces, key=lambda piece: piece.s_m)


def place_along(pieces: list[Piece], s_m: float) -> Pose:
    """The place at ``s_m`` along a reference line, which its last piece goes on."""
    if not pieces:
        raise MapFileError("has no reference line; fix the file")
    before = [piece for piece in pieces if piece.s_m <= s_m] or pieces[:1]
    return before[-1].at(s_m - before[-1].s_m)


def _outlines(entry: ET.Element, pieces: list[Piece]) -> list[ObjectOutline]:
    called = entry.get("name") or entry.get("type")
    name = f"object {entry.get('id', '')[:40]} ({(called or '')[:40]})"
    outline_entries = entry.findall("outlines/outline") or entry.findall("outline")
    is_painted = number_in(entry, "height", 0.0) <= _PAINT_M and called is not None
    outlines = []
    for instance in _instances(entry):
        place = place_along(pieces, instance.s_m)
        centre = place.beside(np.array([[0.0, instance.t_m]]))[0]
        frame = Pose(centre, place.heading_rad + number_in(entry, "hdg", 0.0))
        if not outline_entries and is_painted and min(instance.size_m) > 0:
            corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * instance.size_m
            outlines.append(ObjectOutline(frame.beside(corners), name, called))
        for outline in outline_entries:
            points = _corners(outline, frame, pieces)
            is_area = outline.get("closed", "true") != "false" and outline.get("outer", "true") != "false"
            if len(points) > 2 and is_area:
                outlines.append(ObjectOutline(points, name, called))
    return outlines


class _Instance(NamedTuple):
    """An object, or a repetition of it: its station, m, how far to the left, m, and length and width, m."""

    s_m: float
    t_m: float
    size_m: tuple[float, float]


def _instances(entry: ET.Element) -> list[_Instance]:
    """The object itself, or its repetitions; nothing for one along the whole road, such as a barrier."""
    size_m = (number_in(entry, "length", 0.0), number_in(entry, "width", 0.0))
    repeats = entry.findall("repeat")
    if not repeats:
        return [_Instance(number_in(entry, "s"), number_in(entry, "t", 0.0), size_m)]
    instances = []
    for repeat in repeats:
        begin_m = number_in(repeat, "s")
        length_m = number_in(repeat, "length")
        distance_m = number_in(repeat, "distance", 0.0)
        if distance_m <= 0:
            continue
        count = int((length_m + _SAME_PLACE_M) / distance_m) + 1
        if count > _MOST_REPEATED:
            raise MapFileError(f"an object is repeated {count} times; fix the file")
        for along_m in (distance_m * np.arange(count)).tolist():
            share = along_m / length_m if length_m > 0 else 0.0
            t_m = _between(repeat, "t", number_in(entry, "t", 0.0), share)
            sides_m = (
                _between(repeat, "length", size_m[0], share),
                _between(repeat, "width", size_m[1], share),
            )
            instances.append(_Instance(begin_m + along_m, t_m, sides_m))
    return instances


def _between(repeat: ET.Element, key: str, usual: float, share: float) -> float:
    """A value between those that a repetition states for its start and its end."""
    start = number_in(repeat, f"{key}Start", usual)
    return start + share * (number_in(repeat, f"{key}End", start) - start)


def _corners(outline: ET.Element, frame: Pose, pieces: list[Piece]) -> FloatArray:
    """The corners (N, 2) of an outline, in the object's ``frame`` or along the road."""
    local = [(number_in(corner, "u"), number_in(corner, "v")) for corner in outline.findall("cornerLocal")]
    on_road = [
        place_along(pieces, number_in(corner, "s")).beside(np.array([[0.0, number_in(corner, "t")]]))[0]
        for corner in outline.findall("cornerRoad")
    ]
    points = frame.beside(np.array(local)) if local else np.array(on_road).reshape(-1, 2)
    if len(points) > 1 and np.abs(points[0] - points[-1]).max() < _SAME_PLACE_M:
        return points[:-1]
    return points


def number_in(entry: ET.Element, key: str, missing: float | None = None) -> float:
    """A finite number of an entry, ``missing`` where it has none; MapFileError where there must be one."""
    text = entry.get(key)
    if text is None and missing is not None:
        return missing
    if text is None:
        raise MapFileError(f"a {entry.tag[:40]} has no {key}; fix the file")
    value = float(text)
    if not np.isfinite(value):
        raise MapFileError(f"{key} of a {entry.tag[:40]} is not finite; fix the file")
    return value


def cubic(entry: ET.Element, axis: str, parameter: float) -> float:
    """The polynomial of an entry's ``a``, ``b``, ``c`` and ``d`` of an axis."""
    return sum(number_in(entry, f"{letter}{axis}") * parameter**power for power, letter in enumerate("abcd"))


def _slope(entry: ET.Element, axis: str, parameter: float) -> float:
    slopes = [(number_in(entry, f"{letter}{axis}"), power) for power, letter in enumerate("abcd") if power]
    return sum(power * factor * parameter ** (power - 1) for factor, power in slopes)
