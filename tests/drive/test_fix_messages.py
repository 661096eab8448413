"""What a NavSatFix and a CameraInfo state counts as their definitions say."""

import math

import numpy as np
import pytest

from tests.drive.bags import Messages
from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import info_of
from v2hdm.io.importers.bag.messages import position_row
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


def test_a_region_of_the_whole_image_is_no_crop():
    info = CameraInfo("cam", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))
    message = Messages().info(1.0, info, "cam")
    message.roi.width, message.roi.height = 64, 48
    got = info_of(message, "cam", "here")
    assert (got.width, got.height) == (64, 48)
    np.testing.assert_array_equal(got.intrinsic, info.intrinsic)
    message.roi.height = 24
    with pytest.raises(DriveError, match="binned or cropped"):
        info_of(message, "cam", "here")
