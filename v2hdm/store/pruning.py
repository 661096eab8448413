"""Keeping a cache below its limit: what was not used for longest goes first.

Only what is ours is looked at, and nothing goes that a run in progress uses.
"""

from __future__ import annotations

import logging
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from v2hdm.store.cache import ENDING
from v2hdm.store.folders import LIST, is_stale, remove_ours, size_of
from v2hdm.store.lock import STAGES, unused_before

_log = logging.getLogger(__name__)
_ENTRY = re.compile(rf"[0-9a-f]{{64}}{re.escape(ENDING)}")
_PARTIAL = re.compile(r"\.[\w.-]+[.-][0-9a-f]{8,16}\.part")

DRIVES = "drives and imports"  # kind of the folders, beside the stages of the entries
LEFT = "left by killed runs"  # kind of what was never finished


@dataclass(frozen=True)
class Item:
    """One thing that a cache keeps: its kind, size in bytes, last use (s since 1970), and its end."""

    kind: str
    path: Path
    size: int
    used_s: float
    remove: Callable[[], None]


def items_of(cache: Path) -> list[Item]:
    """Everything that is ours in a cache, what was not used for longest first."""
    found = []
    for path in (cache / STAGES).glob("*/*"):
        kind = path.parent.name if _ENTRY.fullmatch(path.name) else LEFT
        if (kind == LEFT and not _PARTIAL.fullmatch(path.name)) or not path.is_file():
            continue
        with suppress(OSError):  # another process has removed it
            about, remove = path.stat(), partial(path.unlink, missing_ok=True)
            found.append(Item(kind, path, about.st_size, about.st_mtime, remove))
    for folder in cache.glob(".*.part"):
        with suppress(OSError):
            if _PARTIAL.fullmatch(folder.name) and folder.is_dir() and is_stale(folder):
                left = sum(one.stat().st_size for one in folder.rglob("*"))
                found.append(Item(LEFT, folder, left, folder.stat().st_mtime, partial(shutil.rmtree, folder)))
    for listing in cache.glob(f"*/{LIST}"):
        folder, size = listing.parent, size_of(listing.parent)
        with suppress(OSError):
            if size is not None:
                used_s = listing.stat().st_mtime
                found.append(Item(DRIVES, folder, size, used_s, partial(remove_ours, folder)))
    return sorted(found, key=lambda item: (item.used_s, item.path))


def prune(cache: Path, limit: float) -> list[Item]:
    """Remove what was unused for longest until the rest has ``limit`` bytes, and all that killed runs left.

    Returns what was removed. More than the limit stays where runs in progress use it.
    """
    before_s, items, removed = unused_before(cache), items_of(cache), []
    size = sum(item.size for item in items)
    for item in items:
        if item.used_s >= before_s or (size <= limit and item.kind != LEFT):
            continue
        with suppress(OSError):  # not ours to remove: on a shared folder, another user's
            item.remove()
            size -= item.size
            removed.append(item)
    return removed


def prune_to_limit(cache: Path, limit_gb: float) -> None:
    """Prune a cache to a limit in GB, and log what went."""
    removed = prune(cache, limit_gb * 1e9)
    if removed:
        size_gb = sum(item.size for item in removed) / 1e9
        _log.info(
            "%s: removed %d entries of %.1f GB that were not used for longest (cache_gb=%g)",
            cache, len(removed), size_gb, limit_gb,
        )  # fmt: skip
