"""What an experiment keeps of each drive on disk, so that one that was stopped goes on where it was.

Files are gzipped JSON, whose numbers come back exactly, under the key of all that they were made from. A file
of another key, or a damaged one, counts as absent.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.store.files import whole_file

_FASTEST = 1
"""Level of gzip: a fifth of the size already, at a tenth of the time of the default."""


def store(path: Path, key: str, content: Mapping[str, Any]) -> None:
    """Write plain content (lists, numbers, texts, arrays) under a key, whole or not at all."""
    text = json.dumps({"key": key, "content": content}, default=_plain)
    with whole_file(path) as partial:
        partial.write_bytes(gzip.compress(text.encode(), _FASTEST))


def stored(path: Path, key: str) -> dict[str, Any] | None:
    """The content of a file of :func:`store`; None where there is none of this key."""
    try:
        found = json.loads(gzip.decompress(path.read_bytes()))
        content: dict[str, Any] | None = found["content"] if found["key"] == key else None
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError):
        return None
    return content


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not plain")
