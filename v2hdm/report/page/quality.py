"""The quality of a map in the terms of ISO 19157: elements, measures, results and how they were found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from v2hdm.geometry.planar import are_simple, is_simple
from v2hdm.records import ACCURACIES, TWO_SIDED_95
from v2hdm.report.page.facts import Facts
from v2hdm.report.page.identity import drive_date
from v2hdm.report.page.tables import Table, in_words, number, table
from v2hdm.site.accuracy import absolute_radii_m, radius_of_all_m, relative_radii_m, well_known

_HEADINGS = ("element", "measure", "result", "how it was found")
_ADJUSTED = "from the covariances of the adjustment (indirect)"
_NOT_EVALUATED = "not evaluated"


def quality_table(facts: Facts) -> Table | None:
    """Elements of data quality (ISO 19157-1) with the result of each; those not evaluated say so."""
    if facts.hd_map is None:
        return None
    rows = [*_absolute(facts), *_relative(facts), *_heights(facts), *_others(facts)]
    return table(_HEADINGS, rows, words=len(_HEADINGS))


def _absolute(facts: Facts) -> list[Sequence[str]]:
    """Positional accuracy in the frame of the map, stated and checked."""
    assert facts.hd_map is not None
    judged = well_known(facts.hd_map.markings)
    radius_m = radius_of_all_m(absolute_radii_m(judged).ravel())
    element = "Absolute positional accuracy"
    circular = "circular error at 95 % (CE95)"
    without = "" if len(judged) == len(facts.hd_map.markings) else f", without accuracy {ACCURACIES[-1]}"
    rows: list[Sequence[str]] = [
        (
            element,
            circular,
            _cm(radius_m),
            f"{_ADJUSTED}; corners of {in_words(len(judged), 'marking')}{without}",
        )
    ]
    checked_m = _checked_m(facts)
    if len(checked_m):
        external = f"against {in_words(len(checked_m), 'surveyed check point')} (direct, external)"
        rmse_m = float(np.sqrt(np.mean(np.square(checked_m))))
        rows.append((element, "root mean square error of planimetry (RMSEP)", _cm(rmse_m), external))
        rows.append((element, "largest deviation", _cm(float(np.max(checked_m))), external))
    else:
        rows.append((element, "RMSEP at check points", _NOT_EVALUATED, "no check points were surveyed"))
    if facts.truth is not None and "corner_rmse_m" in facts.best:
        rows.append(
            (element, "RMSEP", _cm(float(facts.best["corner_rmse_m"])), "against the rendered site’s truth")
        )
    return rows


def _checked_m(facts: Facts) -> np.ndarray:
    """Distances (N,), m, of the check points that could be compared."""
    distances = []
    for point in facts.check_points:
        try:
            distances.append(float(point.get("distance_m") or "nan"))
        except ValueError:
            continue
    values_m = np.array(distances)
    return np.asarray(values_m[np.isfinite(values_m)])


def _relative(facts: Facts) -> list[Sequence[str]]:
    assert facts.hd_map is not None
    radius_m = radius_of_all_m(relative_radii_m(well_known(facts.hd_map.markings)))
    measure = "relative horizontal error at 95 %, marking to marking within 15 m"
    return [("Relative positional accuracy", measure, _cm(radius_m), _ADJUSTED)]


def _heights(facts: Facts) -> list[Sequence[str]]:
    assert facts.hd_map is not None
    sigmas = [m.heights_sigma_m for m in facts.hd_map.markings if m.heights_sigma_m is not None]
    if not sigmas:
        return [
            ("Vertical accuracy", "linear error at 95 %", _NOT_EVALUATED, "the map states no heights’ errors")
        ]
    error_m = TWO_SIDED_95 * float(np.sqrt(np.mean(np.square(np.concatenate(sigmas)))))
    return [("Vertical accuracy", "linear error at 95 %", _cm(error_m), _ADJUSTED)]


def _others(facts: Facts) -> list[Sequence[str]]:
    """Completeness, consistency, and accuracy of theme and time."""
    assert facts.hd_map is not None
    best = facts.best
    rows: list[Sequence[str]] = []
    rendered = "against the rendered site’s truth"
    if "recall" in best and facts.truth is not None:
        omitted = number(1 - float(best["recall"]), 1, 100)
        rows.append(
            ("Completeness", "rate of omission", f"{omitted} %", f"{rendered}; landmarks driven past")
        )
        extra = number(best.get("false_markings"), 0)
        rows.append(("Completeness", "number of mapped items that are not markings", extra, rendered))
    else:
        unknown = "no independent inventory of the site was given"
        rows.append(("Completeness", "omission, commission", _NOT_EVALUATED, unknown))
    quads = np.array([marking.corners_map for marking in facts.hd_map.markings]).reshape(-1, 4, 2)
    symbols = facts.hd_map.symbols
    crossed = int((~are_simple(quads)).sum()) + sum(not is_simple(symbol.outline_map) for symbol in symbols)
    measure = "outlines that cross themselves"
    result = f"{crossed} of {len(quads) + len(symbols)}"
    rows.append(("Logical consistency", measure, result, "all were tested (direct, internal)"))
    rows.append(("Thematic accuracy", "rate of wrong classes", _NOT_EVALUATED, "no independent inventory"))
    rows.append(("Temporal quality", "valid time", drive_date(facts), "stamps of the images"))
    return rows


def _cm(value_m: float) -> str:
    return f"{number(value_m, 1, 100)} cm" if math.isfinite(value_m) else _NOT_EVALUATED
