"""Dashes of an OpenDRIVE file: the broken marks of its lanes (ASAM OpenDRIVE 1.7, chapter 11)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.asbuilt.opendrive import Piece, cubic, number_in, pieces_of, place_along, read_root
from v2hdm.errors import MapFileError
from v2hdm.records import FloatArray

_DASH_M = 3.0  # length of a dash, and of the gap after it, where a mark states none; as in the shipped ports
_WIDTH_M = 0.12  # width of a mark where it states none: of a standard line by OpenDRIVE
_BROKEN = "broken"
_LEAST_M = 1e-3  # least length of a dash, m: what a section's end cuts off may be less


def dashes_of(path: Path) -> list[FloatArray]:
    """The outlines (4, 2) of all dashes in a file, counter-clockwise; MapFileError where it is damaged."""
    outlines = []
    for road in read_root(path).findall("road"):
        try:
            outlines += list(_of_road(road))
        except (TypeError, ValueError, ZeroDivisionError, LookupError, MapFileError) as failure:
            raise MapFileError(f"{path}: road {road.get('id', '')[:40]}: {failure}; fix the file") from None
    return outlines


class _Stretch(NamedTuple):
    """A part of a road, m along its reference line."""

    begin_m: float
    end_m: float


@dataclass(frozen=True)
class _Section:
    """The lanes of a stretch of a road."""

    stretch: _Stretch
    entry: ET.Element
    offsets: Sequence[ET.Element]  # of lane 0 from the reference line, along the road

    def across_m(self, lane: int, s_m: float) -> float:
        """How far to the left of the reference line a lane's outer border, or lane 0, lies at a station."""
        before = [entry for entry in self.offsets if number_in(entry, "s") <= s_m]
        middle_m = cubic(before[-1], "", s_m - number_in(before[-1], "s")) if before else 0.0
        side = int(np.sign(lane))
        inner = [entry for entry in _lanes(self.entry) if 0 < side * _lane_id(entry) <= side * lane]
        return middle_m + side * sum(self._width_m(entry, s_m) for entry in inner)

    def _width_m(self, lane: ET.Element, s_m: float) -> float:
        along_m = s_m - self.stretch.begin_m
        before = [entry for entry in lane.findall("width") if number_in(entry, "sOffset") <= along_m]
        return cubic(before[-1], "", along_m - number_in(before[-1], "sOffset")) if before else 0.0


def _of_road(road: ET.Element) -> Iterator[FloatArray]:
    pieces = pieces_of(road)
    entries = road.findall("lanes/laneSection")
    ends_m = [number_in(entry, "s") for entry in entries]
    ends_m.append(number_in(road, "length"))
    offsets = road.findall("lanes/laneOffset")
    for entry, (begin_m, end_m) in zip(entries, pairwise(ends_m), strict=True):
        section = _Section(_Stretch(begin_m, end_m), entry, offsets)
        for lane in _lanes(entry):
            yield from _of_lane(section, lane, pieces)


def _of_lane(section: _Section, lane: ET.Element, pieces: list[Piece]) -> Iterator[FloatArray]:
    marks = lane.findall("roadMark")
    ends_m = [section.stretch.begin_m + number_in(mark, "sOffset", 0.0) for mark in marks]
    ends_m.append(section.stretch.end_m)
    for mark, (begin_m, end_m) in zip(marks, pairwise(ends_m), strict=True):
        if mark.get("type") != _BROKEN:
            continue
        width_m = number_in(mark, "width", _WIDTH_M)
        for begin, end in _dashes(mark, _Stretch(begin_m, end_m)):
            outline = []
            for s_m, side in ((begin, -0.5), (end, -0.5), (end, 0.5), (begin, 0.5)):
                left_m = section.across_m(_lane_id(lane), s_m) + side * width_m
                outline.append(place_along(pieces, s_m).beside(np.array([[0.0, left_m]]))[0])
            yield np.array(outline)


def _dashes(mark: ET.Element, stretch: _Stretch) -> Iterator[_Stretch]:
    """The dashes of a mark, whole ones and what the stretch's end cuts."""
    line = mark.find("type/line")
    length_m = _DASH_M if line is None else number_in(line, "length")
    gap_m = _DASH_M if line is None else number_in(line, "space")
    if length_m < _LEAST_M or gap_m < 0:
        raise MapFileError(f"a broken mark has dashes of {length_m:g} m and gaps of {gap_m:g} m")
    first_m = stretch.begin_m + (0.0 if line is None else number_in(line, "sOffset", 0.0))
    for begin_m in np.arange(first_m, stretch.end_m - _LEAST_M, length_m + gap_m).tolist():
        yield _Stretch(begin_m, min(begin_m + length_m, stretch.end_m))


def _lanes(section: ET.Element) -> list[ET.Element]:
    return [lane for side in ("left", "center", "right") for lane in section.findall(f"{side}/lane")]


def _lane_id(lane: ET.Element) -> int:
    return int(lane.get("id", "0"))
