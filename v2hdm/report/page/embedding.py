"""Data within a page."""

from __future__ import annotations

import json


def json_text(content: object) -> str:
    """JSON that is safe in a script element: it neither ends the element nor opens a comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
