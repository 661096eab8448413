"""Ground that is no plane as far as the cameras look is told with its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import drive, poses, raised
from v2hdm.records import FloatArray, Road
from v2hdm.verdict import Status
from v2hdm.verdict.inputs.drive import check_road


def road(height_m: FloatArray) -> Road:
    """A road of 60 m eastwards with heights at every metre."""
    slope = np.column_stack([np.gradient(height_m), np.zeros(61)])
    return Road(np.column_stack([np.arange(61.0), np.zeros(61)]), height_m, slope)


def test_a_long_grade_is_plane() -> None:
    assert not raised(check_road(replace(drive(poses()), road=road(46.2 + 0.05 * np.arange(61.0)))))


def test_a_drive_recorded_as_plane_passes() -> None:
    assert not raised(check_road(drive(poses())))


@pytest.mark.parametrize(("grade", "status"), [(0.015, Status.WARN), (0.12, Status.FAIL)])
def test_the_foot_of_a_ramp_is_told_with_its_place(grade: float, status: Status) -> None:
    ramp = road(grade * np.maximum(np.arange(61.0) - 30, 0))
    (found,) = check_road(replace(drive(poses()), road=ramp))
    assert found.status is status
    assert found.value == pytest.approx(np.rad2deg(grade), rel=0.2)
    place_m = float(found.says.split(" m along")[0])
    assert 15 < place_m < 45
