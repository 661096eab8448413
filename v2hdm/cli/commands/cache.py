"""``v2hdm cache list`` lists the entries; ``prune`` makes room (docs/cache.md)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command

if TYPE_CHECKING:
    from v2hdm.store.cache import Item

_GB = 1e9  # bytes


def _run(arguments: Sequence[str]) -> None:
    """List or prune a cache."""
    parser = COMMAND.parser()
    actions = parser.add_subparsers(dest="what", metavar="{list,prune}", required=True)
    listing = actions.add_parser("list", help="list entries with size and last use")
    pruning = actions.add_parser("prune", help="remove least recently used entries, and leftovers")
    pruning.add_argument("--gb", type=float, required=True, help="size to keep, GB; 0 empties the cache")
    for action in (listing, pruning):
        action.add_argument("--cache", default=Path("cache"), type=Path, metavar="DIR", help="default: cache")
    parsed = parser.parse_args(arguments)
    from v2hdm.errors import ConfigError
    from v2hdm.store.cache import items_of, prune

    cache = parsed.cache
    if not cache.is_dir():
        raise ConfigError(f"{cache}: no such folder; give the cache of your runs with --cache")
    if parsed.what == "list":
        _show(items_of(cache))
        return
    if not parsed.gb >= 0:
        raise ConfigError(f"--gb {parsed.gb:g}: give 0 or more")
    removed = prune(cache, parsed.gb * _GB)
    freed = sum(item.size for item in removed)
    left = sum(item.size for item in items_of(cache))
    print(f"removed {len(removed)} entries of {_size(freed)}; {_size(left)} are left")


def _show(items: Sequence[Item]) -> None:
    kinds = sorted({item.kind for item in items})
    print(f"{'what':<20}{'entries':>8}{'size':>12}  last used")
    for kind in kinds:
        of_kind = [item for item in items if item.kind == kind]
        size = _size(sum(item.size for item in of_kind))
        last_used = time.strftime("%Y-%m-%d %H:%M", time.localtime(max(item.used_s for item in of_kind)))
        print(f"{kind:<20}{len(of_kind):>8}{size:>12}  {last_used}")
    print(f"{'all':<20}{len(items):>8}{_size(sum(item.size for item in items)):>12}")


def _size(size: int) -> str:
    return f"{size / _GB:.2f} GB" if size >= _GB else f"{size / 1e6:.1f} MB"


COMMAND = Command(
    "v2hdm cache",
    "List or prune the cache of runs.",
    _run,
    extra=None,
    interrupted="interrupted; entries removed so far are recomputed when needed",
)
