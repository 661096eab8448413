"""How many positions RTK has fixed: readers say what their source says, and None where it says nothing."""

import numpy as np
import pytest

from tests.drive.bags import Messages
from tests.drive.test_nmea import gga, hdt, rmc
from tests.drive.test_nmea import log as nmea_log
from tests.drive.test_nmea import read as read_nmea_log
from tests.drive.test_poses import LEVER_M
from tests.drive.test_trajectory_files import FORMS, LEVER, SOLUTIONS, heading_csv, read, ubx_messages
from v2hdm.io.importers.bag.messages import position_row, readings_of
from v2hdm.records import Reception

FIX = "sensor_msgs/msg/NavSatFix"
FIXED, FLOAT, SINGLE = (2, 0.015), (2, 0.4), (0, 2.5)
"""Status and sigma, m, of a NavSatFix."""


def counted(got):
    """All that the source says, from its first position to its last."""
    return got.fixes.between(-np.inf, np.inf, got.geoid_m)


@pytest.mark.parametrize(
    ("sentence", "quality"), [(gga, (4, 5)), (gga, (4, 1))], ids=["float", "single"]
)  # fmt: skip
def test_an_nmea_log_counts_the_quality_of_its_positions(sentence, quality, tmp_path):
    fixed, other = quality
    lines = nmea_log(
        lambda t, at, yaw, k: [sentence(t, at, other if k % 4 == 0 else fixed), rmc(t), hdt(yaw)]
    )
    got = read_nmea_log(lines, tmp_path)
    assert counted(got) == Reception(401, 300)
    first_s = got.fixes.stamp_s[0]
    assert got.fixes.between(first_s, first_s + 3.05, None) == Reception(31, 23)


def test_a_solution_of_rtklib_counts_its_quality(tmp_path):
    text = SOLUTIONS["no sigmas"].replace("1 12\n", "2 12\n", 7).replace("1 12\n", "5 12\n", 3)
    (tmp_path / "rover.pos").write_text(text)
    content = {"pos": "rover.pos", "heading_file": heading_csv(tmp_path), "lever_arm_m": LEVER}
    whole = counted(read(content, tmp_path))
    assert whole.positions - whole.rtk_fixed == 10


@pytest.mark.parametrize("form", FORMS)
def test_u_blox_messages_count_their_carrier_solution(form, tmp_path):
    pyubx2 = pytest.importorskip("pyubx2")
    messages = ubx_messages()
    for message in [m for m in messages if m.identity == "NAV-PVT"][:6]:
        payload = {key: value for key, value in vars(message).items() if not key.startswith("_")}
        at = messages.index(message)
        messages[at] = pyubx2.UBXMessage("NAV", "NAV-PVT", pyubx2.GET, **payload | {"carrSoln": 1})
    sent = [pyubx2.UBXReader.parse(message.serialize()) for message in messages]
    (tmp_path / "log.ubx").write_bytes(FORMS[form](sent))
    whole = counted(read({"ubx": "log.ubx", "lever_arm_m": LEVER}, tmp_path, None))
    assert whole.positions - whole.rtk_fixed == 6


@pytest.mark.parametrize(("header", "fixed"), [("quality", 2), ("sigma_m", None)])
def test_a_table_counts_its_quality_and_says_nothing_without(header, fixed, tmp_path):
    rows = [
        f"{k},{2.0 * k},0,1.8,0,{value}" for k, value in enumerate((4, 4, 5, 0.02 if fixed is None else 1))
    ]
    (tmp_path / "rtk.csv").write_text("\n".join([f"stamp_s,x_m,y_m,z_m,yaw_rad,{header}", *rows]))
    content = {"csv": "rtk.csv", "lever_arm_m": list(LEVER_M), "max_sigma_m": 10.0}
    assert counted(read(content, tmp_path)) == Reception(4, fixed)


@pytest.mark.parametrize(
    ("fixes", "expected"),
    [
        ([FIXED] * 8 + [FLOAT] * 2, [True] * 8 + [False] * 2),
        ([FIXED, SINGLE, FIXED], [True, False, True]),
        ([SINGLE] * 3, [False] * 3),
        ([(2, 0.0)] * 3, [True] * 3),  # no covariance: the status is all there is
        ([(0, 0.01)] * 3, None),  # a driver that always writes the status of a plain position
        ([(1, 0.05)] * 3, None),
    ],
    ids=["float", "single", "none", "no covariance", "no status", "augmented"],
)
def test_a_navsatfix_counts_its_status_with_its_sigma(fixes, expected):
    messages = [Messages().fix(1.0, (53.5, 9.0, 5.0), status, sigma_m, "gnss") for status, sigma_m in fixes]
    rows = np.array([position_row(FIX, fix) for fix in messages])
    got = readings_of(FIX, (np.arange(len(rows)) / 10, rows), None, "here").is_fixed
    assert (None if got is None else got.tolist()) == expected
