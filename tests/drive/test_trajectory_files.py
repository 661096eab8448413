"""SBET, RTKLIB's solutions and u-blox messages, written here from one drive, are that drive."""

# ruff: noqa: E501

import json
import logging

import numpy as np
import pytest
import pyubx2
from pyproj import Transformer

from tests.drive.test_nmea import bend, checksum, hms
from tests.drive.test_poses import LEVER_M, ORIGIN, antenna, place
from v2hdm.errors import DriveError
from v2hdm.io.importers.gps_time import GPS_EPOCH_S, WEEK_S, leap_seconds
from v2hdm.io.importers.poses import read_poses
from v2hdm.io.importers.rtklib import read_pos
from v2hdm.io.importers.sbet import read_sbet

LEVER = list(LEVER_M)
STAMP_S, POINTS, YAW = bend()
PLACES = place(antenna(POINTS, YAW))
GPS_S = STAMP_S + 18 - GPS_EPOCH_S
WEEK = int(GPS_S[0] // WEEK_S)
TOW_S = GPS_S - WEEK * WEEK_S
NEAR_S = float(STAMP_S[0]) + 3.0
ROLL, PITCH_DOWN = 0.02, -0.03


def read(content, root, near_s=NEAR_S):
    return read_poses(content, root, ORIGIN, 0.5, "drive.yaml: poses", None, near_s=near_s)


def check(got, metres=1e-3, radians=1e-4, rows=slice(None)):
    np.testing.assert_allclose(got.trajectory.stamp_s, STAMP_S[rows], rtol=0, atol=1e-6)
    poses = got.trajectory.map_from_vehicle
    np.testing.assert_allclose(poses[:, :3, 3], POINTS[rows], rtol=0, atol=metres)
    off = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - YAW[rows]
    np.testing.assert_allclose((off + np.pi) % (2 * np.pi) - np.pi, 0, atol=radians)


def sbet(roll=0.0, pitch_up=0.0, wander=0.3, tow_s=TOW_S, places=PLACES):
    table = np.zeros((len(tow_s), 17))
    table[:, 0] = tow_s
    table[:, 1:3] = np.radians(places[:, :2])
    table[:, 3] = places[:, 2]
    table[:, 7], table[:, 8], table[:, 10] = roll, pitch_up, wander
    table[:, 9] = np.pi / 2 - YAW + wander
    return table


def smrmsg():
    table = np.zeros((len(TOW_S), 10))
    table[:, 0] = TOW_S
    table[:, 1:4] = 0.012, 0.016, 0.03
    table[:, 7:] = 0.6, 0.8, 3.0  # minutes of arc
    return table


@pytest.mark.parametrize("order", ["<f8", ">f8"])
def test_an_sbet_with_its_rms_file_is_the_drive_with_its_sigmas(order, tmp_path):
    sbet().astype(order).tofile(tmp_path / "sbet.out")
    smrmsg().astype(order).tofile(tmp_path / "smrmsg.out")
    got = read({"sbet": "sbet.out", "rms": "smrmsg.out", "lever_arm_m": LEVER}, tmp_path)
    check(got)
    assert got.noise["position_m"] == pytest.approx(np.sqrt((0.012**2 + 0.016**2) / 2))
    assert got.noise["heading_rad"] == pytest.approx(np.radians(3 / 60))
    assert got.noise["roll_pitch_rad"] == pytest.approx(np.radians(np.sqrt((0.6**2 + 0.8**2) / 2) / 60))


def test_roll_and_pitch_of_an_sbet_turn_to_ours(tmp_path):
    sbet(roll=ROLL, pitch_up=-PITCH_DOWN).tofile(tmp_path / "sbet.out")
    attitudes = read_sbet(tmp_path / "sbet.out", {}, tmp_path, "here", NEAR_S).attitudes
    # Right side down is left side up: the left axis rises. Nose up: the forward axis rises.
    np.testing.assert_allclose(attitudes.rotation[:, 2, 1], np.sin(ROLL) * np.cos(PITCH_DOWN), atol=1e-9)
    np.testing.assert_allclose(attitudes.rotation[:, 2, 0], np.sin(-PITCH_DOWN), atol=1e-9)


def test_the_week_of_an_sbet_is_the_images_or_stated_or_asked_for(tmp_path):
    sbet().tofile(tmp_path / "sbet.out")
    content = {"sbet": "sbet.out", "lever_arm_m": LEVER}
    check(read(content | {"date": "2024-05-16"}, tmp_path, near_s=None))
    check(read(content, tmp_path, near_s=STAMP_S[0] - 2 * 86400))
    with pytest.raises(DriveError, match="seconds of the week: add date, a day of the recording"):
        read(content, tmp_path, near_s=None)
    utc = read(content | {"clock": "utc"}, tmp_path).trajectory.stamp_s
    np.testing.assert_allclose(utc, STAMP_S + 18)
    stamps_s = read(content, tmp_path, near_s=float(TOW_S[5])).trajectory.stamp_s
    np.testing.assert_allclose(stamps_s, TOW_S)


def test_an_sbet_goes_on_past_the_end_of_the_week(tmp_path):
    past = (TOW_S - TOW_S[200] - 0.05) % WEEK_S
    sbet(tow_s=past).tofile(tmp_path / "sbet.out")
    got = read({"sbet": "sbet.out", "lever_arm_m": LEVER, "date": "2024-05-18"}, tmp_path, None)
    np.testing.assert_allclose(np.diff(got.trajectory.stamp_s), 0.1, atol=1e-5)


def test_damaged_records_are_left_out_and_counted_and_other_files_refused(tmp_path, caplog):
    table = sbet()
    table[7, 1] = np.nan
    table[9, 3] = 1e9
    path = tmp_path / "sbet.out"
    path.write_bytes(table.tobytes() + b"cut")
    check(read({"sbet": "sbet.out", "lever_arm_m": LEVER}, tmp_path), rows=np.delete(np.arange(401), (7, 9)))
    assert "left out 2 of 401 damaged records" in caplog.text
    assert "its last record is cut: left out 3 bytes" in caplog.text
    with pytest.raises(
        DriveError, match="holds the IMU's, or its reference point's, positions: add lever_arm_m"
    ):
        read({"sbet": "sbet.out"}, tmp_path)
    table = sbet()
    table[:, 1:3] = np.degrees(table[:, 1:3])
    table.tofile(path)
    with pytest.raises(DriveError, match="angles look like degrees: export it in radians"):
        read({"sbet": "sbet.out", "lever_arm_m": LEVER}, tmp_path)
    path.write_text("time, latitude\n")
    with pytest.raises(DriveError, match="15 bytes are no SBET, which has 136 bytes a record"):
        read({"sbet": "sbet.out", "lever_arm_m": LEVER}, tmp_path)


BASE = np.array([[53.5001, 9.9002, 44.0]])
TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def ecef(places):
    return np.column_stack(TO_ECEF.transform(places[:, 1], places[:, 0], places[:, 2]))


def enu_of_base():
    topocentric = f"+proj=topocentric +ellps=WGS84 +lat_0={BASE[0, 0]} +lon_0={BASE[0, 1]} +h_0={BASE[0, 2]}"
    return np.column_stack(Transformer.from_pipeline(topocentric).transform(*ecef(PLACES).T))


def dms(degrees):
    size = abs(degrees)
    minutes = int(size * 60) % 60
    return f"{'-' if degrees < 0 else ''}{int(size)} {minutes:02d} {(size * 60 % 1) * 60:010.7f}"


def calendar(stamp_s):
    return str(np.datetime64(round(stamp_s * 1000), "ms")).replace("-", "/").replace("T", " ")


LLH = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
SIGMAS = "1 12 0.0120 0.0160 0.0300 -0.0020 0.0010 -0.0010 1.00 99.9"
VELOCITY = " vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
DEGREES = [f"{lat:.11f} {lon:.11f} {height:.5f}" for lat, lon, height in PLACES]
PARTS = [f"{dms(lat)} {dms(lon)} {height:.5f}" for lat, lon, height in PLACES]
GPST = [f"{WEEK} {tow:.3f}" for tow in TOW_S]
GPS_DAYS = [calendar(stamp_s + 18) for stamp_s in STAMP_S]


def solution(scale, title, times, values, sigmas=SIGMAS, comments=()):
    rows = [f"{time} {value} {sigmas}" for time, value in zip(times, values, strict=True)]
    return "\n".join(["% program   : RTKLIB ver.2.4.3", *comments, f"%  {scale}  {title}", *rows]) + "\n"


XYZ = LLH.replace("latitude(deg) longitude(deg)  height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)")
for ours, theirs in (
    ("sdne", "sdxy"),
    ("sdeu", "sdyz"),
    ("sdun", "sdzx"),
    ("sdn", "sdx"),
    ("sde", "sdy"),
    ("sdu(", "sdz("),
):
    XYZ = XYZ.replace(ours, theirs)
ENU = LLH.replace("latitude(deg) longitude(deg)  height(m)", "e-baseline(m) n-baseline(m) u-baseline(m)")
ENU = (
    ENU.replace("sdn(m)   sde(m)", "sde(m)   sdn(m)")
    .replace("sdne", "sden")
    .replace("sdeu", "sdnu")
    .replace("sdun", "sdue")
)
FROM_BASE = [" ".join(f"{value:.5f}" for value in row) for row in enu_of_base()]
REF = f"% ref pos   : {BASE[0, 0]} {BASE[0, 1]} {BASE[0, 2]}"
SOLUTIONS = {
    "week and seconds": solution("GPST", LLH, GPST, DEGREES),
    "calendar": solution("GPST", LLH, GPS_DAYS, DEGREES),
    "UTC": solution("UTC", LLH, [calendar(stamp_s) for stamp_s in STAMP_S], DEGREES),
    "JST": solution("JST", LLH, [calendar(stamp_s + 9 * 3600) for stamp_s in STAMP_S], DEGREES),
    "parts of degrees": solution(
        "GPST", LLH.replace("latitude(deg) longitude(deg)", "latitude(d'\") longitude(d'\")"), GPS_DAYS, PARTS
    ),
    "x, y, z": solution("GPST", XYZ, GPST, [" ".join(f"{v:.5f}" for v in row) for row in ecef(PLACES)]),
    "baseline": solution("GPST", ENU, GPST, FROM_BASE, comments=[REF]),
    "baseline, base in x, y, z": solution(
        "GPST", ENU, GPST, FROM_BASE, comments=["% ref pos   : " + " ".join(map(repr, ecef(BASE)[0].tolist()))]
    ),
    "velocities": solution("GPST", LLH + VELOCITY, GPST, DEGREES, SIGMAS + " 1 2 0 .1 .1 .1 0 0 0"),
    "commas": solution("GPST", LLH, GPS_DAYS, DEGREES).replace("(deg) ", "(deg),").replace(" Q", ",Q").replace(
        " 1 12", ",1,12"),
    "no line of names": "\n".join(f"{t} {v} {SIGMAS}" for t, v in zip(GPS_DAYS, DEGREES, strict=True)),
    "no sigmas": solution("GPST", "latitude(deg) longitude(deg) height(m) Q ns", GPST, DEGREES, "1 12"),
}  # fmt: skip


def heading_csv(root):
    rows = [f"{t!r},{y!r}" for t, y in zip(STAMP_S.tolist(), YAW.tolist(), strict=True)]
    (root / "imu.csv").write_text("\n".join(["stamp_s,yaw_rad", *rows]))
    return {"csv": "imu.csv"}


@pytest.mark.parametrize("name", SOLUTIONS)
def test_every_format_of_rtklib_is_the_drive(name, tmp_path):
    (tmp_path / "rover.pos").write_text(SOLUTIONS[name])
    got = read({"pos": "rover.pos", "heading_file": heading_csv(tmp_path), "lever_arm_m": LEVER}, tmp_path)
    check(got)
    east_north = np.sqrt((0.012**2 + 0.016**2) / 2)
    if name == "x, y, z":
        x, y, z, xy, yz, zx = (float(value) for value in SIGMAS.split()[2:8])
        covariance = np.array(
            [[x * x, -xy * xy, -zx * zx], [-xy * xy, y * y, yz * yz], [-zx * zx, yz * yz, z * z]]
        )
        lat, lon = np.radians(PLACES[0, :2])
        east = np.array([-np.sin(lon), np.cos(lon), 0])
        north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
        east_north = np.sqrt((east @ covariance @ east + north @ covariance @ north) / 2)
    expected = 0.02 if name == "no sigmas" else east_north
    assert got.noise["position_m"] == pytest.approx(expected, rel=1e-4)


def test_a_pos_file_says_that_it_has_no_heading(tmp_path):
    (tmp_path / "rover.pos").write_text(SOLUTIONS["calendar"])
    with pytest.raises(DriveError, match=r"positions without a heading, .*heading_file, a second file"):
        read({"pos": "rover.pos", "lever_arm_m": LEVER}, tmp_path)


def test_a_moving_base_gives_the_headings_of_its_baseline(tmp_path):
    ahead = [f"{np.cos(y):.6f} {np.sin(y):.6f} 0.01" for y in YAW]
    title = ["% pos mode  : moving-base"]
    (tmp_path / "moving.pos").write_text(solution("GPST", ENU, GPST, ahead, comments=title))
    (tmp_path / "rover.pos").write_text(SOLUTIONS["calendar"])
    got = read({"pos": "rover.pos", "heading_file": {"pos": "moving.pos"}, "lever_arm_m": LEVER}, tmp_path)
    check(got)
    assert got.noise["heading_rad"] == pytest.approx(np.sqrt((0.012**2 + 0.016**2) / 2), rel=1e-3)
    with pytest.raises(DriveError, match="needs positions, and holds headings only; name it as heading_file"):
        read({"pos": "moving.pos", "lever_arm_m": LEVER}, tmp_path)


def test_qualities_damaged_lines_and_heights_of_the_sea_are_told(tmp_path, caplog):
    text = SOLUTIONS["no sigmas"].replace("1 12\n", "2 12\n", 3).replace("1 12\n", "5 12\n", 2)
    lines = text.splitlines()
    lines[20] = lines[20][:22]
    lines[21] = lines[21].replace(DEGREES[19].split()[0], "nan")
    geodetic = (
        "% (lat/lon/height=WGS84/geodetic,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
    )
    path = tmp_path / "rover.pos"
    path.write_text("\n".join([geodetic, *lines]))
    with caplog.at_level(logging.WARNING):
        sigma_m = read_pos(path, {}, tmp_path, "here").sigma_m
    assert sigma_m.tolist()[:6] == [0.5, 0.5, 0.5, 3.0, 3.0, 0.02]
    assert len(sigma_m) == 399
    assert "left out 2 of 401 damaged lines" in caplog.text
    assert "heights count from the sea (geodetic); add geoid_m" in caplog.text


def test_a_solution_in_nmea_is_a_log(tmp_path):
    lat = f"{int(PLACES[0, 0])}{PLACES[0, 0] % 1 * 60:010.7f}"
    line = checksum(f"GPGGA,{hms(STAMP_S[0])},{lat},N,00954.0,E,4,12,0.8,5.0,M,40.5,M,1.0,0000")
    (tmp_path / "rover.pos").write_text(line + "\n" + checksum(f"GPRMC,{hms(STAMP_S[0])},A,,,,,,,170524,,"))
    got = read_pos(tmp_path / "rover.pos", {}, tmp_path, "here")
    np.testing.assert_allclose(got.stamp_s, STAMP_S[0])


def ubx_messages(attitude="NAV-ATT", position="NAV-HPPOSLLH"):
    messages = []
    for k, (lat, lon, height) in enumerate(PLACES):
        of_week = {"iTOW": round(TOW_S[k] * 1000)}
        at = np.datetime64(round(STAMP_S[k] * 1000), "ms").item()
        date = {"year": at.year, "month": at.month, "day": at.day, "hour": at.hour, "min": at.minute}
        nano = at.microsecond * 1000
        heading = np.degrees(np.pi / 2 - YAW[k]) % 360
        solution = dict(
            date, second=at.second, nano=nano, validDate=1, validTime=1, fixType=3, gnssFixOk=1, carrSoln=2, lat=lat,
            lon=lon, height=round(height * 1000), hAcc=14, headVehValid=int(attitude == "NAV-PVT"), headVeh=heading,
            headAcc=0.3,
        )  # fmt: skip
        messages.append(pyubx2.UBXMessage("NAV", "NAV-PVT", pyubx2.GET, **of_week, **solution))
        if position == "NAV-HPPOSLLH":
            fine = {"height": round(height * 1000), "hAcc": 14.0}
            for key, degrees in (("lat", lat), ("lon", lon)):
                fine[key] = round(degrees * 1e7) / 1e7
                fine[f"_HP{key}"] = degrees - fine[key]
            messages.append(pyubx2.UBXMessage("NAV", "NAV-HPPOSLLH", pyubx2.GET, **of_week, **fine))
        if attitude == "NAV-ATT":
            turned = {
                "roll": 0.0,
                "pitch": 0.0,
                "heading": heading,
                "accRoll": 0.3,
                "accPitch": 0.4,
                "accHeading": 0.3,
            }
            messages.append(pyubx2.UBXMessage("NAV", "NAV-ATT", pyubx2.GET, **of_week, **turned))
        elif attitude == "NAV-RELPOSNED":
            valid = {"gnssFixOK": 1, "relPosValid": 1, "carrSoln": 2, "isMoving": 1, "relPosHeadingValid": 1}
            baseline = {"version": 1, "relPosHeading": heading, "accHeading": 0.3} | valid
            messages.append(pyubx2.UBXMessage("NAV", "NAV-RELPOSNED", pyubx2.GET, **of_week, **baseline))
    return messages


def as_json(message):
    payload = {key: value for key, value in vars(message).items() if not key.startswith("_")}
    payload["iTOW"] = str(pyubx2.itow2utc(payload["iTOW"]))
    return json.dumps({"type": str(type(message)), "identity": message.identity, "payload": payload})


FORMS = {
    "printed": lambda messages: "\n".join(map(str, messages)).encode(),
    "json": lambda messages: "\n".join(map(as_json, messages)).encode(),
    "raw": lambda messages: b"".join(message.serialize() for message in messages),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("attitude", ["NAV-ATT", "NAV-RELPOSNED", "NAV-PVT"])
def test_u_blox_messages_are_the_drive(form, attitude, tmp_path):
    sent = [pyubx2.UBXReader.parse(message.serialize()) for message in ubx_messages(attitude)]
    (tmp_path / "log.ubx").write_bytes(FORMS[form](sent))
    got = read({"ubx": "log.ubx", "lever_arm_m": LEVER}, tmp_path, None)
    check(got, metres=2e-3)
    assert got.noise["position_m"] == pytest.approx(0.014)
    assert np.degrees(got.noise["heading_rad"]) == pytest.approx(0.3, abs=1e-4)
    if attitude == "NAV-ATT":
        assert np.degrees(got.noise["roll_pitch_rad"]) == pytest.approx(
            np.sqrt((0.3**2 + 0.4**2) / 2), abs=1e-4
        )


def test_u_blox_messages_that_are_damaged_are_left_out_and_counted(tmp_path, caplog):
    sent = [str(pyubx2.UBXReader.parse(message.serialize())) for message in ubx_messages(position="NAV-PVT")]
    sent[4] = sent[4].replace("iTOW=", "iTOW=x")
    sent[7] = sent[7][:50]
    (tmp_path / "log.txt").write_text("\n".join(["log begins", *sent]))
    got = read({"ubx": "log.txt", "lever_arm_m": LEVER}, tmp_path)
    assert len(got.trajectory.stamp_s) >= 398
    assert "left out 1 damaged messages" in caplog.text
    (tmp_path / "log.txt").write_text("nothing\n")
    with pytest.raises(DriveError, match=r"holds no NAV-PVT, .*; log NAV-PVT and NAV-ATT"):
        read({"ubx": "log.txt", "lever_arm_m": LEVER}, tmp_path)


def test_leap_seconds_are_those_of_their_time():
    assert leap_seconds(STAMP_S[0]) == 18
    assert leap_seconds(1483228799.0) == 17  # 31 December 2016
