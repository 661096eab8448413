"""From a result folder to its ``report.html``: one file with everything in it."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import jinja2

from v2hdm.records import Drive
from v2hdm.report.page.document import document
from v2hdm.report.page.facts import read_facts
from v2hdm.store.files import replace_text

FILE = "report.html"
"""Name of the page in a result folder."""

_ASSETS = {
    "leaflet.js": "vendor",
    "leaflet.css": "vendor",
    "page.css": "templates",
    "map.js": "templates",
}
"""Scripts and styles that stand in the page as they are, by the folder that holds them."""


def write_page(folder: Path, drive: Drive | None) -> Path:
    """Write ``report.html`` into a result folder, atomically, and return its path.

    Args:
        folder: what ``v2hdm map`` wrote.
        drive: that was mapped, for pictures, the recorded route and truth; None where it is not at hand.

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
