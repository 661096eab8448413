"""From a result folder to ``report.html``, a single file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jinja2
import numpy as np

from v2hdm.records import Drive
from v2hdm.report.page import charts, listing, plans, tables
from v2hdm.report.page.certificates import certificates
from v2hdm.report.page.comparison import comparison_of
from v2hdm.report.page.embedding import json_text
from v2hdm.report.page.facts import Facts, GroundResiduals, ground_residuals, read_facts
from v2hdm.report.page.identity import identity_of, method_words
from v2hdm.report.page.layers import background_layer, comparison, earlier_layer, layers
from v2hdm.report.page.pictures import earlier_pictures, overlays, pictures, room_for_pictures
from v2hdm.report.page.quality import quality_table
from v2hdm.report.page.reference import Reference, reference_of
from v2hdm.report.page.tables import in_words
from v2hdm.report.weak import MOST_PLACES
from v2hdm.site.accuracy import absolute_radii_m, relative_radii_m
from v2hdm.store import names
from v2hdm.store.files import replace_text


class Chart(NamedTuple):
    """A chart as SVG with its words."""

    svg: str
    title: str
    caption: str


_RESIDUALS: Mapping[str, tuple[str, str]] = {
    "histogram": (
        "Reprojection errors",
        "Left: in pixels. Right: in the detector’s stated standard deviations. A curve left of the "
        "grey line means that corners are better than stated, a long tail that some are wrong.",
    ),
    "field": (
        "Over the image",
        "Mean residual of each part of the image, enlarged; the key gives the scale. Arrows without a "
        "pattern are noise; a swirl or a fan would mean a wrong lens model or principal point.",
    ),
    "range": (
        "Over range",
        "In the image, near corners scatter more because a centimetre covers more pixels; a rise at long "
        "range would mean a wrong pitch or lens model. On the ground, residuals grow with range because a "
        "distant pixel covers more of it. The map averages many sightings and is more precise than each.",
    ),
    "route": (
        "Along the route",
        "Above: a stretch that stands out has poor images or wrong poses. Below: the "
        "correction of the recorded poses with its 95 % band; it should drift within the receiver’s noise "
        "and never jump.",
    ),
}
"""Title and caption of the charts of residuals, by the name of each."""

_PLAN_CAPTION = (
    "The map from above, in local metres. Grey: ground that three images or more show. Ringed: places where "
    "markings are known less well than the accuracy goal asks."
)
_COVERAGE_CAPTION = (
    "How many images show each piece of ground, as if nothing stood in the way. The map is weakest where few "
    "images show the ground, and at the ringed places, which the table lists."
)


def document(facts: Facts, compared: Path | None = None) -> SimpleNamespace:
    """Content of the page by template names; missing parts are None or empty.

    ``compared`` is a folder of ``v2hdm compare``.
    """
    reference = reference_of(facts)
    residuals = ground_residuals(facts)
    cameras = tables.camera_pages(facts, overlays(facts))
    map_data = layers(facts, residuals, reference)
    suspicious = _suspicious(facts)
    return SimpleNamespace(
        facts=facts,
        reference=reference,
        identity=identity_of(facts, reference),
        method=method_words(facts, reference),
        quality=quality_table(facts),
        listing=listing.marking_table(facts, reference),
        lanes=listing.lane_table(facts, reference),
        left_out=listing.left_out(facts),
        mapped=len(facts.hd_map.markings) if facts.hd_map else 0,
        corrections=listing.correction_table(facts),
        certificates=certificates(facts, cameras, residuals),
        comparison=comparison_of(compared),
        map_data=map_data,
        pictures=pictures(facts, room_for_pictures(map_data)),
        suspicious=suspicious,
        suspicious_table=_suspicious_table(suspicious),
        cameras=cameras,
        ground=comparison(facts.folder),
        **_of_metrics(facts),
        **_of_accuracy(facts),
        **_of_places(facts, reference),
        **_of_residuals(facts, residuals),
    )


def _of_metrics(facts: Facts) -> dict[str, Any]:
    """Title, verdict and tables of what the run says of itself."""
    metrics = facts.metrics
    verdict = metrics.get("verdict") or {}
    name = str(metrics.get("name", facts.folder.name))
    drive = metrics.get("drive") or {}
    kinds = ("findings", "unobservable", "passed")
    return {
        "title": facts.job.job.site or name,
        "name": name,
        "digest": str(drive.get("images_sha256") or "")[:16],
        "date": str(metrics.get("date", "")),
        "version": str(metrics.get("version", "")),
        "summary": _summary(facts),
        "status": str(verdict.get("status", "FAIL")),
        "headline": str(verdict.get("headline") or "").partition(": ")[2],
        "findings": {kind: tables.finding_rows(verdict, kind) for kind in kinds},
        "contents": tables.content_table(facts),
        "methods": tables.method_table(facts),
        "drive": tables.pair_table(drive),
        "seconds": tables.timing_table(facts),
        "versions": tables.pair_table(metrics.get("versions") or {}),
    }


def _of_accuracy(facts: Facts) -> dict[str, Any]:
    """Figures and tables of how well the map is known."""
    return {
        "accuracy_figure": tables.accuracy_figure(facts),
        "figures": tables.key_figures(facts),
        "accuracy": tables.accuracy_table(facts),
        "against_truth": tables.truth_table(facts),
        "radii": _radii(facts),
        "check_points": tables.check_point_table(facts),
    }


def _of_places(facts: Facts, reference: Reference) -> dict[str, Any]:
    """The plans, and the places to drive again, which they ring."""
    places = listing.places_of(facts)
    ringed = places[:MOST_PLACES]
    return {
        "plan": plans.site_plan(facts, ringed),
        "plan_caption": _PLAN_CAPTION,
        "coverage_plan": plans.coverage_plan(facts, ringed),
        "coverage_caption": _COVERAGE_CAPTION,
        "again": listing.drive_again(places, reference),
    }


def _of_residuals(facts: Facts, residuals: GroundResiduals | None) -> dict[str, Any]:
    """Charts of the residuals, if the run kept them."""
    if residuals is None:
        return {"residuals": {}, "residual_charts": []}
    drawings = charts.residual_charts(facts, residuals)
    shown = [Chart(drawings[key], *words) for key, words in _RESIDUALS.items()] if drawings else []
    return {"residuals": drawings, "residual_charts": shown}


def _summary(facts: Facts) -> str:
    hd_map = facts.hd_map
    if hd_map is None:
        return "This drive gave no map."
    words = [in_words(len(hd_map.markings), "marking"), in_words(len(hd_map.lanes), "lane line")]
    if hd_map.symbols:
        words.append(in_words(len(hd_map.symbols), "symbol"))
    sentence = f"{', '.join(words[:-1])} and {words[-1]}"
    if facts.route is not None:
        sentence += f", mapped along {facts.route.way_m[-1]:.0f}\u00a0m"
    if facts.cameras:
        sentence += f" with {in_words(len(facts.cameras), 'camera')} ({', '.join(facts.cameras)})"
    return f"{sentence}."


def _suspicious_table(rows: Mapping[str, list[str]]) -> tables.Table | None:
    headings = (
        "marking",
        "class",
        "p",
        "criterion",
        "p (shape)",
        "p (residuals)",
        "p (sightings)",
        "disputed (%)",
    )
    return (
        tables.Table(headings, list(rows.values()), [True, False, True, False, *[True] * 4]) if rows else None
    )


def _radii(facts: Facts) -> str:
    markings = facts.hd_map.markings if facts.hd_map else ()
    absolute_m = absolute_radii_m(markings).ravel()
    radii_m = {
        "corners, in the map’s frame": absolute_m[np.isfinite(absolute_m)],
        "markings, from marking to marking": relative_radii_m(markings),
    }
    series = {name: 100 * values_m for name, values_m in radii_m.items() if len(values_m)}
    return charts.radius_chart(series) if series else ""


_ASSETS = {"vendor": ("leaflet.js", "leaflet.css"), "templates": ("page.css", "features.js", "map.js")}
"""Scripts and styles that the page embeds, by folder."""


def write_page(
    folder: Path, drive: Drive | None, background: Path | None = None, comparison: Path | None = None
) -> Path:
    """Write ``report.html`` into a result folder of :mod:`v2hdm.map`, atomically, and return its path.

    ``drive`` supplies pictures, recorded route and truth; ``background`` is a GeoTIFF or a folder of XYZ
    tiles. If either is None, its content is taken from an existing report. ``comparison`` is a folder of
    ``v2hdm compare``. Raises MapFileError for an invalid folder, file or background, DriveError for a damaged
    image or truth.
    """
    text = page_text(folder, drive, background=background, comparison=comparison)
    replace_text(folder / names.REPORT, text)
    return folder / names.REPORT


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("v2hdm.report.page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def paper_text(folder: Path, drive: Drive | None, comparison: Path | None = None) -> str:
    """The document for paper as HTML; errors as of :func:`write_page`."""
    page = document(read_facts(folder, drive), comparison)
    style = (files("v2hdm.report.page") / "templates" / "paper.css").read_text(encoding="utf-8")
    return _environment().get_template("paper.html").render(page=page, assets={"paper.css": style})


def page_text(
    folder: Path,
    drive: Drive | None,
    background: Path | None = None,
    comparison: Path | None = None,
) -> str:
    """The page of :func:`write_page`."""
    here = files("v2hdm.report.page")
    facts = read_facts(folder, drive)
    page = document(facts, comparison)
    page.pictures = page.pictures or earlier_pictures(_earlier(folder / names.REPORT, "pictures"))
    if page.map_data:
        if background is None:
            page.map_data["background"] = earlier_layer(
                _earlier(folder / names.REPORT, "map-data").get("background")
            )
        else:
            page.map_data["background"] = background_layer(background, facts)
    return (
        _environment()
        .get_template("page.html")
        .render(
            page=page,
            assets={
                name: (here / where / name).read_text(encoding="utf-8")
                for where, names in _ASSETS.items()
                for name in names
            },
            map_json=json_text(page.map_data),
            pictures_json=json_text(page.pictures),
        )
    )


def _earlier(path: Path, name: str) -> dict[str, Any]:
    """Data ``name`` of an earlier report, whose sources may be unavailable now."""
    # The old report is not an input: the new one replaces it.
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    script = re.search(r'<script type="application/json" id="' + name + '">(.*?)</script>', text, re.DOTALL)
    try:
        return dict(json.loads(script[1])) if script else {}
    except (ValueError, TypeError, RecursionError):
        return {}


def _suspicious(facts: Facts) -> dict[str, list[str]]:
    """Most suspicious markings, worst first: table cells by the key of their pictures."""
    kinds = {marking.id: marking.kind for marking in facts.hd_map.markings} if facts.hd_map else {}
    rows = {}
    for suspect in facts.best.get("suspicious") or []:
        number = suspect["marking"]
        tests = {name: suspect[f"p_{name}"] for name in ("shape", "residuals", "sightings")}
        if number in kinds:
            cells = [str(number), tables.name_of(kinds[number]), tables.probability(suspect["p"])]
            cells.append(min(tests, key=tests.__getitem__))
            cells += [*map(tables.probability, tests.values()), f"{100 * suspect['disputed']:.0f}"]
            rows[f"m{number}"] = cells
    return rows
