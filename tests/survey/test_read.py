"""A survey's CSV: columns, systems of coordinates, and what is told of a file that means something else."""

import re

import numpy as np
import pyproj
import pytest

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.records import GeodeticOrigin
from v2hdm.survey.read import in_map, misreadings, read_survey

ORIGIN = GeodeticOrigin(53.54, 9.02, 45.0)
"""Nearly at the edge of its UTM zone: the convergence is 0.02 degrees there, 4.8 in the next one."""

PLACES = np.array([[0.0, 0.0, 0.0], [812.4, -350.2, 3.1], [-15.75, 620.04, -1.4]])


def points(tmp_path, text, origin=None, **how):
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8")
    settings = {"crs": None, "geoid_m": None, "sigma_m": 0.01, **how}
    return in_map(read_survey(path, **settings), origin)  # type: ignore[arg-type]


def stated_in(crs, geoid_m=0.0):
    """The places in a projected system, by pyproj alone."""
    geodetic = geodetic_from_enu(ORIGIN, PLACES)
    east, north = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(
        geodetic[:, 1], geodetic[:, 0]
    )
    return np.column_stack([east, north, geodetic[:, 2] - geoid_m])


def written(columns, rows):
    lines = [",".join([f"P{k}", *(f"{value:.9f}" for value in row)]) for k, row in enumerate(rows)]
    return "\n".join([f"id,{columns}", *lines])


def test_local_points_keep_their_metres_names_roles_and_sigmas(tmp_path):
    text = (
        "\ufeffPoint;X;Y;Z;sigma_m;sigma_north_m;Role;Description;Executor\n"
        "A1;3.21;4.05;0.30;;;;corner of the stop line, north;Kim\n"
        "# re-measured\n"
        "A2;61.7;12.33;;0.005;0.02;CHECK;\x1b[2J;Kim\n"
    )
    first, second = points(tmp_path, text)
    assert second.description == "?[2J"
    assert (first.id, first.is_check, first.description) == ("A1", False, "corner of the stop line, north")
    assert (second.id, second.is_check, second.height_m) == ("A2", True, None)
    np.testing.assert_array_equal(first.position_map, [3.21, 4.05])
    np.testing.assert_array_equal(first.sigma_m, [0.01, 0.01])
    np.testing.assert_array_equal(second.sigma_m, [0.005, 0.02])
    assert first.height_m == 0.3


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32631"])
def test_grid_coordinates_of_any_zone_lie_where_they_are_whatever_its_convergence(crs, tmp_path):
    read_points = points(tmp_path, written("Easting,Northing,height", stated_in(crs)), ORIGIN, crs=crs)
    np.testing.assert_allclose([point.position_map for point in read_points], PLACES[:, :2], atol=1e-4)
    np.testing.assert_allclose([point.height_m for point in read_points], PLACES[:, 2], atol=1e-4)


def test_grid_coordinates_and_heights_of_a_grid_of_feet_are_in_feet(tmp_path):
    """In metres they are among the misreadings."""
    origin = GeodeticOrigin(40.7, -73.9, 30.0, "NAD83")
    geodetic = geodetic_from_enu(origin, PLACES)
    to_grid = pyproj.Transformer.from_crs("EPSG:4269", "EPSG:2263", always_xy=True)
    east, north = to_grid.transform(geodetic[:, 1], geodetic[:, 0])
    feet = np.column_stack([east, north, geodetic[:, 2] * 3937 / 1200])
    placed = points(tmp_path, written("Easting,Northing,height", feet), origin, crs="EPSG:2263")
    np.testing.assert_allclose([point.position_map for point in placed], PLACES[:, :2], atol=1e-4)
    np.testing.assert_allclose([point.height_m for point in placed], PLACES[:, 2], atol=1e-4)
    (tmp_path / "m.csv").write_text(written("Easting,Northing,height", feet * 1200 / 3937))
    table = read_survey(tmp_path / "m.csv", "EPSG:2263", None, 0.01)
    np.testing.assert_allclose(misreadings(table, origin)["in metres"], PLACES[:, :2], atol=1e-4)


def test_latitudes_and_longitudes_lie_where_they_are(tmp_path):
    geodetic = geodetic_from_enu(ORIGIN, PLACES)
    read_points = points(tmp_path, written("lat,lon,altitude_m", geodetic), ORIGIN)
    np.testing.assert_allclose([point.position_map for point in read_points], PLACES[:, :2], atol=1e-3)
    np.testing.assert_allclose([point.height_m for point in read_points], PLACES[:, 2], atol=1e-3)


def test_a_point_without_a_height_is_at_that_of_the_origin(tmp_path):
    read_points = points(
        tmp_path, written("east,north", stated_in("EPSG:32632")[:, :2]), ORIGIN, crs="EPSG:32632"
    )
    np.testing.assert_allclose([point.position_map for point in read_points], PLACES[:, :2], atol=1e-3)
    assert [point.height_m for point in read_points] == [None] * 3


def test_heights_above_the_sea_need_the_geoid_and_are_not_used_without(tmp_path, caplog):
    crs = "EPSG:32632+5773"
    text = written("east,north,height_m", stated_in("EPSG:32632", geoid_m=39.6))
    assert [point.height_m for point in points(tmp_path, text, ORIGIN, crs=crs)] == [None] * 3
    assert "geoid_m" in caplog.text
    read_points = points(tmp_path, text, ORIGIN, crs=crs, geoid_m=39.6)
    np.testing.assert_allclose([point.height_m for point in read_points], PLACES[:, 2], atol=1e-3)
    np.testing.assert_allclose([point.position_map for point in read_points], PLACES[:, :2], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "how", "message"),
    [
        ("id,x_m,y_m\n", {}, "has no point"),
        ("x_m,y_m\n1,2\n", {}, "no column id; it has: x_m, y_m"),
        ("id,x_m\nA,1\n", {}, "no column y_m"),
        ("id,sigma_m\nA,1\n", {}, "needs the columns x_m, y_m or east_m, north_m or latitude_deg"),
        ("id,x_m,y_m,lat,lon\nA,1,2,3,4\n", {}, "one of these pairs"),
        ("id,x_m,y_m,x\nA,1,2,3\n", {}, "x_m and x mean the same"),
        ("id,x_m,y_m,sigma_mm\nA,1,2,3\n", {}, "unknown column 'sigma_mm'; did you mean 'sigma_m'?"),
        ("id,x_m,y_m\nA,1,2\nB,1,2,3\n", {}, "line 3: 4 cells under 3 columns"),
        ("id;x_m;y_m\nA;3,21;2\n", {}, "line 2: x_m: '3,21' is not a number; write a decimal point"),
        ("id,x_m,y_m\nA,inf,2\n", {}, "line 2: x_m: 'inf'"),
        ("id,x_m,y_m\nA,,2\n", {}, "line 2: x_m: ''"),
        ("id,x_m,y_m,sigma_m\nA,1,2,0\n", {}, "line 2: a sigma of 0 m"),
        ("id,x_m,y_m,role\nA,1,2,chek\n", {}, "line 2: role 'chek' is neither control nor check"),
        ("id,x_m,y_m\nA,1,2\n,1,2\n", {}, "line 3: the point has no id"),
        ("id,x_m,y_m\nA,1,2\nA,1,2\n", {}, "line 3: point A is already in line 2"),
        ("id,x_m,y_m\nA,1,2\n", {"crs": "EPSG:32632"}, "frame of the poses, and mapping.survey.crs is"),
        ("id,east,north\nA,1,2\n", {}, "which system are east and north in\\? Set mapping.survey.crs"),
        ("id,east,north\nA,1,2\n", {"crs": "EPSG:99999999"}, "unknown crs"),
        ("id,east,north\nA,1,2\n", {"crs": "EPSG:4326"}, "east and north, which EPSG:4326 does not have"),
        ("id,lat,lon\nA,1,2\n", {"crs": "EPSG:32632"}, "holds latitudes and longitudes, which"),
        ("id,lat,lon\nA,109.1,53.5\n", {}, "of A is not a position on the earth; are they swapped?"),
        ("id,east,north\nA,5e5,5.9e6\n", {"crs": "EPSG:25832"}, "in ETRS89.*the drive's origin in WGS84"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_one_line_that_names_the_place(text, how, message, tmp_path):
    with pytest.raises(DriveError, match=message) as caught:
        points(tmp_path, text, ORIGIN, **how)
    assert "\n" not in str(caught.value)
    assert re.match(r".*points\.csv", str(caught.value))


def test_places_on_the_earth_need_a_drive_with_an_origin(tmp_path):
    with pytest.raises(DriveError, match="the drive's map has none; give the drive an origin"):
        points(tmp_path, "id,lat,lon\nA,53.5,9.0\n")


@pytest.mark.parametrize(
    ("columns", "rows", "crs", "meant"),
    [
        ("x,y", PLACES[:, [1, 0]], None, "with x_m and y_m swapped"),
        ("x,y", PLACES[:, :2] / 0.3048, None, "in feet"),
        ("x,y", PLACES[:, :2] * 1e3, None, "in millimetres"),
        ("x,y", stated_in("EPSG:32632")[:, :2], None, "in EPSG:32632"),
        ("x,y", geodetic_from_enu(ORIGIN, PLACES)[:, :2], None, "as latitude and longitude"),
        ("lat,lon", geodetic_from_enu(ORIGIN, PLACES)[:, [1, 0]], None,
         "with latitude_deg and longitude_deg swapped"),
        ("east,north", stated_in("EPSG:32631")[:, :2], "EPSG:32632", "in EPSG:32631"),
        ("east,north", stated_in("EPSG:32632")[:, [1, 0]], "EPSG:32632", "with east_m and north_m swapped"),
        ("east,north", stated_in("EPSG:32632")[:, :2] / 0.3048, "EPSG:32632", "in feet"),
        ("east,north", PLACES[:, :2], "EPSG:32632", "as local metres (columns x_m, y_m)"),
    ],
)  # fmt: skip
def test_what_a_file_in_the_wrong_frame_means_is_among_its_misreadings(columns, rows, crs, meant, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(written(columns, rows))
    ways = misreadings(read_survey(path, crs, None, 0.01), ORIGIN)
    assert [says for says, at in ways.items() if np.abs(at - PLACES[:, :2]).max() < 0.1] == [meant]
