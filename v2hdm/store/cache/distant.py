"""What the object store behind a cache holds: it tells when an entry was written, not when it was used."""

from __future__ import annotations

import re
from dataclasses import dataclass

from v2hdm.store.cache.leases import STAGES
from v2hdm.store.cache.pruning import ENTRY
from v2hdm.store.objects.bucket import Bucket

_NAME = re.compile(rf"{STAGES}/(?P<kind>\w+)/{ENTRY.pattern}")


@dataclass(frozen=True)
class ObjectItem:
    """An entry at an object store, as :class:`v2hdm.store.cache.pruning.Item` is one on disk.

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
