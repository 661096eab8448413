"""CPU time of a command until it says something, here and in another checkout, by turns.

``python -m tests.benchmarks.first_sign CHECKOUT RESULT DRIVE [--rounds N]`` starts ``map``, ``report``,
``view`` and ``localize`` on a finished result of a rendered port and on its drive, and stops each at the
first byte on stdout or stderr. The first round, which compiles modules, is not counted.
"""

from __future__ import annotations

import argparse
import os
import selectors
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parents[2]


def first_sign_s(checkout: Path, arguments: Sequence[str], folder: Path) -> float:
    """CPU seconds of the process, all threads together, when its first byte arrives."""
    process = subprocess.Popen(
        [sys.executable, "-m", "v2hdm", *arguments], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(checkout)},
    )  # fmt: skip
    with process, selectors.DefaultSelector() as selector:
        for stream in (process.stdout, process.stderr):
            selector.register(stream, selectors.EVENT_READ)
        (said, _), *_ = selector.select()
        # The clock of another process (clock_getcpuclockid, by Linux's encoding of clocks).
        took_s = time.clock_gettime((~process.pid << 3) | 2)
        text = os.read(said.fd, 200)
        process.kill()
    if not text or text.startswith(b"error"):
        raise SystemExit(f"{checkout}: {' '.join(arguments)}: {text.decode() or 'said nothing'}")
    return took_s


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parsed = parser.parse_args()
    drive = str(parsed.drive.resolve())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(parsed.result, folder / "result")
        commands = {
            "map": ("map", f"drive.path={drive}", "output=out", "cache=cache"),
            "report": ("report", "result", "--drive", drive),
            "view": ("view", "result", "--drive", drive),
            "localize": ("localize", "result", drive, "--output", "located"),
        }
        for command, arguments in commands.items():
            rounds = [
                [first_sign_s(checkout.resolve(), arguments, folder) for checkout in (parsed.checkout, HERE)]
                for _ in range(parsed.rounds + 1)
            ][1:]
            before_s, now_s = (statistics.median(column) for column in zip(*rounds, strict=True))
            print(f"{command:10s} {before_s:6.2f} s {now_s:6.2f} s {now_s / before_s:5.2f} x", flush=True)


if __name__ == "__main__":
    main()
