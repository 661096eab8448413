"""Keys: digests of everything that an entry is made from, the code that makes it included."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGE = Path(__file__).parents[2]
_CODE = {".py", ".yaml", ".json", ".onnx", ".html", ".js", ".css"}
"""Files of the package that decide what comes out: sources, catalogue, weights, templates."""

LIBRARIES = (
    "torch",
    "kornia",
    "numpy",
    "scipy",
    "onnxruntime",
    "onnxruntime-gpu",
    "opencv-python-headless",
    "numba",
)
"""Those that the figures of a run depend on."""


def key_of(*parts: object) -> str:
    """SHA-256 in hexadecimal of parts that :func:`v2hdm.store.cache.codec.encode` takes."""
    from v2hdm.store.cache.codec import encode  # msgspec, which reading a drive does without

    return hashlib.sha256(encode(parts)).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def code_key() -> str:
    """Key of this package's files and of the versions of what it computes with: any change makes anew."""
    files = sorted(path for path in _PACKAGE.rglob("*") if path.suffix in _CODE)
    content = [(path.relative_to(_PACKAGE).as_posix(), file_digest(path)) for path in files]
    return key_of(content, library_versions())


def library_versions() -> dict[str, str]:
    """Versions by name of Python, of the libraries that are installed, and the system."""
    found = {"Python": platform.python_version()}
    for package in LIBRARIES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found | {"system": f"{platform.system()} {platform.machine()}"}
