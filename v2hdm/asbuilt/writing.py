"""A comparison as lines of the terminal, JSON, a table, a layer of a map and a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.asbuilt.comparison import Finding
from v2hdm.asbuilt.decisions import Fate, Quantity
from v2hdm.asbuilt.misfit import Misfit
from v2hdm.geometry.planar import signed_area
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.records import GeodeticOrigin, HDMap
from v2hdm.store import names
from v2hdm.store.files import replace_csv, write_json

_MOST_LISTED = 12  # findings that the terminal lists; the table has all
_WRONG = (Fate.OFF, Fate.MISSING, Fate.EXTRA)
_COLOURS: Mapping[Fate, str] = {
    Fate.RIGHT: "#2e8b57",
    Fate.OFF: "#c0392b",
    Fate.UNSURE: "#d68910",
    Fate.MISSING: "#8e44ad",
    Fate.NOT_INSPECTED: "#95a5a6",
    Fate.EXTRA: "#2471a3",
}
"""Colours of the picture by what became of a shape; they differ in lightness, too."""


def summary_lines(findings: Sequence[Finding], misfit: Misfit | None, source: str) -> list[str]:
    """Lines for the terminal: the misfit of the whole, the counts, and the worst findings."""
    lines = []
    if misfit is not None:
        lines.append(misfit_line(misfit))
    count = Counter(finding.fate for finding in findings)
    counts = ", ".join(f"{count[fate]} {fate.value}" for fate in Fate if count[fate])
    lines.append(f"{source}: {counts or 'nothing to compare'}")
    wrong = [finding for finding in findings if finding.fate in _WRONG]
    lines += [finding_line(finding) for finding in wrong[:_MOST_LISTED]]
    if len(wrong) > _MOST_LISTED:
        lines.append(f"and {len(wrong) - _MOST_LISTED} more in {names.AS_BUILT_TABLE}")
    return lines


def misfit_line(misfit: Misfit) -> str:
    """How the design lies in the map as a whole."""
    east_cm, north_cm = 100 * misfit.motion.shift_m
    sigma_cm = 100 * float(np.sqrt(np.diag(misfit.covariance)[:2].mean()))
    turned = f"turned by {np.rad2deg(misfit.motion.turn_rad):+.3f} deg"
    where = f"{east_cm:+.1f} cm east, {north_cm:+.1f} cm north (+- {sigma_cm:.1f}), {turned}"
    if misfit.is_significant:
        return (
            f"the design as a whole lies off: the paint is {where} from it; markings are judged without this"
        )
    return f"the design as a whole lies in place: the paint is {where} from it"


def finding_line(finding: Finding) -> str:
    """A finding in one line."""
    who = f"{finding.kind} {finding.id}" if finding.id is not None else finding.name
    if finding.name and finding.id is not None:
        who += f" ({finding.name})"
    outside = [quantity for quantity in finding.quantities if quantity.fate is not Fate.RIGHT]
    measured = "; ".join(quantity_words(quantity) for quantity in outside)
    return f"  {finding.fate.value}: {who}{f': {measured}' if measured else ''}"


def quantity_words(quantity: Quantity) -> str:
    """A quantity with its standard deviation, in cm, degrees or per cent."""
    factor, unit = (100.0, "cm") if quantity.unit == "m" else (1.0, quantity.unit)
    return f"{quantity.name} {factor * quantity.value:+.1f} +- {factor * quantity.sigma:.1f} {unit}"


def write_comparison(
    folder: Path, hd_map: HDMap, findings: Sequence[Finding], misfit: Misfit | None, source: str
) -> None:
    """Write a comparison's files into a folder."""
    count = Counter(finding.fate.value for finding in findings)
    content: dict[str, Any] = {"source": source, "counts": dict(count)}
    if misfit is not None:
        content["design_as_a_whole"] = {
            "lies_off": misfit.is_significant,
            "shift_m": misfit.motion.shift_m.tolist(),
            "turn_deg": float(np.rad2deg(misfit.motion.turn_rad)),
            "sigma": np.sqrt(np.diag(misfit.covariance)).tolist(),
            "probability_if_in_place": misfit.probability,
            "paint_about_design_sigma_m": misfit.painted_m,
        }
    content["findings"] = [_as_json(finding) for finding in findings]
    write_json(folder / names.AS_BUILT, content)
    replace_csv(folder / names.AS_BUILT_TABLE, _rows(findings))
    _write_layer(folder / names.AS_BUILT_LAYER, findings, hd_map.origin)
    _write_picture(folder / names.AS_BUILT_PICTURE, findings, source)


def _as_json(finding: Finding) -> dict[str, Any]:
    entry: dict[str, Any] = {"fate": finding.fate.value, "class": finding.kind}
    stated = {"design": finding.name or None, "id": finding.id, "probability": finding.probability}
    stated["probability_bare"] = finding.bare
    entry |= {key: value for key, value in stated.items() if value is not None}
    for quantity in finding.quantities:
        unit = {"%": "percent"}.get(quantity.unit, quantity.unit)
        entry[f"{quantity.name}_{unit}"] = quantity.value
        entry[f"{quantity.name}_sigma_{unit}"] = quantity.sigma
        entry[f"{quantity.name}_probability"] = quantity.probability
    return entry


def _rows(findings: Sequence[Finding]) -> list[list[object]]:
    """A row for each quantity of each finding, one for findings without any."""
    head: list[object] = ["fate", "class", "id", "design", "x_map_m", "y_map_m", "quantity", "value", "sigma"]
    head += ["low", "high", "unit", "probability", "decision"]
    rows = [head]
    for finding in findings:
        shape = finding.shape_map
        place = ["", ""] if shape is None else [round(float(value), 4) for value in shape.mean(axis=0)]
        identity = "" if finding.id is None else finding.id
        about: list[object] = [finding.fate.value, finding.kind, identity, finding.name, *place]
        for quantity in finding.quantities:
            limits = [quantity.low, quantity.high, quantity.unit, quantity.probability, quantity.fate.value]
            rows.append([*about, quantity.name, quantity.value, quantity.sigma, *limits])
        if not finding.quantities:
            rows.append([*about, *[""] * 8])
    return rows


def _write_layer(path: Path, findings: Sequence[Finding], origin: GeodeticOrigin | None) -> None:
    features = []
    for number, finding in enumerate(findings, 1):
        shape = finding.shape_map
        if shape is None:
            continue
        ring = shape if signed_area(shape) > 0 else shape[::-1]
        positions = geojson_positions(ring, None, origin)
        features.append(geojson_feature(number, "Polygon", [[*positions, positions[0]]], _as_json(finding)))
    write_features(path, features, origin, {"about": "a map against its design"})


def _write_picture(path: Path, findings: Sequence[Finding], source: str) -> None:
    """Draw each shape in the colour of its fate, with an arrow from its place to where it was painted."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(11, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    handles = []
    for fate in Fate:
        of_fate = [finding for finding in findings if finding.fate is fate]
        shapes = [finding.shape_map for finding in of_fate]
        outlines = [shape for shape in shapes if shape is not None]
        if not outlines:
            continue
        colour = _COLOURS[fate]
        is_hollow = fate in (Fate.MISSING, Fate.NOT_INSPECTED)
        face = "none" if is_hollow else colour
        axes.add_collection(PolyCollection(outlines, facecolors=face, edgecolors=colour, linewidths=1.2))
        handles.append(Patch(facecolor=face, edgecolor=colour, label=f"{fate.value} ({len(of_fate)})"))
        if fate is Fate.OFF:
            _draw_arrows(axes, of_fate, colour)
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(f"Paint against {Path(source).name}")
    axes.grid(linewidth=0.3, alpha=0.5)
    axes.legend(handles=handles, loc="best")
    figure.savefig(path, dpi=150)


_TIMES = 20.0  # how many times longer than the offset an arrow is


def _draw_arrows(axes: Any, findings: Sequence[Finding], colour: str) -> None:
    for finding in findings:
        if finding.meant_map is None or finding.found_map is None:
            continue
        start = finding.meant_map.mean(axis=0)
        way = _TIMES * (finding.found_map.mean(axis=0) - start)
        axes.annotate(
            "", xy=start + way, xytext=start, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.0}
        )
    axes.text(0.01, 0.01, f"arrows: offsets, {_TIMES:.0f} times longer", transform=axes.transAxes, fontsize=8)
