"""Edits that a person makes in a copy of the map are corrections of it, and nothing else is."""

import sqlite3
from dataclasses import replace

import numpy as np
import pytest

from tests.report.page.folder import DIAMOND_M, small_map
from v2hdm.errors import MapFileError
from v2hdm.io.maps.edits import read_edits
from v2hdm.io.maps.features import features_of, map_of
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_map
from v2hdm.records import GeodeticOrigin, Marking

WRITERS = {"map.geojson": write_geojson, "map.gpkg": write_geopackage}
ORIGIN = GeodeticOrigin(49.0, 8.4, 110.0)


def numbered(hd_map):
    features = features_of(hd_map)
    return map_of(features, [feature.id for feature in features], hd_map.origin)


def edited(hd_map):
    """The first deleted, the second of another class, a corner of the third moved, one added."""
    _, second, third, fourth = hd_map.markings
    corners = third.corners_map.copy()
    corners[1] += [0.05, -0.02]
    new = Marking("diamond", DIAMOND_M + np.array([3.0, 5.0]), 0)
    markings = (replace(second, kind="stop_line"), replace(third, corners_map=corners), fourth, new)
    return replace(hd_map, markings=markings)


@pytest.fixture(params=[None, ORIGIN], ids=["local", "geodetic"])
def hd_map(request):
    return numbered(replace(small_map(), origin=request.param))


@pytest.mark.parametrize("name", WRITERS)
def test_a_copy_that_nobody_edited_corrects_nothing(name, hd_map, tmp_path):
    WRITERS[name](hd_map, tmp_path / name)
    edits = read_edits(tmp_path / name, hd_map)
    assert (edits.corrections, edits.ignored) == ([], [])


@pytest.mark.parametrize("name", WRITERS)
def test_deleting_reclassifying_moving_and_adding_are_corrections(name, hd_map, tmp_path):
    WRITERS[name](edited(hd_map), tmp_path / name)
    rejected, classed, moved, added = read_edits(tmp_path / name, hd_map).corrections
    assert (rejected.says, rejected.marking) == ("rejected", 1)
    assert (classed.marking, classed.new_kind, classed.moved) == (2, "stop_line", {})
    assert (moved.marking, list(moved.moved)) == (3, [2])
    assert np.subtract(moved.moved[2], moved.outline_map[1]) == pytest.approx([0.05, -0.02], abs=2e-3)
    assert (added.says, added.kind) == ("added", "diamond")
    assert np.array(added.outline_map) == pytest.approx(DIAMOND_M + np.array([3.0, 5.0]), abs=2e-3)


def test_what_no_run_reads_is_told(hd_map, tmp_path):
    lane = hd_map.lanes[0]
    (symbol,) = hd_map.symbols
    other = replace(
        hd_map,
        lanes=(replace(lane, points_map=lane.points_map + 0.5),),
        symbols=(replace(symbol, outline_map=symbol.outline_map + 0.3),),
    )
    write_geojson(other, tmp_path / "map.geojson")
    edits = read_edits(tmp_path / "map.geojson", hd_map)
    assert edits.corrections == []
    assert "symbol 6 was moved, which no run reads" in edits.ignored[0] or "was moved" in edits.ignored[0]
    assert "1 lane lines were edited, which no run reads" in edits.ignored[1]


def test_a_foreign_layer_is_told_and_not_read(hd_map, tmp_path):
    path = tmp_path / "map.gpkg"
    write_geopackage(hd_map, path)
    with sqlite3.connect(path) as data:
        data.execute("CREATE TABLE trees (fid INTEGER PRIMARY KEY, kind TEXT)")
        data.execute("INSERT INTO gpkg_contents (table_name, data_type) VALUES ('trees', 'attributes')")
    data.close()
    edits = read_edits(path, hd_map)
    assert edits.corrections == []
    assert edits.ignored == [f"{path}: not ours and not read: layer trees"]


def test_a_map_of_another_place_or_system_is_refused(hd_map, tmp_path):
    path = tmp_path / "map.geojson"
    far = [replace(marking, corners_map=marking.corners_map + 5e5) for marking in hd_map.markings]
    write_geojson(replace(hd_map, markings=tuple(far), origin=None), path)
    with pytest.raises(MapFileError, match=r"its markings lie .* m from those of this map"):
        read_edits(path, replace(hd_map, origin=None))
    others = [replace(marking, id=number + 900) for number, marking in enumerate(hd_map.markings)]
    write_geojson(replace(hd_map, markings=tuple(others)), path)
    with pytest.raises(MapFileError, match="none of its markings has an id of this map"):
        read_edits(path, hd_map)
    assert read_map(path)[0].markings
