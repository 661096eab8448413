"""Faults of disks, files and frames, hundreds of each: what came of each, and how many ended well.

``python -m tests.benchmarks.faults [KIND ...] [--each N] [--only WORDS] [--scratch FOLDER]``; kinds:

- ``calls``: every call of a door that writes fails once, with ENOSPC from then on or EIO that once;
- ``full``: a disk of just so many bytes, from nothing to more than enough; ``readonly``: one that cannot be
  written (both need root, for a disk in memory).

A door must end in what it makes where nothing fails, or in one line of error with nothing half written and no
file touched that is not its own; afterwards, on a good disk, it must work. The exit code is 1 if any did not.
Doors are forked from a process that has loaded everything.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from tests.faults.doors import HERE, Doors, Expected, Situation, cache_defects
from tests.faults.failing_calls import Failure, watch, why_not
from tests.faults.judge import LONGEST_S, Case, Outcome, Ran, judge, judge_again, run_here

Row = tuple[str, str, str, str]
"""Of a case: kind, name, ``right``, ``told`` or ``DEFECT``, and what is to say of it."""


class Forked:
    """Runs a door in a fork of this process, whose calls that write below a folder may fail."""

    def __init__(self, below: Path, failure: Failure | None = None) -> None:
        self.below, self.failure = below, failure
        self.calls: list[str] = []

    def __call__(self, case: Case) -> Ran:
        """As :func:`tests.faults.judge.run_here`."""
        handle, name = tempfile.mkstemp()
        os.close(handle)

        def work() -> int:
            ran = run_here(case)
            Path(name).write_text(json.dumps([*ran, sorted(sys.modules)]))
            return 0

        watched = watch(work, self.below, self.failure, LONGEST_S + 10)
        self.calls = watched.calls
        text = Path(name).read_text()
        Path(name).unlink()
        if not text:
            return f"killed ({watched.code})", "", ""
        code, error, output, modules = json.loads(text)
        _load(modules)
        return code, error, output


_seen: set[str] = set(sys.modules)


def _load(modules: Sequence[str]) -> None:
    """Load here what a door has loaded, so that later ones need not."""
    for name in modules:
        if name not in _seen and name.split(".")[0] in (
            "v2hdm",
            "train",
            "matplotlib",
            "rich",
            "hydra",
            "torch",
            "scipy",
            "cv2",
        ):
            with suppress(Exception):
                importlib.import_module(name)
        _seen.add(name)


@contextmanager
def _folder(scratch: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=scratch) as name:
        yield Path(name).resolve()


def expected_of(situation: Situation, scratch: Path) -> tuple[Expected, list[str]]:
    """What a door leaves on a good disk, and its calls that write."""
    outcomes, calls = [], []
    for _ in range(2):
        with _folder(scratch) as folder:
            runner = Forked(folder)
            outcomes.append(judge(situation.case, folder, runner))
            calls = runner.calls
    return Expected.of(situation, *outcomes), calls


def calls_that_fail(
    doors: Doors, scratch: Path, each: int, only: str, rng: np.random.Generator
) -> Iterator[Row]:
    """Every call of every door that writes fails once."""
    reason = why_not()
    if reason is not None:
        print(f"calls: skipped: {reason}")
        return
    for situation in doors.all():
        if only not in situation.name:
            continue
        expected, calls = expected_of(situation, scratch)
        chosen = rng.permutation(len(calls))[:each]
        print(
            f"calls: {situation.name}: {len(calls)} calls that write, {len(chosen)} of them made to fail",
            flush=True,
        )
        for at in sorted(chosen):
            lasts = bool(rng.integers(2))
            failure = Failure(int(at), errno.ENOSPC if lasts else errno.EIO, lasts)
            with _folder(scratch) as folder:
                outcome = judge(situation.case, folder, Forked(folder, failure))
                defects = cache_defects(folder / HERE / situation.cache)
                defects += expected.defects(
                    situation, outcome, judge_again(situation.case, folder, Forked(folder))
                )
            words = (
                f"{situation.name}: {'disk full from' if lasts else 'I/O error at'} call {at}, {calls[at]}"
            )
            yield _row("calls", words, outcome, defects)


def _row(kind: str, name: str, outcome: Outcome, defects: Sequence[str]) -> Row:
    said = " | ".join(outcome.error.strip().splitlines()[-3:])[-300:]
    if defects:
        return kind, name, "DEFECT", f"{'; '.join(defects)} -- {said}"
    return kind, name, "told" if outcome.code == 2 else "right", said


KINDS: dict[str, Callable[[Doors, Path, int, str, np.random.Generator], Iterator[Row]]] = {
    "calls": calls_that_fail,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--each", type=int, default=100, help="cases of each door or file (default: 100)")
    parser.add_argument("--only", default="", help="doors and files whose name has this in it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scratch", type=Path, default=Path("cache/faults"))
    parser.add_argument("--verbose", action="store_true", help="print every case")
    parsed = parser.parse_args()
    scratch = parsed.scratch.resolve()
    scratch.mkdir(parents=True, exist_ok=True)
    doors = Doors(scratch)
    counts: dict[str, Counter[str]] = {}
    begun_s = time.perf_counter()
    for kind in parsed.kinds or KINDS:
        counted = counts.setdefault(kind, Counter())
        for row in KINDS[kind](doors, scratch, parsed.each, parsed.only, np.random.default_rng(parsed.seed)):
            counted[row[2]] += 1
            if row[2] == "DEFECT" or parsed.verbose:
                print(f"{row[2]:6} {row[1]}\n       {row[3]}", flush=True)
    print(f"\n{'kind':10} {'cases':>6} {'right':>6} {'told':>6} {'defects':>8}")
    for kind, counted in counts.items():
        print(f"{kind:10} {counted.total():6} {counted['right']:6} {counted['told']:6} {counted['DEFECT']:8}")
    print(f"{time.perf_counter() - begun_s:.0f} s")
    return int(any(counted["DEFECT"] for counted in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
