"""Coverage-guided fuzzing of the readers: whatever a file holds, a value or one line of our own error.

``python -m tests.benchmarks.fuzz READER [--minutes 60] [--corpus FOLDER]`` (the extra ``bench`` has atheris,
which is libFuzzer for Python) starts from a whole file and from what ``--corpus`` holds, and keeps there
every input that reached new code. It ends at the first exception that is not ours, and libFuzzer leaves that
input as ``crash-...``: make it a case of ``tests/faults``. Without READER the readers are listed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path


def main() -> int:
    """Fuzz one reader; does not return where it fuzzes, for libFuzzer ends the process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reader", nargs="?")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--corpus", type=Path)
    parsed = parser.parse_args()
    try:
        import atheris
    except ImportError:
        print("fuzzing needs atheris: pip install 'v2hdm[bench]'", file=sys.stderr)
        return 2
    with atheris.instrument_imports(include=["v2hdm", "yaml"]):
        from tests.faults.readers import READERS
        from v2hdm.errors import V2hdmError
    if parsed.reader not in READERS:
        print("readers: " + ", ".join(READERS))
        return 2
    write, read = READERS[parsed.reader]
    # In memory where that is possible: a file is written for every input.
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=shared if os.access(shared, os.W_OK) else None))
    corpus = parsed.corpus or folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    write(folder / "file")
    (corpus / "whole").write_bytes((folder / "file").read_bytes())

    def one_input(data: bytes) -> None:
        (folder / "file").write_bytes(data)
        try:
            read(folder / "file")
        except V2hdmError as refused:
            if "\n" in str(refused):
                raise RuntimeError("an error of more than one line") from refused

    limits = [f"-max_total_time={round(60 * parsed.minutes)}", "-timeout=30", "-rss_limit_mb=4096"]
    atheris.Setup([sys.argv[0], *limits, "-print_final_stats=1", str(corpus)], one_input)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
