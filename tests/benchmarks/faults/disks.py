"""Disks that fail: at one call, at one size, or because nothing may be written there."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.benchmarks.faults.doors import cache_defects
from tests.benchmarks.faults.failing_calls import Failure, why_not
from tests.benchmarks.faults.forked import Forked
from tests.benchmarks.faults.running import Order, Row, folder_in, row_of
from tests.benchmarks.faults.situations import HERE, Expected, Situation
from tests.faults.judge import Case, Ran, judge, judge_again

_PAGE = 4096
_ROOM = 1 << 30


def calls_that_fail(order: Order) -> Iterator[Row]:
    """Every call of every door that writes fails once."""
    reason = why_not()
    if reason is not None:
        print(f"calls: skipped: {reason}")
        return
    for situation in _chosen(order):
        expected, calls = expected_of(situation, order.scratch)
        chosen = order.rng.permutation(len(calls))[: order.each]
        print(f"calls: {situation.name}: {len(chosen)} of {len(calls)} calls that write fail", flush=True)
        for at in sorted(chosen):
            lasts = bool(order.rng.integers(2))
            failure = Failure(int(at), errno.ENOSPC if lasts else errno.EIO, lasts)
            with folder_in(order.scratch) as folder:
                outcome = judge(situation.case, folder, Forked(folder, failure))
                defects = cache_defects(folder / HERE / situation.cache)
                again = judge_again(situation.case, folder, Forked(folder))
                defects += expected.defects(situation, outcome, again)
            what = "disk full from" if lasts else "I/O error at"
            yield row_of(f"{situation.name}: {what} call {at}, {calls[at]}", outcome, defects)


def full_disks(order: Order) -> Iterator[Row]:
    """Disks with room for nothing, for everything, and for sizes between."""
    for situation in _on_own_disk(order, "full"):
        expected, _ = expected_of(situation, order.scratch)
        needed = _needed(situation.case, order.scratch)
        for room in sorted(order.rng.integers(0, round(1.1 * needed), order.each)):
            with _disk(order.scratch) as folder:

                def run(case: Case, folder: Path = folder, room: int = int(room)) -> Ran:
                    return _then(lambda: _resize(folder, _filled(folder) + room), case, folder)

                outcome = judge(situation.case, folder, run)
                defects = cache_defects(folder / HERE / situation.cache)
                _resize(folder, _ROOM)
                again = judge_again(situation.case, folder, Forked(folder))
                defects += expected.defects(situation, outcome, again)
            yield row_of(f"{situation.name}: room for {room} bytes", outcome, defects)


def readonly_disks(order: Order) -> Iterator[Row]:
    """Disks that may only be read: the whole one, and that of the cache."""
    for situation in _on_own_disk(order, "readonly"):
        expected, _ = expected_of(situation, order.scratch)
        for part in (".", HERE + situation.cache):
            with folder_in(order.scratch) as folder:
                outcome = judge(situation.case, folder, lambda case, at=folder / part: _read_only(at, case))
                defects = expected.defects(situation, outcome)
                defects += cache_defects(folder / HERE / situation.cache)
            yield row_of(
                f"{situation.name}: {'all' if part == '.' else 'the cache'} read-only", outcome, defects
            )


def expected_of(situation: Situation, scratch: Path) -> tuple[Expected, list[str]]:
    """The outcome of a door on a good disk, and its calls that write."""
    outcomes, calls = [], []
    for _ in range(2):
        with folder_in(scratch) as folder:
            runner = Forked(folder)
            outcomes.append(judge(situation.case, folder, runner))
            calls = runner.calls
    return Expected.of(situation, *outcomes), calls


def _chosen(order: Order) -> Iterator[Situation]:
    for situation in order.doors.all():
        if re.search(order.only, situation.name):
            yield situation


def _on_own_disk(order: Order, kind: str) -> Iterator[Situation]:
    if not hasattr(os, "geteuid") or os.geteuid() or _mount("--version"):
        print(f"{kind}: skipped: only root can mount a disk in memory")
        return
    yield from _chosen(order)


def _needed(case: Case, scratch: Path) -> int:
    """Bytes that a door fills."""
    filled: list[int] = []
    with _disk(scratch) as folder:
        judge(case, folder, lambda case: _then(lambda: filled.append(_filled(folder)), case, folder))
        return max(_filled(folder) - filled[0], _PAGE)


def _then(first: Callable[[], None], case: Case, folder: Path) -> Ran:
    first()
    return Forked(folder)(case)


def _mount(*arguments: object) -> int:
    return subprocess.run(["mount", *map(str, arguments)], capture_output=True, check=False).returncode


@contextmanager
def _disk(scratch: Path) -> Iterator[Path]:
    """A disk in memory."""
    with folder_in(scratch) as place:
        if _mount("-t", "tmpfs", "-o", f"size={_ROOM}", "tmpfs", place):
            raise SystemExit(f"{place}: no disk in memory can be mounted there")
        try:
            (place / "on").mkdir()
            yield place / "on"
        finally:
            subprocess.run(["umount", str(place)], check=True)


def _filled(folder: Path) -> int:
    about = os.statvfs(folder)
    return (about.f_blocks - about.f_bfree) * about.f_frsize


def _resize(folder: Path, size: int) -> None:
    assert not _mount("-o", f"remount,size={size}", folder.parent)


def _read_only(folder: Path, case: Case) -> Ran:
    """Run a door while a folder is mounted onto itself, to be read only."""
    here = Path.cwd()
    folder.mkdir(exist_ok=True)
    assert not _mount("--bind", folder, folder)
    try:
        assert not _mount("-o", "remount,bind,ro", folder)
        os.chdir(here)  # what was opened before is not on the new disk
        return Forked(folder)(case)
    finally:
        os.chdir("/")
        subprocess.run(["umount", "-l", str(folder)], check=True)
