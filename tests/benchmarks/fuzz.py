"""Coverage-guided fuzzing of the readers: whatever a file holds, a value or one line of our own error.

``python -m tests.benchmarks.fuzz READER [--minutes 60] [--corpus FOLDER]`` (the extra ``bench`` has atheris,
which is libFuzzer for Python) starts from a whole file and from what ``--corpus`` holds, and keeps there
every input that reached new code. It ends at the first exception that is not ours, and libFuzzer leaves that
input as ``crash-...``: make it a case of ``tests/faults``. Without READER the readers are listed.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import sys
import tempfile
from pathlib import Path

_TOKEN = re.compile(rb'-?\d+\.?\d*(?:[eE][-+]?\d+)?|"[^"\n]*"|\b[A-Za-z_]\w*|[][{},:;]')
_VALUES = (
    *(b"nan", b"inf", b"1e308", b"-1e308", b"1e999", b"-1", b"0", b"1", b"5e-324", b"99999999999999999999"),
    *(b"null", b"true", b'""', b'"\\ud800"', b"[]", b"{}", b"[[[[[[[[", b"{a: ", b"=1+1"),
    *(b"\x1b[2J", b"\xff"),
)  # fmt: skip


def mutated(data: bytes, most: int, seed: int) -> bytes:
    """``data`` with some of its numbers, texts, names and brackets replaced or dropped."""
    chance = random.Random(seed)
    for _ in range(chance.randint(1, 3)):
        tokens = [match.span() for match in _TOKEN.finditer(data)]
        if not tokens:
            return data[:most]
        begin, end = chance.choice(tokens)
        other = slice(*chance.choice(tokens))
        new = chance.choice([chance.choice(_VALUES), data[other], b"", 2 * data[begin:end]])
        data = data[:begin] + new + data[end:]
    return data[:most]


def main() -> int:
    """Fuzz one reader; does not return where it fuzzes, for libFuzzer ends the process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reader", nargs="?")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--corpus", type=Path)
    parser.add_argument("--most-mb", type=int, default=500, help="memory at which it ends")
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

    limits = [
        f"-max_total_time={round(60 * parsed.minutes)}",
        "-timeout=30",
        f"-rss_limit_mb={parsed.most_mb}",
    ]

    def next_input(data: bytes, most: int, seed: int) -> bytes:
        return mutated(data, most, seed) if seed % 4 else bytes(atheris.Mutate(data, most))

    arguments = [sys.argv[0], *limits, "-print_final_stats=1", str(corpus)]
    atheris.Setup(arguments, one_input, custom_mutator=next_input)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
