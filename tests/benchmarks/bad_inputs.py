"""Bad inputs and situations through the doors: what came of each, and how many ended well.

``python -m tests.benchmarks.bad_inputs [--only WORDS]``; exit code 1 if any did not.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.faults.cases import all_cases
from tests.faults.judge import judge


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--verbose", action="store_true", help="print what every case said")
    parsed = parser.parse_args()
    cases = [case for case in all_cases() if parsed.only in case.name]
    fault_counts: Counter[str] = Counter()
    bad, begin_s = 0, time.perf_counter()
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            outcome = judge(case, Path(folder))
        faults = outcome.faults(case)
        bad += bool(faults)
        fault_counts.update(fault.split(" ")[0] for fault in faults)
        if faults or parsed.verbose:
            print(f"{'BAD ' if faults else 'good'} {case.name}: {'; '.join(faults)}")
            print(f"     {' | '.join(outcome.error.strip().splitlines()[-3:])[-400:]}", flush=True)
    took_s = time.perf_counter() - begin_s
    print(f"{len(cases)} cases, {len(cases) - bad} ended well, {bad} did not, {took_s:.0f} s")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
