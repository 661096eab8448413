"""Tables and progress bars on the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table

METHODS: Mapping[str, str] = {
    "CNI": "naive map, manually calibrated IPM",
    "ENI": "naive map, IPM estimated from another vehicle",
    "Opt": "joint optimisation of extrinsics and corners",
    "ONI": "naive map, optimised IPM",
}
"""The methods of the paper (IROS 2023), in the order of its tables."""


_AGAINST_TRUTH = ("recall", "false", "corner RMSE (cm)", "bias (cm)")
_WITHOUT_TRUTH = ("sigma (cm)", "reprojection (px)")


def results_table(title: str, results: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    """Method x camera set: markings, recall and corner errors, from ``metrics.json``'s ``results``."""
    has_truth = any("recall" in row for rows in results.values() for row in rows.values())
    table = Table(title=title, title_justify="left", header_style="bold")
    table.add_column("method")
    for heading in ("cameras", "markings"):
        table.add_column(heading, justify="right" if heading == "markings" else "left")
    headings = _AGAINST_TRUTH if has_truth else _WITHOUT_TRUTH
    for heading in headings:
        table.add_column(heading, justify="right")
    methods = sorted({m for rows in results.values() for m in rows}, key=lambda m: (_order(m), m))
    for method in methods:
        for cameras, rows in results.items():
            if method in rows:
                table.add_row(method, cameras, *_cells(rows[method], has_truth))
        table.add_section()
    return table


def _order(method: str) -> int:
    return list(METHODS).index(method) if method in METHODS else len(METHODS)


def _cells(row: Mapping[str, float], has_truth: bool) -> list[str]:
    if not has_truth:
        return [
            str(row["markings"]),
            _number(_times_100(row.get("median_sigma_m")), 1),
            _number(row.get("reprojection_rmse_px"), 2),
        ]
    return [
        str(row["markings"]),
        _number(row.get("recall"), 3),
        str(row.get("false_markings", "-")),
        _number(_times_100(row.get("corner_rmse_m")), 1),
        _number(_times_100(row.get("corner_bias_m")), 1),
    ]


def _times_100(value: float | None) -> float | None:
    return None if value is None else 100.0 * value


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def changes_table(changes: Mapping[str, Any]) -> Table:
    """What became of an earlier map's markings: those that moved, are gone or are new, one a row."""
    counts = ", ".join(f"{number} {fate}" for fate, number in changes["counts"].items() if number)
    table = Table(title=f"changes: {counts}", title_justify="left", header_style="bold")
    for heading, justify in (
        ("id", "right"),
        ("class", "left"),
        ("fate", "left"),
        ("by (cm)", "right"),
        ("sigma (cm)", "right"),
        ("odds", "right"),
        ("seen / should be", "right"),
        ("at (m)", "left"),
    ):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    for one in changes["listed"]:
        shift, sigma = one["shift_m"], one["shift_sigma_m"]
        corners = one["after_map"] or one["before_map"]
        x, y = (sum(corner[k] for corner in corners) / len(corners) for k in (0, 1))
        table.add_row(
            str(one["id"]),
            one["class"],
            one["fate"],
            "" if shift is None else f"{100 * math.hypot(*shift):.0f}",
            "" if sigma is None else f"{100 * math.hypot(*sigma) / math.sqrt(2):.1f}",
            f"{one['probability']:.3f}",
            f"{one['found']} / {one['views']}",
            f"({x:.1f}, {y:.1f})",
        )
    return table
