"""Folders of a cache that are ours: rendered drives, and what is imported from bags and videos.

Each holds a list of the files that we wrote, ``.v2hdm-cache.json``; only these are ever removed. The list's
time of change is that of the folder's last use.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError
from v2hdm.io.safe.texts import read_json
from v2hdm.store.cache.leases import hold_lease

LIST = ".v2hdm-cache.json"
"""Name of the list in a folder."""

_ABOUT = "files that v2hdm wrote here, which it may remove to make room; touched when they are used"


def note_use(folder: Path) -> None:
    """Say that a folder is in use now, and what in it is ours where that was never said.

    A folder that cannot be written is used as it is. The folder's cache is in use, too, from now on.
    """
    hold_lease(folder.parent)
    with suppress(OSError):
        path = folder / LIST
        if path.is_file():
            os.utime(path)
            return
        files = sorted(one for one in folder.rglob("*") if one.is_file())
        names = [one.relative_to(folder).as_posix() for one in files]
        size = sum(one.stat().st_size for one in files)
        content = {"about": _ABOUT, "bytes": size, "files": names}
        partial = folder / f".{os.getpid()}.part"
        partial.write_text(json.dumps(content) + "\n", encoding="utf-8")
        partial.replace(path)


def size_of(folder: Path) -> int | None:
    """Bytes of our files in a folder, as its list says; None where it is none of our folders."""
    content = _listed(folder)
    size = None if content is None else content.get("bytes")
    return size if isinstance(size, int) and size >= 0 else None


def our_files(folder: Path) -> list[Path]:
    """Those files of a folder that are ours and there."""
    names = (_listed(folder) or {}).get("files")
    if not isinstance(names, list):
        return []
    listed = [folder / name for name in names if isinstance(name, str) and "\0" not in name]
    # The list may lie: nothing outside of the folder is ours, whatever way leads there.
    here = folder.resolve()
    within = {parent for parent in {path.parent for path in listed} if parent.resolve().is_relative_to(here)}
    return [path for path in listed if path.parent in within and path.is_file() and not path.is_symlink()]


def _listed(folder: Path) -> dict[str, Any] | None:
    try:
        content = read_json(folder / LIST, ConfigError)
    except ConfigError:
        return None
    return content if isinstance(content, dict) and content.get("about") == _ABOUT else None


def remove_ours(folder: Path) -> None:
    """Remove our files from a folder, and the folder where nothing else is in it.

    Those at its top go first: without them it is neither a drive nor an import.

    Raises:
        OSError: a file cannot be removed.
    """
    for path in sorted(our_files(folder), key=lambda path: (len(path.parts), path)):
        path.unlink(missing_ok=True)
    (folder / LIST).unlink(missing_ok=True)
    below = sorted((one for one in folder.rglob("*") if one.is_dir()), key=lambda one: -len(one.parts))
    for one in [*below, folder]:
        with suppress(OSError):
            one.rmdir()
