"""Folders of a cache that are ours: rendered drives, and what is imported from bags and videos.

Each holds a list of the files that we wrote, ``.v2hdm-cache.json``; only these are ever removed. The list's
time of change is that of the folder's last use.

Streams of bags and videos kept as plain files: imported once, whole or not at all.

An entry is a folder that is named by a hash of its source (names, sizes and times of change of the files) and
of how it was read. Its list of contents, with size and hash of every file, tells a damaged one, which is made
anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, DriveError
from v2hdm.io.texts import read_json
from v2hdm.store.files import file_digest
from v2hdm.store.lock import hold_lease

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


_VERSION = 2
"""Raised whenever an import comes out as other files."""

_CONTENTS = "contents.txt"
_IMAGES = (".png", ".jpg", ".jpeg")


def entry_folder(cache: Path, files: Sequence[Path], label: str, settings: Any) -> Path:
    """Where the entry of a stream of some source files belongs.

    Raises:
        DriveError: a source cannot be looked at.
    """
    try:
        stats = [(file.name, file.stat()) for file in files]
    except OSError as failure:
        raise DriveError(f"{failure.filename}: cannot be read ({failure.strerror}); check the path") from None
    source = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    text = json.dumps([_VERSION, source, label, settings], sort_keys=True)
    words = "".join(letter if letter.isalnum() else "_" for letter in f"{files[0].stem}-{label}").strip("_")
    folder = cache / f"{words[:60]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    if is_whole(folder):
        note_use(folder)
    return folder


def is_whole(folder: Path) -> bool:
    """Whether ``folder`` is an entry with all of its files: images by their size, the rest by content."""
    try:
        lines = (folder / _CONTENTS).read_text(encoding="utf-8").splitlines()
        entries = [line.split(" ", 2) for line in lines[1:]]
        return lines[0] == str(len(entries)) and all(
            [size, digest] == _told(folder / name) for size, digest, name in entries
        )
    except (OSError, ValueError, IndexError):
        return False


def _told(path: Path) -> list[str]:
    """What the list of contents says of a file; a decoder tells of a damaged image."""
    size = str(path.stat().st_size)
    return [size, "-" if path.suffix in _IMAGES else file_digest(path)]


def begin_entry(folder: Path) -> Path:
    """An empty hidden folder to fill for ``folder``; those that dead processes left behind are removed."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in folder.parent.glob(f".{folder.name}.*.part"):
            if not _is_alive(int(left.name.split(".")[-2])) or left == _partial(folder):
                shutil.rmtree(left, ignore_errors=True)
        _partial(folder).mkdir()
    except OSError as failure:
        raise cannot_write(folder, failure) from None
    return _partial(folder)


def finish_entry(folder: Path) -> None:
    """Put what was filled in its place, with its list of contents."""
    partial = _partial(folder)
    try:
        files = sorted(path for path in partial.rglob("*") if path.is_file())
        lines = [" ".join([*_told(path), path.relative_to(partial).as_posix()]) for path in files]
        (partial / _CONTENTS).write_text("\n".join([str(len(lines)), *lines]) + "\n", encoding="utf-8")
        if folder.exists() and not is_whole(folder):
            shutil.rmtree(folder)
        if folder.exists():  # another process was faster
            shutil.rmtree(partial)
        else:
            partial.replace(folder)
        note_use(folder)
    except OSError as failure:
        raise cannot_write(folder, failure) from None


def drop_entry(folder: Path) -> None:
    """Remove what was filled for ``folder`` so far."""
    shutil.rmtree(_partial(folder), ignore_errors=True)


def cannot_write(folder: Path, failure: OSError) -> DriveError:
    """The error of an import that finds no place."""
    return DriveError(
        f"{folder}: cannot write the import ({failure.strerror}); free space or choose another drive.cache"
    )


def _partial(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.{os.getpid()}.part")


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
