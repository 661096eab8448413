"""The four methods on a made-up yard: all at once, marking by marking, through kornia."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.mapping.scene import MATCH_M, SceneOptions, make_scene, match, rotation_error_deg
from v2hdm.association.ground import locate
from v2hdm.association.sightings import collect_sightings
from v2hdm.errors import MappingError
from v2hdm.geometry import ipm, tensors
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import initial_rig
from v2hdm.mapping.options import MappingOptions

CAMERAS = ("front", "rear")


@pytest.fixture(scope="module")
def short_scene():
    return make_scene(SceneOptions(length_m=40.0, seed=21))


@pytest.fixture(scope="module")
def scene():
    return make_scene(SceneOptions(length_m=100.0, seed=21))


@pytest.fixture(scope="module")
def results(scene):
    return run_methods(scene.drive, scene.detections, ("front", "rear"))


def test_the_optimised_map_holds_every_marking_once_and_no_other(scene, results):
    mapped = results["Opt"].hd_map
    pairs, rmse_m = match(mapped, scene.markings, MATCH_M)
    assert len(pairs) == len(mapped.markings)
    assert len({b for _, b in pairs}) == len(pairs)
    assert len(pairs) >= 0.98 * len(scene.markings)
    assert rmse_m < 0.015


def test_the_extrinsics_are_recovered(scene, results):
    for name, calibration in results["Opt"].calibrations.items():
        truth = scene.cam_from_vehicle[name]
        assert rotation_error_deg(calibration.cam_from_vehicle, truth) < 0.06
        centre = -calibration.cam_from_vehicle[:3, :3].T @ calibration.cam_from_vehicle[:3, 3]
        assert np.linalg.norm(centre + truth[:3, :3].T @ truth[:3, 3]) < 0.02


def test_each_camera_alone_finds_its_mounting_and_the_markings_that_it_saw(scene, results):
    alone = results["Opt"].alone
    assert set(alone) == {"front", "rear"}
    for name, result in alone.items():
        assert result.cameras == (name,)
        truth = scene.cam_from_vehicle[name]
        assert rotation_error_deg(result.calibrations[name].cam_from_vehicle, truth) < 0.1
        pairs, rmse_m = match(result.hd_map, scene.markings, MATCH_M)
        assert len(pairs) == len(result.hd_map.markings) > 0.8 * len(scene.markings)
        assert rmse_m < 0.03


def test_corner_errors_are_as_large_as_their_covariances_say(scene, results):
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


def test_reprojection_improves_by_the_optimisation(results):
    optimised = results["Opt"]
    assert optimised.reprojection_rmse_px is not None
    assert optimised.initial_reprojection_rmse_px is not None
    assert optimised.reprojection_rmse_px < 0.5 < 5.0 < optimised.initial_reprojection_rmse_px


def test_the_naive_map_is_good_under_a_good_ipm_and_bad_under_a_bad_one(scene, results):
    _, calibrated_m = match(results["CNI"].hd_map, scene.markings, 2.0)
    _, estimated_m = match(results["ENI"].hd_map, scene.markings, 2.0)
    _, optimised_m = match(results["ONI"].hd_map, scene.markings, 2.0)
    assert calibrated_m < 0.06
    assert estimated_m > 0.2
    assert optimised_m < 1.2 * calibrated_m


def test_lanes_follow_their_lines(scene, results):
    solid = next(lane for lane in scene.lanes if lane.kind == "lane_line").points_map
    mapped = np.concatenate(
        [lane.points_map for lane in results["Opt"].hd_map.lanes if lane.kind == "lane_line"]
    )
    distance = np.linalg.norm(mapped[:, None] - solid[None], axis=2)
    assert np.quantile(distance.min(axis=1), 0.95) < 0.3
    assert (distance.min(axis=0) < 0.3).mean() > 0.9


def test_a_straight_street_with_one_camera_and_only_dashes_gives_the_yaw():
    street = make_scene(
        SceneOptions(length_m=90.0, turns=False, dashes_only=True, cameras=("front",), step_m=1.2, seed=22)
    )
    optimum = run_methods(street.drive, street.detections, ("front",))["Opt"]
    pairs, _ = match(optimum.hd_map, street.markings, MATCH_M)
    assert len(pairs) == len(optimum.hd_map.markings) >= 22
    estimate = optimum.calibrations["front"].cam_from_vehicle
    assert rotation_error_deg(estimate, street.cam_from_vehicle["front"]) < 0.08


def test_a_camera_that_saw_nothing_keeps_its_extrinsic(short_scene):
    drive = short_scene.drive
    front_only = [
        in_image for in_image in short_scene.detections if drive.images[in_image.image].camera == "front"
    ]
    optimum = run_methods(drive, front_only, CAMERAS)["Opt"]
    assert optimum.calibrations["rear"].covariance is None
    assert optimum.calibrations["front"].covariance is not None


def test_a_drive_without_a_marking_says_so(scene):
    nothing = [replace(in_image, markings=()) for in_image in scene.detections]
    with pytest.raises(MappingError, match="no markings were found"):
        run_methods(scene.drive, nothing, ("front",))


def test_markings_seen_once_each_say_so(scene):
    with pytest.raises(MappingError, match="two images"):
        run_methods(scene.drive, scene.detections[:2], ("front",))


def test_where_no_marking_lies_inside_the_regions_of_interest_the_naive_maps_are_empty(short_scene):
    tiny = np.array([[6.0, -0.05], [6.1, -0.05], [6.1, 0.05], [6.0, 0.05]])
    cameras = {
        name: replace(camera, roi_vehicle=tiny * np.sign(camera.roi_vehicle[:, 0].mean()))
        for name, camera in short_scene.drive.cameras.items()
    }
    drive = replace(short_scene.drive, cameras=cameras)
    methods = run_methods(drive, short_scene.detections, CAMERAS)
    assert [len(methods[name].hd_map.markings) for name in ("CNI", "ENI", "ONI")] == [0, 0, 0]
    assert methods["Opt"].hd_map.markings


@pytest.fixture(scope="module")
def both_modes():
    """A scene, its map of all at once and its map marking by marking."""
    scene = make_scene(SceneOptions(length_m=50.0, seed=5))
    options = (MappingOptions(), MappingOptions(mode="incremental"))
    return scene, *(
        run_methods(scene.drive, scene.detections, CAMERAS, mapping_options)["Opt"]
        for mapping_options in options
    )


def test_marking_by_marking_the_map_is_nearly_that_of_all_at_once(both_modes):
    scene, _, result = both_modes
    pairs, rmse_m = match(result.hd_map, scene.markings, MATCH_M)
    assert len(pairs) == len(result.hd_map.markings)
    assert len({b for _, b in pairs}) == len(pairs)
    assert len(pairs) >= 0.9 * len(scene.markings)
    assert rmse_m < 0.05
    for name, truth in scene.cam_from_vehicle.items():
        assert rotation_error_deg(result.calibrations[name].cam_from_vehicle, truth) < 0.1
    assert all(np.all(np.isfinite(marking.covariance_m2)) for marking in result.hd_map.markings)


def test_both_modes_say_the_same_of_themselves(both_modes):
    _, batch, grown = both_modes
    assert batch.reprojection_rmse_px is not None
    assert grown.reprojection_rmse_px is not None
    assert grown.reprojection_rmse_px == pytest.approx(batch.reprojection_rmse_px, rel=0.2)
    assert grown.initial_reprojection_rmse_px == pytest.approx(batch.initial_reprojection_rmse_px, rel=0.2)
    assert batch.diagnostics.keys() == grown.diagnostics.keys()
    assert grown.diagnostics["observations"] == pytest.approx(batch.diagnostics["observations"], rel=0.1)
    assert grown.diagnostics["chi2_per_dof"] == pytest.approx(1.0, abs=0.3)
    assert grown.certainty.keys() == batch.certainty.keys() == {"front", "rear"}
    for name, calibration in batch.calibrations.items():
        assert calibration.covariance is not None
        sigma, other = (
            np.sqrt(np.diag(c)) for c in (calibration.covariance, grown.calibrations[name].covariance)
        )
        assert np.all(other < 1.6 * sigma)
        assert np.all(other > 0.7 * sigma)
    ours, theirs = (
        np.median([marking.relative_sigma_m for marking in result.hd_map.markings])
        for result in (grown, batch)
    )
    assert ours == pytest.approx(theirs, rel=0.3)
    assert grown.evidence.held_out_loss is not None
    assert grown.evidence.held_out_loss < 3.0
    assert len(grown.evidence.score_tests) == len(batch.evidence.score_tests)
    assert grown.poses is not None
    assert grown.clocks[0].keys() == batch.clocks[0].keys()


@pytest.fixture(scope="module")
def sightings(short_scene):
    return collect_sightings(short_scene.drive, short_scene.detections, CAMERAS)


def homographies(sightings, rig):
    vehicle_from_map = np.linalg.inv(rig.map_from_vehicle[sightings.frame])
    cam_from_map = rig.cam_from_vehicle[sightings.camera] @ vehicle_from_map
    return ipm.ground_from_pinhole_px(rig.intrinsic[sightings.camera], cam_from_map)


def test_every_sighting_goes_through_kornia(short_scene, sightings, monkeypatch):
    mapped: set[tuple[float, float]] = set()
    backward, transform_points, grad = [0], tensors.transform_points, torch.autograd.grad

    def transforming(homography, points):
        mapped.update(map(tuple, points.detach().reshape(-1, 2).tolist()))
        return transform_points(homography, points)

    def differentiating(*args, **kwargs):
        backward[0] += 1
        return grad(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(tensors, "transform_points", transforming)
    monkeypatch.setattr(torch.autograd, "grad", differentiating)
    assert run_methods(short_scene.drive, short_scene.detections, CAMERAS)["Opt"].hd_map.markings
    corners = sightings.corners_pinhole_px[np.isfinite(sightings.corners_pinhole_px).all(axis=2)]
    assert {(float(u), float(v)) for u, v in corners} <= mapped
    assert backward[0] >= 2


def test_it_is_that_of_the_vehicle_to_a_nanometre(short_scene, sightings):
    cameras = {name: short_scene.drive.cameras[name] for name in CAMERAS}
    rig = initial_rig(cameras, sightings.map_from_vehicle)
    start = [extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm]) for camera in cameras.values()]
    np.testing.assert_allclose(rig.cam_from_vehicle, start, atol=1e-12)
    located = locate(sightings, rig)
    by_numpy = ipm.apply_in_front(homographies(sightings, rig), sightings.corners_pinhole_px)
    np.testing.assert_allclose(located.corners_map[located.informs], by_numpy[located.informs], atol=1e-9)
    jacobian = ipm.homography_jacobian(homographies(sightings, rig), sightings.corners_pinhole_px)
    covariance = jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2)
    np.testing.assert_allclose(
        located.covariance_m2[located.informs], covariance[located.informs], rtol=1e-9, atol=1e-12
    )
