"""The statements of a NavSatFix and a CameraInfo count as their definitions say."""

import math

import numpy as np
import pytest

from tests.drive.bags import Messages
from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import info_of
from v2hdm.io.importers.bag.messages import heading_row, position_row, readings_of
from v2hdm.records import CameraInfo

FIX = "sensor_msgs/msg/NavSatFix"


@pytest.mark.parametrize(
    ("status", "expected_m"), [(-2, math.inf), (-1, math.inf), (0, 3), (1, 1), (2, 0.02)]
)
@pytest.mark.parametrize(("kind", "variance"), [(0, 0), (0, 1e-4), (1, 0), (2, -1), (3, math.nan)])
def test_a_fix_that_does_not_state_its_sigma_has_that_of_its_status(status, expected_m, kind, variance):
    fix = Messages().fix(1.0, (53.5, 9.0, 5.0), status, 0.0, "gnss")
    fix.position_covariance_type = kind
    fix.position_covariance[[0, 4, 8]] = variance
    assert position_row(FIX, fix)[3] == expected_m


@pytest.mark.parametrize(("status", "expected_m"), [(-2, 0.5), (-1, math.inf), (0, 0.5), (2, 0.5)])
def test_a_stated_sigma_counts_but_without_a_position(status, expected_m):
    fix = Messages().fix(1.0, (53.5, 9.0, 5.0), status, 0.5, "gnss")
    assert position_row(FIX, fix)[3] == expected_m


def positions_of(altitudes):
    fixes = [Messages().fix(1.0, (53.5, 9.0, height_m), 2, 0.02, "gnss") for height_m in altitudes]
    return np.arange(len(fixes)) / 10, np.array([position_row(FIX, fix) for fix in fixes])


@pytest.mark.parametrize(
    ("altitudes", "expected"), [([math.nan] * 3, [0, 0, 0]), ([5, math.nan, 6], [5, math.nan, 6])]
)
def test_fixes_without_any_altitude_are_flat(altitudes, expected, caplog):
    got = readings_of(FIX, positions_of(altitudes), None, "here")
    np.testing.assert_array_equal(got.points[:, 2], expected)
    assert ("no heights" in caplog.text) == (expected[0] == 0)


IMU = "sensor_msgs/msg/Imu"


def headings_of(change, count=10):
    """Rows of level Imu messages; ``change`` gets the first one."""
    messages = [Messages().imu(k / 10, np.eye(3), "imu") for k in range(count)]
    change(messages)
    return np.arange(count) / 10, np.array([heading_row(IMU, message) for message in messages])


def _zero(messages):
    messages[0].orientation.w = 0.0


def _nan(messages):
    messages[0].orientation.w = math.nan


def _unmeasured(messages):
    messages[0].orientation_covariance[0] = -1


@pytest.mark.parametrize("change", [_zero, _nan, _unmeasured])
def test_orientations_that_were_not_measured_are_left_out_and_counted_or_refused(change, caplog):
    got = readings_of(FIX, positions_of([5.0] * 10), headings_of(change), "here")
    np.testing.assert_allclose(got.attitudes.stamp_s, np.arange(1, 10) / 10)
    assert "left out 1 of 10 orientations: not measured" in caplog.text
    with pytest.raises(DriveError, match="here: all quaternions of its heading are 0 or nan, or their cov"):
        readings_of(FIX, positions_of([5.0]), headings_of(change, 1), "here")


@pytest.mark.parametrize(
    ("variance", "sigma_rad"), [(1e6, math.nan), (99999.0, math.nan), (4e-6, 2e-3), (0.0, math.nan)]
)
def test_a_variance_that_stands_for_an_unknown_heading_is_no_sigma(variance, sigma_rad):
    def change(messages):
        messages[0].orientation_covariance[8] = variance

    assert headings_of(change)[1][0, 4] == pytest.approx(sigma_rad, nan_ok=True)


def test_a_region_of_the_whole_image_is_no_crop():
    info = CameraInfo("cam", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))
    message = Messages().info(1.0, info, "cam")
    message.roi.width, message.roi.height = 64, 48
    got = info_of(message, "cam", "here").info
    assert (got.width, got.height) == (64, 48)
    np.testing.assert_array_equal(got.intrinsic, info.intrinsic)
    message.roi.height = 24
    with pytest.raises(DriveError, match="binned or cropped"):
        info_of(message, "cam", "here")
