"""A map against the design of its site: each shape right, off, missing or not inspected; extra markings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from v2hdm.asbuilt.decisions import Fate, Quantity, Tolerances, decided, judge
from v2hdm.asbuilt.design import (
    BuiltShape,
    Design,
    DesignShape,
    built_shapes,
    check_place,
    check_shapes,
    outline_of,
)
from v2hdm.asbuilt.ground import Mosaic, bare_probabilities
from v2hdm.asbuilt.misfit import Misfit, find_misfit
from v2hdm.asbuilt.registration import Pairs, paired, register
from v2hdm.errors import MapFileError
from v2hdm.records import UNSTATED_DRIFT_OVER_M, FloatArray, HDMap, Marking
from v2hdm.site.living.map_errors import SHIFT, Errors

_LEAST_FOUND = 0.2  # least share of the design's shapes that must lie on markings, or it is another site's

_BARE = 0.99  # probability of bare ground from which on a shape of the design is missing


@dataclass(frozen=True)
class Finding:
    """The decision on a shape of the design, or on a marking that the design does not have."""

    fate: Fate
    kind: str
    name: str  # of the shape, empty for an extra marking
    id: int | None  # of the marking, None without one
    meant_map: FloatArray | None  # (4, 2) corners of the shape in the map, m
    found_map: FloatArray | None  # (4, 2) corners of the marking where the map's shared error is taken off
    probability: float | None = None  # that all quantities conform
    quantities: tuple[Quantity, ...] = ()
    bare: float | None = None  # probability of bare ground at a shape without a marking, None if not seen

    @property
    def shape_map(self) -> FloatArray | None:
        """The corners (4, 2) to draw, m: the marking's, or the shape's where there is no marking."""
        return self.meant_map if self.found_map is None else self.found_map


@dataclass(frozen=True)
class Comparison:
    """A map compared with a design."""

    design: Design
    findings: tuple[Finding, ...]
    misfit: Misfit | None  # None where too little is found to tell

    def count(self, fate: Fate) -> int:
        """The number of findings with that fate."""
        return sum(finding.fate is fate for finding in self.findings)

    @property
    def conforms(self) -> bool:
        """Whether nothing is off, missing or extra, and the whole design is in place."""
        wrong = (Fate.OFF, Fate.MISSING, Fate.EXTRA)
        is_moved = self.misfit is not None and self.misfit.is_significant
        return not is_moved and not any(finding.fate in wrong for finding in self.findings)


def compare_with_design(
    hd_map: HDMap, design: Design, tolerance: Tolerances, mosaic: Mosaic | None = None
) -> Comparison:
    """Compare a map with a design in its frame.

    A motion of the whole design is found first, and each marking is judged without it and without the error
    that it shares with its neighbours. A shape without a marking is missing where the ``mosaic`` shows bare
    ground, and else not inspected.

    Raises:
        MapFileError: a shape of the design is none, or the design is not of the map's site.
    """
    design = check_shapes(design)
    if not design.shapes:
        besides = f" ({design.lines} open lines)" if design.lines else ""
        raise MapFileError(
            f"{design.source}: has no closed shapes to compare{besides}; give a design with outlines"
        )
    built = built_shapes(hd_map)
    outlines = [outline_of(shape.outline_map) for shape in design.shapes]
    meant = np.stack([outline.corners_map for outline in outlines])
    kinds = [shape.kind for shape in design.shapes]
    corners = np.array([shape.corners_map for shape in built]).reshape(-1, 4, 2)
    built_kinds = [shape.kind for shape in built]
    _check_site(meant, corners, design)
    start = register(meant, kinds, corners, built_kinds)
    pairs = paired(start.apply(meant), kinds, corners, built_kinds)
    _check_found(pairs, design)
    errors = _errors_of(
        [built[number] for number in pairs.marking], hd_map.drift_over_m or UNSTATED_DRIFT_OVER_M
    )
    places = meant[pairs.shape].mean(axis=1)
    misfit = find_misfit(corners[pairs.marking].mean(axis=1), places, errors, start)
    placed = start.apply(meant) if misfit.is_significant else meant
    findings = []
    for k, number in enumerate(pairs.shape.tolist()):
        marking = built[pairs.marking[k]]
        has_size = marking.has_size and outlines[number].has_size
        pair = _Pair(design.shapes[number], placed[number], marking, int(pairs.turn[k]), has_size)
        covariance_m2 = errors.own_m2[k] + SHIFT @ misfit.common_m2[k] @ SHIFT.T
        findings.append(_judged(pair, marking.corners_map - misfit.common_m[k], covariance_m2, tolerance))
    findings += _missing(pairs, design.shapes, placed, built, mosaic)
    extra = sorted(set(range(len(built))) - set(pairs.marking.tolist()))
    findings += [_extra(built[number]) for number in extra if _is_designed(built[number], kinds)]
    return Comparison(design, tuple(findings), misfit)


def _errors_of(shapes: Sequence[BuiltShape], over_m: float) -> Errors:
    markings = [
        Marking(shape.kind, shape.corners_map, 1, shape.covariance_m2, shape.relative_sigma_m)
        for shape in shapes
    ]
    return Errors.of(markings, over_m)


class _Pair(NamedTuple):
    """A shape of the design, its corners (4, 2) in the map, and the marking that was painted for it."""

    shape: DesignShape
    meant_map: FloatArray
    marking: BuiltShape
    turn: int
    has_size: bool


def _judged(
    pair: _Pair, corners_map: FloatArray, covariance_m2: FloatArray, tolerance: Tolerances
) -> Finding:
    """The finding on a pair; the marking's corners (4, 2) are without the error that it shares."""
    result = judge(pair.meant_map, corners_map, covariance_m2, pair.turn, tolerance, pair.has_size)
    return Finding(
        fate=decided(result.probability),
        kind=pair.marking.kind,
        name=pair.shape.name,
        id=pair.marking.id,
        meant_map=pair.meant_map,
        found_map=corners_map,
        probability=result.probability,
        quantities=result.quantities,
    )


def _missing(
    pairs: Pairs,
    shapes: Sequence[DesignShape],
    placed: FloatArray,
    built: Sequence[BuiltShape],
    mosaic: Mosaic | None,
) -> list[Finding]:
    """Shapes without a marking, which ``placed`` (N, 4, 2) has in the map."""
    alone = np.array(sorted(set(range(len(shapes))) - set(pairs.shape.tolist())), dtype=np.int64)
    kinds = [shapes[number].kind or "" for number in alone]
    bare = np.full(len(alone), np.nan)
    if mosaic is not None and len(alone):
        bare = bare_probabilities(mosaic, kinds, placed[alone], _corners_by_kind(built))
    return [
        Finding(
            fate=Fate.MISSING if probability >= _BARE else Fate.NOT_INSPECTED,
            kind=kind,
            name=shapes[number].name,
            id=None,
            meant_map=placed[number],
            found_map=None,
            bare=float(probability) if np.isfinite(probability) else None,
        )
        for number, kind, probability in zip(alone.tolist(), kinds, bare, strict=True)
    ]


def _corners_by_kind(built: Sequence[BuiltShape]) -> dict[str, FloatArray]:
    """The corners (M, 4, 2) of the map's shapes by class."""
    kinds = sorted({shape.kind for shape in built})
    return {kind: np.stack([shape.corners_map for shape in built if shape.kind == kind]) for kind in kinds}


def _extra(shape: BuiltShape) -> Finding:
    return Finding(Fate.EXTRA, shape.kind, "", shape.id, None, shape.corners_map)


def _is_designed(shape: BuiltShape, kinds: Sequence[str | None]) -> bool:
    """Whether the design has shapes of this class, which makes this one extra."""
    return None in kinds or shape.kind in kinds


def _check_site(meant: FloatArray, corners: FloatArray, design: Design) -> None:
    """Refuse a design that lies elsewhere than the map."""
    if not len(corners):
        raise MapFileError(f"{design.source}: the map has no marking to compare with it; map the site first")
    check_place(meant.mean(axis=1), corners.reshape(-1, 2), design.source, "the map's markings")


def _check_found(pairs: Pairs, design: Design) -> None:
    if len(pairs.shape) < max(1.0, _LEAST_FOUND * len(design.shapes)):
        count_of_kind = Counter(shape.kind or "unknown class" for shape in design.shapes)
        kinds = ", ".join(f"{count} {kind}" for kind, count in count_of_kind.most_common(4))
        raise MapFileError(
            f"{design.source}: {len(pairs.shape)} of its {len(design.shapes)} shapes ({kinds}) lie on "
            "markings of the map; check that it is of this site, and its system, units and classes"
        )
