"""Images of a camera whose clock is off get the poses of when they were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.drive.example import make_drive
from v2hdm.association.sightings import frames_of
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive, with_clock_offsets


def test_images_taken_later_than_stamped_lie_further_along_the_route(tmp_path: Path) -> None:
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    late = with_clock_offsets(drive, {"front": 0.1}, 0.5)
    before = [image for image in drive.images if image.camera == "front"]
    after = [image for image in late.images if image.camera == "front"]
    moved_m = [
        b.map_from_vehicle[0, 3] - a.map_from_vehicle[0, 3] for a, b in zip(before, after, strict=True)
    ]
    np.testing.assert_allclose(moved_m, 0.5, atol=1e-9)  # 5 m/s for 0.1 s
    assert [image.stamp_s for image in after] == [image.stamp_s for image in before]


def test_cameras_of_one_stamp_but_two_clocks_are_frames_of_their_own(tmp_path: Path) -> None:
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    late = with_clock_offsets(drive, {"front": 0.1}, 0.5)
    assert len(frames_of(late).stamp_s) == 2 * len(frames_of(drive).stamp_s)


def test_without_an_offset_nothing_changes(tmp_path: Path) -> None:
    make_drive(tmp_path)
    drive = read_drive(tmp_path)
    same = with_clock_offsets(drive, {}, 0.5)
    assert [image.path for image in same.images] == [image.path for image in drive.images]


def test_an_offset_beyond_the_recorded_poses_is_refused_by_the_cameras_name(tmp_path: Path) -> None:
    make_drive(tmp_path)
    with pytest.raises(DriveError, match="'front'"):
        with_clock_offsets(read_drive(tmp_path), {"front": 60.0}, 0.5)
