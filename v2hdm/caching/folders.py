"""Folders of a cache that are ours: rendered drives, and what is imported from bags and videos.

Each holds a list of the files that we wrote, ``.v2hdm-cache.json``; only these are ever removed. The list's
time of change is that of the folder's last use.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from v2hdm.caching.leases import hold_lease
from v2hdm.errors import ConfigError
from v2hdm.texts import read_json

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
        names = sorted(one.relative_to(folder).as_posix() for one in folder.rglob("*") if one.is_file())
        partial = folder / f".{os.getpid()}.part"
        partial.write_text(json.dumps({"about": _ABOUT, "files": names}) + "\n", encoding="utf-8")
        partial.replace(path)


def our_files(folder: Path) -> list[Path] | None:
    """Those files of a folder that are ours and there; None where it is none of our folders."""
    try:
        content = read_json(folder / LIST, ConfigError)
    except ConfigError:
        return None
    if not isinstance(content, dict) or content.get("about") != _ABOUT:
        return None
    names = content.get("files")
    if not isinstance(names, list):
        return None
    listed = [folder / name for name in names if isinstance(name, str) and "\0" not in name]
    here = folder.resolve()
    # The list may lie: nothing outside of the folder is ours, whatever way leads there.
    within = [path for path in listed if path.parent.resolve().is_relative_to(here)]
    return [path for path in within if path.is_file() and not path.is_symlink()]


def remove_ours(folder: Path) -> None:
    """Remove our files from a folder, and the folder where nothing else is in it.

    Those at its top go first: without them it is neither a drive nor an import.

    Raises:
        OSError: a file cannot be removed.
    """
    files = our_files(folder)
    if files is None:
        return
    for path in sorted(files, key=lambda path: (len(path.parts), path)):
        path.unlink(missing_ok=True)
    (folder / LIST).unlink(missing_ok=True)
    below = sorted((one for one in folder.rglob("*") if one.is_dir()), key=lambda one: -len(one.parts))
    for one in [*below, folder]:
        with suppress(OSError):
            one.rmdir()
