"""A drive mapped in sections has the map of the drive, each marking once, whoever saw it."""

import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.errors import ConfigError, MappingError
from v2hdm.executor import HERE
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions, SizeOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.mapping.sections.run import map_in_sections
from v2hdm.mapping.sections.section import sections_of
from v2hdm.records import Image, ImageDetections, IntArray


class Listed:
    """Detections of a scene, by image."""

    def __init__(self, detections: Sequence[ImageDetections]) -> None:
        self.detections = detections

    def __call__(self, images: Sequence[Image], numbers: IntArray) -> list[ImageDetections]:
        return [replace(self.detections[number], image=at) for at, number in enumerate(numbers)]


class Elsewhere(type(HERE)):
    """An executor whose work, jobs and results are copied, as those of other processes are."""

    def outcomes(self, stage, jobs, progress, at_once):
        stage = pickle.loads(pickle.dumps(stage))
        for number, job in enumerate(jobs):
            result = stage.work(pickle.loads(pickle.dumps(job)), lambda task, done, total: None)
            yield number, pickle.loads(pickle.dumps(result))


def in_sections(scene: Scene, folder: Path, most_m: float = 130.0, **options: object) -> MethodResult:
    """The map of a scene in sections."""
    cameras = list(scene.drive.cameras)
    source = Listed(scene.detections)
    chosen = MappingOptions(**options)
    return map_in_sections(scene.drive, source, cameras, chosen, most_m, Elsewhere(), folder)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneOptions(seed=4, length_m=260.0))


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory) -> MethodResult:
    return in_sections(scene, tmp_path_factory.mktemp("sections"))


@pytest.fixture(scope="module")
def whole(scene) -> MethodResult:
    cameras = list(scene.drive.cameras)
    return run_methods(scene.drive, scene.detections, cameras, MappingOptions(), naive=False)["Opt"]


def test_sections_have_every_image_once_as_their_own(scene):
    sections = sections_of(scene.drive, 130.0)
    own = np.concatenate([section.images[section.is_own] for section in sections])
    assert len(sections) == 2
    np.testing.assert_array_equal(np.sort(own), np.arange(len(scene.drive.images)))
    assert all(not section.is_own.all() for section in sections)


def test_the_map_is_that_of_the_drive(result, whole):
    """Gates and noise are estimated section by section, which moves corners by a tenth of their sigma."""
    ours = np.array([marking.corners_map for marking in result.hd_map.markings])
    theirs = np.array([marking.corners_map for marking in whole.hd_map.markings])
    assert len(ours) == len(theirs)
    away_m, other = cKDTree(theirs.mean(axis=1)).query(ours.mean(axis=1))
    assert sorted(other.tolist()) == list(range(len(theirs)))
    assert away_m.max() < 3e-3
    assert np.median(away_m) < 5e-4
    for marking, k in zip(result.hd_map.markings, other, strict=True):
        before = whole.hd_map.markings[k]
        ratio = np.trace(marking.covariance_m2) / np.trace(before.covariance_m2)
        assert 0.5 < ratio < 2.0
    for name, calibration in result.calibrations.items():
        turned = calibration.cam_from_vehicle @ np.linalg.inv(whole.calibrations[name].cam_from_vehicle)
        assert np.abs(turned - np.eye(4)).max() < 1e-3
        sigma = np.sqrt(np.diag(calibration.covariance) / np.diag(whole.calibrations[name].covariance))
        np.testing.assert_allclose(sigma, 1.0, atol=0.1)


def test_no_marking_is_mapped_twice(result):
    centres = np.array([marking.corners_map.mean(axis=0) for marking in result.hd_map.markings])
    nearest_m, _ = cKDTree(centres).query(centres, k=2)
    assert nearest_m[:, 1].min() > 0.5


def test_what_goes_with_the_map_is_of_the_whole_drive(scene, result, whole):
    assert len(result.poses.frame) == len(scene.drive.images)
    assert np.abs(result.poses.map_from_vehicle - whole.poses.map_from_vehicle)[:, :2, 3].max() < 5e-3
    assert np.isfinite(result.poses.sigma).all()
    of_markings = set(result.residuals.marking.tolist()) - {0}
    assert of_markings == set(range(1, len(result.hd_map.markings) + 1))
    nearest = result.residuals.marking == 1
    images = {result.residuals.image[row] for row in result.residuals.row_image[nearest].tolist()}
    assert len(images) == result.hd_map.markings[0].sightings
    assert result.evidence.fits["front"].observations > 0.9 * whole.evidence.fits["front"].observations
    assert {lane.kind for lane in result.hd_map.lanes} == {lane.kind for lane in whole.hd_map.lanes}


def test_a_section_without_a_marking_is_named_in_one_line(scene, tmp_path):
    first = sections_of(scene.drive, 130.0)[0].images
    bare = [
        replace(found, markings=()) if found.image in set(first.tolist()) else found
        for found in scene.detections
    ]
    with pytest.raises(
        MappingError, match=r"section \d, about x .* m, y .* m: no markings were found"
    ) as refused:
        in_sections(replace(scene, detections=bare), tmp_path)
    assert "\n" not in str(refused.value)


def test_settings_that_sections_cannot_have_each_for_itself_are_refused(scene, tmp_path):
    sizes = SizeOptions(by_class_m={"diamond": [1.2, 0.6]})
    with pytest.raises(ConfigError, match=r"mapping\.known_sizes: not with sections"):
        in_sections(scene, tmp_path, known_sizes=sizes)
    with pytest.raises(ConfigError, match=r"mapping\.ground=surface: not with sections"):
        in_sections(scene, tmp_path, ground="surface")
