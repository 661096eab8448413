"""Faults of disks, files and frames, hundreds of each: what came of each, and how many ended well.

``python -m tests.benchmarks.faults [KIND ...] [--each N] [--only PATTERN] [--scratch FOLDER]``; the kinds:

- ``calls``: every call of a door that writes fails once, with ENOSPC from then on or EIO that once;
- ``full``: disks of just so many bytes, from nothing to more than enough; ``readonly``: disks that may only
  be read, all of them or that of the cache alone (both need root, for a disk in memory);
- ``texts``, ``images``, ``networks``, ``caches``, ``results``: files of a drive, the detector's network,
  entries of the cache and earlier results, of which a bit was flipped, the end cut off or a sector zeroed;
- ``frames``: images frozen, exchanged, dropped, doubled or mixed up, and drop-outs of RTK.

On a bad disk a door must end in what it makes on a good one, or in one line of error with nothing half
written and no file touched that is not its own; afterwards, on a good disk, it must work. Of damaged files
and frames it must make a map that is as good as that of whole ones, or tell. The exit code is 1 if any did
not. Doors are forked from a process that has loaded everything.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.benchmarks.faults.disks import calls_that_fail, full_disks, readonly_disks
from tests.benchmarks.faults.doors import Doors
from tests.benchmarks.faults.files import (
    damaged_caches,
    damaged_images,
    damaged_networks,
    damaged_results,
    damaged_texts,
    faulty_frames,
)
from tests.benchmarks.faults.running import Kind, Order

KINDS: dict[str, Kind] = {
    "calls": calls_that_fail,
    "full": full_disks,
    "readonly": readonly_disks,
    "texts": damaged_texts,
    "images": damaged_images,
    "networks": damaged_networks,
    "caches": damaged_caches,
    "results": damaged_results,
    "frames": faulty_frames,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--each", type=int, default=100, help="cases of each door or file (default: 100)")
    parser.add_argument("--only", default="", help="doors and files whose name matches this")
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
        rng = np.random.default_rng(parsed.seed)
        for row in KINDS[kind](Order(doors, scratch, parsed.each, parsed.only, rng)):
            counted[row.end] += 1
            if row.end == "DEFECT" or parsed.verbose:
                print(f"{row.end:6} {row.name}\n       {row.said}", flush=True)
        print(f"{kind}: {dict(counted)}, {time.perf_counter() - begun_s:.0f} s so far", flush=True)
    print(f"\n{'kind':10} {'cases':>6} {'right':>6} {'told':>6} {'defects':>8}")
    for kind, counted in counts.items():
        print(f"{kind:10} {counted.total():6} {counted['right']:6} {counted['told']:6} {counted['DEFECT']:8}")
    print(f"{time.perf_counter() - begun_s:.0f} s")
    return int(any(counted["DEFECT"] for counted in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
