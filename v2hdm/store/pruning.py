"""What a cache holds, and keeping it below its limit: what was not used for longest goes first.

Only what is ours is looked at, and nothing goes that a run in progress uses.

What the object store behind a cache holds: it tells when an entry was written, not when it was used.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from v2hdm.store.cache import ENDING, checked
from v2hdm.store.folders import LIST, remove_ours, size_of
from v2hdm.store.lock import STAGES, unused_before
from v2hdm.store.remote import Bucket

_log = logging.getLogger(__name__)

ENTRY = re.compile(rf"[0-9a-f]{{64}}{re.escape(ENDING)}")
"""Names of entries."""

_PARTIAL = re.compile(r"\.[0-9a-f]{16}\.[0-9a-f]{8}\.part")

DRIVES = "drives and imports"
"""Kind of the folders, beside the stages of the entries."""

LEFT = "left by killed runs"
"""Kind of what was never finished."""


class Kept(Protocol):
    """One thing that a cache keeps, on disk or elsewhere."""

    @property
    def kind(self) -> str:
        """What it is: a stage, or one of the kinds above."""

    @property
    def path(self) -> object:
        """Where it is, to be shown."""

    @property
    def size(self) -> int:
        """Its bytes."""

    @property
    def used_s(self) -> float:
        """Its last use, s since 1970."""

    def read(self) -> bytes:
        """What an entry holds."""

    def remove(self) -> None:
        """Remove it; what is gone already is removed."""


_Kept = TypeVar("_Kept", bound=Kept)


@dataclass(frozen=True)
class Item:
    """One thing that a cache keeps: what it is (a stage, or one of the kinds above), where, how large.

    ``used_s`` is its last use, s since 1970.
    """

    kind: str
    path: Path
    size: int
    used_s: float

    def read(self) -> bytes:
        """What an entry's file holds."""
        return self.path.read_bytes()

    def remove(self) -> None:
        """Remove it; what another process has removed is gone as well."""
        if self.path.is_dir():
            remove_ours(self.path)
        else:
            self.path.unlink(missing_ok=True)


def items_of(cache: Path) -> list[Item]:
    """All that is ours in a cache, what was not used for longest first."""
    found = []
    for path in (cache / STAGES).glob("*/*"):
        kind = path.parent.name if ENTRY.fullmatch(path.name) else LEFT
        if (kind == LEFT and not _PARTIAL.fullmatch(path.name)) or not path.is_file():
            continue
        with suppress(OSError):  # another process has removed it
            about = path.stat()
            found.append(Item(kind, path, about.st_size, about.st_mtime))
    for listing in cache.glob(f"*/{LIST}"):
        size = size_of(listing.parent)
        if size is None:
            continue
        with suppress(OSError):
            found.append(Item(DRIVES, listing.parent, size, listing.stat().st_mtime))
    return sorted(found, key=lambda item: (item.used_s, item.path))


def prune(cache: Path, limit: float) -> list[Item]:
    """Remove what was not used for longest until the rest has ``limit`` bytes; returns what was removed.

    What killed runs have left goes in any case. More than the limit stays where runs in progress use it.
    """
    before_s = unused_before(cache)
    return remove_to(items_of(cache), limit, before_s)


def remove_to(items: Sequence[_Kept], limit: float, before_s: float = math.inf) -> list[_Kept]:
    """Remove the first of some items until the rest has ``limit`` bytes, none used since ``before_s``."""
    size, removed = sum(item.size for item in items), list[_Kept]()
    for item in items:
        if item.used_s >= before_s or (size <= limit and item.kind != LEFT):
            continue
        try:
            item.remove()
        except OSError:  # not ours to remove: on a shared folder, another user's
            continue
        size -= item.size
        removed.append(item)
    return removed


def make_room(cache: Path, limit_gb: float) -> None:
    """Prune a cache to a limit in GB, and log what went."""
    removed = prune(cache, limit_gb * 1e9)
    if removed:
        size_gb = sum(item.size for item in removed) / 1e9
        _log.info(
            "%s: removed %d entries of %.1f GB that were not used for longest (cache_gb=%g)",
            cache, len(removed), size_gb, limit_gb,
        )  # fmt: skip


def remove_damaged(items: Sequence[_Kept]) -> list[_Kept]:
    """Read all entries among some items and remove those that are damaged; returns these."""
    damaged = []
    for item in items:
        if item.kind in (DRIVES, LEFT):
            continue
        with suppress(OSError):
            if checked(item.read()) is None:
                item.remove()
                damaged.append(item)
    return damaged


_NAME = re.compile(rf"{STAGES}/(?P<kind>\w+)/{ENTRY.pattern}")


@dataclass(frozen=True)
class ObjectItem:
    """An entry at an object store, as :class:`v2hdm.store.pruning.Item` is one on disk.

    ``used_s`` is when it was written.
    """

    kind: str
    path: str
    size: int
    used_s: float
    objects: Bucket

    def read(self) -> bytes:
        """Its bytes; none where it is gone."""
        return self.objects.read(self.path) or b""

    def remove(self) -> None:
        """Remove it."""
        self.objects.remove(self.path)


def items_at(objects: Bucket) -> list[ObjectItem]:
    """All entries below a URL, those that were written first first.

    Raises:
        ConfigError: the store failed.
    """
    named = ((_NAME.fullmatch(name), one) for name, one in objects.listed().items())
    items = [
        ObjectItem(name["kind"], name.string, one.size, one.written_s, objects) for name, one in named if name
    ]
    return sorted(items, key=lambda item: (item.used_s, item.path))
