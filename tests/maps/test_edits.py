"""Maps that were edited in a GIS come back as they were drawn; surveyed points find their corners."""

import json
import logging

import numpy as np
import pyogrio
import pyogrio.errors
import pyogrio.raw
import pytest

from tests.maps.gis import ORIGIN, assert_same_map, move_feature, street
from v2hdm.errors import MapFileError
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_geojson, read_geopackage, read_map
from v2hdm.records import HDMap, Marking
from v2hdm.survey.match import match

EDITED = ["geojson", "gpkg"]
METRES_A_DEGREE = 111_000.0
TENTH_OF_A_MM = 1e-4


def written(folder, file_format, hd_map):
    path = folder / f"map.{file_format}"
    FORMATS[file_format].write(hd_map, path, None)
    return path


def assert_identical(got, expected):
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(got, name), value, err_msg=name)


@pytest.mark.parametrize("file_format", EDITED)
@pytest.mark.parametrize("with_heights", [True, False])
@pytest.mark.parametrize("origin", [ORIGIN, None])
def test_a_map_that_nobody_edited_comes_back_to_the_last_bit(tmp_path, file_format, with_heights, origin):
    hd_map = street(origin, with_heights)
    got, _ = read_map(written(tmp_path, file_format, hd_map))
    assert_same_map(got, hd_map)
    assert [feature.id for feature in (*got.markings, *got.lanes)] == list(range(1, 9))


@pytest.mark.parametrize("file_format", EDITED)
@pytest.mark.parametrize("origin", [ORIGIN, None])
@pytest.mark.parametrize("identity", [1, 2, 7])
def test_what_was_moved_in_a_gis_comes_back_moved_and_all_else_as_it_was(
    tmp_path, file_format, origin, identity
):
    path = written(tmp_path, file_format, street(origin))
    before, _ = read_map(path)
    units = np.ones(2)
    if origin is not None:
        units = 1 / METRES_A_DEGREE / np.array([np.cos(np.deg2rad(origin.latitude_deg)), 1.0])
    layer = None if file_format == "geojson" else "markings" if identity <= 5 else "lanes"
    move_feature(path, identity, *(np.array([0.5, -0.25]) * units), layer)
    after, _ = read_map(path)
    for old, new in zip([*before.markings, *before.lanes], [*after.markings, *after.lanes], strict=True):
        if old.id != identity:
            assert_identical(new, old)
            continue
        assert (new.id, new.kind, new.sightings) == (old.id, old.kind, old.sightings)
        moved_m = points(new) - points(old)
        np.testing.assert_allclose(moved_m, np.tile([0.5, -0.25], (len(moved_m), 1)), atol=3e-3)
        assert np.ptp(moved_m, axis=0).max() < TENTH_OF_A_MM
        np.testing.assert_array_equal(new.heights_m, old.heights_m)
        if isinstance(old, Marking) and isinstance(new, Marking):
            # A hand placed the whole marking once.
            by_hand_m2 = 0.02**2 * np.kron(np.ones((4, 4)), np.eye(2))
            np.testing.assert_allclose(new.covariance_m2, old.covariance_m2 + by_hand_m2, rtol=1e-12)


def points(feature):
    return feature.corners_map if isinstance(feature, Marking) else feature.points_map


def edited(path, number, **changes):
    """Change a feature of a GeoJSON file, the geometry's coordinates or properties."""
    content = json.loads(path.read_text())
    feature = content["features"][number]
    for key, value in changes.items():
        if key == "coordinates":
            feature["geometry"]["coordinates"] = value(feature["geometry"]["coordinates"])
        elif key == "geometry":
            feature["geometry"] = value
        else:
            feature["properties"][key] = value
    path.write_text(json.dumps(content))


def test_a_ring_that_starts_elsewhere_and_runs_the_other_way_round_is_the_same(tmp_path):
    path = written(tmp_path, "geojson", street())
    before = read_geojson(path)
    edited(path, 0, coordinates=lambda rings: [[*rings[0][2:4], *rings[0][:3]][::-1]])
    assert_identical(read_geojson(path).markings[0], before.markings[0])


def test_a_height_that_was_edited_is_the_new_height(tmp_path):
    path = written(tmp_path, "geojson", street())
    before = read_geojson(path).markings[0]
    edited(path, 0, coordinates=lambda rings: [[[x, y, z + 0.3] for x, y, z in rings[0]]])
    after = read_geojson(path).markings[0]
    assert before.heights_m is not None
    np.testing.assert_allclose(after.heights_m, before.heights_m + 0.3, atol=TENTH_OF_A_MM)
    np.testing.assert_allclose(after.corners_map, before.corners_map, atol=2 * TENTH_OF_A_MM)


def test_a_corner_that_was_moved_is_known_as_a_hand_places_it(tmp_path):
    path = written(tmp_path, "geojson", street())
    before = read_geojson(path).markings[0]
    assert before.covariance_m2 is not None
    by_deg = 0.14 / 111_320

    def dragged(rings):
        (ring,) = rings
        ring[1][1] += by_deg
        return [ring]

    edited(path, 0, coordinates=dragged)
    after = read_geojson(path).markings[0]
    assert after.covariance_m2 is not None
    off_m = np.linalg.norm(after.corners_map - before.corners_map, axis=1)
    (moved,) = np.flatnonzero(off_m > 0.1)
    assert off_m[moved] == pytest.approx(0.14, abs=0.005)
    assert np.sqrt(np.diagonal(after.covariance_m2)[2 * moved : 2 * moved + 2]).min() >= 0.02
    others = np.delete(np.arange(8), [2 * moved, 2 * moved + 1])
    of_others = np.ix_(others, others)
    np.testing.assert_allclose(after.covariance_m2[of_others], before.covariance_m2[of_others])
    assert after.accuracy is None
    assert np.linalg.eigvalsh(after.covariance_m2).min() > 0


def test_a_geometry_without_heights_keeps_those_of_the_map(tmp_path):
    path = written(tmp_path, "geojson", street())
    before = read_geojson(path).lanes[0]
    edited(path, 5, coordinates=lambda line: [[x + 1e-5, y] for x, y, _ in line])
    after = read_geojson(path).lanes[0]
    np.testing.assert_array_equal(after.heights_m, before.heights_m)
    step_m = (after.points_map - before.points_map)[:, 0]
    np.testing.assert_allclose(step_m, 1e-5 * 111_320 * np.cos(np.deg2rad(29.95)), rtol=2e-3)


def test_a_vertex_that_was_added_is_there_and_the_log_says_so(tmp_path, caplog):
    path = written(tmp_path, "geojson", street())
    before = read_geojson(path).lanes[0]
    edited(path, 5, coordinates=lambda line: [line[0], np.mean(line[:2], axis=0).tolist(), *line[1:]])
    with caplog.at_level(logging.INFO, "v2hdm"):
        after = read_geojson(path).lanes[0]
    expected = np.insert(before.points_map, 1, before.points_map[:2].mean(axis=0), axis=0)
    np.testing.assert_allclose(after.points_map, expected, atol=2 * TENTH_OF_A_MM)
    np.testing.assert_allclose(after.heights_m[[0, 2, -1]], before.heights_m[[0, 1, -1]], atol=2e-4)
    assert "1 features were edited and are taken as drawn: 6" in caplog.text


def test_a_marking_that_was_drawn_anew_needs_a_class_only_and_gets_an_id(tmp_path):
    path = written(tmp_path, "geojson", street(None, with_heights=False))
    content = json.loads(path.read_text())
    ring = [[20.0, 5.0], [20.0, 6.0], [21.0, 6.0], [21.0, 5.0], [20.0, 5.0]]
    drawn = {"type": "MultiPolygon", "coordinates": [[ring]]}
    content["features"].append({"type": "Feature", "properties": {"class": "diamond"}, "geometry": drawn})
    path.write_text(json.dumps(content))
    new = read_geojson(path).markings[-1]
    assert (new.id, new.kind, new.sightings, new.covariance_m2) == (9, "diamond", 0, None)
    np.testing.assert_array_equal(new.corners_map, np.array(ring)[3::-1])


def test_ids_are_unique_and_stay_when_features_go_or_are_copied(tmp_path, caplog):
    path = written(tmp_path, "geojson", street())
    content = json.loads(path.read_text())
    assert [feature["id"] for feature in content["features"]] == list(range(1, 9))
    del content["features"][0]
    content["features"].append(content["features"][1])
    path.write_text(json.dumps(content))
    with caplog.at_level(logging.INFO, "v2hdm"):
        hd_map = read_geojson(path)
    assert [feature.id for feature in (*hd_map.markings, *hd_map.lanes)] == [2, 3, 4, 5, 9, 6, 7, 8]
    assert "1 features had no id of their own" in caplog.text
    write_geojson(hd_map, path)
    again = read_geojson(path)
    assert [feature.id for feature in (*again.markings, *again.lanes)] == [2, 3, 4, 5, 9, 6, 7, 8]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coordinates": lambda rings: [[[122.05, 29.95, 12.0], *rings[0]]]}, "four corners, not 5"),
        ({"coordinates": lambda rings: [rings[0], rings[0]]}, "holes or several parts"),
        ({"coordinates": lambda rings: [[[x, y + 500, z] for x, y, z in rings[0]]]}, "not in degrees"),
        ({"coordinates": lambda rings: "here"}, "holes or several parts"),
        ({"geometry": {"type": "Point", "coordinates": [0, 0]}}, "is a Point"),
        ({"geometry": None, "corners_map": None}, "four corners, not 0"),
        ({"id": "three"}, "id: expected a finite number"),
        ({"id": 2**40}, "id: expected a whole number"),
        ({"class": None}, "class: expected a text as name"),
    ],
)
def test_an_edit_that_makes_no_map_is_refused_by_name(tmp_path, changes, message):
    path = written(tmp_path, "geojson", street())
    edited(path, 0, **changes)
    with pytest.raises(MapFileError, match=f"feature 0.*{message}"):
        read_geojson(path)


def test_a_geopackage_of_another_tool_is_refused(tmp_path):
    path = tmp_path / "map.gpkg"
    nothing: np.ndarray = np.array([], dtype=object)
    pyogrio.raw.write(
        path, nothing, [nothing], ["name"], layer="roads", geometry_type="Point", crs="EPSG:4326"
    )
    with pytest.raises(MapFileError, match="not a map written by v2hdm"):
        read_geopackage(path)


def test_where_gdal_cannot_write_is_one_line(tmp_path, monkeypatch):
    def full(*_, **__):
        raise pyogrio.errors.DataSourceError("disk full\nat line 7")

    monkeypatch.setattr(pyogrio.raw, "write", full)
    with pytest.raises(MapFileError, match=r"map\.gpkg: cannot be written \(disk full\)"):
        write_geopackage(street(), tmp_path / "map.gpkg")
    assert not list(tmp_path.iterdir())


def test_a_geopackage_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = written(tmp_path, "gpkg", street())
    broken = HDMap((Marking("diamond", np.zeros((4, 2)), 3, id="seven"),))  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        write_geopackage(broken, path)
    assert len(read_geopackage(path).markings) == 5
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.gpkg"]


DASH = np.array([[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]])
DRIFT_M, OWN_M = 0.1, 0.01


def dashes(count=12):
    """Corners (4 count, 2) of dashes 12 cm wide, every 6 m along x and along y by turns."""
    turned = [DASH if k % 2 else DASH[:, ::-1] for k in range(count)]
    return np.concatenate([dash + np.array([6.0 * k, 0.0]) for k, dash in enumerate(turned)])


def covariance(count, drift_m=DRIFT_M):
    return np.kron(np.full((count, count), drift_m**2) + OWN_M**2 * np.eye(count), np.eye(2))


def test_a_shift_by_more_than_half_a_dash_is_seen_through_and_the_nearest_corner_is_not():
    corners, rng, right, nearest = dashes(), np.random.default_rng(2), [], []
    for _ in range(50):
        chosen = 4 * rng.permutation(12)[:8] + rng.integers(4, size=8)
        shift = rng.uniform(0.07, 0.1) * np.array([np.cos(angle := rng.uniform(0, 6.3)), np.sin(angle)])
        points = corners[chosen] - shift + OWN_M * rng.standard_normal((8, 2))
        right.append((match(points, corners, 0.25, covariance(8)) == chosen).all())
        distances_m = np.linalg.norm(points[:, None] - corners, axis=-1)
        nearest.append((distances_m.argmin(axis=1) == chosen).all())
    assert np.mean(right) > 0.9
    assert np.mean(nearest) < 0.3


@pytest.mark.parametrize("drift_m", [0.0, DRIFT_M])
def test_a_point_that_is_off_is_matched_all_the_same_and_moves_no_other(drift_m):
    corners = dashes()
    chosen = np.array([0, 5, 10, 15, 20])
    points = corners[chosen].copy()
    points[3] += 0.2, 0.0
    matched = match(points, corners, 0.25, covariance(5, drift_m))
    np.testing.assert_array_equal(matched[[0, 1, 2, 4]], chosen[[0, 1, 2, 4]])
    assert matched[3] >= 0


def test_no_corner_has_two_points_and_none_is_out_of_reach():
    corners = np.array([[0.0, 0.0], [9.0, 0.0]])
    points = np.array([[0.05, 0.0], [0.01, 0.0], [9.3, 0.0]])
    assert match(points, corners, 0.25, covariance(3, 0.0)).tolist() == [-1, 0, -1]
    assert match(points[:0], corners, 0.25, np.zeros((0, 0))).tolist() == []


def test_a_survey_of_another_datum_finds_its_corners_in_a_map_that_states_no_drift():
    corners, rng, right = dashes(), np.random.default_rng(6), []
    for _ in range(50):
        chosen = 4 * rng.permutation(12)[:8] + rng.integers(4, size=8)
        points = corners[chosen] - np.array([0.12, -0.12]) + OWN_M * rng.standard_normal((8, 2))
        right.append((match(points, corners, 0.25, covariance(8, 0.0)) == chosen).all())
    assert np.mean(right) > 0.9
