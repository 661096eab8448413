"""From a result folder to ``report.html``, a single file."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jinja2
import numpy as np

from v2hdm.records import Drive
from v2hdm.report.page import charts, tables
from v2hdm.report.page.embedding import json_text
from v2hdm.report.page.facts import Facts, ground_residuals, read_facts
from v2hdm.report.page.layers import background_layer, comparison, earlier_layer, layers
from v2hdm.report.page.pictures import earlier_pictures, overlays, pictures
from v2hdm.report.page.tables import in_words
from v2hdm.site.accuracy import absolute_radii_m, relative_radii_m
from v2hdm.store import names
from v2hdm.store.files import replace_text


def document(facts: Facts) -> SimpleNamespace:
    """Content of the page by template names; missing parts are None or empty."""
    metrics = facts.metrics
    verdict = metrics.get("verdict") or {}
    residuals = ground_residuals(facts)
    findings = {
        which: tables.finding_rows(verdict, which) for which in ("findings", "unobservable", "passed")
    }
    return SimpleNamespace(
        facts=facts,
        name=str(metrics.get("name", facts.folder.name)),
        date=str(metrics.get("date", "")),
        version=str(metrics.get("version", "")),
        summary=_summary(facts),
        status=str(verdict.get("status", "FAIL")),
        headline=str(verdict.get("headline") or "").partition(": ")[2],
        findings=findings,
        figures=tables.key_figures(facts),
        site=_site(facts),
        accuracy=tables.accuracy_table(facts),
        against_truth=tables.truth_table(facts),
        radii=_radii(facts),
        check_points=tables.check_point_table(facts),
        map_data=layers(facts, residuals),
        pictures=pictures(facts),
        suspicious=_suspicious(facts),
        cameras=tables.camera_pages(facts, overlays(facts)),
        ground=comparison(facts.folder),
        residuals=charts.residual_charts(facts, residuals) if residuals else {},
        excluded=tables.reason_table(facts),
        contents=tables.content_table(facts),
        methods=tables.method_table(facts),
        drive=tables.pair_table(metrics.get("drive") or {}),
        seconds=tables.timing_table(facts),
        versions=tables.pair_table(metrics.get("versions") or {}),
    )


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


def _site(facts: Facts) -> str:
    if facts.hd_map is None or not (facts.hd_map.markings or facts.hd_map.lanes):
        return ""
    excluded = np.array([candidate.position_map for candidate in facts.excluded]).reshape(-1, 2)
    return charts.site_chart(facts.hd_map, facts.route, excluded)


def _radii(facts: Facts) -> str:
    markings = facts.hd_map.markings if facts.hd_map else ()
    absolute_m = absolute_radii_m(markings).ravel()
    radii_m = {
        "corners, in the map’s frame": absolute_m[np.isfinite(absolute_m)],
        "markings, from marking to marking": relative_radii_m(markings),
    }
    series = {name: 100 * values_m for name, values_m in radii_m.items() if len(values_m)}
    return charts.radius_chart(series) if series else ""


_ASSETS = {"vendor": ("leaflet.js", "leaflet.css"), "templates": ("page.css", "map.js")}
"""Scripts and styles that the page embeds, by folder."""


def write_page(folder: Path, drive: Drive | None, background: Path | None = None) -> Path:
    """Write ``report.html`` into a result folder of :mod:`v2hdm.map`, atomically, and return its path.

    ``drive`` supplies pictures, recorded route and truth; ``background`` is a GeoTIFF or a folder of XYZ
    tiles. If either is None, its content is taken from an existing report. Raises MapFileError for an invalid
    folder, file or background, DriveError for a damaged image or truth.
    """
    replace_text(folder / names.REPORT, page_text(folder, drive, background=background))
    return folder / names.REPORT


def page_text(folder: Path, drive: Drive | None, background: Path | None = None) -> str:
    """The page of :func:`write_page`."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("v2hdm.report.page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    here = files("v2hdm.report.page")
    facts = read_facts(folder, drive)
    page = document(facts)
    page.pictures = page.pictures or earlier_pictures(_earlier(folder / names.REPORT, "pictures"))
    if page.map_data:
        if background is None:
            page.map_data["background"] = earlier_layer(
                _earlier(folder / names.REPORT, "map-data").get("background")
            )
        else:
            page.map_data["background"] = background_layer(background, facts)
    return environment.get_template("page.html").render(
        page=page,
        assets={
            name: (here / where / name).read_text(encoding="utf-8")
            for where, names in _ASSETS.items()
            for name in names
        },
        map_json=json_text(page.map_data),
        pictures_json=json_text(page.pictures),
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
            cells = [str(number), tables.name_of(kinds[number]), f"{suspect['p']:.2g}"]
            cells.append(min(tests, key=tests.__getitem__))
            cells += [*(f"{p:.2g}" for p in tests.values()), f"{100 * suspect['disputed']:.0f}"]
            rows[f"m{number}"] = cells
    return rows
