"""A map as we wrote it is read fast and is the same; one that was touched is read as any other."""

import json
from dataclasses import fields

import numpy as np
import pytest

from tests.maps.test_composed import hd_map as composed_map
from tests.report.page.folder import covariance, small_map
from v2hdm.errors import MapFileError
from v2hdm.io.maps import written
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.maps.written import read_written
from v2hdm.records import DIAMOND, GIVE_WAY, STOP_LINE, GeodeticOrigin, HDMap, Marking, PaintLeft
from v2hdm.store.results import result_folder

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def rich_map():
    """Markings with all that a map states of one, and with nothing."""
    heights = np.array([0.1, 0.2, 0.3, 0.4])
    markings = (
        Marking(
            DIAMOND, SQUARE / 3, 4, covariance(), 0.004, accuracy="B", paint=PaintLeft(0.7, 0.1, -0.2, 0.05)
        ),
        Marking(STOP_LINE, SQUARE + 5, 2, variety=GIVE_WAY, paint=PaintLeft(0.7, 0.1, None, None)),
        Marking(DIAMOND, SQUARE - 9e5, 1, covariance(0.03), heights_m=heights, heights_sigma_m=heights / 10),
    )
    small = small_map()
    return HDMap(markings, small.lanes, GeodeticOrigin(29.95, 122.05, 12.0), small.symbols)


@pytest.fixture
def folder(tmp_path):
    with result_folder(tmp_path / "result") as result:
        write_geojson(rich_map(), result / "map.geojson")
    return tmp_path / "result"


def assert_same(record, other):
    for field in fields(record):
        before, after = getattr(record, field.name), getattr(other, field.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(before, after, err_msg=field.name)
        elif isinstance(before, tuple) and before and hasattr(before[0], "kind"):
            for feature, again in zip(before, after, strict=True):
                assert_same(feature, again)
        else:
            assert before == after, field.name


@pytest.mark.parametrize("made", [rich_map, small_map, lambda: HDMap((), ())])
def test_what_we_wrote_is_read_as_the_strict_reader_reads_it(made, tmp_path):
    with result_folder(tmp_path / "result") as result:
        write_geojson(made(), result / "map.geojson")
    path = tmp_path / "result" / "map.geojson"
    assert_same(read_geojson(path), read_written(path))


def test_composed_markings_are_read_as_well(tmp_path):
    with result_folder(tmp_path / "result") as result:
        write_geojson(composed_map.__wrapped__(), result / "map.geojson")
    path = tmp_path / "result" / "map.geojson"
    assert_same(read_geojson(path), read_written(path))


def test_an_unchanged_file_does_not_go_through_the_strict_reader(folder, monkeypatch):
    monkeypatch.setattr(written, "read_geojson", lambda path: pytest.fail("read strictly"))
    assert len(read_written(folder / "map.geojson").markings) == 3


def test_a_file_that_was_edited_is_checked_as_any_other(folder):
    path = folder / "map.geojson"
    content = json.loads(path.read_text())
    content["features"][0]["properties"]["covariance_m2"][0][0] = -1.0
    path.write_text(json.dumps(content))
    with pytest.raises(MapFileError, match="feature 0, covariance_m2: not symmetric or negative"):
        read_written(path)
