"""Poses as people have them, against formulas and libraries that the readers do not use."""

import logging
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from tests.drive.bags import Messages, write_ros2
from tests.drive.example import ORIGIN, description, make_drive
from v2hdm.errors import DriveError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.importers.poses import read_poses
from v2hdm.io.importers.readings import read_table
from v2hdm.io.rows import read_rows
from v2hdm.records import GeodeticOrigin

START_S = 1715934630.0
"""2024-05-17 08:30:30 UTC."""

LEVER_M = (1.2, -0.3, 1.8)
LEVEL_M = 3e-4
"""Level where it is, 820 m off, a vehicle has its antenna 0.2 mm elsewhere than level with the map, m."""


def curve(count=41):
    """Times, positions in the map and headings (to the left of east) of a vehicle on a bend of 30 m."""
    stamp_s = START_S + 0.25 * np.arange(count)
    yaw = 0.4 + 5.0 * (stamp_s - START_S) / 30.0
    points = np.column_stack([30 * np.sin(yaw), -30 * np.cos(yaw), 0.01 * np.arange(count)])
    return stamp_s, points + np.array([700.0, -400.0, 2.0]), yaw


def antenna(points, yaw):
    """Where the antenna of a level vehicle is, written out."""
    x, y, z = LEVER_M
    offset = np.column_stack([
        np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, np.full(len(yaw), z),
    ])  # fmt: skip
    return points + offset


def place(points_map, origin=ORIGIN):
    """Latitude, longitude, height of map points, by PROJ's own topocentric frame."""
    pipeline = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={origin.latitude_deg!r} "
        f"+lon_0={origin.longitude_deg!r} +h_0={origin.altitude_m!r} +step +inv +proj=cart +ellps=WGS84 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    lon, lat, height = pyproj.Transformer.from_pipeline(pipeline).transform(*points_map.T)
    return np.column_stack([lat, lon, height])


def true_azimuth_deg(points_map, yaw):
    """Compass headings at the places themselves, from two points a metre apart on the ellipsoid."""
    ahead = points_map + np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
    here, place_ahead = place(points_map), place(ahead)
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(
        here[:, 1], here[:, 0], place_ahead[:, 1], place_ahead[:, 0]
    )
    return np.asarray(azimuth) % 360


def read(content, root, origin=ORIGIN):
    return read_poses(content, root, origin, 0.5, "drive.yaml: poses", None)


def check(got, rows=slice(None), metres=1e-6, radians=1e-7):
    stamp_s, points, yaw = (values[rows] for values in curve())
    np.testing.assert_allclose(got.trajectory.stamp_s, stamp_s, rtol=0, atol=1e-6)
    poses = got.trajectory.map_from_vehicle
    np.testing.assert_allclose(poses[:, :3, 3], points, rtol=0, atol=metres)
    off = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - yaw
    np.testing.assert_allclose((off + np.pi) % (2 * np.pi) - np.pi, 0, atol=radians)


def checksum(body):
    value = 0
    for letter in body:
        value ^= ord(letter)
    return f"${body}*{value:02X}"


def nmea_angle(degrees, digits, sides):
    whole = int(abs(degrees))
    minutes = 60 * (abs(degrees) - whole)
    return f"{whole:0{digits}d}{minutes:012.9f},{sides[0 if degrees >= 0 else 1]}"


def nmea_log(qualities=None, heading="HDT", start_day_s=30630.0):
    stamp_s, points, yaw = curve()
    places = place(antenna(points, yaw))
    headings = true_azimuth_deg(points, yaw)
    lines = [checksum("GPRMC,083030.00,A,,,,,,,170524,,")]
    for k, (lat, lon, height) in enumerate(places):
        of_day = (start_day_s + stamp_s[k] - START_S) % 86400
        clock = f"{int(of_day // 3600):02d}{int(of_day % 3600 // 60):02d}{of_day % 60:05.2f}"
        quality = 4 if qualities is None else qualities[k]
        where = f"{nmea_angle(lat, 2, 'NS')},{nmea_angle(lon, 3, 'EW')}"
        lines.append(
            checksum(f"GNGGA,{clock},{where},{quality},12,0.8,{height - 40.5:.7f},M,40.5,M,1.0,0000")
        )
        if heading == "HDT":
            lines.append(checksum(f"GNHDT,{headings[k]:.8f},T"))
        elif heading == "THS":
            lines.append(checksum(f"GNTHS,{headings[k]:.8f},A"))
        elif heading == "PASHR":
            lines.append(checksum(f"PASHR,{clock},{headings[k]:.8f},T,0.0,0.0,0.0,0.1,0.1,0.05,2,1"))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("heading", ["HDT", "THS", "PASHR"])
def test_an_nmea_log_gives_the_vehicle_and_not_the_antenna(heading, tmp_path):
    (tmp_path / "log.nmea").write_text(nmea_log(heading=heading))
    got = read({"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}, tmp_path)
    check(got, metres=LEVEL_M, radians=1e-6)
    assert got.noise["position_m"] == pytest.approx(0.02)
    assert got.origin == ORIGIN


def test_positions_without_an_rtk_fix_are_left_out_and_counted(tmp_path, caplog):
    qualities = [4] * 20 + [5] * 15 + [1] * 4 + [0] * 2
    (tmp_path / "log.nmea").write_text(nmea_log(qualities))
    content: dict[str, Any] = {"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}
    with caplog.at_level(logging.WARNING):
        check(read(content, tmp_path), slice(0, 20), metres=LEVEL_M, radians=1e-6)
    assert "left out 19 of 39 positions" in caplog.text
    wide = read(content | {"max_sigma_m": 1.0}, tmp_path)
    check(wide, slice(0, 35), metres=LEVEL_M, radians=1e-6)
    assert wide.noise["position_m"] == pytest.approx(np.sqrt((20 * 0.02**2 + 15 * 0.5**2) / 35))
    (tmp_path / "log.nmea").write_text(nmea_log([5] * 41))
    with pytest.raises(DriveError, match=r"no position is known to 0\.1 m \(the best is 0\.5 m\)"):
        read(content, tmp_path)


def test_a_log_past_midnight_goes_on(tmp_path):
    (tmp_path / "log.nmea").write_text(nmea_log(start_day_s=86395.0))
    stamps = read({"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}, tmp_path).trajectory.stamp_s
    np.testing.assert_allclose(np.diff(stamps), 0.25, atol=1e-6)


def test_an_nmea_log_is_refused_for_what_it_lacks(tmp_path):
    log = tmp_path / "log.nmea"
    content: dict[str, Any] = {"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}
    whole = nmea_log().splitlines()
    log.write_text("\n".join(whole[1:]))
    with pytest.raises(DriveError, match="states the date: add date"):
        read(content, tmp_path)
    check(read(content | {"date": "2024-05-17"}, tmp_path), metres=LEVEL_M, radians=1e-6)
    log.write_text("\n".join(line for line in whole if "HDT" not in line))
    with pytest.raises(
        DriveError, match="positions without a heading, and the course over ground is not a heading"
    ):
        read(content, tmp_path)
    log.write_text("\n".join(whole))
    with pytest.raises(DriveError, match="holds an antenna's positions: add lever_arm_m"):
        read({"nmea": "log.nmea"}, tmp_path)
    log.write_text("\n".join(line.replace(",4,12", ",4,13") for line in whole))
    with pytest.raises(DriveError, match=r"41 of 83 NMEA sentences are damaged|no GGA"):
        read(content, tmp_path)


def grid(points, crs):
    places = place(points)
    easting, northing = pyproj.Transformer.from_crs("EPSG:4258", crs, always_xy=True).transform(
        places[:, 1], places[:, 0]
    )
    return np.column_stack([easting, northing, places[:, 2]])


ETRS = GeodeticOrigin(53.5, 9.9, 45.0, "ETRS89")


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:25833", "EPSG:4647"])
@pytest.mark.parametrize("heading", ["true", "grid"])
def test_projected_coordinates_and_either_north_give_the_same_poses(crs, heading, tmp_path):
    stamp_s, points, yaw = curve()
    table = grid(points, crs)
    azimuth_deg = true_azimuth_deg(points, yaw)
    if heading == "grid":
        ahead = points + 0.5 * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        east, north, _ = (grid(ahead, crs) - grid(2 * points - ahead, crs)).T
        between_deg = (azimuth_deg - np.degrees(np.arctan2(east, north)) + 180) % 360 - 180
        # Four degrees west of zone 33's meridian the two norths are four degrees apart.
        assert np.abs(between_deg).min() > (4 if crs == "EPSG:25833" else 0.7)
        azimuth_deg = azimuth_deg - between_deg
    rows = np.column_stack([stamp_s, table, azimuth_deg])
    lines = [";".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "route.csv").write_text("\n".join(["t;E;N;h;hdg", *lines]))
    columns = {"stamp_s": "t", "x_m": "E", "y_m": "N", "z_m": "h", "heading_deg": "hdg"}
    content = {"csv": "route.csv", "columns": columns, "crs": crs, "heading": heading}
    got = read(content, tmp_path, None)
    assert got.origin.datum.startswith("ETRS89")
    origin = GeodeticOrigin(53.5, 9.9, 45.0, got.origin.datum)
    check(read(content, tmp_path, origin), metres=1e-5, radians=1e-6)


@pytest.mark.parametrize(("crs", "geoid_m"), [("EPSG:2263", None), ("EPSG:2263+6360", -32.0)])
def test_easting_northing_and_height_of_a_grid_of_feet_are_in_feet(crs, geoid_m, tmp_path, caplog):
    """New York Long Island; NAVD88 counts US survey feet above the sea, 32 m below the ellipsoid."""
    origin = GeodeticOrigin(40.7, -73.9, 30.0, "NAD83")
    stamp_s, points, yaw = curve()
    places = place(points, origin)
    to_grid = pyproj.Transformer.from_crs("EPSG:4269", "EPSG:2263", always_xy=True)
    east, north = to_grid.transform(places[:, 1], places[:, 0])
    up = (places[:, 2] - (geoid_m or 0.0)) * 3937 / 1200
    ahead = place(points + np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]), origin)
    azimuth_deg, _, _ = pyproj.Geod(ellps="WGS84").inv(places[:, 1], places[:, 0], ahead[:, 1], ahead[:, 0])
    rows = np.column_stack([stamp_s, east, north, up, azimuth_deg % 360])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "route.csv").write_text("\n".join(["stamp_s,x_m,y_m,z_m,heading_deg", *lines]))
    content = {"csv": "route.csv", "crs": crs, "heading": "true"}
    if geoid_m is not None:
        content["geoid_m"] = geoid_m
    with caplog.at_level(logging.INFO):
        got = read(content, tmp_path, None)
    assert "are read in the unit of EPSG:2263" in caplog.text
    assert got.origin.altitude_m == pytest.approx(places[0, 2], abs=1e-6)
    check(read(content, tmp_path, origin), metres=1e-5, radians=1e-6)


def test_a_grid_that_names_no_datum_is_on_that_of_the_stated_origin(tmp_path):
    stamp_s, points, yaw = curve()
    rows = np.column_stack([stamp_s, grid(points, "EPSG:25832"), true_azimuth_deg(points, yaw)])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "route.csv").write_text("\n".join(["stamp_s,x_m,y_m,z_m,heading_deg", *lines]))
    zone = "+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs"
    content = {"csv": "route.csv", "crs": zone, "heading": "true"}
    check(read(content, tmp_path, ETRS), metres=1e-5, radians=1e-6)


def test_swapped_easting_and_northing_are_refused_as_a_place_where_the_grid_is_not_used(tmp_path):
    stamp_s, points, _ = curve()
    rows = np.column_stack([stamp_s, grid(points, "EPSG:25832")[:, [1, 0, 2]], np.zeros(len(points))])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "route.csv").write_text("\n".join(["stamp_s,x_m,y_m,z_m,heading_deg", *lines]))
    content = {"csv": "route.csv", "crs": "EPSG:25832", "heading": "true"}
    with pytest.raises(DriveError, match=r"longitude 5\d.\d\d, where EPSG:25832 is not used; check it, and"):
        read(content, tmp_path, None)


def test_what_a_projected_system_leaves_open_is_asked_for(tmp_path):
    (tmp_path / "route.csv").write_text(
        "stamp_s,x_m,y_m,z_m,heading_deg\n1,560000,5930000,3,5\n2,560001,5930000,3,5\n"
    )
    content: dict[str, Any] = {"csv": "route.csv", "crs": "EPSG:25832", "heading": "grid"}
    for changes, message in (
        ({"heading": None}, "true and grid north differ in EPSG:25832: add heading"),
        ({"crs": "EPSG:99999"}, "unknown crs 'EPSG:99999'"),
        ({"crs": "+proj=utm +zone=32 +ellps=GRS80"}, r"\+ellps=GRS80 names no datum; give its code"),
        ({"crs": "EPSG:27700"}, "EPSG:27700 .* is not on a satellite datum"),
        ({"crs": "EPSG:5555"}, "are above sea level: add geoid_m"),
        ({"crs": None}, "heading: only for coordinates on the earth"),
        ({"crs": "EPSG:4258"}, "EPSG:4258 is not projected"),
        ({"crs": "EPSG:3035"}, "EPSG:3035 is not conformal"),
        ({"heading": "north"}, "heading: expected one of true, grid"),
        ({"lever_arm": [0, 0, 0]}, "unknown key 'lever_arm'; did you mean 'lever_arm_m'"),
        ({"tum": "a"}, "name one source"),
    ):
        wrong = {key: value for key, value in (content | changes).items() if value is not None}
        with pytest.raises(DriveError, match=message):
            read(wrong, tmp_path, None)
    with pytest.raises(DriveError, match="the poses are in ETRS89, the origin in WGS84"):
        read(content, tmp_path, ORIGIN)


def test_heights_above_the_sea_are_raised_by_the_geoid(tmp_path):
    (tmp_path / "route.csv").write_text(
        "stamp_s,x_m,y_m,z_m,heading_deg\n1,560000,5930000,3,5\n2,560001,5930000,3,5\n"
    )
    content = {"csv": "route.csv", "crs": 5555, "heading": "grid", "geoid_m": 41.25, "epoch": 2024.5}
    got = read(content, tmp_path, None)
    assert got.origin.altitude_m == pytest.approx(44.25)
    assert got.origin.epoch == 2024.5


def test_a_table_in_the_map_frame_with_angles(tmp_path):
    stamp_s, points, yaw = curve()
    roll, pitch = 0.03, -0.02
    rows = zip(stamp_s, points.tolist(), yaw.tolist(), strict=True)
    lines = [
        f"{t * 1e9:.0f}\t{p[0]!r}\t{p[1]!r}\t{p[2]!r}\t{y!r}\t{roll}\t{np.degrees(-pitch)}\t"
        for t, p, y in rows
    ]
    names = "stamp_ns\tx_m\ty_m\tz_m\tyaw_rad\troll_rad\tpitch_up_deg\tsigma_m"
    (tmp_path / "route.csv").write_text("\n".join([names, *lines]))
    got = read({"csv": "route.csv"}, tmp_path)
    expected = Rotation.from_euler("xyz", np.column_stack([np.full(41, roll), np.full(41, pitch), yaw]))
    np.testing.assert_allclose(got.trajectory.map_from_vehicle[:, :3, :3], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(got.trajectory.map_from_vehicle[:, :3, 3], points, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no pose"),
        ("stamp_s,x_m,y_m\n1,2\n", "line 2: 2 cells under 3 columns"),
        ("stamp_s,x_m,y_m,yaw_deg\n1,2,x,0\n", "line 2: y_m: 'x' is not a number"),
        ("stamp_s,x_m,y_m,yaw_deg\n1,2,nan,0\n", "none of its 1 positions is a number"),
        ("stamp_s,x_m,y_m,yaw_deg\n,2,3,0\nnan,2,3,0\n", "route.csv: no line has a time"),
        ("x_m,y_m,yaw_deg\n1,2,0\n", "needs one time column"),
        ("stamp_s,stamp_ns,x_m,y_m,yaw_deg\n1,1,2,0,0\n", "has stamp_s, stamp_ns"),
        ("stamp_s,x_m,yaw_deg\n1,2,0\n", "has no column 'y_m'"),
        ("stamp_s,yaw_deg\n1,2\n", "needs positions"),
        ("stamp_s,x_m,y_m,yaw_deg,heading_deg\n1,2,0,0,0\n", "has heading_deg and yaw_deg"),
        ("stamp_s,x_m,y_m\n1,2,0\n", "positions without a heading"),
        ("stamp_s,x_m,y_m,yaw_deg\n9,2,0,0\n3,2,0,0\n", "pose 2: its time 3.000 s is 6.000 s before"),
        ("stamp_s,x_m,y_m,qx,qy,qz,qw\n9,2,0,0,0,0,2\n", "pose 1: quaternion of norm 2"),
        ("utc,x_m,y_m,yaw_deg\nnow,2,0,0\n", "'now' is not a time such as"),
    ],
)
def test_a_damaged_table_is_refused_in_one_line(text, message, tmp_path):
    (tmp_path / "route.csv").write_text(text)
    with pytest.raises(DriveError, match=message) as caught:
        read({"csv": "route.csv"}, tmp_path)
    assert "\n" not in str(caught.value)


def test_lines_of_no_numbers_in_a_table_are_left_out_and_counted(tmp_path, caplog):
    lines = [f"{k / 10},{k / 10},0,0,1" for k in range(20)]
    lines[3] = "0.3,nan,0,0,1"
    lines[5] = "0.5,,NaN,0,1"
    lines[7] = "0.7,0.7,0,0,"
    lines[9] = ",0.9,0,0,1"
    (tmp_path / "route.csv").write_text("\n".join(["stamp_s,x_m,y_m,z_m,yaw_deg", *lines]))
    got = read({"csv": "route.csv"}, tmp_path)
    positions_m = np.delete(np.arange(20) / 10, [3, 5, 9])
    np.testing.assert_allclose(got.trajectory.map_from_vehicle[:, 0, 3], positions_m, atol=1e-12)
    for words in ("1 of 20 lines without a time", "2 of 19 positions", "1 of 19 headings"):
        assert words in caplog.text


def test_names_in_a_table_move_no_cursor(tmp_path):
    (tmp_path / "a.csv").write_text("na\x1b[2Jme,x\nP\x9b2J,1\n")
    assert read_rows(tmp_path / "a.csv", ",", "point") == (["na?[2Jme", "x"], [(2, ["P?2J", "1"])])


def test_a_pose_whose_quality_is_left_blank_has_no_fix(tmp_path):
    path = tmp_path / "route.csv"
    path.write_text("stamp_s,x_m,y_m,yaw_deg,quality\n1,2,3,0,4\n2,3,3,0,\n3,4,3,0,inf\n")
    assert read_table(path, {}, tmp_path, "here").sigma_m.tolist() == [0.02, np.inf, np.inf]


def test_positions_that_do_not_say_how_sure_they_are_are_left_out_among_those_that_do(tmp_path, caplog):
    lines = [f"{k / 10},{k / 10},0,0,{'' if k in (3, 4) else 0.02}" for k in range(20)]
    (tmp_path / "route.csv").write_text("\n".join(["stamp_s,x_m,y_m,yaw_deg,sigma_m", *lines]))
    assert len(read({"csv": "route.csv"}, tmp_path).trajectory.stamp_s) == 18
    assert "left out 2 of 20 positions" in caplog.text


def with_topic(root, messages, poses, **changes):
    """A drive of a folder's images at times within the curve, with the poses of a bag."""
    make_drive(root, stamps=(START_S + 1.0, START_S + 2.0, START_S + 9.0))
    with description(root) as content:
        content.pop("pose_noise")
        content |= {"bag": "site", "poses": poses} | changes
    write_ros2(root / "site", messages)
    return read_drive(root, ReadOptions(cache=str(root / "cache")))


def test_fixes_and_an_imu_at_other_times_with_antenna_and_turned_sensor(tmp_path):
    stamp_s, points, yaw = curve()
    messages = Messages()
    for k, where in enumerate(place(antenna(points, yaw))):
        status = -1 if k in (3, 4) else 2
        messages.add(stamp_s[k], "/fix", messages.fix(stamp_s[k], where, status, 0.015, "gnss"))
    # The Imu's x axis points left, and its clock ticks between the fixes.
    for t in np.arange(START_S - 0.01, START_S + 10.1, 0.02):
        turn = 0.4 + 5.0 * (t - START_S) / 30.0 + np.pi / 2
        messages.add(t, "/imu", messages.imu(t, Rotation.from_euler("z", turn).as_matrix(), "imu"))
    poses = {"topic": "/fix", "heading_topic": "/imu", "lever_arm_m": list(LEVER_M)}
    drive = with_topic(tmp_path, messages, poses | {"mounting_rpy_deg": [0, 0, 90]})
    keep = np.delete(np.arange(41), (3, 4))
    np.testing.assert_allclose(drive.recorded.stamp_s, stamp_s[keep], atol=1e-6)
    got = drive.recorded.map_from_vehicle
    # At 800 m from the origin east is turned by 2e-4 rad, and the Imu counts from the east of the place.
    np.testing.assert_allclose(got[:, :3, 3], points[keep], atol=5e-4)
    turned = np.arctan2(got[:, 1, 0], got[:, 0, 0]) - yaw[keep]
    expected = np.radians(true_azimuth_deg(points, yaw)[keep]) - (np.pi / 2 - yaw[keep])
    np.testing.assert_allclose(np.angle(np.exp(1j * (turned - expected))), 0, atol=1e-6)
    assert drive.pose_noise.position_m == pytest.approx(0.015)
    assert drive.pose_noise.heading_rad == pytest.approx(0.002)


def test_fixes_of_one_antenna_and_the_rates_of_an_upturned_imu_are_the_drive(tmp_path):
    stamp_s, points, yaw = curve()
    messages = Messages()
    for k, where in enumerate(place(antenna(points, yaw))):
        messages.add(stamp_s[k], "/fix", messages.fix(stamp_s[k], where, 2, 0.015, "gnss"))
    for t in np.arange(START_S - 0.01, START_S + 10.1, 0.02):
        imu = messages.imu(t, np.eye(3), "imu")
        imu.angular_velocity.z = -5.0 / 30.0
        messages.add(t, "/imu", imu)
    poses = {"topic": "/fix", "heading": "course", "gyro_topic": "/imu", "lever_arm_m": list(LEVER_M)}
    drive = with_topic(tmp_path, messages, poses | {"mounting_rpy_deg": [180, 0, 0]})
    got = drive.recorded.map_from_vehicle
    assert np.degrees(np.abs(np.arctan2(got[:, 1, 0], got[:, 0, 0]) - yaw).max()) < 0.7
    assert np.abs(got[:, :3, 3] - points).max() < 0.03
    assert drive.headed_by_course
    with pytest.raises(DriveError, match="its z axis points down"):
        with_topic(tmp_path / "wrong", messages, poses)


def test_covariances_become_the_noise_unless_the_drive_says_otherwise(tmp_path):
    stamp_s, points, yaw = curve()
    covariance = np.diag([0.03**2, 0.03**2, 1.0, 0.1, 0.1, 0.004**2])
    messages = Messages()
    for t, point, angle in zip(stamp_s, points, yaw, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("z", angle).as_matrix(), point
        messages.add(t, "/pose", messages.with_covariance(t, matrix, covariance))
    drive = with_topic(tmp_path, messages, {"topic": "/pose"})
    assert drive.pose_noise.position_m == pytest.approx(0.03)
    assert drive.pose_noise.position_drift_m == pytest.approx(0.03 / np.sqrt(2))
    assert drive.pose_noise.heading_rad == pytest.approx(0.004)
    with description(tmp_path) as content:
        content["pose_noise"] = {"position_m": 0.05}
    noise = read_drive(tmp_path, ReadOptions(cache=str(tmp_path / "cache"))).pose_noise
    assert (noise.position_m, noise.heading_rad) == (0.05, pytest.approx(0.004))


def test_poses_of_transforms_over_a_moving_and_a_fixed_edge(tmp_path):
    stamp_s, points, yaw = curve()
    map_from_odom, base_from_gnss = np.eye(4), np.eye(4)
    map_from_odom[:3, :3] = Rotation.from_euler("z", 0.7).as_matrix()
    map_from_odom[:3, 3] = [5.0, -2.0, 0.0]
    base_from_gnss[:3, 3] = LEVER_M
    messages = Messages()
    for t, point, angle in zip(stamp_s, points, yaw, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("z", angle).as_matrix(), point
        messages.add(
            t, "/tf", messages.transforms(t, {("odom", "gnss"): np.linalg.inv(map_from_odom) @ matrix})
        )
    edges = {("map", "odom"): map_from_odom, ("base_link", "gnss"): base_from_gnss}
    messages.rows.insert(0, (START_S, "/tf_static", messages.transforms(START_S, edges)))
    drive = with_topic(tmp_path, messages, {"topic": "/tf", "frame": "map", "vehicle": "base_link"})
    expected = 2 * points - antenna(points, yaw)
    np.testing.assert_allclose(drive.recorded.map_from_vehicle[:, :3, 3], expected, atol=1e-6)
