"""CPU time of each stage of ``v2hdm map`` here and in another checkout, by turns, each from an empty cache.

``python -m tests.benchmarks.stages CHECKOUT [--rounds N] [+run=port2 ...]``. Processes that a stage starts
count with it. Kernels that a checkout has compiled before are used; without its ``__pycache__`` folders it
begins cold.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

PROGRAM = """
import json, os, resource, sys
from contextlib import contextmanager
from pathlib import Path
import v2hdm.pipeline.context as context
from v2hdm.cli.main import main

def cpu_s():
    total = sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    children = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        ticks = sum(map(int, fields[11:15]))
        children.setdefault(int(fields[1]), []).append((int(stat.parent.name), ticks))
    left = [os.getpid()]
    while left:
        for process, ticks in children.get(left.pop(), ()):
            total += ticks / os.sysconf("SC_CLK_TCK")
            left.append(process)
    return total

@contextmanager
def timed(self, step):
    began_s = cpu_s()
    yield
    took_s[step] = took_s.get(step, 0.0) + cpu_s() - began_s
    self.seconds[step] = 0.0

took_s, context.Context.timed = {}, timed
if __name__ == "__main__":
    code = main(["map", *sys.argv[2:]])
    Path(sys.argv[1]).write_text(json.dumps({**took_s, "all": cpu_s()}))
    sys.exit(code)
"""


def stages(checkout: Path, overrides: list[str]) -> dict[str, float]:
    """CPU seconds by stage, and of all."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "program.py").write_text(PROGRAM)
        places = [f"output={folder / 'out'}", f"cache={folder / 'cache'}"]
        command = [sys.executable, str(folder / "program.py"), str(folder / "cpu.json"), *overrides, *places]
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        process = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
        if process.returncode == 2:
            raise SystemExit(f"{checkout}: {process.stdout[-400:]}{process.stderr[-400:]}")
        return json.loads((folder / "cpu.json").read_text())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--rounds", type=int, default=1)
    parsed, overrides = parser.parse_known_args()
    here = Path(__file__).parents[2]
    for _ in range(parsed.rounds):
        before, after = (
            stages(checkout.resolve(), overrides or ["+run=port2"]) for checkout in (parsed.checkout, here)
        )
        for stage, took_s in before.items():
            now_s = after.get(stage, 0.0)
            print(f"{stage:10s} {took_s:7.1f} s {now_s:7.1f} s {now_s / max(took_s, 0.1):5.2f} x", flush=True)


if __name__ == "__main__":
    main()
