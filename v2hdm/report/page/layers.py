"""What the map in the page shows, as one JSON document in local metres."""

from __future__ import annotations

from typing import Any

import numpy as np

from v2hdm.records import FloatArray, Lane, Marking, Symbol
from v2hdm.report.metrics import corner_errors, match_markings
from v2hdm.report.page.facts import Facts
from v2hdm.report.page.ground import mosaic_layer
from v2hdm.report.page.sightings import GroundResiduals

SIGMAS_95 = 2.4477
"""Half axes of the ellipse that holds 95 % of a normal error in two dimensions, in standard deviations: the
root of the chi-square quantile of two degrees of freedom."""

_LEAST_ARROW_SIGHTINGS = 4


def marking_key(identity: int | None) -> str:
    """By what the page finds the pictures of a marking."""
    return f"m{identity}"


def symbol_key(identity: int | None) -> str:
    """The same of a symbol."""
    return f"s{identity}"


def excluded_key(number: int) -> str:
    """The same of candidate ``number`` of those left out."""
    return f"x{number}"


def ellipses(marking: Marking) -> FloatArray | None:
    """The 95 % ellipse of each corner: half axes a >= b in m and direction of a in rad, (4, 3)."""
    if marking.covariance_m2 is None:
        return None
    blocks = marking.covariance_m2.reshape(4, 2, 4, 2)[range(4), :, range(4), :]
    variance, axes = np.linalg.eigh(blocks)
    half = SIGMAS_95 * np.sqrt(np.maximum(variance[:, ::-1], 0.0))
    direction = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])
    return np.column_stack([half, direction])


def layers(facts: Facts, residuals: GroundResiduals | None) -> dict[str, Any]:
    """The document of the map: markings, lanes, symbols, truth, route, what was left out, a mosaic."""
    hd_map = facts.hd_map
    if hd_map is None:
        return {}
    named: list[Marking | Symbol | Lane] = [*hd_map.markings, *hd_map.symbols, *hd_map.lanes]
    kinds = sorted({one.kind for one in named})
    arrows = _arrows(residuals)
    errors = _errors(facts)
    markings = []
    for number, marking in enumerate(hd_map.markings):
        found: dict[str, Any] = {
            "id": marking.id,
            "k": kinds.index(marking.kind),
            "c": _metres(marking.corners_map),
            "n": marking.sightings,
        }
        axes = ellipses(marking)
        if axes is not None:
            found["e"] = np.round(axes, 5).tolist()
        if marking.relative_sigma_m is not None:
            found["r"] = round(SIGMAS_95 * marking.relative_sigma_m, 5)
        if number in errors:
            found["t"] = round(errors[number], 5)
        if marking.id in arrows:
            found["a"] = arrows[marking.id]
        markings.append(found)
    route = facts.route
    return {
        "kinds": kinds,
        "cameras": list(residuals.cameras) if residuals else [],
        "markings": markings,
        "lanes": [
            {"id": one.id, "k": kinds.index(one.kind), "p": _metres(one.points_map), "n": one.sightings}
            for one in hd_map.lanes
        ],
        "symbols": [
            {
                "id": one.id,
                "k": kinds.index(one.kind),
                "p": _metres(one.outline_map),
                "n": one.sightings,
                "e": None if one.sigma_m is None else round(SIGMAS_95 * one.sigma_m, 5),
            }
            for one in hd_map.symbols
        ],
        "excluded": [
            {"k": one.kind, "p": _metres(one.position_map[None])[0], "n": one.sightings, "why": one.reason}
            for one in facts.excluded
        ],
        "checks": _checks(facts),
        "truth": _truth(facts),
        "route": {
            "adjusted": [] if route is None else _metres(route.map_from_vehicle[:, :2, 3]),
            "recorded": [] if route is None or route.recorded is None else _metres(route.recorded[:, :2, 3]),
        },
        "mosaic": mosaic_layer(facts.folder),
    }


def _metres(points: FloatArray) -> list[list[float]]:
    rounded: list[list[float]] = np.round(points, 3).tolist()
    return rounded


def _errors(facts: Facts) -> dict[int, float]:
    """Of the markings that have a true counterpart, by their number: root mean square of the corners, m."""
    if facts.truth is None or facts.hd_map is None:
        return {}
    mapped, true = facts.hd_map.markings, facts.truth.map.markings
    rows, columns = match_markings(mapped, true)
    found = {}
    for row, column in zip(rows, columns, strict=True):
        off = corner_errors([mapped[row]], [true[column]])
        found[row] = float(np.sqrt((off**2).sum(axis=1).mean()))
    return found


def _checks(facts: Facts) -> list[dict[str, Any]]:
    """The surveyed check points: where, and by how much the map differs."""
    checks = []
    for one in facts.check_points:
        place = [_number(one.get(key)) for key in ("x_map_m", "y_map_m")]
        off = [_number(one.get(key)) for key in ("dx_m", "dy_m")]
        if None not in place:
            inside = one.get("inside_95_percent", "")
            checks.append({"id": one.get("id", ""), "p": place, "off": off, "inside": inside})
    return checks


def _number(text: str | None) -> float | None:
    try:
        return float(text or "")
    except ValueError:
        return None


def _truth(facts: Facts) -> dict[str, Any] | None:
    if facts.truth is None:
        return None
    return {
        "markings": [_metres(one.corners_map) for one in facts.truth.map.markings],
        "lanes": [_metres(one.points_map) for one in facts.truth.map.lanes],
    }


def _arrows(residuals: GroundResiduals | None) -> dict[int, list[list[float]]]:
    """By marking an arrow a camera: number of the camera, mean of projected minus observed on the ground, m.

    A pixel covers ground that grows with the squared range, so observations count by its inverse, squared.
    """
    if residuals is None:
        return {}
    good = residuals.is_point & np.isfinite(residuals.ground_m).all(axis=1) & (residuals.marking > 0)
    weight = 1.0 / np.maximum(residuals.range_m[good], 1.0) ** 4
    count = len(residuals.cameras)
    cell = residuals.marking[good] * count + residuals.camera[good]
    total = np.bincount(cell, weight)
    seen = np.bincount(cell)
    sums = np.stack([np.bincount(cell, weight * residuals.ground_m[good, a]) for a in (0, 1)], axis=1)
    out: dict[int, list[list[float]]] = {}
    for one in np.flatnonzero(seen >= _LEAST_ARROW_SIGHTINGS).tolist():
        mean = np.round(sums[one] / total[one], 5).tolist()
        out.setdefault(one // count, []).append([one % count, *mean, int(seen[one])])
    return out
