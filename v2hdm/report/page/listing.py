"""The lists of a document: markings, lane lines, weak places, what was left out, corrections by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along, rectangle_size
from v2hdm.records import FloatArray, Marking, Symbol
from v2hdm.report.page.facts import Facts
from v2hdm.report.page.reference import Reference
from v2hdm.report.page.tables import Table, name_of, number
from v2hdm.report.weak import MOST_PLACES, Place, weak_places
from v2hdm.site.accuracy import absolute_radii_m, corner_radii_m


def marking_table(facts: Facts, reference: Reference) -> Table | None:
    """Every marking and symbol: number, class, accuracy, centre, size, 95 % radius of its worst corner."""
    if facts.hd_map is None:
        return None
    features: list[Marking | Symbol] = [*facts.hd_map.markings, *facts.hd_map.symbols]
    centres = np.array([_outline(feature).mean(axis=0) for feature in features]).reshape(-1, 2)
    worst_m = absolute_radii_m(facts.hd_map.markings).max(axis=1).tolist()
    for symbol in facts.hd_map.symbols:
        covariance_m2 = symbol.covariance_m2
        worst_m.append(np.inf if covariance_m2 is None else float(corner_radii_m(covariance_m2).max()))
    rows = []
    for feature, (first, second), radius_m in zip(features, reference.words(centres), worst_m, strict=True):
        length_m, width_m = rectangle_size(_outline(feature))
        size = [number(length_m, 2), number(width_m, 2)]
        numbers = [first, second, *size, number(None if np.isinf(radius_m) else radius_m, 1, 100)]
        numbers.append(str(feature.sightings))
        rows.append([str(feature.id), name_of(feature.kind), feature.accuracy or "–", *numbers])
    axes = reference.axes
    headings = ("no.", "class", "accuracy", *axes, "length (m)", "width (m)", "95 % radius (cm)", "images")
    return Table(headings, rows, [True, False, False, *[True] * 6])


def _outline(feature: Marking | Symbol) -> FloatArray:
    return feature.corners_map if isinstance(feature, Marking) else feature.outline_map


def lane_table(facts: Facts, reference: Reference) -> Table | None:
    """Every lane line: its class and length, and the coordinates of its ends."""
    if facts.hd_map is None or not facts.hd_map.lanes:
        return None
    lanes = facts.hd_map.lanes
    ends = np.concatenate([lane.points_map[[0, -1]] for lane in lanes])
    words = reference.words(ends)
    rows = []
    for place, lane in enumerate(lanes):
        length_m = float(length_along(lane.points_map)[-1])
        begin, end = words[2 * place : 2 * place + 2]
        rows.append(
            [str(lane.id), name_of(lane.kind), number(length_m, 1), *begin, *end, str(lane.sightings)]
        )
    first, second = reference.axes
    ends_of = (f"begins {first}", second, f"ends {first}", second)
    headings = ("no.", "class", "length (m)", *ends_of, "images")
    return Table(headings, rows, [True, False, *[True] * 6])


class LeftOut(NamedTuple):
    """A reason for leaving candidates out, in plain words, and how many it concerns."""

    reason: str
    candidates: int


def left_out(facts: Facts) -> tuple[LeftOut, ...]:
    """The reasons, most frequent first."""
    counts = Counter(candidate.reason for candidate in facts.excluded)
    return tuple(LeftOut(reason, count) for reason, count in counts.most_common())


class Again(NamedTuple):
    """Where to drive again: the place in words, and how."""

    where: tuple[str, str]  # the coordinates of its middle
    markings: int
    radius: str  # cm
    says: str


class DriveAgain(NamedTuple):
    """The places where a further drive pays, and how many more there are."""

    places: tuple[Again, ...]
    more: int


def places_of(facts: Facts) -> tuple[Place, ...]:
    """The places of markings below accuracy A, those of most markings first."""
    if facts.hd_map is None:
        return ()
    return weak_places(facts.hd_map, facts.coverage, route_map_of(facts))


def drive_again(places: Sequence[Place], reference: Reference) -> DriveAgain:
    """The first of the weak ``places`` in words."""
    listed = places[:MOST_PLACES]
    where = reference.words(_centres(listed))
    rows = tuple(
        Again(at, place.markings, number(place.radius_m, 1, 100), place.says)
        for at, place in zip(where, listed, strict=True)
    )
    return DriveAgain(rows, len(places) - len(listed))


def route_map_of(facts: Facts) -> FloatArray:
    """The way driven (F, 2), m; nothing without a route."""
    return np.zeros((0, 2)) if facts.route is None else facts.route.map_from_vehicle[:, :2, 3]


def _centres(places: Sequence[Place]) -> FloatArray:
    return np.array([place.centre_map for place in places]).reshape(-1, 2)


def correction_table(facts: Facts) -> Table | None:
    """The corrections by hand that the map follows, and what the images say against them."""
    corrections: list[dict[str, Any]] = facts.metrics.get("corrections") or []
    rows = [
        [str(entry.get("place", "")), str(entry.get("says", "")), str(entry.get("against") or "–")]
        for entry in corrections
    ]
    return Table(("where", "correction", "the images say"), rows, [False] * 3) if rows else None
