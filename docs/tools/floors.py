"""Draws the floors of the library out of its import contracts: ``python docs/tools/floors.py``."""

from __future__ import annotations

import tomllib
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "floors.svg"
_WIDTH = 800  # width of the picture, px
_MARGIN = 10  # margin of the picture, px
_FLOOR = 26  # height of a floor, px
_GAP = 6  # gap between parts and between floors, px
_LETTER = 7.3  # width of a letter of the font below, px
_STYLE = (
    "rect{fill:#e8eef4;stroke:#5b6b7b}rect.light{fill:#fff3d6}text{font:12px monospace;fill:#1b2733;"
    "text-anchor:middle}"
)


def floors() -> list[list[str]]:
    """The library's parts by floor, the highest first; neighbours never import each other."""
    contracts = _contracts()
    layers = next(
        contract["layers"]
        for contract in contracts
        if contract["type"] == "layers" and "containers" not in contract
    )
    return [[part.strip().removeprefix("v2hdm.") for part in floor.split("|")] for floor in layers]


def without_torch() -> set[str]:
    """The parts that a contract keeps free of torch."""
    free = next(contract for contract in _contracts() if "torch" in contract.get("forbidden_modules", ()))
    return {name.removeprefix("v2hdm.") for name in free["source_modules"]}


def draw() -> str:
    """The picture, as SVG."""
    free = without_torch()
    rows = [row for floor in floors() for row in _rows(floor)]
    height = 2 * _MARGIN + len(rows) * (_FLOOR + _GAP) - _GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" '
        f'height="{height}" role="img" aria-label="Floors of v2hdm: each may import those below it">',
        f"<style>{_STYLE}</style>",
        f'<rect width="{_WIDTH}" height="{height}" style="fill:#fff;stroke:none"/>',
    ]
    for number, row in enumerate(rows):
        top = _MARGIN + number * (_FLOOR + _GAP)
        total = sum(len(name) + 2 for name in row)
        room = _WIDTH - 2 * _MARGIN - _GAP * (len(row) - 1)
        left = float(_MARGIN)
        for name in row:
            width = room * (len(name) + 2) / total
            light = any(f"{name}.".startswith(f"{package}.") for package in free)
            kind = ' class="light"' if light else ""
            parts.append(
                f'<rect{kind} x="{left:.0f}" y="{top}" width="{width:.0f}" height="{_FLOOR}" rx="3"/>'
            )
            parts.append(f'<text x="{left + width / 2:.0f}" y="{top + 17}">{escape(name)}</text>')
            left += width + _GAP
    return "\n".join([*parts, "</svg>"]) + "\n"


def _contracts() -> list[dict[str, list[str]]]:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return list(settings["tool"]["importlinter"]["contracts"])


def _rows(floor: list[str]) -> list[list[str]]:
    """A floor in rows that its names fit into."""
    rows: list[list[str]] = [[]]
    for name in floor:
        if sum(len(label) * _LETTER + 20 for label in [*rows[-1], name]) > _WIDTH - 2 * _MARGIN:
            rows.append([])
        rows[-1].append(name)
    return rows


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
