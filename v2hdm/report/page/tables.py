"""The report's tables, key figures and cameras as text with units, for the templates."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from v2hdm.geometry.ipm import angle_sigmas, centre_sigmas, mounting_angles
from v2hdm.geometry.planar import length_along
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import ACCURACIES, SIGMAS_95, Lane, Marking, Symbol
from v2hdm.report.metrics import corner_errors, match_markings
from v2hdm.report.page.facts import CameraFacts, Facts
from v2hdm.report.terminal import METHODS, figure_columns
from v2hdm.site.accuracy import absolute_radii_m, radius_of_all_m, relative_radii_m, well_known


class Table(NamedTuple):
    """Rows of text under headings; ``numeric`` columns are right-aligned."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: Sequence[bool]


class Figure(NamedTuple):
    """One key figure: name, value, unit and meaning."""

    name: str
    value: str
    unit: str
    note: str


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> Table:
    """A table with ``words`` columns of text, then numbers."""
    return Table(headings, rows, [n >= words for n in range(len(headings))])


def number(value: object, digits: int | None = None, factor: float = 1.0) -> str:
    """A number as text, with three significant digits by default; a dash if there is none.

    What is not zero never reads so: it has one digit then, as 0.04 or 3e-05.
    """
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    if digits is None:
        digits = min(max(0, 2 - math.floor(math.log10(abs(value)))), 6) if value else 0
    text = f"{factor * value:.{digits}f}"
    if value and not float(text):
        text = f"{factor * value:.1g}"
    return text.replace("-", "−")


def probability(value: float) -> str:
    """A test's probability as text; a tiny one is given as an upper limit."""
    return "< 0.001" if value < _LEAST_PROBABILITY else f"{value:.3f}"


_LEAST_PROBABILITY = 1e-3  # smallest probability of a test that is printed as a number


def name_of(kind: str) -> str:
    """A class name for readers."""
    return kind.replace("_", " ")


def in_words(count: int, what: str) -> str:
    """``1 marking``, ``2 markings``."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def pair_table(content: Mapping[str, Any]) -> Table | None:
    """Names and values of a part of ``metrics.json``, with its own parts; None is left out."""
    rows = list(_pairs(content))
    return table(("", ""), rows, words=2) if rows else None


_UNITS = {"m": "m", "s": "s", "deg": "°", "sha256": "SHA-256"}
"""Units as readers know them, by the endings of names."""


def _pairs(content: Mapping[str, Any], of: str = "") -> Iterator[list[str]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _pairs(value, f"{name_of(key)}: ")
        elif value is not None:
            name, _, ending = key.rpartition("_")
            has_unit = ending in _UNITS and name
            yield [of + (f"{name_of(name)} ({_UNITS[ending]})" if has_unit else name_of(key)), _plain(value)]


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(part) for part in value)
    return number(value) if isinstance(value, float) else str(value)


_LEAST_FOR_SHARE = 20  # least number of corners for a percentage

_Mapped = TypeVar("_Mapped", bound=Marking | Symbol | Lane)


def key_figures(facts: Facts) -> tuple[Figure, ...]:
    """Key figures at the top of the page."""
    if facts.hd_map is None:
        return ()
    markings = facts.hd_map.markings
    best = facts.best
    lanes = best.get("lanes", {})
    symbols = in_words(len(facts.hd_map.symbols), "symbol")
    length = number(lanes.get("length_m"), 0)
    figures = [
        Figure("Markings", str(len(markings)), "", f"and {symbols}"),
        Figure("Lane lines", str(len(facts.hd_map.lanes)), "", f"{length} m in total"),
    ]
    judged = well_known(markings)
    exception = "" if len(judged) == len(markings) else f"; without accuracy {ACCURACIES[-1]}"
    for name, radii_m, note in (
        ("In the map’s frame", absolute_radii_m(judged).ravel(), f"holds 95 % of the corners{exception}"),
        ("From marking to marking", relative_radii_m(judged), f"holds 95 % of the markings{exception}"),
    ):
        radius_m = radius_of_all_m(radii_m)
        if math.isfinite(radius_m):
            figures.append(Figure(name, number(radius_m, 1, 100), "cm", note))
    grades = facts.hd_map.accuracies
    if grades:
        top, *others = ACCURACIES
        note = ", ".join(f"{grades.count(grade)} {grade}" for grade in others)
        note = f"within the accuracy goal; besides, {note}"
        figures.append(Figure(f"Accuracy {top}", str(grades.count(top)), f"of {len(grades)}", note))
    if "corner_rmse_m" in best:
        note = "RMSE of all corners"
        figures.append(Figure("Against the truth", number(best["corner_rmse_m"], 1, 100), "cm", note))
    checked = facts.metrics.get("check_points") or {}
    if "rmse_m" in checked:
        note = f"RMSE of {checked.get('compared')} surveyed points that no estimate used"
        figures.append(Figure("Check points", number(checked["rmse_m"], 1, 100), "cm", note))
    if "reprojection_rmse_px" in best:
        before = best.get("initial_reprojection_rmse_px")
        note = "reprojection" + ("" if before is None else f"; {number(before, 2)} px before")
        figures.append(Figure("In the images", number(best["reprojection_rmse_px"], 2), "px", note))
    return tuple(figures)


def accuracy_figure(facts: Facts) -> Figure | None:
    """The one accuracy of the first page, with its definition; None without any."""
    if facts.hd_map is None:
        return None
    markings = facts.hd_map.markings
    judged = well_known(markings)
    radius_m = radius_of_all_m(absolute_radii_m(judged).ravel())
    if not math.isfinite(radius_m):
        return None
    note = (
        "Accuracy: 95 % of the mapped corners lie within this distance of their true places in the stated "
        "coordinate system, by the covariances of the adjustment (circular error at 95 %)."
    )
    worse = len(markings) - len(judged)
    if worse:
        verb = "is" if worse == 1 else "are"
        note += (
            f" {in_words(worse, 'marking')} known less well (accuracy {ACCURACIES[-1]}) {verb} not counted."
        )
    return Figure("Accuracy", number(radius_m, 1, 100), "cm", note)


def accuracy_table(facts: Facts) -> Table | None:
    """The radii that hold 95 % of corners and markings, by class, and of those that the verdict is about."""
    markings = () if facts.hd_map is None else facts.hd_map.markings
    if all(marking.covariance_m2 is None for marking in markings):
        return None
    by_kind: dict[str, Sequence[Marking]] = {**_by_kind(markings)}
    if len(by_kind) > 1:
        by_kind["all"] = markings
    judged = well_known(markings)
    if len(judged) < len(markings):
        by_kind[f"all without accuracy {ACCURACIES[-1]}"] = judged
    rows = []
    for name, of_kind in by_kind.items():
        radii_m = (absolute_radii_m(of_kind).ravel(), relative_radii_m(of_kind))
        cells = [number(radius_of_all_m(values_m), 1, 100) for values_m in radii_m]
        rows.append([name_of(name), str(len(of_kind)), *cells])
    return table(("class", "markings", "in the map’s frame (cm)", "from marking to marking (cm)"), rows)


def truth_table(facts: Facts) -> Table | None:
    """Errors against ground truth by class, and the fraction inside their ellipses."""
    if facts.truth is None or facts.hd_map is None:
        return None
    by_class = facts.best.get("by_class", {})
    rows = []
    by_kind: dict[str, Sequence[Marking]] = {**_by_kind(facts.hd_map.markings)}
    for name, markings in [*by_kind.items(), ("all", facts.hd_map.markings)]:
        figures = facts.best if name == "all" else by_class.get(name, {})
        recall = None if name == "all" else figures.get("recall")
        errors = [number(figures.get(key), 2, 100) for key in ("corner_rmse_m", "corner_bias_m")]
        false = number(figures.get("false_markings"), 0)
        inside = number(_inside(markings, facts), 0, 100)
        rows.append([name_of(name), str(len(markings)), false, number(recall, 1, 100), *errors, inside])
    errors_of = ("false", "recall (%)", "RMSE (cm)", "bias (cm)", "inside 95 % ellipse (%)")
    return table(("class", "markings", *errors_of), rows)


def _inside(markings: Sequence[Marking], facts: Facts) -> float | None:
    """Fraction of the corners whose true position is inside their 95 % ellipse."""
    assert facts.truth is not None
    rows, columns = match_markings(markings, facts.truth.map.markings)
    squared: list[float] = []
    for row, column in zip(rows, columns, strict=True):
        covariances = markings[row].corner_covariances_m2
        if covariances is not None:
            off = corner_errors([markings[row]], [facts.truth.map.markings[column]])
            squared += np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off).tolist()
    return None if len(squared) < _LEAST_FOR_SHARE else float(np.mean(np.array(squared) <= SIGMAS_95**2))


class _CheckColumn(NamedTuple):
    heading: str
    factor: float | None = None  # from the file's unit to the column's; None for text
    digits: int = 0


_CHECK_COLUMNS: Mapping[str, _CheckColumn] = {
    "id": _CheckColumn("point"),
    "description": _CheckColumn("description"),
    "marking": _CheckColumn("marking"),
    "class": _CheckColumn("class"),
    "corner": _CheckColumn("corner", 1.0),
    "dx_m": _CheckColumn("east (cm)", 100.0, 1),
    "dy_m": _CheckColumn("north (cm)", 100.0, 1),
    "distance_m": _CheckColumn("distance (cm)", 100.0, 1),
    "normalised_error": _CheckColumn("in σ", 1.0, 1),
    "inside_95_percent": _CheckColumn("inside 95 %"),
    "dz_m": _CheckColumn("up (cm)", 100.0, 1),
    "not_compared_because": _CheckColumn("not compared because"),
}
"""How the page shows columns of ``check_points.csv``."""


def check_point_table(facts: Facts) -> Table | None:
    """Independent surveyed points against the map, from ``check_points.csv``."""
    rows = facts.check_points
    columns = {name: column for name, column in _CHECK_COLUMNS.items() if any(row.get(name) for row in rows)}
    if not columns:
        return None
    headings = [column.heading for column in columns.values()]
    cells = [[_check_cell(row.get(name, ""), column) for name, column in columns.items()] for row in rows]
    return Table(headings, cells, [column.factor is not None for column in columns.values()])


def _check_cell(text: str, column: _CheckColumn) -> str:
    if column.factor is None:
        return text
    try:
        return number(float(text), column.digits, column.factor)
    except ValueError:
        return "–"


def content_table(facts: Facts) -> Table | None:
    """Content of the map by class: count, length and sightings."""
    if facts.hd_map is None:
        return None
    rows = []
    drawn: dict[str, Sequence[Marking | Symbol | Lane]] = {
        "marking": facts.hd_map.markings, "symbol": facts.hd_map.symbols, "lane line": facts.hd_map.lanes
    }  # fmt: skip
    for form, drawn_as_form in drawn.items():
        for name, features in _by_kind(drawn_as_form).items():
            lanes = [feature for feature in features if isinstance(feature, Lane)]
            length = number(sum(length_along(lane.points_map)[-1] for lane in lanes) if lanes else None, 1)
            sightings = number(float(np.median([feature.sightings for feature in features])), 0)
            rows.append([name_of(name), form, str(len(features)), length, sightings])
    return table(("class", "as", "count", "length (m)", "sightings"), rows, words=2)


def method_table(facts: Facts) -> Table | None:
    """The paper's methods side by side, with all cameras."""
    if not facts.results:
        return None
    columns = figure_columns(facts.results.values())
    rows = [
        [name, METHODS[name], str(row.get("markings", "–"))]
        + [number(row.get(key), digits, factor) for key, digits, factor in columns.values()]
        for name, row in ((name, facts.results[name]) for name in METHODS if name in facts.results)
    ]
    return table(("", "method", "markings", *columns), rows, words=2)


_FORMERLY = {"unobservable": "untold"}
"""Names of the lists of findings in older results."""


def finding_rows(verdict: Mapping[str, Any], which: str) -> tuple[tuple[str, ...], ...]:
    """Status, check, subject, measured value, limit and sentence of the findings ``which``."""
    rows = []
    for finding in verdict.get(which) or verdict.get(_FORMERLY.get(which, which)) or []:
        unit = f" {finding['unit']}" if finding.get("unit") else ""
        value, limit = (number(finding.get(key)) for key in ("value", "limit"))
        outcome = which if which == "unobservable" else str(finding["status"])
        measured = [text if text == "–" else f"{text}{unit}" for text in (value, limit)]
        rows.append((outcome, str(finding["check"]), str(finding["about"]), *measured, str(finding["says"])))
    return tuple(rows)


def timing_table(facts: Facts) -> Table | None:
    """Duration of each step."""
    seconds = facts.metrics.get("seconds") or {}
    if not seconds:
        return None
    steps = seconds | {"total": sum(float(duration_s) for duration_s in seconds.values())}
    return table(("step", "s"), [[name, number(float(value), 1)] for name, value in steps.items()])


def _by_kind(features: Sequence[_Mapped]) -> dict[str, list[_Mapped]]:
    """Features by class, most frequent first."""
    by_kind: dict[str, list[_Mapped]] = {}
    for feature in features:
        by_kind.setdefault(feature.kind, []).append(feature)
    return dict(sorted(by_kind.items(), key=lambda pair: -len(pair[1])))


class CameraPage(NamedTuple):
    """One camera in the report: summary, table, and picture (JPEG in base64)."""

    name: str
    words: str
    lens: str
    mounting: Table
    picture: str | None


def camera_pages(facts: Facts, pictures: Mapping[str, str]) -> tuple[CameraPage, ...]:
    """One entry per calibrated camera."""
    extrinsics = facts.metrics.get("extrinsics") or {}
    out = []
    for name, camera in facts.cameras.items():
        extrinsic = extrinsics.get(name, {})
        info = camera.calibration.info
        words = str(extrinsic.get("certainty") or "").removeprefix(f"{name}: ")
        lens = (
            f"{info.width} × {info.height} px, focal length {info.intrinsic[0, 0]:.0f} px, "
            f"{name_of(info.distortion_model)}"
        )
        out.append(CameraPage(name, words, lens, _mounting(camera, extrinsic), pictures.get(name)))
    return tuple(out)


def _mounting(camera: CameraFacts, extrinsic: Mapping[str, Any]) -> Table:
    """A camera's calibration; ``extrinsic`` are its figures in ``metrics.json``."""
    calibration = camera.calibration
    matrix = calibration.cam_from_vehicle
    covariance = calibration.covariance
    centre = camera_centre(matrix)
    angles = np.rad2deg(mounting_angles(matrix))
    unknown = np.full(3, np.nan)
    centre_sigma = unknown if covariance is None else centre_sigmas(matrix, covariance)
    angle_sigma = unknown if covariance is None else np.rad2deg(angle_sigmas(matrix, covariance))
    rows = []
    for n, (axis, key) in enumerate((("forward", "x"), ("left", "y"), ("up", "z"))):
        changed = _change(extrinsic.get(f"{key}_change_m"), 1e3, 0, " mm")
        value = number(centre[n], 3)
        sigma = number(centre_sigma[n], 1, 1e3)
        rows.append([f"centre {axis}", f"{value} m", f"{sigma} mm", changed])
    for n, (axis, key) in enumerate((("roll", "roll"), ("pitch, down", "pitch"), ("yaw, left", "yaw"))):
        changed = _change(extrinsic.get(f"{key}_change_deg"), 1.0, 2, "°")
        rows.append([axis, f"{number(angles[n], 3)}°", f"{number(angle_sigma[n], 3)}°", changed])
    if camera.clock_offset_s is not None:
        offset = number(camera.clock_offset_s, 1, 1e3)
        sigma = number(camera.clock_sigma_s, 1, 1e3)
        rows.append(["clock, images later", f"{offset} ms", f"{sigma} ms", "–"])
    if camera.read_out_s is not None:
        read_out = number(camera.read_out_s, 1, 1e3)
        sigma = number(camera.read_out_sigma_s, 1, 1e3)
        rows.append(["read-out, first row to last", f"{read_out} ms", f"{sigma} ms", "–"])
    return table(("", "value", "± 1 σ", "change"), rows)


def _change(value: object, factor: float, digits: int, unit: str) -> str:
    if not isinstance(value, int | float):
        return "–"
    return f"{'+' if value > 0 else ''}{number(value, digits, factor)}{unit}"
