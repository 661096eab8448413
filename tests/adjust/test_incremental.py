"""Marking by marking, the map is the one that the batch adjustment finds."""

import time
from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import Scene, make_scene
from v2hdm.adjust import Drift, Observations, PoseSigma, Problem, SolveOptions, solve
from v2hdm.adjust.incremental import IncrementalMap, RigPrior
from v2hdm.adjust.incremental_file import load_map, save_map
from v2hdm.adjust.marking_fit import MarkingObservations
from v2hdm.adjust.pose_errors import Noise
from v2hdm.errors import AdjustError

STILL = Noise(np.zeros(6), np.inf)
JITTER = PoseSigma(position_m=0.01, heading_rad=0.001, roll_pitch_rad=0.002, height_m=0.005)


DRIFTING = PoseSigma(
    position_m=0.012,
    heading_rad=0.001,
    roll_pitch_rad=0.002,
    height_m=0.005,
    position_drift=Drift(0.01, 20.0),
    heading_drift=Drift(0.0008, 5.0),
    roll_pitch_drift=Drift(0.0015, 2.0),
)


def noise_of(sigma: PoseSigma) -> Noise:
    drifts = sigma.drift_by_state()
    fading = (np.array([drift.sigma for drift in drifts]), np.array([drift.over_m for drift in drifts]))
    return Noise(sigma.by_state(), np.inf, *fading)


def street(**changes) -> Scene:
    return make_scene(3, **{"frames": 60, "start_error_deg": 1.0, "min_views": 4, **changes})


def prior_of(problem: Problem) -> RigPrior:
    assert problem.centre_vehicle is not None
    assert problem.centre_sigma_m is not None
    return RigPrior(
        problem.intrinsic, problem.cam_from_vehicle, problem.centre_vehicle, problem.centre_sigma_m, 10.0
    )


def by_marking(problem: Problem) -> list[MarkingObservations]:
    """Four corners each, in the order of their numbers."""
    seen, out = problem.observations, []
    step_m = np.linalg.norm(np.diff(problem.map_from_vehicle[:, :3, 3], axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(step_m)])
    for first in range(0, problem.corner_count - 3, 4):
        rows = np.flatnonzero((seen.corner >= first) & (seen.corner < first + 4))
        out.append(
            MarkingObservations(
                seen.camera[rows],
                seen.corner[rows] - first,
                seen.frame[rows],
                travelled_m[seen.frame[rows]],
                np.linalg.inv(problem.map_from_vehicle)[seen.frame[rows]],
                seen.pinhole_px[rows],
                seen.covariance_px[rows],
            )
        )
    return out


def in_units(problem: Problem, size: int = 4) -> list[MarkingObservations]:
    """So many markings each."""
    markings, out = by_marking(problem), []
    for first in range(0, len(markings), size):
        unit = markings[first]
        for k, seen in enumerate(markings[first + 1 : first + size], 1):
            unit = unit.joined(replace(seen, corner=seen.corner + 4 * k))
        out.append(unit)
    return out


def whole_markings(problem: Problem) -> Problem:
    """Without the last corners that make no four."""
    count = problem.corner_count // 4 * 4
    seen = problem.observations
    keep = seen.corner < count
    parts = (seen.camera, seen.frame, seen.corner, seen.pinhole_px, seen.covariance_px)
    return replace(problem, corner_count=count, observations=Observations(*(part[keep] for part in parts)))


def with_frames_of_their_own(problem: Problem) -> Problem:
    """Every marking sees frames that no other sees: the model of the incremental map, as a batch."""
    seen = problem.observations
    frame = (seen.corner // 4) * len(problem.map_from_vehicle) + seen.frame
    poses = np.tile(problem.map_from_vehicle, (problem.corner_count // 4, 1, 1))
    used, frame = np.unique(frame, return_inverse=True)
    return replace(problem, map_from_vehicle=poses[used], observations=replace(seen, frame=frame))


def assert_is_the_batch_optimum(grown: IncrementalMap, batch_problem: Problem, options: SolveOptions) -> None:
    """Within a hundredth of a standard deviation."""
    best = solve(batch_problem, options)
    groups = np.arange(batch_problem.corner_count).reshape(-1, 4)
    sigma = np.sqrt(np.diagonal(best.corner_covariance(groups), axis1=1, axis2=2))
    corners = np.stack([grown.corners_map(m) for m in range(len(groups))])
    off = (corners - best.corners_map[groups]).reshape(len(groups), 8)
    assert np.max(np.abs(off) / sigma) < 0.01
    stated = np.sqrt([np.diag(grown.corner_covariance(m)) for m in range(len(groups))])
    np.testing.assert_allclose(stated, sigma, rtol=0.02)
    np.testing.assert_allclose(grown.extrinsic_covariance, best.extrinsic_covariance, rtol=0.05, atol=1e-9)


def grow(problem: Problem, noise: Noise = STILL) -> IncrementalMap:
    grown = IncrementalMap(prior_of(problem), noise)
    for marking, observations in enumerate(by_marking(problem)):
        grown.observe(marking, observations)
    return grown


def test_with_poses_taken_at_their_word_it_is_the_papers_optimum():
    problem = whole_markings(street().problem)
    assert_is_the_batch_optimum(grow(problem), problem, SolveOptions(pose_states=(), loss="none"))


def test_with_pose_errors_it_is_the_optimum_of_markings_that_share_none():
    scene = street(frames=40, jitter=JITTER)
    problem = with_frames_of_their_own(whole_markings(scene.problem))
    grown = grow(problem, Noise(JITTER.by_state(), np.inf))
    assert_is_the_batch_optimum(grown, problem, SolveOptions(loss="none"))


def as_one_unit(problem: Problem) -> IncrementalMap:
    """All markings as one, which shares the errors of the images that it is seen in."""
    shared = IncrementalMap(prior_of(problem), noise_of(problem.pose_sigma))
    for seen in in_units(problem, problem.corner_count):
        shared.observe(0, seen)
    return shared


@pytest.mark.parametrize("sigma", [JITTER, DRIFTING], ids=["white", "drifting"])
def test_markings_of_one_unit_share_the_errors_of_their_images(sigma):
    problem = whole_markings(street(frames=40, jitter=sigma).problem)
    best = solve(problem, SolveOptions(loss="none"))
    sigma = np.sqrt(np.diag(best.corner_covariance(np.arange(problem.corner_count)))).reshape(-1, 2)
    unit = as_one_unit(problem)
    assert np.max(np.abs(unit.corners_map(0) - best.corners_map) / sigma) < 0.01
    np.testing.assert_allclose(unit.extrinsic_covariance, best.extrinsic_covariance, rtol=0.05, atol=1e-9)


def test_the_extrinsics_sigmas_hold_where_markings_share_the_drift_of_their_poses():
    """Four markings to a unit: normalised squared errors per degree of freedom, two cameras, ten drives."""
    nees = []
    for seed in range(10):
        scene = street(frames=40, jitter=DRIFTING, noise_seed=seed)
        grown = IncrementalMap(prior_of(scene.problem), noise_of(DRIFTING))
        for unit, seen in enumerate(in_units(whole_markings(scene.problem))):
            grown.observe(unit, seen)
        off = grown.cam_from_vehicle @ np.linalg.inv(scene.cam_from_vehicle)
        tangent = np.concatenate(
            [off[:, :3, 3], np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], axis=1)], axis=1
        )
        covariance = grown.extrinsic_covariance
        nees += [
            error @ np.linalg.solve(own, error) / 6 for error, own in zip(tangent, covariance, strict=True)
        ]
    assert 0.6 < np.mean(nees) < 1.5


def test_sharing_the_errors_of_images_makes_corners_more_exact():
    """On the average of eight drives of one street: on a single one chance has a say."""
    together, apart = [], []
    for seed in range(8):
        scene = street(frames=40, jitter=JITTER, noise_seed=seed)
        problem = whole_markings(scene.problem)
        grown = grow(problem, Noise(JITTER.by_state(), np.inf))
        alone = np.concatenate([grown.corners_map(m) for m in grown.markings])
        truth = scene.corners_map[: len(alone)]
        together.append(np.mean(np.square(as_one_unit(problem).corners_map(0) - truth)))
        apart.append(np.mean(np.square(alone - truth)))
    assert np.sqrt(np.mean(together) / np.mean(apart)) < 0.8


def test_a_marking_seen_again_is_re_estimated_from_all_it_was_ever_seen_in():
    problem = whole_markings(street().problem)
    markings = by_marking(problem)
    whole, twice = grow(problem), IncrementalMap(prior_of(problem), STILL)
    later = {}
    for marking, seen in enumerate(markings):
        early = seen.frame <= np.median(seen.frame)
        if len(np.unique(seen.corner[early])) < 4 or len(np.unique(seen.corner[~early])) < 4:
            early[:] = True
        parts = [MarkingObservations(*(v[rows] for v in vars(seen).values())) for rows in (early, ~early)]
        twice.observe(marking, parts[0])
        if len(parts[1].camera):
            later[marking] = parts[1]
    assert len(later) > 5
    for marking, seen in later.items():
        twice.observe(marking, seen)
    for marking in whole.markings:
        sigma = np.sqrt(np.diag(whole.corner_covariance(marking))).reshape(4, 2)
        off = twice.corners_map(marking) - whole.corners_map(marking)
        assert np.max(np.abs(off) / sigma) < 0.01
        np.testing.assert_allclose(
            twice.corner_covariance(marking), whole.corner_covariance(marking), rtol=0.05, atol=1e-7
        )


def test_a_forgotten_marking_leaves_no_trace():
    problem = whole_markings(street().problem)
    markings = by_marking(problem)
    without, with_and_back = (IncrementalMap(prior_of(problem), STILL) for _ in range(2))
    for marking, seen in enumerate(markings[:8]):
        without.observe(marking, seen)
        with_and_back.observe(marking, seen)
    with_and_back.observe(99, markings[9])
    assert np.abs(with_and_back.cam_from_vehicle - without.cam_from_vehicle).max() > 1e-7
    with_and_back.forget(99)
    np.testing.assert_allclose(with_and_back.cam_from_vehicle, without.cam_from_vehicle, atol=1e-9)
    with pytest.raises(AdjustError, match="marking 99 is not in the map"):
        with_and_back.corners_map(99)


def test_a_marking_that_cannot_be_re_estimated_stays_as_it_was():
    problem = whole_markings(street().problem)
    markings = by_marking(problem)
    grown = IncrementalMap(prior_of(problem), STILL)
    for marking, seen in enumerate(markings[:4]):
        grown.observe(marking, seen)
    before, corners = grown.cam_from_vehicle, grown.corners_map(2)
    bad = replace(markings[2], pinhole_px=np.full_like(markings[2].pinhole_px, np.nan))
    with pytest.raises(AdjustError, match="pinhole_px of marking 2 is not finite"):
        grown.observe(2, bad)
    np.testing.assert_allclose(grown.cam_from_vehicle, before, atol=1e-9)
    np.testing.assert_allclose(grown.corners_map(2), corners, atol=1e-9)


def test_a_saved_map_goes_on_as_if_nothing_had_happened(tmp_path):
    problem = whole_markings(street(frames=40, jitter=JITTER).problem)
    markings = by_marking(problem)
    noise = Noise(JITTER.by_state(), 3.0, np.array([0.008, 0.008, 0, 0, 0, 0.0005]), np.full(6, 20.0))
    straight_on, stopped = (IncrementalMap(prior_of(problem), noise) for _ in range(2))
    for marking, seen in enumerate(markings[:7]):
        straight_on.observe(marking, seen)
        stopped.observe(marking, seen)
    save_map(stopped, tmp_path / "map.npz")
    resumed = load_map(tmp_path / "map.npz")
    for marking, seen in [*enumerate(markings[7:], 7), (2, markings[2])]:
        straight_on.observe(marking, seen)
        resumed.observe(marking, seen)
    assert list(resumed.markings) == list(straight_on.markings)
    np.testing.assert_array_equal(resumed.cam_from_vehicle, straight_on.cam_from_vehicle)
    for marking in straight_on.markings:
        np.testing.assert_array_equal(resumed.corners_map(marking), straight_on.corners_map(marking))
        np.testing.assert_array_equal(
            resumed.corner_covariance(marking), straight_on.corner_covariance(marking)
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.npz"]


def test_an_empty_map_can_be_saved_and_what_is_no_map_is_refused(tmp_path):
    problem = street().problem
    save_map(IncrementalMap(prior_of(problem), STILL), tmp_path / "empty.npz")
    grown = load_map(tmp_path / "empty.npz")
    grown.observe(0, by_marking(problem)[0])
    assert list(grown.markings) == [0]
    (tmp_path / "text.npz").write_text("no map")
    for name in ("text.npz", "absent.npz"):
        with pytest.raises(AdjustError, match=f"{name}: no saved map can be read here"):
            load_map(tmp_path / name)


def test_the_time_for_a_marking_does_not_grow_with_the_map():
    """Between doublings, the two-hundredth costs what the tenth did."""
    problem = street(frames=20, every_m=3.0).problem
    markings = by_marking(problem)
    grown = IncrementalMap(prior_of(problem), STILL)
    took = []
    for marking in range(200):
        began = time.process_time()
        grown.observe(marking, markings[marking % len(markings)])
        took.append(time.process_time() - began)
    assert np.median(took[150:200]) < 1.5 * np.median(took[9:60]) + 1e-3
