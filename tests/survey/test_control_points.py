"""A user's knowledge beforehand, surveyed corners and sizes; and inputs that the drive contradicts."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.adjust import Drift, PoseSigma
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import collect_sightings
from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.errors import ConfigError
from v2hdm.faults import table
from v2hdm.faults.odds import is_contradicted
from v2hdm.geometry.rigid import interpolate
from v2hdm.mapping.bundle import control_points, known_lengths, without_corner
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import ControlOptions, MappingOptions, SizeOptions, SurveyOptions, check_options
from v2hdm.records import DIAMOND, LANE_DASH, Trajectory
from v2hdm.site.options import LaneOptions

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
INDEX = np.array([[7, 8, -1, 9]])


def named(name, **changes):
    return ControlOptions(**{"id": name, "position_map": [1.0, 2.0], "sigma_m": [0.01, 0.01], **changes})  # type: ignore[arg-type]


def survey_of(*points, sigma_m=0.01):
    """Control points at ``points`` (x, y), named after them."""
    return SurveyOptions(
        points=[
            named(f"({x:.2f}, {y:.2f})", position_map=[x, y], sigma_m=[sigma_m, sigma_m]) for x, y in points
        ]
    )


def found(points):
    control = control_points(survey_of(*points), SQUARE[None], INDEX, PoseSigma())
    if control is None:
        return {}
    return {int(c): (x, y) for c, (x, y) in zip(control.corner, control.points_map.tolist(), strict=True)}


def test_a_surveyed_point_is_of_the_nearest_corner_within_reach():
    assert found([[0.1, 0.1], [0.9, 0.0]]) == {7: (0.1, 0.1), 8: (0.9, 0.0)}
    assert found([[0.1, 0.1], [0.0, 0.05]]) == {7: (0.0, 0.05)}
    assert found([[0.5, 0.5]]) == {}
    assert found([[1.0, 1.0]]) == {}, "that corner is not part of the adjustment"
    assert found([]) == {}


def test_surveyed_points_that_no_corner_is_nearest_to_are_told():
    survey = survey_of([0.1, 0.1], [5.0, 5.0], [0.0, 0.05], [1.0, 1.0])
    control = control_points(survey, SQUARE[None], INDEX, PoseSigma())
    assert without_corner(survey, control) == ["(0.10, 0.10)", "(5.00, 5.00)", "(1.00, 1.00)"]
    assert len(without_corner(survey, None)) == 4
    assert without_corner(SurveyOptions(), None) == []


def adjusted(scene, survey, one_by_one=False):
    sightings = collect_sightings(scene.drive, scene.detections, ("front",))
    options = MappingOptions(pose_model="full", survey=survey)
    views, drive = views_of(scene.drive, ("front",)), scene.drive
    optimiser = Optimiser(sightings, views, drive.cameras, drive.noises, options)
    settled = optimiser.grow() if one_by_one else optimiser.settle(optimiser.initial_tracks())
    corners = optimiser.finish(settled).bundle.corners_map.reshape(-1, 2)
    return corners[np.isfinite(corners).all(axis=1)]


def mean_offset_m(corners_map, truth):
    """How far the corners as a whole are off those of the truth that are nearest to them."""
    distances_m = np.linalg.norm(corners_map[:, None] - truth[None], axis=-1)
    off = corners_map - truth[distances_m.argmin(axis=1)]
    return float(np.linalg.norm(np.median(off[distances_m.min(axis=1) < 0.2], axis=0)))


def test_two_surveyed_corners_take_the_drift_of_the_receiver_out_of_the_map():
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
    survey = survey_of(*truth[nearest].tolist(), sigma_m=0.005)
    assert mean_offset_m(adjusted(scene, survey), truth) < 0.02
    assert mean_offset_m(adjusted(scene, survey, one_by_one=True), truth) < 0.02


def test_a_control_point_has_its_own_sigmas_and_is_left_out_by_name():
    point_a = named("A", position_map=[1.0, 0.0], sigma_m=[0.002, 0.05])
    survey = SurveyOptions(points=[named("B", position_map=[0.0, 0.02]), point_a])
    control = control_points(survey, SQUARE[None], INDEX, PoseSigma())
    assert dict(zip(control.corner.tolist(), control.sigma_m.tolist(), strict=True)) == {
        7: [0.01, 0.01],
        8: [0.002, 0.05],
    }
    assert [point.id for point in survey.without("B").points] == ["A"]


def test_points_find_their_corners_in_a_map_that_drifts_by_more_than_half_a_dash():
    dashes = (
        np.array([[[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]]] * 5)
        + 6.0 * np.arange(5)[:, None, None]
    )
    index = np.arange(20).reshape(5, 4)
    points = dashes[np.arange(5), [0, 2, 3, 1, 0]] - [0.03, 0.08]
    survey = SurveyOptions(
        points=[named(f"P{k}", position_map=place.tolist()) for k, place in enumerate(points)]
    )
    drifting = PoseSigma(0.08, position_drift=Drift(0.079, 100.0))
    control = control_points(survey, dashes, index, drifting)
    assert set(control.corner.tolist()) == {0, 6, 11, 13, 16}
    nearest = np.linalg.norm(points[:, None] - dashes.reshape(-1, 2), axis=-1).argmin(axis=1)
    assert set(nearest.tolist()) != {0, 6, 11, 13, 16}


def test_the_errors_of_a_maps_corners_hang_together_as_drift_makes_them():
    scene = make_scene(SceneOptions(seed=31, length_m=40.0, wild_rate=0.0, false_rate=0.0))
    noise = replace(
        scene.drive.pose_noise, position_m=0.08, position_drift_m=0.078, position_drift_over_m=500.0
    )
    drive = replace(scene.drive, pose_noise=noise)
    result = run_methods(drive, scene.detections, ("front",), MappingOptions(pose_model="full"))["Opt"]
    markings = result.hd_map.markings
    chosen = np.arange(len(markings))
    joint = result.joint_covariance(chosen, chosen % 4)
    assert np.linalg.eigvalsh(joint).min() > -1e-12
    for k, marking in enumerate(markings):
        of_corner = marking.covariance_m2.reshape(4, 2, 4, 2)[k % 4, :, k % 4]
        np.testing.assert_allclose(joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], of_corner, atol=5e-6)
    sigma_m = np.sqrt(np.diag(joint))
    alike = (joint / np.outer(sigma_m, sigma_m))[0::2, 0::2]
    assert alike.min() > 0.8
    of_pair = result.joint_covariance(np.array([3, 3]), np.array([0, 2]))
    np.testing.assert_allclose(of_pair[:2, 2:], markings[3].covariance_m2.reshape(4, 2, 4, 2)[0, :, 2])  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"survey": {"points": [named("A", position_map=[1.0, float("nan")])]}}, r"position_map\[1\]"),
        (
            {"survey": {"points": [named("A", sigma_m=[0.01, 0.0])]}},
            r"points\[0\]\.sigma_m is \[0\.01, 0\.0\]",
        ),
        ({"survey": {"points": [named("A", position_map=[1.0])]}}, r"points\[0\]\.position_map is \[1\.0\]"),
        ({"survey": {"points": [named("A"), named("A")]}}, "names the point A twice"),
        ({"survey": {"sigma_m": 0.0}}, r"survey\.sigma_m"),
        ({"survey": {"reach_m": -1.0}}, r"survey\.reach_m"),
        ({"known_sizes": {"by_class_m": {"zebra": [1.0, 1.0]}}}, r"by_class_m\.zebra"),
        ({"known_sizes": {"by_class_m": {DIAMOND: [1.0]}}}, r"by_class_m\.diamond"),
        ({"known_sizes": {"by_class_m": {DIAMOND: [0.5, 1.0]}}}, "the longer one first"),
        ({"known_sizes": {"by_class_m": {DIAMOND: [float("nan"), 1.0]}}}, r"by_class_m\.diamond"),
        ({"known_sizes": {"by_class_m": {DIAMOND: [1.0, 0.0]}}}, r"by_class_m\.diamond"),
        ({"known_sizes": {"sigma_m": 0.0}}, r"known_sizes\.sigma_m"),
        ({"lanes": {"model": "spline"}}, r"mapping\.lanes\.model is 'spline'; choose after or joint"),
        ({"mode": "online"}, r"mode is 'online'; choose batch or incremental"),
        ({"max_range_m": 0.0}, r"mapping\.max_range_m"),
    ],
)
def test_options_that_cannot_be_used_are_refused(options, message):
    parts = {"survey": SurveyOptions, "known_sizes": SizeOptions, "lanes": LaneOptions}
    mapping_options = {key: parts[key](**value) if key in parts else value for key, value in options.items()}
    with pytest.raises(ConfigError, match=message):
        check_options(MappingOptions(**mapping_options), CORNERED_CLASSES)


def test_a_survey_that_is_still_a_file_is_refused(scene):
    with pytest.raises(ConfigError, match=r"survey\.file is 'points.csv': read it and give its points"):
        mapped(scene, scene.drive, MappingOptions(survey=SurveyOptions(file="points.csv")))


SIZES = SizeOptions(by_class_m={DIAMOND: [1.2, 0.6], LANE_DASH: [3.0, 0.15]})
RHOMBUS = np.array([[-0.6, 0.0], [0.0, -0.3], [0.6, 0.0], [0.0, 0.3]])
STRIP = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.15], [0.0, 0.15]])


def lengths_of(kind, corners):
    index = np.arange(100, 104)[None]
    known = known_lengths(SIZES, [kind], corners[None], index)
    if known is None:
        return {}
    ends = np.sort(np.stack([known.first, known.second]), axis=0).T - 100
    return {(int(a), int(b)): float(m) for (a, b), m in zip(ends, known.length_m, strict=True)}


@given(turn=st.integers(0, 3), off=st.floats(-0.1, 0.1))
def test_whichever_corner_comes_first_the_distances_are_those_of_the_marking(turn, off):
    for kind, shape, pairs in ((DIAMOND, RHOMBUS, 2), (LANE_DASH, STRIP, 4)):
        corners = np.roll(shape, turn, axis=0)
        metres_of = lengths_of(kind, (1 + off) * corners)
        assert len(metres_of) == pairs
        for (a, b), metres in metres_of.items():
            assert metres == pytest.approx(np.linalg.norm(corners[a] - corners[b]))


def test_nothing_is_known_of_what_has_another_size_or_an_unknown_one():
    assert not lengths_of(DIAMOND, 1.3 * RHOMBUS)
    assert not lengths_of(LANE_DASH, STRIP * (0.5, 1.0))
    assert not lengths_of(DIAMOND, np.where(np.arange(4)[:, None] == 1, np.nan, RHOMBUS))
    assert not lengths_of("stop_line", STRIP)


def test_a_map_that_grows_marking_by_marking_keeps_to_the_sizes():
    scene = make_scene(SceneOptions(seed=31, length_m=40.0, pixel_sigma=0.6, hidden_corner_rate=0.0))
    (true,) = {tuple(np.round(_diagonals(m.corners_map), 6)) for m in scene.markings if m.kind == DIAMOND}
    sightings = collect_sightings(scene.drive, scene.detections, ("front", "rear"))
    views, noise = views_of(scene.drive, ("front", "rear")), scene.drive.pose_noise
    sizes = SizeOptions(by_class_m={DIAMOND: list(true)}, sigma_m=0.002)
    options = MappingOptions(mode="incremental", pose_model="heave", known_sizes=sizes)
    solved = Optimiser(sightings, views, scene.drive.cameras, (noise,), options).grow()
    assert solved.problem.lengths is not None
    long_m = np.array([_diagonals(c)[0] for c in solved.corners_map if np.isfinite(c).all()])
    lengths_m = long_m[np.abs(long_m - true[0]) < 0.15 * true[0]]
    assert len(lengths_m) > 5
    assert np.std(lengths_m) < 0.004


def _diagonals(corners):
    return np.sort(np.linalg.norm(corners[2:] - corners[:2], axis=1))[::-1]


OPTIONS = MappingOptions(pose_model="heave")


@pytest.fixture(scope="module")
def scene():
    return make_scene(SceneOptions(seed=31, length_m=90.0, wild_rate=0.0, false_rate=0.0))


def mapped(scene, drive, options=OPTIONS):
    return run_methods(drive, scene.detections, ("front",), options)["Opt"]


def faults(result):
    return [test.fault for test in result.evidence.corrected]


def centre_of(result):
    matrix = result.calibrations["front"].cam_from_vehicle
    return np.asarray(-matrix[:3, :3].T @ matrix[:3, 3])


def surveyed(drive, off_m):
    camera = drive.cameras["front"]
    centre = camera.centre_prior.centre_vehicle + off_m
    prior = replace(camera.centre_prior, centre_vehicle=centre)
    return replace(drive, cameras={**drive.cameras, "front": replace(camera, centre_prior=prior)})


def test_a_survey_half_a_metre_too_high_is_dropped_and_told(scene):
    result = mapped(scene, surveyed(scene.drive, (0.0, 0.0, 0.5)))
    assert faults(result) == [table.SURVEY]
    (dropped,) = result.evidence.corrected
    assert (dropped.cameras, dropped.axis) == (("front",), 2)
    assert dropped.value == pytest.approx(-0.5, abs=0.1)
    assert centre_of(result)[2] == pytest.approx(2.4, abs=0.05)


@pytest.mark.parametrize("turns", [True, False])
def test_positions_in_web_mercator_are_reported_and_no_survey_is_dropped_for_them(turns):
    street = make_scene(SceneOptions(seed=31, length_m=90.0, turns=turns, wild_rate=0.0, false_rate=0.0))
    images = []
    for image in street.drive.images:
        pose = image.map_from_vehicle.copy()
        pose[:2, 3] *= 1.15
        images.append(replace(image, map_from_vehicle=pose))
    result = mapped(street, replace(street.drive, images=images))
    assert faults(result) == []
    assert table.SCALE in [test.fault for test in result.evidence.score_tests if is_contradicted(test)]


def test_known_sizes_that_the_paint_does_not_have_are_dropped_and_told(scene):
    # Diamonds of the scene are 1.2 m by 0.6 m.
    sizes = SizeOptions(by_class_m={DIAMOND: [1.1, 0.55]}, sigma_m=0.005)
    result = mapped(scene, scene.drive, replace(OPTIONS, known_sizes=sizes))
    assert table.SIZE in faults(result)
    longest = [np.ptp(m.corners_map, axis=0) for m in result.hd_map.markings if m.kind == DIAMOND]
    assert np.median(np.linalg.norm(longest, axis=1)) > 1.15


def test_a_surveyed_point_that_lies_elsewhere_is_dropped_and_one_far_from_the_map_warned_of(scene, caplog):
    markings = mapped(scene, scene.drive).hd_map.markings
    points = [m.corners_map[0] for m in markings[2:14:3]]
    points[1] = points[1] + (0.15, 0.0)
    survey = survey_of(*points, (500.0, 3.0), sigma_m=0.005)
    result = mapped(scene, scene.drive, replace(OPTIONS, survey=survey))
    assert [test.about for test in result.evidence.corrected] == [f"({points[1][0]:.2f}, {points[1][1]:.2f})"]
    assert re.search(r"1 of [45] surveyed points are not used.*\(500\.00, 3\.00\)", caplog.text)


def test_a_clock_60_ms_late_is_put_right(scene):
    # The recorded trajectory, a pose every .2 s; the images then claim the poses of 60 ms before.
    stamps = np.unique([image.stamp_s for image in scene.drive.images])
    poses = {image.stamp_s: image.map_from_vehicle for image in scene.drive.images}
    trajectory = Trajectory(stamps, np.stack([poses[stamp] for stamp in stamps]))
    images = [replace(image, stamp_s=image.stamp_s - 0.06) for image in scene.drive.images]
    late = replace(scene.drive, images=images, trajectory=trajectory, recorded=trajectory)
    late = replace(
        late,
        images=[replace(image, map_from_vehicle=_before(trajectory, image.stamp_s)) for image in late.images],
    )
    result = mapped(scene, late)
    assert faults(result) == [table.CLOCK]
    assert result.clocks[0]["front"].value_s == pytest.approx(0.06, abs=0.008)


def _before(trajectory, stamp_s):
    return np.asarray(interpolate(trajectory, np.array([max(stamp_s, 0.0)]), 1.0)[0][0])


def test_inputs_are_tested_with_the_poses_estimated_even_where_the_first_groups_hold():
    clear = SceneOptions(
        seed=3, length_m=30.0, turns=False, wild_rate=0.0, false_rate=0.0, hidden_corner_rate=0.0,
        detection_rate=1.0, ipm_error_deg=0.0, ipm_error_m=0.0, pixel_sigma=0.1,
    )  # fmt: skip
    scene = make_scene(clear)
    inputs = Inputs(scene.drive, scene.detections, ("front",), OPTIONS)
    assert "roll" in inputs.optimiser.settle(inputs.tracks).model.solver.pose_states


@pytest.mark.parametrize(
    "sizes", [SizeOptions(), SizeOptions(by_class_m={DIAMOND: [1.2, 0.6]}, sigma_m=0.005)]
)
def test_right_inputs_are_kept(scene, sizes):
    result = mapped(scene, scene.drive, replace(OPTIONS, known_sizes=sizes))
    assert faults(result) == []
    assert max(test.sigmas for test in result.evidence.score_tests) < 5
