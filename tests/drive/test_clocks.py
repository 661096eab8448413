"""Clocks that are usually mixed up are named."""

import re

import numpy as np
import pytest

from tests.drive.example import description, make_drive
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive
from v2hdm.io.trajectory import known_offset, why_no_pose
from v2hdm.verdict.inputs.poses import Motion
from v2hdm.verdict.inputs.recording import check_clocks


@pytest.mark.parametrize(
    ("offset_s", "says"),
    [
        (18.0, r"18 s ahead of the poses': one is GPS time, the other UTC .*; .*offset_s: 18 under"),
        (-18.0, r"18 s behind the poses': one is GPS time, the other UTC .*; .*offset_s: -18 under"),
        (19.0, "one is TAI, the other GPS time"),
        (37.2, "one is TAI .PTP., the other UTC"),
        (7200.0, "7200 s ahead of the poses': time zones apart"),
        (-19800.0, "19800 s behind the poses': time zones apart"),
        (-315964782.0, "GPS time since 1980"),
        (619315200.0, "1024 weeks early"),
    ],
)
def test_the_difference_of_two_clocks_is_named(offset_s, says):
    poses = 1.7e9 + np.arange(0.0, 12.0, 0.1)
    images = poses[::2] + offset_s
    assert re.search(says, known_offset(images, poses))
    if abs(offset_s) > 12:
        assert re.search(says, why_no_pose(images, poses, 0.5))


@pytest.mark.parametrize("ends_s", [(0.0, 0.0), (18.0, -5.0), (25.0, 25.0), (18.0, 60.0)])
def test_other_differences_have_no_name(ends_s):
    assert known_offset((ends_s[0], 100 + ends_s[1]), (0.0, 100.0)) is None


def test_the_check_names_gps_time_where_poses_and_images_overlap_in_part(tmp_path):
    make_drive(tmp_path, stamps=(118.0, 128.0, 138.0, 148.0, 158.0, 167.5))
    rows = [f"{100 + 0.1 * n:.1f} {n / 2} 0 0 0 0 0 1" for n in range(496)]
    (tmp_path / "poses.tum").write_text("\n".join(rows))
    drive = read_drive(tmp_path)
    findings = {finding.check: finding for finding in check_clocks(drive, Motion.of(drive))}
    assert "18 s ahead of the poses': one is GPS time, the other UTC" in findings["images without pose"].says
    with description(tmp_path) as content:
        content["poses"] = {"tum": "poses.tum", "offset_s": 18}
    assert not any(read_drive(tmp_path).unposed.values())


def test_a_drive_of_gps_seconds_without_any_overlap_is_refused_by_its_cause(tmp_path):
    make_drive(tmp_path, stamps=(118.05, 118.95, 119.95))
    with pytest.raises(DriveError, match="one is GPS time, the other UTC"):
        read_drive(tmp_path)
