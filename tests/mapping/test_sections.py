"""A drive mapped in sections has the map of the drive, each marking once, whoever saw it."""

import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import norm

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.errors import AdjustError, ConfigError, MappingError, WorkerError
from v2hdm.executor import HERE
from v2hdm.faults import Contradiction, table
from v2hdm.geometry.planar import length_along
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions, SizeOptions
from v2hdm.mapping.results import NO_SEGMENT, MethodResult
from v2hdm.mapping.sections import run, work
from v2hdm.mapping.sections.common import Names, named, with_owners
from v2hdm.mapping.sections.faults import pooled_tests, refuse_contradicted
from v2hdm.mapping.sections.joint import (
    Fit,
    Gate,
    Judged,
    gates,
    refuse_contradicting_drives,
    scatter_by_marking,
)
from v2hdm.mapping.sections.ours import Pairs
from v2hdm.mapping.sections.run import map_in_sections
from v2hdm.mapping.sections.section import sections_of
from v2hdm.mapping.sections.work import Work
from v2hdm.progress import Progress, silent
from v2hdm.records import Image, ImageDetections, IntArray, PoseNoise, Session


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


def in_sections(
    scene: Scene, folder: Path, most_m: float = 65.0, progress: Progress = silent, **options: object
) -> MethodResult:
    """The map of a scene in sections."""
    cameras = list(scene.drive.cameras)
    source = Listed(scene.detections)
    chosen = MappingOptions(**options)
    return map_in_sections(scene.drive, source, cameras, chosen, most_m, Elsewhere(), folder, progress)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneOptions(seed=4, length_m=130.0))


@pytest.fixture(scope="module")
def told() -> list[tuple[str, int, int]]:
    """The progress of the mapping of ``result``."""
    return []


@pytest.fixture(scope="module")
def result(scene, told, tmp_path_factory) -> MethodResult:
    folder = tmp_path_factory.mktemp("sections")
    return in_sections(scene, folder, progress=lambda *step: told.append(step))


@pytest.fixture(scope="module")
def whole(scene) -> MethodResult:
    cameras = list(scene.drive.cameras)
    return run_methods(scene.drive, scene.detections, cameras, MappingOptions(), naive=False)["Opt"]


def test_sections_have_every_image_once_as_their_own(scene):
    sections = sections_of(scene.drive, 65.0)
    numbers = np.concatenate([section.images[section.is_own] for section in sections])
    assert len(sections) == 2
    np.testing.assert_array_equal(np.sort(numbers), np.arange(len(scene.drive.images)))
    assert all(not section.is_own.all() for section in sections)


def test_the_steps_of_the_sections_are_told_one_by_one(result, told):
    for step in ("map sections", "propose markings", "finish sections"):
        assert [(done, total) for name, done, total in told if name == step] == [(0, 2), (1, 2), (2, 2)]


def test_the_map_is_that_of_the_drive(result, whole):
    ours = np.array([marking.corners_map for marking in result.hd_map.markings])
    theirs = np.array([marking.corners_map for marking in whole.hd_map.markings])
    assert len(ours) == len(theirs)
    _, other = cKDTree(theirs.mean(axis=1)).query(ours.mean(axis=1))
    assert sorted(other.tolist()) == list(range(len(theirs)))
    assert np.linalg.norm(ours - theirs[other], axis=2).max() < 1e-4
    traces = [
        (np.trace(marking.covariance_m2), np.trace(whole.hd_map.markings[k].covariance_m2))
        for marking, k in zip(result.hd_map.markings, other, strict=True)
    ]
    np.testing.assert_allclose(np.sqrt([ours / theirs for ours, theirs in traces]), 1.0, atol=0.01)
    for name, calibration in result.calibrations.items():
        turned = calibration.cam_from_vehicle @ np.linalg.inv(whole.calibrations[name].cam_from_vehicle)
        assert np.abs(turned - np.eye(4)).max() < 1e-5
        sigma = np.sqrt(np.diag(calibration.covariance) / np.diag(whole.calibrations[name].covariance))
        np.testing.assert_allclose(sigma, 1.0, atol=0.01)


def test_a_map_is_the_same_where_every_section_solves_for_all_that_it_shows(
    scene, result, tmp_path, monkeypatch
):
    """Otherwise a section solves for its own candidates alone, and for each column of these once."""
    none = np.zeros(0, dtype=np.int64)
    monkeypatch.setattr(work, "of_ours", lambda final, is_ours: final)
    monkeypatch.setattr(work, "near_corners", lambda bundle, is_ours: Pairs(none, none))
    slowly = in_sections(scene, tmp_path)
    assert len(slowly.hd_map.markings) == len(result.hd_map.markings)
    for marking, other in zip(result.hd_map.markings, slowly.hd_map.markings, strict=True):
        np.testing.assert_allclose(marking.corners_map, other.corners_map, atol=1e-9)
        np.testing.assert_allclose(marking.covariance_m2, other.covariance_m2, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(marking.relative_sigma_m, other.relative_sigma_m, rtol=1e-5)


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


def test_what_several_sections_see_counts_once(result, whole):
    for count in ("observations", "candidates"):
        assert result.diagnostics[count] == whole.diagnostics[count]


def test_a_section_without_a_marking_is_named_in_one_line(scene, tmp_path):
    first = sections_of(scene.drive, 65.0)[0].images
    bare = [
        replace(in_image, markings=()) if in_image.image in set(first.tolist()) else in_image
        for in_image in scene.detections
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


class Dying(Elsewhere):
    """An executor whose process dies over the second job."""

    def outcomes(self, stage, jobs, progress, at_once):
        yield 1, WorkerError("a process died twice over the same work")


def test_a_process_that_dies_is_one_line_that_names_step_and_section(scene, tmp_path):
    cameras = list(scene.drive.cameras)
    with pytest.raises(WorkerError, match=r"map sections, section 2 of 2: a process died twice"):
        map_in_sections(
            scene.drive, Listed(scene.detections), cameras, MappingOptions(), 65.0, Dying(), tmp_path
        )


def judged(corner, shift_m) -> Judged:
    """A section's observations of such corners, by 100 frames a drive."""
    return Judged(np.array(corner), 100 * np.array(shift_m), np.array([100, 100]))


def fit(squared, corner, is_behind=None) -> Fit:
    """A section's observations with such squared residuals of such corners."""
    is_behind = np.zeros(len(squared), dtype=bool) if is_behind is None else np.array(is_behind)
    return Fit(np.array(squared, dtype=float), np.array(corner), is_behind, np.full(len(squared), 2.0), {})


def test_an_observation_is_judged_at_the_scale_of_all_sections_and_its_corner_counted_in_all():
    usual = [1.4] * 20
    first = fit([*usual, 5.0, 300.0, 1.0], [*range(20), 20, 20, 21])
    second = fit([*usual, 5.0, 1.0], [*range(22, 42), 20, 21], is_behind=[False] * 21 + [True])
    # Before the second section's others it has an observation of a corner of its own, which no solve has.
    in_solve = [np.ones(23, dtype=bool), np.arange(23) > 0]
    of_first, of_second = gates([first, second], [Gate(rows, rows) for rows in in_solve], 0.001)
    assert not of_second.is_accepted[0]
    of_second = Gate(*(column[1:] for column in of_second))
    assert of_first.is_accepted[20:].tolist() == [True, False, True]
    assert of_second.is_accepted[20:].tolist() == [True, False]
    # Corner 20 is seen once in each section, corner 21 twice, once behind the camera.
    assert of_first.is_used[20:].tolist() == [True, False, False]
    assert of_second.is_used[20:].tolist() == [True, False]


def test_outliers_are_those_of_the_drive_where_one_section_is_all_of_it(tmp_path):
    scene = make_scene(SceneOptions(seed=4, length_m=60.0))
    work = Work(Listed(scene.detections), tuple(scene.drive.cameras), MappingOptions(), tmp_path)
    (section,) = sections_of(scene.drive, 1000.0)
    work.write("section", 0, section)
    alone = [work.settle(0)]
    (names,) = named(alone)
    work.write("names", 0, names)
    in_one = np.zeros(len(section.frames), dtype=np.int64)
    of_section = run._Run(work, HERE, lambda step, done, total: None, 1)
    rough = run._judge_together(of_section, scene.drive, in_one, alone, [work.judge(0).corner])
    (gate,) = rough.gates
    settled = work.read("examined", 0).settled
    assert settled.model.variance_factor < 0.9  # the detector states more than there is
    assert 0 < np.count_nonzero(~gate.is_accepted) == np.count_nonzero(~settled.inliers)


def test_a_corner_scatters_as_all_its_images_do_whatever_section_they_are_of():
    rng = np.random.default_rng(3)
    squared = rng.chisquare(2, 400)
    squared[::40] *= 9  # of corner 0
    corner = np.arange(400) % 40
    freedom = np.full(400, 2.0)
    is_behind = np.zeros(400, dtype=bool)
    whole = scatter_by_marking([Fit(squared, corner, is_behind, freedom, {})], 10)
    halves = [
        Fit(squared[rows], corner[rows], is_behind[rows], freedom[rows], {})
        for rows in (slice(0, None, 2), slice(1, None, 2))
    ]
    np.testing.assert_allclose(scatter_by_marking(halves, 10), whole)
    assert whole[0, 0] == whole.max() > 2


def test_drives_that_markings_shift_apart_are_named_in_one_line(scene):
    noise = PoseNoise(position_m=0.02)
    drives = [Session(name, Path(name), noise) for name in ("monday", "tuesday")]
    network = replace(scene.drive, joined=tuple(drives))
    refuse_contradicting_drives([judged([], ((0.03, 0.0), (-0.03, 0.0)))], network)
    with pytest.raises(AdjustError, match=r"drive (monday|tuesday) by 30 cm against the others") as refused:
        refuse_contradicting_drives([judged([], ((0.15, 0.0), (-0.15, 0.0)))], network)
    assert "\n" not in str(refused.value)


def test_a_marking_belongs_to_the_section_that_knows_most_of_its_corners():
    """The first section knows two corners of marking 0 by ten sightings, the second all four by three."""
    none = np.zeros(3, dtype=bool)
    first = Names(np.array([0, 1, 2]), np.zeros(3, dtype=int), ~none, np.array([10, 4, 5]), none)
    second = Names(np.array([2, 0, 1]), np.zeros(3, dtype=int), ~none, np.array([0, 3, 6]), none)
    corners = [np.array([0, 1, 0, 4, 5, 6, 7]), np.array([0, 1, 2, 3, 4, 5, 6, 7])]
    of_first, of_second = with_owners([first, second], corners)
    # Both know all of marking 1, which the second sees more often; none knows a corner of marking 2.
    assert of_first.is_ours.tolist() == [False, False, True]
    assert of_second.is_ours.tolist() == [False, True, True]


def late(value: float, sigma: float) -> Contradiction:
    """The front camera's clock, off by so many seconds."""
    sigmas = abs(value) / sigma
    return Contradiction(
        table.CLOCK.name, 0, 0, -1, value, sigma, sigma, 2 * float(norm.sf(sigmas)), sigmas**2 / 2,
        cameras=("front",),
    )  # fmt: skip


def test_an_error_that_every_section_hints_at_is_seen_by_all_together():
    (pooled,) = pooled_tests([[late(0.02, 0.01)]] * 16)
    assert pooled.value == pytest.approx(0.02)
    assert pooled.sigma == pytest.approx(0.0025)
    with pytest.raises(MappingError, match=r"contradict the clock of front by 8 sigmas \(\+0\.02 s\)"):
        refuse_contradicted([pooled], NO_SEGMENT)


def test_errors_on_which_sections_disagree_are_known_as_badly_as_they_disagree():
    tests = [[late(0.004 * (-1) ** number, 0.001)] for number in range(40)]
    (pooled,) = pooled_tests(tests)
    assert abs(pooled.value) < 1e-9
    assert pooled.sigma > 2 * 0.001 / 40**0.5
    refuse_contradicted([pooled], NO_SEGMENT)


def test_one_of_many_sections_by_chance_contradicts_nothing():
    """One of a hundred sections is four sigmas off; their mean is not."""
    rng = np.random.default_rng(0)
    tests = [[late(float(rng.normal(0, 0.002)), 0.002)] for _ in range(100)]
    tests[7] = [late(0.008, 0.002)]
    (pooled,) = pooled_tests(tests)
    assert pooled.sigmas < 3
    refuse_contradicted([pooled], NO_SEGMENT)


def test_lanes_do_not_end_where_sections_meet(result, whole):
    longest, other = (
        max(length_along(lane.points_map)[-1] for lane in of_drive.hd_map.lanes)
        for of_drive in (result, whole)
    )
    assert longest == pytest.approx(other, abs=1.0)
    assert len(result.hd_map.lanes) == len(whole.hd_map.lanes)
