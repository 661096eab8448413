"""Mistakes undone one at a time explain why no ground matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import camera, drive, poses
from tests.verdict.test_ground_findings import estimate
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import undistort_points
from v2hdm.ground import GroundEstimate, GroundOptions, GroundStatus, Reading
from v2hdm.records import Drive
from v2hdm.verdict.inputs import ground as ground_checks
from v2hdm.verdict.inputs.ground import find_cause, scaled, upside_down

LOST = replace(estimate(), status=GroundStatus.NO_MATCH, shares={Reading.AS_GIVEN: 0.0})


def test_undoing_feet_shortens_the_path() -> None:
    metres = scaled(drive(poses()), 0.3048)
    assert metres.images[-1].map_from_vehicle[:3, 3] == pytest.approx(
        0.3048 * drive(poses()).images[-1].map_from_vehicle[:3, 3]
    )
    assert metres.trajectory is not None
    assert metres.trajectory.map_from_vehicle[-1, :3, :3] == pytest.approx(
        poses().map_from_vehicle[-1, :3, :3]
    )


def test_a_pixel_of_an_image_upside_down_shows_the_ground_of_the_opposite_pixel() -> None:
    lens = replace(camera().info, distortion=(-0.1, 0.02, 0.003, -0.002, 0.0))
    one = replace(drive(poses()), cameras={"front": replace(camera(), info=lens)})
    right, turned = one.cameras["front"], upside_down(one).cameras["front"]
    points_px = np.array([[300.0, 500.0], [700.0, 650.0]])
    opposite_px = np.array([1279.0, 719.0]) - points_px
    seen = apply_homography(right.ipm["estimated"], undistort_points(right.info, points_px))
    also = apply_homography(turned.ipm["estimated"], undistort_points(turned.info, opposite_px))
    assert also == pytest.approx(seen, abs=1e-6)


def test_the_first_mistake_whose_undoing_makes_the_ground_match_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def only_in_metres(tried: Drive, name: str, options: GroundOptions) -> GroundEstimate:
        length_m = tried.images[-1].map_from_vehicle[0, 3]
        return estimate() if length_m < 0.5 * drive(poses()).images[-1].map_from_vehicle[0, 3] else LOST

    monkeypatch.setattr(ground_checks, "estimate_ground", only_in_metres)
    says = find_cause(drive(poses()), {"front": LOST})
    assert says is not None
    assert "feet" in says


def test_nothing_is_tried_where_a_camera_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_checks, "estimate_ground", None)
    assert find_cause(drive(poses()), {"front": LOST, "rear": estimate("rear")}) is None
    assert find_cause(drive(poses()), {}) is None
