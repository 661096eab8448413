"""``v2hdm benchmark make SITE DIR``: the drive of a benchmark, as a mapper gets it (docs/benchmark.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_site, log_to_terminal, steps_of
from v2hdm.cli.command import GO_ON, Command, need_installed


def _run(arguments: Sequence[str]) -> None:
    """Make a drive without its truth."""
    parser = COMMAND.parser()
    add_site(parser)
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder for the drive")
    where = "folder in which drives are made and kept (default: cache)"
    parser.add_argument("--cache", type=Path, default=Path("cache"), metavar="DIR", help=where)
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: all cores)")
    parsed = parser.parse_args(arguments)
    need_installed("torch")
    from v2hdm.benchmark.sites import input_hash, site_of, write_input
    from v2hdm.executor import open_executor
    from v2hdm.settings import check_workers
    from v2hdm.store.results import result_folder

    log_to_terminal()
    check_workers(parsed.workers)
    site = site_of(parsed.site, parsed.way)
    with (
        result_folder(parsed.folder, "DIR", f"v2hdm benchmark make {site.name}") as unfinished,
        open_executor(parsed.workers, writable=[parsed.cache]) as executor,
    ):
        write_input(site, unfinished, parsed.cache, executor, steps_of("make images"))
        digest = input_hash(unfinished)
    print(f"{site.name}: {site.says}")
    print(f"drive in {parsed.folder}, sha256 {digest}: {_published(digest, site.input_sha256)}")


def _published(digest: str, published: str) -> str:
    if not published:
        return "of a layout of your own, which is not published"
    if digest == published:
        return "as published"
    return f"not as published ({published}), say so where you compare scores"


COMMAND = Command(
    "v2hdm benchmark make",
    "Make the drive of a benchmark, without its truth.",
    _run,
    interrupted=f"interrupted; finished images are kept, {GO_ON}",
)
