"""Paint against a table of rules: widths, lengths, gaps, spacings, offsets, angles and wear by class.

A rule has a lower and an upper limit in a unit, and where it is from. Gaps, spacings and offsets are between
a marking and the next one of its class ahead of it, in one row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.asbuilt.comparison import Finding
from v2hdm.asbuilt.decisions import Sizes, axes_of, decided, drawn, judged, sizes_of
from v2hdm.asbuilt.design import BuiltShape, built_shapes
from v2hdm.errors import MapFileError, shown
from v2hdm.geometry.planar import cross, turned_left
from v2hdm.io.rows import read_rows
from v2hdm.io.trajectory import parse_number
from v2hdm.records import FOOT_M, FloatArray, HDMap

_COLUMNS = ("class", "quantity", "low", "high", "unit")
_UNITS: Mapping[str, tuple[str, float]] = {
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "ft": ("m", FOOT_M),
    "in": ("m", FOOT_M / 12),
    "deg": ("deg", 1.0),
    "%": ("%", 1.0),
}
"""The unit that a quantity is measured in, and what one of the table's is of it."""

_MOST_ASIDE_M = 0.5  # largest distance, m, of the next marking of a row from the line of the one before
_MOST_TURNED = np.sin(np.deg2rad(20))  # sine of the largest turn from a marking of a row to the next; chosen
_AHEAD_M = 100.0  # largest distance, m, in which the next marking of a row is looked for
_BROKEN = 3.0  # times the usual spacing of a class beyond which a row has ended, and another begins; chosen


class Rule(NamedTuple):
    """A rule on a ``quantity`` of a class, in ``unit``, with its limits and its place in the file."""

    kind: str
    quantity: str
    low: float
    high: float
    unit: str
    source: str


@dataclass(frozen=True)
class _Measured:
    """Draws (1 + D, 4, 2) of a marking's corners, the first as mapped, and of the next one of its row."""

    shape: BuiltShape
    corners: FloatArray
    following: FloatArray | None

    def sizes(self, corners: FloatArray) -> Sizes:
        return sizes_of(corners, axes_of(corners[0]))

    def length_m(self) -> FloatArray:
        return self.sizes(self.corners).length_m

    def width_m(self) -> FloatArray:
        return self.sizes(self.corners).width_m

    def angle_deg(self) -> FloatArray:
        """The largest difference of a corner's angle from a right one."""
        ahead = np.roll(self.corners, -1, axis=1) - self.corners
        behind = np.roll(ahead, 1, axis=1)
        turns = np.arctan2(cross(behind, ahead), (behind * ahead).sum(axis=2))
        return np.asarray(np.rad2deg(np.abs(turns - np.pi / 2).max(axis=1)))

    def paint_left_percent(self) -> FloatArray | None:
        paint = self.shape.paint
        if paint is None:
            return None
        standard = np.random.default_rng(106).standard_normal(len(self.corners) - 1)
        return 100 * (paint.share + paint.sigma * np.concatenate([[0.0], standard]))

    def gap_m(self) -> FloatArray | None:
        if self.following is None:
            return None
        lengths_m = (self.sizes(self.corners).length_m + self.sizes(self.following).length_m) / 2
        return np.asarray(self._ahead()[0] - lengths_m)

    def spacing_m(self) -> FloatArray | None:
        return None if self.following is None else self._ahead()[0]

    def offset_m(self) -> FloatArray | None:
        return None if self.following is None else self._ahead()[1]

    def _ahead(self) -> tuple[FloatArray, FloatArray]:
        """How far the next marking lies ahead and, either way, aside."""
        assert self.following is not None
        along = self.sizes(self.corners).ahead
        way = self.following.mean(axis=1) - self.corners.mean(axis=1)
        return np.abs((way * along).sum(axis=1)), np.abs((way * turned_left(along)).sum(axis=1))


_MEASURES: Mapping[str, tuple[str, Callable[[_Measured], FloatArray | None]]] = {
    "length": ("m", _Measured.length_m),
    "width": ("m", _Measured.width_m),
    "gap": ("m", _Measured.gap_m),
    "spacing": ("m", _Measured.spacing_m),
    "offset": ("m", _Measured.offset_m),
    "angle": ("deg", _Measured.angle_deg),
    "paint_left": ("%", _Measured.paint_left_percent),
}
"""The unit of each quantity, and its draws; None where a marking has it not."""


def read_rules(path: Path, kinds: Sequence[str]) -> tuple[Rule, ...]:
    """Read a CSV file with the columns class, quantity, low, high, unit and, if it has one, source.

    ``kinds`` are the classes that there are. An empty limit is none. Raises MapFileError, with the line.
    """
    header, rows = read_rows(path, ";\t,", "rule")
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise MapFileError(f"{path}: has no column {missing[0]}; it needs {', '.join(_COLUMNS)}")
    rules = []
    for line, cells in rows:
        cell_of = dict(zip(header, cells, strict=True))
        rules.append(_rule(cell_of, kinds, f"{path}: line {line}"))
    return tuple(rules)


def _rule(cell_of: Mapping[str, str], kinds: Sequence[str], where: str) -> Rule:
    kind = cell_of["class"]
    quantity = cell_of["quantity"]
    unit = cell_of["unit"]
    if kind not in kinds:
        raise MapFileError(f"{where}: {shown(kind)} is not a class; choose from: {', '.join(sorted(kinds))}")
    if quantity not in _MEASURES:
        raise MapFileError(
            f"{where}: unknown quantity {shown(quantity)}; choose from: {', '.join(_MEASURES)}"
        )
    if not unit:
        raise MapFileError(f"{where}: has no unit; give one of: {', '.join(_UNITS)}")
    measured_in, factor = _UNITS.get(unit, ("", 1.0))
    if measured_in != _MEASURES[quantity][0]:
        raise MapFileError(f"{where}: {quantity} is not measured in {shown(unit)}; fix the unit")
    limits = [
        factor * parse_number(cell_of[key], f"{where}: {key}") if cell_of[key] else unlimited
        for key, unlimited in (("low", -np.inf), ("high", np.inf))
    ]
    if not limits[0] <= limits[1]:
        raise MapFileError(f"{where}: low is above high; swap them")
    if not np.isfinite(limits).any():
        raise MapFileError(f"{where}: has no limit; give low, high or both")
    return Rule(kind, quantity, limits[0], limits[1], measured_in, cell_of.get("source", ""))


def compare_with_rules(hd_map: HDMap, rules: Sequence[Rule]) -> tuple[Finding, ...]:
    """Judge each marking of a map by the rules on its class; those of classes without rules are left out."""
    findings = []
    for kind in dict.fromkeys(rule.kind for rule in rules):
        shapes = [shape for shape in built_shapes(hd_map) if shape.kind == kind and shape.has_size]
        of_kind = [rule for rule in rules if rule.kind == kind]
        findings += [_finding(measured, of_kind) for measured in _measured(shapes)]
    return tuple(findings)


def _measured(shapes: Sequence[BuiltShape]) -> list[_Measured]:
    """The shapes of a class, each with the next one of its row, if it has one."""
    draws = [
        np.concatenate([shape.corners_map[None], drawn(shape.corners_map, shape.covariance_m2)])
        for shape in shapes
    ]
    return [
        _Measured(shape, draws[k], None if following is None else _beside(shapes, draws, k, following))
        for k, (shape, following) in enumerate(zip(shapes, _following(shapes), strict=True))
    ]


def _beside(shapes: Sequence[BuiltShape], draws: Sequence[FloatArray], first: int, second: int) -> FloatArray:
    """Draws of the second shape given those of the first: what both share with their surroundings is one."""
    shared_m2 = min(_shared_m2(shapes[first]), _shared_m2(shapes[second]))
    total_m2 = [
        np.einsum("iaja->", shapes[k].covariance_m2.reshape(4, 2, 4, 2)) / 32 for k in (first, second)
    ]
    moved = draws[first].mean(axis=1) - shapes[first].corners_map.mean(axis=0)
    alone_m2 = shapes[second].covariance_m2 - shared_m2 * np.kron(np.ones((4, 4)), np.eye(2))
    gain = shared_m2 / total_m2[0] if total_m2[0] > 0 else 0.0
    corners = shapes[second].corners_map
    reverse = drawn(corners, alone_m2)[::-1]  # other draws than those of the first
    return np.concatenate([corners[None], reverse + gain * moved[1:, None]])


def _shared_m2(shape: BuiltShape) -> float:
    """The variance, m^2, of the part of a marking's error that its neighbours have, too."""
    if shape.relative_sigma_m is None:
        return 0.0
    centre_m2 = float(np.einsum("iaja->", shape.covariance_m2.reshape(4, 2, 4, 2))) / 32
    return max(centre_m2 - shape.relative_sigma_m**2, 0.0)


def _following(shapes: Sequence[BuiltShape]) -> list[int | None]:
    """The next shape of each one's row, ahead along its length; None at the end of a row."""
    if not shapes:
        return []
    centres = np.array([shape.corners_map.mean(axis=0) for shape in shapes])
    ahead = np.array([sizes_of(shape.corners_map, axes_of(shape.corners_map)).ahead for shape in shapes])
    # Directions have no sign of their own: all point to the same half of the plane, along their row.
    main = np.linalg.eigh(np.einsum("ni,nj->ij", ahead, ahead))[1][:, 1]
    ahead = ahead * np.where(ahead @ main < 0, -1.0, 1.0)[:, None]
    next_shape = np.full(len(shapes), -1)
    spacing_m = np.full(len(shapes), np.nan)
    for k, neighbours in enumerate(cKDTree(centres).query_ball_point(centres, _AHEAD_M)):
        way = centres[neighbours] - centres[k]
        along_m = way @ ahead[k]
        aside_m = np.abs(way @ turned_left(ahead[k]))
        turned = np.abs(cross(ahead[neighbours], ahead[k][None]))
        fits = (along_m > 0) & (aside_m < _MOST_ASIDE_M) & (turned < _MOST_TURNED)
        if fits.any():
            nearest = int(np.argmin(np.where(fits, along_m, np.inf)))
            next_shape[k] = neighbours[nearest]
            spacing_m[k] = along_m[nearest]
    if np.isfinite(spacing_m).any():
        next_shape[spacing_m > _BROKEN * np.nanmedian(spacing_m)] = -1
    return [int(number) if number >= 0 else None for number in next_shape]


def _finding(measured: _Measured, rules: Sequence[Rule]) -> Finding:
    values = []
    for rule in rules:
        draws = _MEASURES[rule.quantity][1](measured)
        if draws is not None:
            values.append((rule.quantity, draws, rule.low, rule.high, rule.unit))
    result = judged(values)
    shape = measured.shape
    return Finding(
        fate=decided(result.probability),
        kind=shape.kind,
        name="",
        id=shape.id,
        meant_map=None,
        found_map=shape.corners_map,
        probability=result.probability,
        quantities=result.quantities,
    )
