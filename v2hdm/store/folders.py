"""Folders of a cache that are ours: rendered drives, imports from bags and videos, downloads.

Each holds a list of the files that we wrote, ``.v2hdm-cache.json``, with their sizes and hashes; only these
are ever removed. The list's time of change is that of the folder's last use. An import is whole or absent; a
damaged one is made anew.

Locks of the operating system on files are released by the end of a process, whatever ends it. One that uses
a cache holds a file of its own locked there, and touches all that it uses: nothing that was last used before
the oldest of these locks was taken is used by a run in progress.
"""

from __future__ import annotations

import atexit
import filecmp
import hashlib
import json
import logging
import os
import platform
import secrets
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from v2hdm.errors import ConfigError, DriveError
from v2hdm.safe.texts import read_json
from v2hdm.store.files import file_digest, refuse_url
from v2hdm.store.inputs import note_input

STAGES = "stages"  # folder within a cache of the entries of stages
IN_USE = f"{STAGES}/in_use"  # folder within a cache of the locks of runs in progress
HOST = platform.node() or "this host"
_ENDING = ".lock"  # of the name of a lock in IN_USE
_TRIES = 9  # tries to make a lock in a folder that others may remove meanwhile; chosen
_LONGEST_WAIT_S = 10.0  # for a lock that others hold for milliseconds; chosen
_POLL_S = 0.01  # how often a lock is tried
_used: Counter[Path] = Counter()


def take_lock(stream: IO[str]) -> bool:
    """Lock an open file without waiting and report whether it was free; a warning where none can be held."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as failure:
        _log.warning("%s: no lock is possible here (%s); do not write it twice at once", stream.name, failure)
    return True


@contextmanager
def waited_for(path: Path) -> Iterator[None]:
    """Hold the lock file ``path`` within this block; raises ConfigError if others hold it for long."""
    end_s = time.monotonic() + _LONGEST_WAIT_S
    while True:
        stream = path.open("a+", encoding="utf-8")
        # The last holder may have removed the file between our opening and locking it.
        with suppress(OSError):
            if take_lock(stream) and os.path.samestat(os.fstat(stream.fileno()), path.stat()):
                break
        stream.close()
        if time.monotonic() > end_s:
            raise ConfigError(f"{path}: another process holds this lock; try again, or end that process")
        time.sleep(_POLL_S)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        stream.close()


@contextmanager
def in_use(cache: Path) -> Iterator[None]:
    """Protect entries of a writable cache that are used within this block from pruning."""
    path = cache / IN_USE / f"{secrets.token_hex(8)}{_ENDING}"
    here = cache.resolve()
    stream = None
    for _ in range(_TRIES):  # whoever leaves may remove the folder meanwhile
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = path.open("x", encoding="utf-8")
            break
        except FileNotFoundError:
            continue
        except OSError:
            break
    if stream is None:
        yield
        return
    _used[here] += 1
    try:
        take_lock(stream)
        yield
    finally:
        _used[here] -= 1
        stream.close()
        with suppress(OSError):
            path.unlink(missing_ok=True)
            for folder in (path.parent, path.parent.parent, cache):  # as many as are empty
                folder.rmdir()


def unused_before(cache: Path) -> float:
    """The time, s since 1970, before which nothing was last used that a run in progress uses."""
    earliest = time.time()
    for path in (cache / IN_USE).glob(f"*{_ENDING}"):
        with suppress(OSError):  # given up meanwhile
            start_s = path.stat().st_mtime
            is_left = False
            with suppress(OSError), path.open(encoding="utf-8") as stream:  # unreadable counts as held
                is_left = take_lock(stream)
            if is_left:
                path.unlink(missing_ok=True)
            else:
                earliest = min(earliest, start_s)
    return earliest


_log = logging.getLogger(__name__)

LIST = ".v2hdm-cache.json"  # name of the list in a folder
_ABOUT = "files that v2hdm wrote here, which it may remove to make room; touched when they are used"

_VERSION = 3  # raised whenever an import comes out as other files
_IMAGES = (".png", ".jpg", ".jpeg")  # endings of files that are listed without a digest
_WRITER = f"{HOST}-{secrets.token_hex(4)}"  # this process in unfinished files' names
_STALE_S = 3600.0  # time without a write after which an unfinished folder counts as left by a killed run, s


def note_use(folder: Path) -> None:
    """Note that a folder and its cache are in use now, and list its files where that was never done."""
    if not _used[folder.parent.resolve()]:
        held = ExitStack()
        held.enter_context(in_use(folder.parent))
        atexit.register(held.close)
    with suppress(OSError):
        if (folder / LIST).is_file():
            os.utime(folder / LIST)
        else:
            _write_list(folder)


def size_of(folder: Path) -> int | None:
    """The bytes of our files in a folder, from its list; None for other folders."""
    size = _listed(folder).get("bytes")
    return size if isinstance(size, int) and size >= 0 else None


def remove_ours(folder: Path) -> None:
    """Remove our files from a folder, top level first, then empty folders. Raises OSError."""
    for path in sorted(_ours(folder), key=lambda path: (len(path.parts), path)):
        path.unlink(missing_ok=True)
    (folder / LIST).unlink(missing_ok=True)
    remove_empty(folder)


def remove_empty(folder: Path) -> None:
    """Remove the folders in a folder that hold nothing, and itself."""
    folders = [path for path in folder.rglob("*") if path.is_dir()]
    deepest_first = sorted(folders, key=lambda path: -len(path.parts))
    for directory in [*deepest_first, folder]:
        with suppress(OSError):
            directory.rmdir()


def bring_over(old: Path, new: Path, is_ours: Callable[[str], bool]) -> None:
    """Carry the files of others in the ``old`` folder over to the ``new`` one."""
    for root, folders, files in os.walk(old):
        here = Path(root)
        links = [name for name in folders if (here / name).is_symlink()]
        names = [(here / name).relative_to(old).as_posix() for name in (*files, *links)]
        theirs = [name for name in names if not is_ours(name)]
        if theirs or not (files or folders):
            (new / here.relative_to(old)).mkdir(parents=True, exist_ok=True)
        for name in theirs:
            place = new / name
            while os.path.lexists(place) and not _is_same(old / name, place):
                place = place.with_name(f"{place.stem}.kept{place.suffix}")
                _log.warning("%s is not ours; it is kept as %s", old / name, place.name)
            if os.path.lexists(place):
                continue
            try:
                os.link(old / name, place, follow_symlinks=False)
            except OSError:  # a file system without links
                shutil.copy2(old / name, place, follow_symlinks=False)


def _is_same(path: Path, other: Path) -> bool:
    if path.is_symlink() or other.is_symlink():
        return path.is_symlink() and other.is_symlink() and path.readlink() == other.readlink()
    return path.is_file() and other.is_file() and filecmp.cmp(path, other, shallow=False)


def _ours(folder: Path) -> list[Path]:
    names = _listed(folder).get("files")
    if not isinstance(names, list | dict):
        return []
    listed = [folder / name for name in names if isinstance(name, str) and "\0" not in name]
    # The list may lie: nothing outside of the folder is ours, whatever way leads there.
    here = folder.resolve()
    within = {parent for parent in {path.parent for path in listed} if parent.resolve().is_relative_to(here)}
    return [path for path in listed if path.parent in within and path.is_file() and not path.is_symlink()]


def _listed(folder: Path) -> dict[str, Any]:
    try:
        content = read_json(folder / LIST, ConfigError)
    except ConfigError:
        return {}
    return content if isinstance(content, dict) and content.get("about") == _ABOUT else {}


def entry_folder(cache: Path, files: Sequence[Path], label: str, settings: Any) -> Path:
    """The folder of an import of some files, by a hash of all that it is made of; DriveError as by stat."""
    refuse_url(cache)
    for file in files:
        note_input(file)
    try:
        stats = [(file.name, file.stat()) for file in files]
    except OSError as failure:
        raise DriveError(f"{failure.filename}: cannot be read ({failure.strerror}); check the path") from None
    source = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    text = json.dumps([_VERSION, source, label, settings], sort_keys=True)
    words = "".join(letter if letter.isalnum() else "_" for letter in f"{files[0].stem}-{label}").strip("_")
    # Absolute, so that images are called the same wherever the result is read again.
    folder = cache.absolute() / f"{words[:60]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    if is_whole(folder):
        note_use(folder)
    return folder


def is_whole(folder: Path) -> bool:
    """Whether ``folder`` is an import with all of its files: images by their size, the rest by content."""
    files = _listed(folder).get("files")
    try:
        return isinstance(files, dict) and all(_described(folder / name) == files[name] for name in files)
    except (OSError, ValueError):
        return False


@contextmanager
def new_entry(folder: Path) -> Iterator[Path]:
    """A hidden folder to fill, then moved to ``folder`` as a whole; raises DriveError if it cannot be."""
    partial = folder.with_name(f".{folder.name}.{_WRITER}.part")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in folder.parent.glob(f".{folder.name}.*-{'[0-9a-f]' * 8}.part"):
            if left == partial or is_stale(left):
                shutil.rmtree(left, ignore_errors=True)
        partial.mkdir()
        yield partial
        _write_list(partial)
        if folder.exists() and not is_whole(folder):
            remove_ours(folder)
        if not folder.exists():
            partial.replace(folder)
        elif not is_whole(folder):  # else another process was faster
            _fill(folder, partial)
        note_use(folder)
    except OSError as failure:
        raise DriveError(
            f"{folder}: cannot be written ({failure.strerror}); free space or set drive.cache"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _fill(folder: Path, new: Path) -> None:
    """Move what is in ``new`` into a folder of somebody's files, which stay; the list comes last."""
    for path in sorted(new.rglob("*"), key=lambda path: (path.name == LIST, path)):
        place = folder / path.relative_to(new)
        if path.is_dir():
            if place.is_symlink():  # what it leads to is not ours
                place.unlink()
            place.mkdir(exist_ok=True)
        else:
            path.replace(place)


def is_stale(folder: Path) -> bool:
    """Whether nothing in an unfinished import was written for long: its process was killed."""
    with suppress(OSError):  # it is being written, or gone
        return time.time() - max(path.stat().st_mtime for path in [folder, *folder.rglob("*")]) > _STALE_S
    return False


def _write_list(folder: Path) -> None:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    described = {path.relative_to(folder).as_posix(): _described(path) for path in files}
    size = sum(size for size, _ in described.values())
    partial = folder / f".{_WRITER}.part"
    text = json.dumps({"about": _ABOUT, "bytes": size, "files": described})
    partial.write_text(text + "\n", encoding="utf-8")
    partial.replace(folder / LIST)


def _described(path: Path) -> list[Any]:
    """The size and digest of a file; a damaged image is found by its decoder."""
    return [path.stat().st_size, "-" if path.suffix in _IMAGES else file_digest(path)]
