"""Inputs that the drive contradicts are dropped, and told; right ones are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.adjust import Fault
from v2hdm.geometry.trajectory import interpolate
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions, SizeOptions, SurveyOptions
from v2hdm.mapping.recovery import Inputs
from v2hdm.mapping.results import MethodResult
from v2hdm.records import DIAMOND, Drive, FloatArray, Trajectory

OPTIONS = MappingOptions(pose_model="heave")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneOptions(seed=31, length_m=90.0, wild_rate=0.0, false_rate=0.0))


def mapped(scene: Scene, drive: Drive, options: MappingOptions = OPTIONS) -> MethodResult:
    return run_methods(drive, scene.detections, ("front",), options)["Opt"]


def faults(result: MethodResult) -> list[Fault]:
    assert result.evidence is not None
    return [one.fault for one in result.evidence.corrected]


def centre_of(result: MethodResult) -> FloatArray:
    matrix = result.calibrations["front"].cam_from_vehicle
    return np.asarray(-matrix[:3, :3].T @ matrix[:3, 3])


def surveyed(drive: Drive, off_m: tuple[float, float, float]) -> Drive:
    camera = drive.cameras["front"]
    assert camera.centre_prior is not None
    centre = camera.centre_prior.centre_vehicle + off_m
    prior = replace(camera.centre_prior, centre_vehicle=centre)
    return replace(drive, cameras={**drive.cameras, "front": replace(camera, centre_prior=prior)})


def test_right_inputs_are_kept(scene: Scene) -> None:
    result = mapped(scene, scene.drive)
    assert faults(result) == []
    assert result.evidence is not None
    assert max(one.sigmas for one in result.evidence.score_tests) < 5


def test_a_survey_half_a_metre_too_high_is_dropped_and_told(scene: Scene) -> None:
    result = mapped(scene, surveyed(scene.drive, (0.0, 0.0, 0.5)))
    assert faults(result) == [Fault.SURVEY]
    assert result.evidence is not None
    (told,) = result.evidence.corrected
    assert (told.cameras, told.axis) == (("front",), 2)
    assert told.value == pytest.approx(-0.5, abs=0.1)
    assert centre_of(result)[2] == pytest.approx(2.4, abs=0.05)


def test_known_sizes_that_the_paint_does_not_have_are_dropped_and_told(scene: Scene) -> None:
    # Diamonds of the scene are 1.2 m by 0.6 m.
    sizes = SizeOptions(by_class_m={DIAMOND: [1.1, 0.55]}, sigma_m=0.005)
    result = mapped(scene, scene.drive, replace(OPTIONS, known_sizes=sizes))
    assert Fault.SIZE in faults(result)
    longest = [np.ptp(m.corners_map, axis=0) for m in result.hd_map.markings if m.kind == DIAMOND]
    assert np.median(np.linalg.norm(longest, axis=1)) > 1.15


def test_known_sizes_that_the_paint_has_are_kept(scene: Scene) -> None:
    sizes = SizeOptions(by_class_m={DIAMOND: [1.2, 0.6]}, sigma_m=0.005)
    assert faults(mapped(scene, scene.drive, replace(OPTIONS, known_sizes=sizes))) == []


def test_a_surveyed_point_that_lies_elsewhere_is_dropped_and_the_others_stay(scene: Scene) -> None:
    known = mapped(scene, scene.drive).hd_map.markings
    points = [m.corners_map[0] for m in known[2:14:3]]
    points[1] = points[1] + (0.15, 0.0)
    survey = SurveyOptions(points_map=[point.tolist() for point in points], sigma_m=0.005)
    result = mapped(scene, scene.drive, replace(OPTIONS, survey=survey))
    assert result.evidence is not None
    assert [one.about for one in result.evidence.corrected] == [f"({points[1][0]:.2f}, {points[1][1]:.2f})"]


def test_a_clock_60_ms_late_is_put_right(scene: Scene) -> None:
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
    assert faults(result) == [Fault.CLOCK]
    assert result.clocks[0]["front"].value_s == pytest.approx(0.06, abs=0.008)


def _before(trajectory: Trajectory, stamp_s: float) -> FloatArray:
    return np.asarray(interpolate(trajectory, np.array([max(stamp_s, 0.0)]), 1.0)[0][0])


def test_inputs_are_tested_with_the_poses_estimated_even_where_the_first_groups_hold() -> None:
    clear = SceneOptions(
        seed=3, length_m=30.0, turns=False, wild_rate=0.0, false_rate=0.0, hidden_corner_rate=0.0,
        detection_rate=1.0, ipm_error_deg=0.0, ipm_error_m=0.0, pixel_sigma=0.1,
    )  # fmt: skip
    scene = make_scene(clear)
    inputs = Inputs(scene.drive, scene.detections, ("front",), OPTIONS)
    assert "roll" in inputs.optimiser.settle(inputs.tracks).model.solver.pose_states
