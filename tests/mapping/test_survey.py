"""Corners that the user has surveyed: found in the map, and the map found by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.adjust import Drift, PoseSigma
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import collect_sightings
from v2hdm.errors import ConfigError
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import ControlOptions, MappingOptions, SurveyOptions
from v2hdm.mapping.stated import control_points, without_corner
from v2hdm.records import FloatArray

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
INDEX = np.array([[7, 8, -1, 9]])


def found(points: list[list[float]]) -> dict[int, tuple[float, float]]:
    control = control_points(SurveyOptions(points_map=points, reach_m=0.25), SQUARE[None], INDEX, PoseSigma())
    if control is None:
        return {}
    return {int(c): (x, y) for c, (x, y) in zip(control.corner, control.points_map.tolist(), strict=True)}


def test_a_surveyed_point_is_of_the_nearest_corner_within_reach() -> None:
    assert found([[0.1, 0.1], [0.9, 0.0]]) == {7: (0.1, 0.1), 8: (0.9, 0.0)}
    assert found([[0.1, 0.1], [0.0, 0.05]]) == {7: (0.0, 0.05)}
    assert found([[0.5, 0.5]]) == {}
    assert found([[1.0, 1.0]]) == {}, "that corner is not part of the adjustment"
    assert found([]) == {}


def test_surveyed_points_that_no_corner_is_nearest_to_are_told() -> None:
    survey = SurveyOptions(points_map=[[0.1, 0.1], [5.0, 5.0], [0.0, 0.05], [1.0, 1.0]], reach_m=0.25)
    control = control_points(survey, SQUARE[None], INDEX, PoseSigma())
    assert without_corner(survey, control) == ["(0.10, 0.10)", "(5.00, 5.00)", "(1.00, 1.00)"]
    assert len(without_corner(survey, None)) == 4
    assert without_corner(SurveyOptions(), None) == []


def test_a_surveyed_point_far_from_the_map_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    scene = make_scene(SceneOptions(seed=31, length_m=30.0, wild_rate=0.0, false_rate=0.0))
    options = MappingOptions(pose_model="full", survey=SurveyOptions(points_map=[[500.0, 3.0]]))
    run_methods(scene.drive, scene.detections, ("front",), options)
    (warning,) = [r.getMessage() for r in caplog.records if "surveyed" in r.getMessage()]
    assert "1 of 1" in warning
    assert "(500.00, 3.00)" in warning


def adjusted(scene: Scene, survey: SurveyOptions, one_by_one: bool = False) -> FloatArray:
    sightings = collect_sightings(scene.drive, scene.detections, ("front",))
    options = MappingOptions(pose_model="full", survey=survey)
    views, drive = views_of(scene.drive, ("front",)), scene.drive
    optimiser = Optimiser(sightings, views, drive.cameras, drive.noises, options)
    settled = optimiser.grow() if one_by_one else optimiser.settle(optimiser.initial_tracks())
    corners = optimiser.finish(settled).bundle.corners_map.reshape(-1, 2)
    return corners[np.isfinite(corners).all(axis=1)]


def mean_offset_m(corners_map: FloatArray, truth: FloatArray) -> float:
    """How far the corners as a whole are off those of the truth that are nearest to them."""
    apart = np.linalg.norm(corners_map[:, None] - truth[None], axis=-1)
    off = corners_map - truth[apart.argmin(axis=1)]
    return float(np.linalg.norm(np.median(off[apart.min(axis=1) < 0.2], axis=0)))


def test_two_surveyed_corners_take_the_drift_of_the_receiver_out_of_the_map() -> None:
    scene = make_scene(SceneOptions(seed=31, length_m=60.0, wild_rate=0.0, false_rate=0.0))
    drifted = np.eye(4)
    drifted[:2, 3] = 0.06, -0.05
    images = [
        replace(image, map_from_vehicle=drifted @ image.map_from_vehicle) for image in scene.drive.images
    ]
    noise = replace(
        scene.drive.pose_noise, position_m=0.08, position_drift_m=0.078, position_drift_over_m=500.0
    )
    scene = replace(scene, drive=replace(scene.drive, images=images, pose_noise=noise))
    truth = np.concatenate([marking.corners_map for marking in scene.markings])
    alone = adjusted(scene, SurveyOptions())
    assert mean_offset_m(alone, truth) > 0.06
    middle = alone[np.argsort(alone[:, 0])[[len(alone) // 3, 2 * len(alone) // 3]]]
    nearest = np.linalg.norm(middle[:, None] - truth[None], axis=-1).argmin(axis=1)
    survey = SurveyOptions(points_map=truth[nearest].tolist(), sigma_m=0.005)
    assert mean_offset_m(adjusted(scene, survey), truth) < 0.02
    assert mean_offset_m(adjusted(scene, survey, one_by_one=True), truth) < 0.02


def named(name: str, **changes: list[float]) -> ControlOptions:
    return ControlOptions(**{"id": name, "position_map": [1.0, 2.0], "sigma_m": [0.01, 0.01], **changes})  # type: ignore[arg-type]


def test_a_control_point_has_its_own_sigmas_and_is_left_out_by_name() -> None:
    survey = SurveyOptions(
        points_map=[[0.0, 0.02]],
        points=[named("A", position_map=[1.0, 0.0], sigma_m=[0.002, 0.05])],
        reach_m=0.25,
    )
    control = control_points(survey, SQUARE[None], INDEX, PoseSigma())
    assert control is not None
    assert dict(zip(control.corner.tolist(), control.sigma_m.tolist(), strict=True)) == {
        7: [0.01, 0.01],
        8: [0.002, 0.05],
    }
    assert [one.id for one in survey.without("(0.00, 0.02)").control] == ["A"]
    assert [one.id for one in survey.without("A").control] == ["(0.00, 0.02)"]


def test_points_find_their_corners_in_a_map_that_drifts_by_more_than_half_a_dash() -> None:
    dashes = (
        np.array([[[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]]] * 5)
        + 6.0 * np.arange(5)[:, None, None]
    )
    index = np.arange(20).reshape(5, 4)
    points = dashes[np.arange(5), [0, 2, 3, 1, 0]] - [0.03, 0.08]
    survey = SurveyOptions(points=[named(f"P{k}", position_map=one.tolist()) for k, one in enumerate(points)])
    drifting = PoseSigma(0.08, position_drift=Drift(0.079, 100.0))
    control = control_points(survey, dashes, index, drifting)
    assert control is not None
    assert set(control.corner.tolist()) == {0, 6, 11, 13, 16}
    nearest = np.linalg.norm(points[:, None] - dashes.reshape(-1, 2), axis=-1).argmin(axis=1)
    assert set(nearest.tolist()) != {0, 6, 11, 13, 16}


def test_the_errors_of_a_maps_corners_hang_together_as_drift_makes_them() -> None:
    scene = make_scene(SceneOptions(seed=31, length_m=40.0, wild_rate=0.0, false_rate=0.0))
    noise = replace(
        scene.drive.pose_noise, position_m=0.08, position_drift_m=0.078, position_drift_over_m=500.0
    )
    drive = replace(scene.drive, pose_noise=noise)
    result = run_methods(drive, scene.detections, ("front",), MappingOptions(pose_model="full"))["Opt"]
    markings, corners = result.hd_map.markings, result.corners
    assert corners is not None
    chosen = np.arange(len(markings))
    joint = corners.covariance(chosen, chosen % 4)
    assert np.linalg.eigvalsh(joint).min() > -1e-12
    for k, marking in enumerate(markings):
        assert marking.covariance_m2 is not None
        own = marking.covariance_m2.reshape(4, 2, 4, 2)[k % 4, :, k % 4]
        np.testing.assert_allclose(joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], own, atol=5e-6)
    sigma_m = np.sqrt(np.diag(joint))
    alike = (joint / np.outer(sigma_m, sigma_m))[0::2, 0::2]
    assert alike.min() > 0.8
    both = corners.covariance(np.array([3, 3]), np.array([0, 2]))
    np.testing.assert_allclose(both[:2, 2:], markings[3].covariance_m2.reshape(4, 2, 4, 2)[0, :, 2])  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("survey", "mode", "message"),
    [
        ({"points_map": [[1.0, 2.0, 3.0]]}, "batch", r"survey\.points_map\[0\]"),
        ({"points_map": [[1.0, 2.0], [1.0, float("nan")]]}, "batch", r"survey\.points_map\[1\]"),
        ({"points": [named("A", sigma_m=[0.01, 0.0])]}, "batch", r"points\[0\]\.sigma_m is \[0\.01, 0\.0\]"),
        ({"points": [named("A", position_map=[1.0])]}, "batch", r"points\[0\]\.position_map is \[1\.0\]"),
        ({"points": [named("A"), named("A")]}, "batch", "names the point A twice"),
        ({"file": "points.csv"}, "batch", r"survey\.file is 'points.csv': read it first"),
        ({"sigma_m": 0.0}, "batch", r"survey\.sigma_m"),
        ({"reach_m": -1.0}, "batch", r"survey\.reach_m"),
        ({"reach_m": -1.0}, "incremental", r"survey\.reach_m"),
    ],
)
def test_a_survey_that_cannot_be_used_is_refused(survey: dict[str, object], mode: str, message: str) -> None:
    scene = make_scene(SceneOptions(length_m=20.0))
    options = MappingOptions(mode=mode, survey=SurveyOptions(**survey))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=message):
        run_methods(scene.drive, scene.detections, ("front",), options)
