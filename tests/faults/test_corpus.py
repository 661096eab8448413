"""What fuzzing has found to reach code of its own in each reader is a value or one line of our own error.

``corpus.tar.xz`` holds a folder a reader, of what ``python -m tests.benchmarks.fuzz READER --corpus FOLDER``
kept: libFuzzer keeps an input only where it reaches code that none before it has.
"""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest

from tests.faults.readers import READERS, refusal
from v2hdm.errors import V2hdmError

CORPUS = Path(__file__).with_name("corpus.tar.xz")


def inputs() -> dict[str, list[bytes]]:
    """By reader."""
    found: dict[str, list[bytes]] = {}
    with tarfile.open(CORPUS) as archive:
        for member in archive:
            stream = archive.extractfile(member)
            assert stream is not None
            found.setdefault(member.name.split("/")[0], []).append(stream.read())
    return found


INPUTS = inputs()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("reader", INPUTS)
def test_what_fuzzing_has_reached_is_read_or_refused(reader: str, tmp_path: Path) -> None:
    write, read = READERS[reader]
    path = tmp_path / "file"
    write(path)  # and what belongs beside it
    for data in INPUTS[reader]:
        path.write_bytes(data)
        assert "\n" not in (refusal(lambda: read(path), V2hdmError) or "")
