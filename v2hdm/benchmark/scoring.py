"""The score of a map against the truth of its site: geometry, completeness, stated accuracy, verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from v2hdm.benchmark.sites import Reference
from v2hdm.benchmark.submissions import Submission
from v2hdm.records import HDMap
from v2hdm.report.consistency import Consistency, consistency_of
from v2hdm.report.metrics import (
    LaneMetrics,
    MarkingMetrics,
    corner_errors,
    lane_metrics,
    marking_metrics,
    match_markings,
)

GOAL_M = 0.05  # radius, m, about the true corner within which a good map has 95 % of its corners
FALSE_SHARE = 0.01  # largest share of false markings of a good map

RIGHT = "right"
SILENT = "wrong: the map is not good, and it passed"
FALSE_ALARM = "wrong: the map is good, and it failed"
UNSTATED = "wrong: the map is not good, and its warning understates that"

HOLDS = 0.9  # least share of corners in their stated 95 % ellipses for a warning to state how bad a map is


@dataclass(frozen=True)
class Score:
    """A map's score; lengths in m, nan where nothing can be told.

    Attributes:
        site: name of the site.
        markings: its figures of all markings.
        by_class: the same by class.
        corner_median_m: median distance of a corner from the true one.
        corner_95_m: distance within which 95 % of the corners lie.
        stated: whether errors are as large as stated.
        lanes: its figures of lane lines, None without any.
        is_good: whether 95 % of the corners lie within :data:`GOAL_M`, and hardly a marking is false.
        verdict: that the tool states, None without one.
        verdict_is: what becomes of it: right or why it is wrong; None without one.
        is_strictly_right: whether it is a PASS of a good map or a FAIL of another; None without one.
    """

    site: str
    markings: MarkingMetrics
    by_class: dict[str, MarkingMetrics]
    corner_median_m: float
    corner_95_m: float
    stated: Consistency
    lanes: LaneMetrics | None
    is_good: bool
    verdict: str | None
    verdict_is: str | None
    is_strictly_right: bool | None

    def as_json(self) -> dict[str, Any]:
        """Plain values, None for what cannot be told."""
        plain: dict[str, Any] = _without_nan(asdict(self))
        return plain


def score_map(submission: Submission, reference: Reference, site: str) -> Score:
    """Score a map in the frame of its site."""
    hd_map = submission.hd_map
    true = reference.truth.map.markings
    rows, columns = match_markings(hd_map.markings, true)
    mapped = [hd_map.markings[row] for row in rows]
    counterparts = [true[column] for column in columns]
    errors_m = np.linalg.norm(corner_errors(mapped, counterparts), axis=1)
    figures = marking_metrics(hd_map, reference.truth, reference.expected)
    corner_95_m = float(np.quantile(errors_m, 0.95)) if len(errors_m) else float("nan")
    has_few_false = figures.false_markings <= FALSE_SHARE * figures.markings
    is_good = corner_95_m <= GOAL_M and has_few_false
    stated = consistency_of(mapped, counterparts)
    verdict = submission.verdict
    return Score(
        site=site,
        markings=figures,
        by_class=_by_class(hd_map, reference),
        corner_median_m=float(np.median(errors_m)) if len(errors_m) else float("nan"),
        corner_95_m=corner_95_m,
        stated=stated,
        lanes=lane_metrics(hd_map.lanes, reference.truth) if hd_map.lanes else None,
        is_good=is_good,
        verdict=verdict,
        verdict_is=_judged(verdict, is_good, has_few_false and stated.inside_95 >= HOLDS),
        is_strictly_right=None if verdict is None else verdict == ("PASS" if is_good else "FAIL"),
    )


def _by_class(hd_map: HDMap, reference: Reference) -> dict[str, MarkingMetrics]:
    kinds = dict.fromkeys(marking.kind for marking in (*reference.truth.map.markings, *hd_map.markings))
    return {kind: marking_metrics(hd_map, reference.truth, reference.expected, kind) for kind in kinds}


def _judged(verdict: str | None, is_good: bool, states_errors: bool) -> str | None:
    """Judge a verdict by whether a user of the map is misled.

    A PASS says that the map is good, a FAIL that it must not be used. A WARN says that it may be used for
    what its stated accuracy allows, which misleads nobody while that accuracy holds.
    """
    if verdict is None:
        return None
    if is_good:
        return FALSE_ALARM if verdict == "FAIL" else RIGHT
    if verdict == "PASS":
        return SILENT
    return UNSTATED if verdict == "WARN" and not states_errors else RIGHT


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def table_of(score: Score) -> list[str]:
    """The score as lines for a terminal."""
    figures = score.markings
    rows = [("", "expected", "recall", "mapped", "false", "RMSE")]
    for name, counted in {"all": figures, **score.by_class}.items():
        recall = f"{100 * counted.recall:.1f} %" if np.isfinite(counted.recall) else "-"
        error = _cm(counted.corner_rmse_m)
        rows.append(
            (name, str(counted.expected), recall, str(counted.markings), str(counted.false_markings), error)
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(
            [
                row[0].ljust(widths[0]),
                *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)),
            ]
        )
        for row in rows
    ]
    lines.append(f"corners: half within {_cm(score.corner_median_m)}, 95 % within {_cm(score.corner_95_m)}")
    lines += _stated_lines(score.stated)
    if score.lanes is not None:
        lanes = score.lanes
        lines.append(
            f"lane lines: {_cm(lanes.rms_lateral_error_m)} aside (RMS), {100 * lanes.mapped_fraction:.1f} % "
            f"of the visible length mapped, {lanes.false_length_m:.1f} m false"
        )
    if score.verdict is None:
        lines.append("verdict: none stated")
    else:
        strictly = "right" if score.is_strictly_right else "wrong"
        lines.append(f"verdict: {score.verdict}, {score.verdict_is}; strictly (no WARN) {strictly}")
    return lines


def _stated_lines(stated: Consistency) -> list[str]:
    if not stated.corners:
        return ["stated accuracy: none"]
    parts = {"places": stated.place, "beside neighbours": stated.beside, "shapes": stated.shape}
    said = ", ".join(f"{name} {nees:.2f}" for name, nees in parts.items() if np.isfinite(nees))
    return [
        f"stated accuracy: NEES {stated.nees:.2f} (1 is right), {100 * stated.inside_95:.1f} % of "
        f"{stated.corners} corners inside their 95 % ellipse",
        f"NEES by part: {said}",
    ]


def _cm(length_m: float) -> str:
    return f"{100 * length_m:.1f} cm" if np.isfinite(length_m) else "-"
