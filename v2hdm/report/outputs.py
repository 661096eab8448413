"""Figures of a run as a file, in its folder of results."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v2hdm.store.files import replace_text


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write strict JSON, whole; figures that do not exist (nan) are left out of their object."""
    replace_text(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items() if not _is_nan(item)}
    if isinstance(value, (list, tuple)):
        return [None if _is_nan(item) else _finite(item) for item in value]
    return value.item() if hasattr(value, "item") else value


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)
