"""A file of a result that is not what was written there is read, and told of."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from tests.drive.example import make_map
from v2hdm.io.maps import read_geojson
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.store.results import result_folder


@pytest.fixture
def written(tmp_path: Path) -> Path:
    with result_folder(tmp_path / "run") as folder:
        write_geojson(make_map(), folder / "map.geojson")
    return tmp_path / "run" / "map.geojson"


def test_a_file_as_it_was_written_is_no_matter(written: Path, caplog: pytest.LogCaptureFixture) -> None:
    read_geojson(written)
    assert not caplog.records


def test_a_changed_file_is_read_and_told_of_once(written: Path, caplog: pytest.LogCaptureFixture) -> None:
    written.write_text(written.read_text() + "\n")
    for _ in range(2):
        read_geojson(written)
    (told,) = caplog.records
    assert told.levelno == logging.WARNING
    assert str(written) in told.getMessage()
    assert "is not as we wrote it" in told.getMessage()


def test_a_damaged_list_says_nothing(written: Path, caplog: pytest.LogCaptureFixture) -> None:
    listing = written.parent / ".v2hdm-results.jsonl"
    listing.write_bytes(listing.read_bytes()[:90] + b"\xff[{")
    read_geojson(written)
    assert not caplog.records
