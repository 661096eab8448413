"""From a result folder to its ``report.html``: one file with everything in it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import jinja2
import numpy as np

from v2hdm.records import Drive
from v2hdm.report.page import charts, tables
from v2hdm.report.page.facts import Facts, GroundResiduals, ground_residuals, read_facts
from v2hdm.report.page.layers import ground_page, layers
from v2hdm.report.page.pictures import overlays, pictures
from v2hdm.report.page.tables import in_words
from v2hdm.store.files import replace_text

_SAYS = {
    "PASS": "Every check is within its limit. Map and calibrations can be relied on as stated below.",
    "WARN": "The map holds, or was corrected as reported below. Read the findings before you rely on it.",
    "FAIL": "The map is wrong or cannot be relied on, whatever the figures below say. Each finding names a "
    "cause and a remedy.",
}


@dataclass(frozen=True)
class Chart:
    """An SVG, what it shows and what to see in it."""

    title: str
    caption: str
    svg: str


def document(facts: Facts) -> SimpleNamespace:
    """The whole page by the names of its templates; parts that a run does not have are None or empty.

    Raises:
        DriveError: an image of the drive cannot be read.
    """
    metrics = facts.metrics
    verdict = metrics.get("verdict") or {}
    status = str(verdict.get("status", "FAIL"))
    residuals = ground_residuals(facts)
    about = [tables.pair_table("The drive.", metrics.get("drive") or {}), tables.timing_table(facts)]
    about.append(tables.pair_table("Versions of what computed it.", metrics.get("versions") or {}))
    return SimpleNamespace(
        name=str(metrics.get("name", facts.folder.name)),
        date=str(metrics.get("date", "")),
        version=str(metrics.get("version", "")),
        summary=_summary(facts),
        verdict=SimpleNamespace(
            status=status,
            says=_SAYS.get(status, ""),
            raised=tables.finding_rows(verdict, "findings"),
            untold=tables.finding_rows(verdict, "untold"),
            passed=tables.finding_rows(verdict, "passed"),
        ),
        figures=tables.key_figures(facts),
        site=_site(facts),
        accuracy=[one for one in (tables.accuracy_table(facts), tables.truth_table(facts)) if one],
        accuracy_chart=_accuracy_chart(facts),
        check_points=tables.check_point_table(facts),
        map_data=layers(facts, residuals),
        pictures=pictures(facts),
        suspicious=_suspicious(facts),
        cameras=tables.camera_pages(facts, overlays(facts)),
        ground=ground_page(facts.folder),
        residuals=_residual_charts(facts, residuals),
        excluded=_excluded(facts),
        excluded_words=_excluded_words(facts),
        contents=tables.content_table(facts),
        methods=tables.method_table(facts),
        about=[one for one in about if one is not None],
        config=facts.config.strip(),
        missing=_missing(facts),
    )


def _summary(facts: Facts) -> str:
    """The contents of the map in a sentence."""
    if facts.hd_map is None:
        return "No map came of this drive."
    counts = ((facts.hd_map.markings, "marking"), (facts.hd_map.lanes, "lane line"))
    words = [in_words(len(own), name) for own, name in counts]
    if facts.hd_map.symbols:
        words.append(in_words(len(facts.hd_map.symbols), "symbol"))
    sentence = f"{', '.join(words[:-1])} and {words[-1]}"
    if facts.route is not None:
        sentence += f", mapped along {facts.route.way_m[-1]:.0f} m"
    if facts.cameras:
        sentence += f" with {in_words(len(facts.cameras), 'camera')} ({', '.join(facts.cameras)})"
    return f"{sentence}."


def _site(facts: Facts) -> Chart | None:
    if facts.hd_map is None or not (facts.hd_map.markings or facts.hd_map.lanes):
        return None
    excluded = np.array([one.position_map for one in facts.excluded]).reshape(-1, 2)
    return Chart(
        "The map from above",
        "Where markings stand close together along the whole route, the drive was seen throughout. "
        "Crosses show what was left out: they should be few and at the edges.",
        charts.site_chart(facts.hd_map, facts.route, excluded),
    )


def _accuracy_chart(facts: Facts) -> Chart | None:
    if facts.hd_map is None:
        return None
    known = {
        "relative to neighbours": tables.relative_m(facts.hd_map.markings),
        "absolute": tables.half_axes_m(facts.hd_map.markings),
    }
    series = {name: 100 * values for name, values in known.items() if len(values)}
    if not series:
        return None
    return Chart(
        "How many corners are how good",
        "Read it upwards from the accuracy that you need: the lines say which share of the corners "
        "reaches it. The absolute accuracy rests on the receiver’s stated noise. An offset that a whole "
        "drive shares, as of a base station set up wrongly, shows in no drive: only surveyed check points "
        "tell it.",
        charts.ellipse_chart(series),
    )


def _residual_charts(facts: Facts, residuals: GroundResiduals | None) -> tuple[Chart, ...]:
    if residuals is None or facts.route is None:
        return ()
    sizes = {
        name: (one.calibration.info.width, one.calibration.info.height) for name, one in facts.cameras.items()
    }
    return (
        Chart(
            "How far corners lie from where the map puts them",
            "Left: in pixels. Right: in standard deviations of the detector’s own statement; lines to "
            "the left of the grey one mean that the corners are better than stated, a long tail that some "
            "are wrong.",
            charts.histogram_chart(residuals),
        ),
        Chart(
            "Over the image",
            "Mean residual of each part of the image, drawn longer than it is (the key gives the scale). "
            "Arrows without a pattern are noise; a swirl or a fan would be a wrong lens or principal point.",
            charts.field_chart(residuals, sizes),
        ),
        Chart(
            "Over range",
            "In the image near corners scatter more, for there a centimetre is more pixels; a rise at the "
            "far end would be a wrong tilt or lens. On the ground residuals grow with range, since a far "
            "pixel covers more of it. The map is made of many such sightings and is better than each.",
            charts.range_chart(residuals),
        ),
        Chart(
            "Along the route",
            "Above: a stretch that stands out was seen badly or has wrong poses. Below: what was taken "
            "off the recorded poses, with the band of 95 %; it should wander within the receiver’s noise and "
            "never jump.",
            charts.route_chart(facts.route, residuals),
        ),
    )


def _excluded(facts: Facts) -> Chart | None:
    counts = Counter(one.reason for one in facts.excluded).most_common()
    if not counts:
        return None
    return Chart(
        "Why candidates were left out",
        "Each of them is on the map above, with its reason and, where the drive is at hand, its pictures.",
        charts.bar_chart("excluded", counts),
    )


def _excluded_words(facts: Facts) -> str:
    if facts.hd_map is None:
        return ""
    out, kept = len(facts.excluded), len(facts.hd_map.markings)
    if not out:
        return "Nothing was left out."
    return f"{out} of {out + kept} candidates ({100 * out / (out + kept):.0f} %) are not in the map."


def _missing(facts: Facts) -> tuple[str, ...]:
    """Parts that the page lacks, and why."""
    found = []
    if facts.drive is None:
        found.append(
            "The drive was not at hand: no pictures of markings, no recorded route, no truth. "
            "Make the report again with --drive."
        )
    if facts.residuals is None and facts.hd_map is not None:
        found.append(
            "The folder has no residuals.csv (an older run): no residuals, no pictures. Map it again."
        )
    return tuple(found)


FILE = "report.html"
"""Name of the page in a result folder."""

_ASSETS = {"leaflet.js": "vendor", "leaflet.css": "vendor", "page.css": "templates", "map.js": "templates"}
"""Scripts and styles that stand in the page as they are, by the folder that holds them."""


def write_page(folder: Path, drive: Drive | None) -> Path:
    """Write ``report.html`` into a result folder of :mod:`v2hdm.map`, atomically, and return its path.

    ``drive`` is the one that was mapped, for pictures, recorded route and truth; None if not at hand.

    Raises:
        MapFileError: the folder is no result, or a file in it is damaged.
        DriveError: an image or the truth of the drive is damaged.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("v2hdm.report.page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    here = files("v2hdm.report.page")
    page = document(read_facts(folder, drive))
    text = environment.get_template("page.html").render(
        page=page,
        assets={name: (here / where / name).read_text(encoding="utf-8") for name, where in _ASSETS.items()},
        map_json=_json(page.map_data),
        pictures_json=_json(page.pictures),
    )
    replace_text(folder / FILE, text)
    return folder / FILE


def _json(content: object) -> str:
    """JSON that may stand in a script element: nothing in it ends the element or begins a comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _suspicious(facts: Facts) -> dict[str, list[str]]:
    """The most suspicious markings, the worst first: cells of a row by the key of their pictures."""
    kinds = {one.id: one.kind for one in facts.hd_map.markings} if facts.hd_map else {}
    rows = {}
    for one in facts.best.get("suspicious") or []:
        number, tests = (
            one["marking"],
            {name: one[f"p_{name}"] for name in ("shape", "residuals", "sightings")},
        )
        if number in kinds:
            cells = [
                str(number),
                tables.name_of(kinds[number]),
                f"{one['p']:.2g}",
                min(tests, key=tests.__getitem__),
            ]
            cells += [*(f"{p:.2g}" for p in tests.values()), f"{100 * one['disputed']:.0f}"]
            rows[f"m{number}"] = cells
    return rows
