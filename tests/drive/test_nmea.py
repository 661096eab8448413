"""Logs of receivers as they are written: order, rates, two receivers, damaged and lacking fields."""

import logging

import numpy as np
import pytest

from tests.drive.test_poses import LEVER_M, ORIGIN, antenna, checksum, nmea_angle, place
from v2hdm.errors import DriveError
from v2hdm.io.importers.nmea import nmea_readings
from v2hdm.io.importers.poses import read_poses

START_S = 1715934630.0
"""2024-05-17 08:30:30 UTC."""

RATE_HZ = 10.0


def bend(count=401):
    """Times, places of the vehicle and headings (rad from north) of a drive with bends, 4 to 8 m/s."""
    t = np.arange(count) / RATE_HZ
    yaw = 0.9 * np.sin(0.35 * t)
    speed = 6.0 + 2.0 * np.sin(0.8 * t)
    step = speed / RATE_HZ
    middle = np.interp(t[:-1] + 0.5 / RATE_HZ, t, yaw)
    east = np.concatenate([[0.0], np.cumsum(step[:-1] * np.cos(middle))])
    north = np.concatenate([[0.0], np.cumsum(step[:-1] * np.sin(middle))])
    return START_S + t, np.column_stack([east, north, np.zeros(count)]), yaw


def hms(stamp_s):
    of_day = round(stamp_s - START_S + 30630, 3) % 86400
    return f"{int(of_day // 3600):02d}{int(of_day % 3600 // 60):02d}{of_day % 60:06.3f}"


def gga(stamp_s, where, quality=4, talker="GN", geoid="40.5", height=None):
    angles = f"{nmea_angle(where[0], 2, 'NS')},{nmea_angle(where[1], 3, 'EW')}"
    high = f"{where[2] - 40.5:.4f}" if height is None else height
    return checksum(f"{talker}GGA,{hms(stamp_s)},{angles},{quality},12,0.8,{high},M,{geoid},M,1.0,0000")


def rmc(stamp_s, status="A", day="170524"):
    return checksum(f"GNRMC,{hms(stamp_s)},{status},,,,,,,{day},,")


def heading_of(yaw):
    return np.degrees(np.pi / 2 - yaw) % 360


def hdt(yaw, talker="GN"):
    return checksum(f"{talker}HDT,{heading_of(yaw):.6f},T")


def between(stamp_s, times, yaw):
    return float(np.interp(stamp_s, times, yaw))


def log(make):
    """The lines of a log of the bend; ``make`` gives the sentences of one epoch."""
    stamp_s, points, yaw = bend()
    places = place(antenna(points, yaw))
    return [line for k in range(len(stamp_s)) for line in make(stamp_s[k], places[k], yaw[k], k)]


def read(lines, root, **keys):
    (root / "log.nmea").write_text("\r\n".join(lines) + "\r\n")
    content = {"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)} | keys
    return read_poses(content, root, ORIGIN, 0.5, "drive.yaml: poses", None)


def worst_deg(got):
    stamp_s, _, yaw = bend()
    poses = got.trajectory.map_from_vehicle
    off = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - np.interp(got.trajectory.stamp_s, stamp_s, yaw)
    return np.degrees(np.abs((off + np.pi) % (2 * np.pi) - np.pi)).max()


STAMP_S, POINTS, YAW = bend()
ORDERS = {
    "after": lambda t, at, yaw, k: [gga(t, at), rmc(t), hdt(yaw)],
    "between": lambda t, at, yaw, k: [gga(t, at), hdt(yaw), rmc(t)],
    "before": lambda t, at, yaw, k: [hdt(yaw), gga(t, at), rmc(t)],
    "THS before": lambda t, at, yaw, k: [checksum(f"GNTHS,{heading_of(yaw):.6f},A"), gga(t, at), rmc(t)],
    "five behind": lambda t, at, yaw, k: [
        gga(t, at), *(hdt(between(t + 0.02 * n, STAMP_S, YAW)) for n in range(5)), rmc(t),
    ],
    "five before": lambda t, at, yaw, k: [
        *(hdt(between(t - 0.02 * n, STAMP_S, YAW)) for n in (4, 3, 2, 1, 0)), gga(t, at), rmc(t),
    ],
    "every third": lambda t, at, yaw, k: [gga(t, at), rmc(t)] + ([hdt(yaw)] if k % 3 == 0 else []),
}  # fmt: skip


@pytest.mark.parametrize("name", ORDERS)
def test_headings_belong_to_their_own_time_whatever_the_order_and_rate_or_the_doubt_is_told(
    name, tmp_path, caplog
):
    with caplog.at_level(logging.WARNING):
        off_deg = worst_deg(read(log(ORDERS[name]), tmp_path))
    # Between readings 0.3 s apart a heading that turns evenly is known to a tenth of a degree.
    assert off_deg < 0.2 or "its headings have no time" in caplog.text
    if name in ("after", "between", "before", "THS before", "every third"):
        assert off_deg < 0.2
        assert "no time" not in caplog.text


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("form", ["unix", "clock", "tag"])
def test_the_times_at_which_a_logger_got_sentences_tell_their_epoch(form, first, tmp_path, caplog):
    def stamped(line, at_s):
        day = at_s - START_S + 30630 + 7200
        clock = f"{int(day // 3600):02d}:{int(day % 3600 // 60):02d}:{day % 60:06.3f}"
        before = {"unix": f"{at_s:.3f} ", "clock": f"[2024-05-17 {clock}] ", "tag": f"\\c:{at_s:.3f}*5A\\"}
        return before[form] + line

    def epoch(t, at, yaw, k):
        behind = 0.0 if first else 0.01
        lines = [stamped(gga(t, at), t + 0.03), stamped(rmc(t), t + 0.031)]
        return (
            [stamped(hdt(yaw), t + 0.029), *lines]
            if first
            else [*lines, stamped(hdt(yaw), t + 0.03 + behind)]
        )

    stamp_s, points, yaw = (values[:50] for values in bend())
    places = place(antenna(points, yaw))
    lines = [line for k in range(50) for line in epoch(stamp_s[k], places[k], yaw[k], k)]
    assert worst_deg(read(lines, tmp_path)) < 0.01
    assert "no time" not in caplog.text


TIMED = {
    "KSXT": lambda t, at, yaw: checksum(
        f"KSXT,20240517{hms(t)},{at[1]:.9f},{at[0]:.9f},{at[2]:.4f},{heading_of(yaw):.4f},,,,,3,3,20,20,,,,,,,,"
    ),
    "AVR": lambda t, at, yaw: checksum(
        f"PTNL,AVR,{hms(t)},{(heading_of(yaw) + 180) % 360 - 180:+.4f},Yaw,0.1,Tilt,,,1.2,3,1.2,17"
    ),
    "VHD": lambda t, at, yaw: checksum(
        f"PTNL,VHD,{hms(t)},051724,{heading_of(yaw):.4f},0.0,0.1,0.0,1.2,0.0,3,07,2.4,M"
    ),
    "PASHR": lambda t, at, yaw: checksum(
        f"PASHR,{hms(t)},{heading_of(yaw):.4f},T,1.0,-2.0,0.0,0.1,0.2,0.05,2,1"
    ),
    "PSAT": lambda t, at, yaw: checksum(f"PSAT,HPR,{hms(t)},{heading_of(yaw):.4f},-2.0,1.0,N"),
    "HDG": lambda t, at, yaw: checksum(f"HCHDG,{(heading_of(yaw) - 3.5 + 1.0) % 360:.4f},1.0,W,3.5,E"),
}


@pytest.mark.parametrize("name", TIMED)
def test_headings_of_every_sentence_are_read(name, tmp_path):
    got = read(log(lambda t, at, yaw, k: [gga(t, at), TIMED[name](t, at, yaw), rmc(t)]), tmp_path)
    assert worst_deg(got) < 0.01
    sigmas = {"PASHR": 0.05, "HDG": 2.0}
    assert np.degrees(got.noise.get("heading_rad", np.nan)) == pytest.approx(
        sigmas.get(name, np.nan), nan_ok=True
    )
    if name == "PASHR":
        assert np.degrees(got.noise["roll_pitch_rad"]) == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 2))


def test_ksxt_alone_is_a_drive(tmp_path):
    got = read(log(lambda t, at, yaw, k: [TIMED["KSXT"](t, at, yaw)]), tmp_path)
    np.testing.assert_allclose(got.trajectory.map_from_vehicle[:, :3, 3], bend()[1], atol=2e-3)


def test_gns_and_ggk_are_positions(tmp_path):
    def gns(t, at, yaw, k):
        angles = f"{nmea_angle(at[0], 2, 'NS')},{nmea_angle(at[1], 3, 'EW')}"
        return [checksum(f"GNGNS,{hms(t)},{angles},RRNN,17,0.7,{at[2] - 40.5:.4f},40.5,1.0,0000"),
                TIMED["PASHR"](t, at, yaw), rmc(t)]  # fmt: skip

    def ggk(t, at, yaw, k):
        angles = f"{nmea_angle(at[0], 2, 'NS')},{nmea_angle(at[1], 3, 'EW')}"
        return [checksum(f"PTNL,GGK,{hms(t)},051724,{angles},3,12,1.2,EHT{at[2]:.4f},M"),
                TIMED["AVR"](t, at, yaw)]  # fmt: skip

    gns_noise = read(log(gns), tmp_path).noise
    assert gns_noise["position_m"] == pytest.approx(0.02)
    got = read(log(ggk), tmp_path)
    np.testing.assert_allclose(got.trajectory.map_from_vehicle[:, :3, 3], bend()[1], atol=1e-3)


def shifted(at, east_deg=2e-5):
    return (at[0], at[1] + east_deg, at[2])


def test_two_receivers_in_one_log_are_told_apart(tmp_path, caplog):
    def both(quality):
        return log(lambda t, at, yaw, k: [
            gga(t, at), gga(t, shifted(at), quality, "GP"), TIMED["PASHR"](t, at, yaw), rmc(t),
        ])  # fmt: skip

    with pytest.raises(DriveError, match=r"two receivers, GN and GP, 1\.\d m apart: add talker: GN or GP"):
        read(both(4), tmp_path)
    poses = read(both(4), tmp_path, talker="GN").trajectory.map_from_vehicle
    other = read(both(4), tmp_path, talker="GP").trajectory.map_from_vehicle
    np.testing.assert_allclose((other - poses)[:, 0, 3], 1.327, atol=0.01)
    chosen = read(both(1), tmp_path).trajectory.map_from_vehicle
    np.testing.assert_allclose(chosen, poses)
    assert "taking GN, which alone has RTK fixes" in caplog.text
    with pytest.raises(DriveError, match="no positions of talker 'GL'; it has: GN, GP"):
        read(both(4), tmp_path, talker="GL")
    alike = log(lambda t, at, yaw, k: [gga(t, at), gga(t, shifted(at)), TIMED["PASHR"](t, at, yaw), rmc(t)])
    with pytest.raises(DriveError, match="two receivers in one log, which call themselves alike"):
        read(alike, tmp_path)


def test_two_receivers_at_other_times_are_told_apart_and_one_that_changes_its_talker_is_not(tmp_path):
    def in_turns(t, at, yaw, k):
        position = gga(t, at) if k % 2 else gga(t, shifted(at), talker="GP")
        return [position, TIMED["PASHR"](t, at, yaw), rmc(t)]

    crossed = log(in_turns)
    with pytest.raises(DriveError, match="two receivers"):
        read(crossed, tmp_path)
    changing = log(lambda t, at, yaw, k: [
        gga(t, at, talker="GP" if k < 150 else "GN"), TIMED["PASHR"](t, at, yaw), rmc(t),
    ])  # fmt: skip
    assert len(read(changing, tmp_path).trajectory.stamp_s) == len(bend()[0])


def test_headings_of_another_receiver_are_not_taken(tmp_path):
    lines = log(lambda t, at, yaw, k: [
        gga(t, at), gga(t, shifted(at), 1, "GP"), hdt(yaw + 1.0, "GP"), hdt(yaw), rmc(t),
    ])  # fmt: skip
    assert worst_deg(read(lines, tmp_path)) < 0.01


def good(t, at, yaw, k):
    return [gga(t, at), hdt(yaw), rmc(t)]


@pytest.mark.parametrize("angle", [90.0, 1e9, np.nan])
@pytest.mark.parametrize("at_k", [0, 200, 400])
def test_one_wrong_heading_among_good_ones_is_left_out_and_counted(angle, at_k, tmp_path, caplog):
    def epoch(t, at, yaw, k):
        spoiled = checksum(f"GNHDT,{heading_of(yaw) + angle if angle < 360 else angle:.3f},T")
        return [gga(t, at), spoiled if k == at_k else hdt(yaw), rmc(t)]

    assert worst_deg(read(log(epoch), tmp_path)) < 0.2
    said = "left out 1 of 401 headings that jump" if angle == 90 else "left out 1 of 1203 damaged sentences"
    assert said in caplog.text


@pytest.mark.parametrize("at_k", [0, 200, 400])
def test_one_position_off_the_path_is_left_out_and_counted(at_k, tmp_path, caplog):
    lines = log(lambda t, at, yaw, k: good(t, shifted(at, 4e-4) if k == at_k else at, yaw, k))
    got = read(lines, tmp_path)
    assert len(got.trajectory.stamp_s) == 400
    assert "left out 1 of 401 positions that jump" in caplog.text


def test_a_step_that_stays_is_no_stray(tmp_path, caplog):
    lines = log(lambda t, at, yaw, k: good(t, shifted(at, 1e-5) if k > 200 else at, yaw, k))
    assert len(read(lines, tmp_path).trajectory.stamp_s) == 401
    assert "left out" not in caplog.text


def test_sentences_that_are_cut_lack_a_sum_or_share_a_line_are_left_out_and_counted(tmp_path, caplog):
    lines = log(good)
    lines[30] = lines[30][:40] + lines[31]  # cut, and the next behind it
    lines[31] = ""
    lines[60] = lines[60].partition("*")[0]  # cut at its sum
    lines[90] = lines[90][:20] + "9" + lines[90][21:]
    lines.insert(5, "\x00\xb5b$ garbage \x01")
    lines.insert(9, "!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*23")
    got = read(lines, tmp_path)
    assert len(got.trajectory.stamp_s) == 398
    assert "left out 3 of 1203 damaged sentences" in caplog.text


def test_mixed_line_ends_and_utf_16_are_fine(tmp_path):
    lines = log(good)
    content = {"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}
    mixed = "".join(line + ("\r\n", "\n", "\r", "\r\r\n")[k % 4] for k, line in enumerate(lines))
    for data in (mixed.encode(), mixed.encode("utf-16")):
        (tmp_path / "log.nmea").write_bytes(data)
        got = read_poses(content, tmp_path, ORIGIN, 0.5, "here", None)
        assert len(got.trajectory.stamp_s) == 401


def test_logs_without_any_checksum_are_read(tmp_path):
    assert len(read([line.partition("*")[0] for line in log(good)], tmp_path).trajectory.stamp_s) == 401


def test_a_missing_geoid_here_and_there_is_that_of_the_others(tmp_path):
    lines = log(lambda t, at, yaw, k: [gga(t, at, geoid="" if k % 7 == 3 else "40.5"), hdt(yaw), rmc(t)])
    heights = read(lines, tmp_path).trajectory.map_from_vehicle[:, 2, 3]
    np.testing.assert_allclose(heights, 0.0, atol=1e-3)


def test_positions_without_a_height_are_flat_or_left_out(tmp_path, caplog):
    lines = log(lambda t, at, yaw, k: [gga(t, at, height=""), hdt(yaw), rmc(t)])
    assert len(read(lines, tmp_path).trajectory.stamp_s) == 401
    assert "no heights; taken as 0 m" in caplog.text
    some = log(lambda t, at, yaw, k: [gga(t, at, height="" if k == 9 else None), hdt(yaw), rmc(t)])
    assert len(read(some, tmp_path).trajectory.stamp_s) == 400


def test_sigmas_of_gst_hold_before_and_behind_the_position_and_zeros_say_nothing():
    def gst(t, sigma):
        return checksum(f"GNGST,{hms(t)},1.0,,,,{sigma},{sigma},0.02")

    for first in (True, False):
        lines = log(lambda t, at, yaw, k, first=first: (
            [gst(t, 0.03), gga(t, at), rmc(t)] if first else [gga(t, at), rmc(t), gst(t, 0.03)]
        ))  # fmt: skip
        np.testing.assert_allclose(nmea_readings(lines, "log").sigma_m, 0.03)
    zeros = log(lambda t, at, yaw, k: [gga(t, at, quality=1), rmc(t), gst(t, "0.000")])
    np.testing.assert_allclose(nmea_readings(zeros, "log").sigma_m, 3.0)


def test_the_date_is_that_of_fixes_and_holds_across_midnight():
    late = [
        line
        for n in range(20)
        for line in (
            checksum(f"GNRMC,{hms(START_S + 55765 + n)},{'V' if n < 8 else 'A'},,,,,,,"
                     f"{'060180' if n < 8 else '170524' if n < 5 else '180524' if n >= 5 else ''},,"),
            gga(START_S + 55765 + n, (53.5, 9.9, 45.0)),
        )
    ]  # fmt: skip
    stamp_s = nmea_readings(late, "log").stamp_s
    # 08:30:30 and 15:29:25 are 23:59:55.
    np.testing.assert_allclose(stamp_s, START_S + 55765 + np.arange(20))


def test_without_a_date_that_of_the_images_holds(tmp_path):
    lines = [line for line in log(good) if "RMC" not in line]
    (tmp_path / "log.nmea").write_text("\n".join(lines))
    content = {"nmea": "log.nmea", "lever_arm_m": list(LEVER_M)}
    got = read_poses(content, tmp_path, ORIGIN, 0.5, "here", None, near_s=START_S + 9.0)
    np.testing.assert_allclose(got.trajectory.stamp_s[0], START_S)


@pytest.mark.parametrize("image_s", [2.0, 3000.0, 43000.0])
def test_a_log_from_before_midnight_without_a_date_belongs_to_images_from_behind_it(image_s):
    """The log begins at 23:59:55; the images' middle is ``image_s`` behind its first sentence."""
    begin_s = START_S + 55765
    lines = [gga(begin_s + n, (53.5, 9.9, 45.0)) for n in range(20)]
    stamp_s = nmea_readings(lines, "log", near_s=begin_s + image_s).stamp_s
    np.testing.assert_allclose(stamp_s, begin_s + np.arange(20))
