"""Write our scores into docs/benchmark.md: ``python docs/tools/benchmark.py SCORE.json ...``.

Each file is what ``v2hdm benchmark score RESULT SITE --json`` prints.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "benchmark.md"
HEADS = (
    "figure", "recall", "false", "corner RMSE", "95 % within", "NEES", "place / beside / shape",
    "inside 95 %", "lane lines", "verdict", "strictly",
)  # fmt: skip


def column_of(score: Mapping[str, Any]) -> list[str]:
    """The cells of a score, below the name of its site."""
    markings = score["markings"]
    stated = score["stated"]
    lanes = score["lanes"]
    return [
        f"`{score['site']}`",
        f"{100 * markings['recall']:.1f} % of {markings['expected']}",
        f"{markings['false_markings']} of {markings['markings']}",
        _cm(markings["corner_rmse_m"]),
        _cm(score["corner_95_m"]),
        f"{stated['nees']:.2f}" if stated["corners"] else "-",
        " / ".join(_figure(stated[part]) for part in ("place", "beside", "shape")),
        f"{100 * stated['inside_95']:.1f} %" if stated["corners"] else "-",
        _cm(lanes["rms_lateral_error_m"]) if lanes else "-",
        f"{score['verdict']}: {score['verdict_is']}" if score["verdict"] else "-",
        {True: "right", False: "wrong", None: "-"}[score["is_strictly_right"]],
    ]


def table(scores: Sequence[Mapping[str, Any]]) -> str:
    """The table of some scores, a column for each site, as Markdown."""
    columns = [HEADS, *map(column_of, scores)]
    head, *rows = (f"| {' | '.join(row)} |" for row in zip(*columns, strict=True))
    return "\n".join([head, "|" + "---|" * len(columns), *rows])


def with_table(page: str, text: str) -> str:
    """The page with another table in place of the one that begins with our first head."""
    before, head, after_head = page.partition(f"| {HEADS[0]} | ")
    if not head:
        raise SystemExit(f"{PAGE}: has no table that begins with {HEADS[0]}")
    after = after_head.partition("\n\n")[2]
    return f"{before}{text}\n\n{after}"


def _figure(nees: float | None) -> str:
    return "-" if nees is None else f"{nees:.2f}"


def _cm(length_m: float | None) -> str:
    return "-" if length_m is None else f"{100 * length_m:.1f} cm"


if __name__ == "__main__":
    scores = [json.loads(Path(name).read_text(encoding="utf-8")) for name in sys.argv[1:]]
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table(scores)), encoding="utf-8")
