"""The sources of the compiled kernels, and their digest."""

from __future__ import annotations

import hashlib
from pathlib import Path


def digest(folder: Path) -> str:
    """A digest of the sources in a folder; empty where there are none, as in a wheel."""
    paths = sorted([*folder.glob("*.h"), *folder.glob("*.cpp")])
    content = b"".join(path.read_bytes().replace(b"\r\n", b"\n") for path in paths)
    return hashlib.sha256(content).hexdigest()[:16] if paths else ""
