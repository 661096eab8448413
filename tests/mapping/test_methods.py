"""The four methods on a made-up yard: markings found, none invented, extrinsics recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import MATCH_M, Scene, SceneOptions, make_scene, match, rotation_error_deg
from v2hdm.errors import ConfigError, MappingError
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneOptions(length_m=100.0, seed=21))


@pytest.fixture(scope="module")
def results(scene: Scene) -> dict[str, MethodResult]:
    return run_methods(scene.drive, scene.detections, ("front", "rear"))


def test_every_method_ran(results: dict[str, MethodResult]) -> None:
    assert list(results) == ["CNI", "ENI", "Opt", "ONI"]


def test_the_optimised_map_holds_every_marking_once_and_no_other(
    scene: Scene, results: dict[str, MethodResult]
) -> None:
    mapped = results["Opt"].hd_map
    pairs, rmse_m = match(mapped, scene.markings, MATCH_M)
    assert len(pairs) == len(mapped.markings)
    assert len({b for _, b in pairs}) == len(pairs)
    assert len(pairs) >= 0.98 * len(scene.markings)
    assert rmse_m < 0.015


def test_the_extrinsics_are_recovered(scene: Scene, results: dict[str, MethodResult]) -> None:
    for name, calibration in results["Opt"].calibrations.items():
        truth = scene.cam_from_vehicle[name]
        assert rotation_error_deg(calibration.cam_from_vehicle, truth) < 0.06
        centre = -calibration.cam_from_vehicle[:3, :3].T @ calibration.cam_from_vehicle[:3, 3]
        assert np.linalg.norm(centre + truth[:3, :3].T @ truth[:3, 3]) < 0.02


def test_corner_errors_are_as_large_as_their_covariances_say(
    scene: Scene, results: dict[str, MethodResult]
) -> None:
    mapped = results["Opt"].hd_map
    pairs, _ = match(mapped, scene.markings, MATCH_M)
    normalised = []
    for a, b in pairs:
        estimate, true = mapped.markings[a], scene.markings[b].corners_map
        best = min(
            (np.roll(true, s, axis=0) for s in range(4)),
            key=lambda t: np.sum((estimate.corners_map - t) ** 2),
        )
        error = (estimate.corners_map - best).ravel()
        assert estimate.covariance_m2 is not None
        normalised.append(error @ np.linalg.solve(estimate.covariance_m2, error) / 8)
    assert 0.2 < np.mean(normalised) < 2.0


def test_reprojection_improves_by_the_optimisation(results: dict[str, MethodResult]) -> None:
    optimised = results["Opt"]
    assert optimised.reprojection_rmse_px is not None
    assert optimised.initial_reprojection_rmse_px is not None
    assert optimised.reprojection_rmse_px < 0.5 < 5.0 < optimised.initial_reprojection_rmse_px


def test_the_naive_map_is_good_under_a_good_ipm_and_bad_under_a_bad_one(
    scene: Scene, results: dict[str, MethodResult]
) -> None:
    _, calibrated_m = match(results["CNI"].hd_map, scene.markings, 2.0)
    _, estimated_m = match(results["ENI"].hd_map, scene.markings, 2.0)
    _, optimised_m = match(results["ONI"].hd_map, scene.markings, 2.0)
    assert calibrated_m < 0.06
    assert estimated_m > 0.2
    assert optimised_m < 1.2 * calibrated_m


def test_each_exclusion_has_a_place_and_a_reason(results: dict[str, MethodResult]) -> None:
    for exclusion in results["Opt"].excluded:
        assert np.isfinite(exclusion.position_map).all()
        assert exclusion.reason


def test_lanes_follow_their_lines(scene: Scene, results: dict[str, MethodResult]) -> None:
    solid = next(lane for lane in scene.lanes if lane.kind == "lane_line").points_map
    mapped = np.concatenate(
        [lane.points_map for lane in results["Opt"].hd_map.lanes if lane.kind == "lane_line"]
    )
    distance = np.linalg.norm(mapped[:, None] - solid[None], axis=2)
    assert np.quantile(distance.min(axis=1), 0.95) < 0.3
    assert (distance.min(axis=0) < 0.3).mean() > 0.9


def test_a_straight_street_with_one_camera_and_only_dashes_gives_the_yaw() -> None:
    street = make_scene(
        SceneOptions(length_m=90.0, turns=False, dashes_only=True, cameras=("front",), step_m=1.2, seed=22)
    )
    found = run_methods(street.drive, street.detections, ("front",))["Opt"]
    pairs, _ = match(found.hd_map, street.markings, MATCH_M)
    assert len(pairs) == len(found.hd_map.markings) >= 22
    estimate = found.calibrations["front"].cam_from_vehicle
    assert rotation_error_deg(estimate, street.cam_from_vehicle["front"]) < 0.08


def test_a_camera_that_saw_nothing_keeps_its_extrinsic(scene: Scene) -> None:
    front_only = [found for found in scene.detections if scene.drive.images[found.image].camera == "front"]
    found = run_methods(scene.drive, front_only, ("front", "rear"))["Opt"]
    assert found.calibrations["rear"].covariance is None
    assert found.calibrations["front"].covariance is not None


def test_a_drive_without_a_marking_says_so(scene: Scene) -> None:
    nothing = [replace(found, markings=()) for found in scene.detections]
    with pytest.raises(MappingError, match="no marking was found"):
        run_methods(scene.drive, nothing, ("front",))


def test_markings_seen_once_each_say_so(scene: Scene) -> None:
    with pytest.raises(MappingError, match="two images"):
        run_methods(scene.drive, scene.detections[:2], ("front",))


def test_an_unknown_camera_is_named(scene: Scene) -> None:
    with pytest.raises(MappingError, match=r"'left'.*front, rear"):
        run_methods(scene.drive, scene.detections, ("left",))


def test_an_option_out_of_range_is_named(scene: Scene) -> None:
    with pytest.raises(ConfigError, match=r"mapping\.max_range_m"):
        run_methods(scene.drive, scene.detections, ("front",), MappingOptions(max_range_m=0.0))


def test_where_no_marking_lies_inside_the_regions_of_interest_the_naive_maps_are_empty(scene: Scene) -> None:
    tiny = np.array([[6.0, -0.05], [6.1, -0.05], [6.1, 0.05], [6.0, 0.05]])
    cameras = {
        name: replace(camera, roi_vehicle=tiny * np.sign(camera.roi_vehicle[:, 0].mean()))
        for name, camera in scene.drive.cameras.items()
    }
    found = run_methods(replace(scene.drive, cameras=cameras), scene.detections, ("front", "rear"))
    assert [len(found[name].hd_map.markings) for name in ("CNI", "ENI", "ONI")] == [0, 0, 0]
    assert found["Opt"].hd_map.markings
