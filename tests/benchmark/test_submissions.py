"""Files of other tools: every one that cannot be scored is one line that says why."""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmark.hand import DIAMOND, ORIGIN, at, feature, paint, write
from v2hdm.asbuilt.reading import Source
from v2hdm.benchmark.submissions import read_submission
from v2hdm.errors import ConfigError, MapFileError, V2hdmError
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.records import Marking


def test_a_map_of_ours_is_read_with_its_covariances_and_verdict(tmp_path, reference):
    covariance = 1e-4 * np.eye(8)
    markings = [replace(m, covariance_m2=covariance) for m in reference.truth.map.markings]
    hd_map = replace(reference.truth.map, markings=tuple(markings))
    write_geojson(hd_map, tmp_path / "map.geojson", {"status": "WARN"})
    submission = read_submission(tmp_path, reference.truth.map)
    assert submission.verdict == "WARN"
    assert len(submission.hd_map.markings) == 40
    np.testing.assert_allclose(submission.hd_map.markings[3].covariance_m2, covariance)


def test_a_map_of_ours_with_another_origin_is_brought_to_the_sites(tmp_path, reference):
    other = replace(ORIGIN, latitude_deg=ORIGIN.latitude_deg + 1e-4)
    markings = []
    for marking in reference.truth.map.markings:
        raised = np.column_stack([marking.corners_map, np.zeros(4)])
        corners = enu_from_geodetic(other, geodetic_from_enu(ORIGIN, raised))[:, :2]
        markings.append(replace(marking, corners_map=corners))
    write_geojson(
        replace(reference.truth.map, markings=tuple(markings), origin=other), tmp_path / "m.geojson"
    )
    submission = read_submission(tmp_path / "m.geojson", reference.truth.map)
    for read, true in zip(submission.hd_map.markings, reference.truth.map.markings, strict=True):
        np.testing.assert_allclose(read.corners_map, true.corners_map, atol=1e-4)


def test_names_of_another_tool_are_explained(tmp_path, reference):
    features = [feature("rhombus", m.corners_map) for m in reference.truth.map.markings[:30]]
    path = write(tmp_path / "map.geojson", features)
    with pytest.raises(MapFileError, match=r"unknown classes: 'rhombus' .30.; --class NAME=CLASS"):
        read_submission(path, reference.truth.map)
    submission = read_submission(path, reference.truth.map, Source(kinds={"rhombus": "diamond"}))
    assert {marking.kind for marking in submission.hd_map.markings} == {"diamond"}


def test_polygons_that_are_not_scored_are_counted(tmp_path, reference, caplog):
    features = [*paint(reference), feature("arrow", at(DIAMOND, 8.0, 6.0)), feature(None, DIAMOND)]
    submission = read_submission(write(tmp_path / "map.geojson", features), reference.truth.map)
    assert len(submission.hd_map.markings) == 40
    assert "not scored, for they have no four corners or no class: 1 arrow, 1 without a class" in caplog.text


def test_a_polygon_of_more_corners_is_scored_by_the_box_about_it(tmp_path, reference):
    dash = reference.truth.map.markings[30].corners_map
    ring = np.insert(dash, 1, (dash[0] + dash[1]) / 2, axis=0)
    path = write(tmp_path / "map.geojson", [feature("lane_dash", ring)])
    (marking,) = read_submission(path, reference.truth.map).hd_map.markings
    assert isinstance(marking, Marking)
    off_m = np.linalg.norm(marking.corners_map[:, None] - dash[None], axis=2).min(axis=1)
    assert off_m.max() < 1e-3


BAD = {
    "swapped degrees": (lambda r: paint(r, swap=True), {}, "not a longitude and latitude; are its axes"),
    "grid without its name": (
        lambda r: paint(r, (351_000.0, 3_314_000.0), local=True), {}, "or is it in another system"
    ),
    "another site": (lambda r: paint(r, (5_000.0, 0.0)), {}, r"at least 4,8\d\d m from the site's markings"),
    "another system of its name": (
        lambda r: paint(r, (500_000.0, 3_314_000.0), local=True),
        {"crs": {"type": "name", "properties": {"name": "EPSG:32650"}}},
        "from the site's markings; check its system and its units",
    ),
    "another datum": (
        lambda r: paint(r, (351_000.0, 3_314_000.0), local=True),
        {"crs": {"type": "name", "properties": {"name": "EPSG:25832"}}},
        "is on ETRS89",
    ),
    "empty": (lambda r: [], {}, "has no marking of four corners to score; give polygons with a class"),
    "only lines": (
        lambda r: [feature("lane_line", r.truth.map.lanes[0].points_map, "LineString")], {}, "has no marking"
    ),
    "no polygon": (
        lambda r: [{"type": "Feature", "geometry": {"type": "Point", "coordinates": [122.05, 29.95]}}],
        {},
        "feature 0: its geometry is a Point",
    ),
    "a line as a ring": (
        lambda r: [feature("diamond", DIAMOND * (1.0, 0.0))], {}, "feature 0: encloses nothing"
    ),
    "a sigma of nothing": (lambda r: paint(r, sigma_m=0), {}, "feature 0, sigma_m: 0 m is not a standard d"),
    "a sigma in words": (lambda r: paint(r, sigma_m="2 cm"), {}, "sigma_m: expected a finite number"),
    "half a covariance": (lambda r: paint(r, covariance_m2=[[1.0]]), {}, "feature 0, covariance_m2"),
    "a verdict of its own": (paint, {"verdict": "fine"}, "its verdict is not one of PASS, WARN, FAIL"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_cannot_be_scored_is_one_line(name, tmp_path, reference):
    make, members, says = BAD[name]
    path = write(tmp_path / "map.geojson", make(reference), **members)
    with pytest.raises(V2hdmError, match=says) as refused:
        read_submission(path, reference.truth.map)
    assert "\n" not in str(refused.value)
    assert str(path) in str(refused.value)


def test_metres_with_swapped_axes_are_named(tmp_path, reference):
    features = [feature(m.kind, m.corners_map[:, ::-1], local=True) for m in reference.truth.map.markings]
    path = write(tmp_path / "map.geojson", features)
    with pytest.raises(MapFileError, match="x and y swapped"):
        read_submission(path, reference.truth.map, Source("local"))


def test_a_file_of_another_format_is_refused(tmp_path, reference):
    (tmp_path / "map.dxf").write_text("0")
    with pytest.raises(MapFileError, match=r"is not a GeoJSON file; give one that ends in \.geojson"):
        read_submission(tmp_path / "map.dxf", reference.truth.map)
    (tmp_path / "map.geojson").write_text("{}")
    with pytest.raises(MapFileError, match="is not a collection of features"):
        read_submission(tmp_path / "map.geojson", reference.truth.map)


def test_an_unknown_system_is_named(tmp_path, reference):
    path = write(tmp_path / "map.geojson", paint(reference))
    with pytest.raises((ConfigError, MapFileError), match="EPSG:99"):
        read_submission(path, reference.truth.map, Source("EPSG:99"))
