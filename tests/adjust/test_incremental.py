"""Marking by marking, the map is the one that the batch adjustment finds."""

from dataclasses import replace

import numpy as np
import pytest

from tests.adjust.scene import make_scene, rows_of
from v2hdm.adjust import ControlPoints, Drift, KnownLengths, PoseSigma, SolveOptions, solve
from v2hdm.adjust.incremental import IncrementalMap, Sighted
from v2hdm.errors import AdjustError

PAPER = SolveOptions(pose_states=(), loss="none")
JITTER = PoseSigma(position_m=0.01, heading_rad=0.001, roll_pitch_rad=0.002, height_m=0.005)
DRIFTING = replace(JITTER, position_m=0.012, position_drift=Drift(0.01, 20.0))


def street(**changes):
    return make_scene(3, **{"frames": 60, "start_error_deg": 1.0, "min_views": 4, **changes})


def part(observations, rows, first=0):
    return replace(rows_of(observations, rows), corner=observations.corner[rows] - first)


def whole_markings(problem):
    """Without the last corners that make no four."""
    count = problem.corner_count // 4 * 4
    rows = np.flatnonzero(problem.observations.corner < count)
    return replace(problem, corner_count=count, observations=part(problem.observations, rows))


def known_beside(problem, truth):
    """With a side of every marking and two surveyed corners of every third one."""
    first = np.arange(0, problem.corner_count, 4)
    surveyed = np.concatenate([first[::3], first[::3] + 2])
    length_m = np.linalg.norm(truth[first] - truth[first + 1], axis=1)
    return replace(
        problem,
        lengths=KnownLengths(first, first + 1, length_m, np.full(len(first), 0.003)),
        control=ControlPoints(surveyed, truth[surveyed], np.tile([0.005, 0.008], (len(surveyed), 1))),
    )


def by_marking(problem):
    """Four corners each, in the order of their numbers, with what the problem knows of them."""
    observations, out = problem.observations, []
    for first in range(0, problem.corner_count - 3, 4):
        of_marking = part(
            observations,
            np.flatnonzero((observations.corner >= first) & (observations.corner < first + 4)),
            first,
        )
        lengths, control = problem.lengths, problem.control
        if lengths is not None:
            is_of_marking = lengths.first // 4 == first // 4
            ends = lengths.first[is_of_marking] - first, lengths.second[is_of_marking] - first
            lengths = KnownLengths(*ends, lengths.length_m[is_of_marking], lengths.sigma_m[is_of_marking])
        if control is not None:
            is_of_marking = control.corner // 4 == first // 4
            control = ControlPoints(
                control.corner[is_of_marking] - first,
                control.points_map[is_of_marking],
                control.sigma_m[is_of_marking],
            )
        out.append(Sighted(of_marking, lengths, control))
    return out


def grow(problem, options=PAPER):
    grown = IncrementalMap(problem, options)
    for marking, sighted in enumerate(by_marking(problem)):
        grown.observe(marking, sighted)
    return grown


def farthest(grown, problem, options):
    """The largest distance of a corner's coordinate from the batch optimum, in standard deviations."""
    best = solve(problem, options)
    groups = np.arange(problem.corner_count).reshape(-1, 4)
    sigma = np.sqrt(np.diagonal(best.corner_covariance(groups), axis1=1, axis2=2))
    corners = np.stack([grown.corners_map(m) for m in range(len(groups))])
    off = (corners - best.corners_map[groups]).reshape(len(groups), 8)
    return float(np.max(np.abs(off) / sigma))


def test_with_poses_taken_at_their_word_it_is_the_papers_optimum():
    problem = whole_markings(street().problem)
    assert len(by_marking(problem)) & (len(by_marking(problem)) - 1), "a power of two has just been solved"
    assert farthest(grow(problem), problem, PAPER) < 0.01


def test_surveyed_corners_and_known_lengths_count_as_in_the_batch():
    scene = street()
    plain = whole_markings(scene.problem)
    problem = known_beside(plain, scene.corners_map)
    grown = grow(problem)
    assert farthest(grown, problem, PAPER) < 0.01
    assert farthest(grown, plain, PAPER) > 0.5


@pytest.mark.parametrize("sigma", [JITTER, DRIFTING], ids=["white", "drifting"])
def test_with_pose_errors_it_is_near_the_batch_and_the_batch_itself_once_adjusted(sigma):
    problem = whole_markings(street(frames=40, jitter=sigma).problem)
    options = SolveOptions(loss="none")
    grown = grow(problem, options)
    assert farthest(grown, problem, options) < 2.0
    grown.adjust()
    assert farthest(grown, problem, options) < 0.01


def test_a_clock_offset_is_found_along():
    scene = street(frames=40)
    twist = np.tile([2.0, 0, 0, 0, 0, 0.05], (40, 1))
    problem = replace(whole_markings(scene.problem), twist_vehicle=twist, clock_sigma_s=0.01)
    options = replace(PAPER, clock_offset=True)
    assert farthest(grow(problem, options), problem, options) < 0.02


def test_a_robust_loss_is_the_batchs():
    problem = whole_markings(street(outliers=0.03).problem)
    options = SolveOptions(pose_states=(), loss="cauchy")
    grown = grow(problem, options)
    grown.adjust()
    assert farthest(grown, problem, options) < 0.01


def test_a_marking_seen_again_is_re_estimated_from_all_it_was_ever_seen_in():
    problem = whole_markings(street().problem)
    grown, later = IncrementalMap(problem, PAPER), {}
    for marking, sighted in enumerate(by_marking(problem)):
        observations = sighted.observations
        early = observations.frame <= np.median(observations.frame)
        if len(np.unique(observations.corner[early])) < 4 or len(np.unique(observations.corner[~early])) < 4:
            early[:] = True
        grown.observe(marking, Sighted(part(observations, np.flatnonzero(early))))
        if not early.all():
            later[marking] = Sighted(part(observations, np.flatnonzero(~early)))
    assert len(later) > 5
    for marking, sighted in later.items():
        grown.observe(marking, sighted)
    assert farthest(grown, problem, PAPER) < 0.01


def test_a_marking_that_cannot_be_re_estimated_stays_as_it_was():
    problem = whole_markings(street().problem)
    markings = by_marking(problem)
    grown = IncrementalMap(problem, PAPER)
    for marking, sighted in enumerate(markings[:9]):
        grown.observe(marking, sighted)
    before, corners = grown.cam_from_vehicle, grown.corners_map(2)
    observations = markings[10].observations
    bad = Sighted(replace(observations, pinhole_px=np.full_like(observations.pinhole_px, np.nan)))
    with pytest.raises(AdjustError, match="not finite"):
        grown.observe(2, bad)
    np.testing.assert_array_equal(grown.cam_from_vehicle, before)
    np.testing.assert_array_equal(grown.corners_map(2), corners)
    assert len(grown.markings[2].observations.corner) == len(markings[2].observations.corner)


def test_markings_that_leave_the_extrinsics_free_wait_for_more():
    problem = replace(whole_markings(street().problem), centre_vehicle=None, centre_sigma_m=None)
    markings = by_marking(problem)
    lone = part(markings[0].observations, np.unique(markings[0].observations.corner, return_index=True)[1])
    grown = IncrementalMap(problem, PAPER)
    grown.observe(0, Sighted(lone))
    assert not grown.is_solved(0)
    with pytest.raises(AdjustError, match="marking 0 is not in the map"):
        grown.corners_map(0)
    np.testing.assert_array_equal(grown.cam_from_vehicle, problem.cam_from_vehicle)


def test_a_preview_is_the_back_projection():
    problem = whole_markings(street(start_error_deg=0.0).problem)
    sighted = by_marking(problem)[0]
    grown = grow(problem)
    np.testing.assert_allclose(grown.preview(sighted), grown.corners_map(0), atol=0.05)


def test_a_marking_that_turns_a_camera_beyond_all_bounds_is_refused():
    # A camera matrix of half the resolution, and a survey whose x has the wrong sign.
    scene = street(frames=40, jitter=JITTER)
    plain = replace(whole_markings(scene.problem), pose_sigma=JITTER)
    mirrored = scene.corners_map * [-1.0, 1.0]
    problem = replace(known_beside(plain, mirrored), lengths=None)
    problem.intrinsic[:, :2] *= 0.5
    grown, refused = IncrementalMap(problem, SolveOptions(loss="none")), 0
    for marking, sighted in enumerate(by_marking(problem)):
        try:
            grown.observe(marking, sighted)
        except AdjustError:
            refused += 1
        assert np.isfinite(grown.cam_from_vehicle).all()
    assert refused
