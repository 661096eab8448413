"""A drive at an object store, copied into the cache, once for each content that it has had."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from v2hdm.errors import DriveError
from v2hdm.io.importers.imported import begin_entry, cannot_write, drop_entry, finish_entry, is_whole
from v2hdm.store.cache.folders import note_use
from v2hdm.store.cache.keys import key_of
from v2hdm.store.objects.bucket import Bucket, Thing

_log = logging.getLogger(__name__)

_AT_ONCE = 32
"""Objects of one call, fetched side by side."""


def mirrored(objects: Bucket, cache: Path, tell: Callable[[int, int], None]) -> Path:
    """The folder in ``cache`` that holds what is below a URL now.

    Args:
        objects: of the drive's folder.
        cache: folder of this machine.
        tell: called as ``tell(done, total)`` with numbers of objects.

    Raises:
        DriveError: there is no drive, a name of it leads out of its folder, or the copy cannot be written.
        ConfigError: the store failed.
    """
    things = {name: one for name, one in objects.listed().items() if not name.endswith("/")}
    if not things:
        raise DriveError(f"{objects}: no such drive; give the URL of a drive's folder")
    wrong = next((name for name in things if {"", ".", ".."} & set(name.split("/")) or "\\" in name), None)
    if wrong is not None:
        raise DriveError(f"{objects}: the name {wrong!r} is none of a file in a folder; rename the object")
    called = objects.url.rsplit("/", 1)[-1]
    content = key_of(objects.url, sorted((name, one.size, one.token) for name, one in things.items()))
    entry = cache / f"{called}-{content[:12]}"
    if is_whole(entry):
        note_use(entry)
        return entry / called
    _log.info("%s: copying %d objects of %.1f MB to %s", objects, len(things), _megabytes(things), entry)
    partial = begin_entry(entry) / called
    try:
        names = sorted(things)
        for begin in range(0, len(names), _AT_ONCE):
            some = names[begin : begin + _AT_ONCE]
            objects.fetch({name: partial / name for name in some})
            changed = next((one for one in some if (partial / one).stat().st_size != things[one].size), None)
            if changed is not None:
                raise DriveError(f"{objects}/{changed}: changes while it is copied; start again")
            tell(begin + len(some), len(names))
        finish_entry(entry)
    except OSError as failure:
        raise cannot_write(entry, failure) from None
    finally:
        drop_entry(entry)
    return entry / called


def _megabytes(things: dict[str, Thing]) -> float:
    return sum(one.size for one in things.values()) / 1e6
