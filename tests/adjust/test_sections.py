"""Sections of a problem, joined, are the problem: its optimum and its covariances, whatever they share."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.adjust.scene import make_scene, with_ground, with_late_clocks
from tests.adjust.site import DRIFTING
from tests.adjust.test_sessions import joined, visited_again
from v2hdm.adjust import ControlPoints, KnownLengths, Problem, SolveOptions, solve
from v2hdm.adjust.sections import rounds, summary
from v2hdm.adjust.sections.blocks import BlockMatrix, BlockPattern
from v2hdm.adjust.sections.parts import Part, cut
from v2hdm.adjust.sections.rounds import Job, Shape, Work, load_told, save_part
from v2hdm.adjust.sections.solve import finish_parts, fit_parts, join_parts
from v2hdm.adjust.sections.way import parts_of_way
from v2hdm.adjust.whitening import factorise
from v2hdm.errors import AdjustError


def test_blocks_of_the_inverse_are_those_of_the_inverse():
    """Two chains of blocks that meet in the last one, against numpy."""
    sizes = (3, 1, 4, 2, 5)
    pattern = BlockPattern.of(sizes, [(0, 1, 4), (1, 2, 4), (3, 4)], last=4)
    matrix = BlockMatrix.zeros(pattern)
    begins = np.cumsum([0, *sizes])
    rng = np.random.default_rng(1)
    whole = np.zeros((15, 15))
    for clique in ((0, 1, 4), (1, 2, 4), (3, 4)):
        rows = np.concatenate([np.arange(begins[block], begins[block + 1]) for block in clique])
        root = rng.normal(size=(len(rows), len(rows)))
        whole[np.ix_(rows, rows)] += root @ root.T + np.eye(len(rows))
    for (row, column), block in matrix.blocks.items():
        block += whole[begins[row] : begins[row + 1], begins[column] : begins[column + 1]]
    factor = matrix.factorise()
    right = rng.normal(size=15)
    solved = factor.solve(np.split(right, begins[1:-1]))
    np.testing.assert_allclose(np.concatenate(solved), np.linalg.solve(whole, right))
    inverse = np.linalg.inv(whole)
    for (row, column), block in factor.inverse().items():
        expected = inverse[begins[row] : begins[row + 1], begins[column] : begins[column + 1]]
        np.testing.assert_allclose(block, expected, atol=1e-12)


def test_drives_along_one_street_are_in_one_part():
    street = np.column_stack([np.linspace(0.0, 1000.0, 501), np.zeros(501)])
    there_and_back = np.concatenate([street, street[::-1] + np.array([0.0, 3.0])])
    part = parts_of_way(there_and_back, np.repeat([0, 1], 501), 600.0)
    assert len(set(part.tolist())) == 4
    np.testing.assert_array_equal(part[:501], part[501:][::-1])


def test_a_street_is_cut_where_few_frames_look_across():
    """Two yards of five passes each, 8 m apart, joined by a street of one pass: the cut is in the street."""
    way_map = np.column_stack([np.arange(0.0, 100.0, 2.0), np.zeros(50)])
    passes = np.concatenate([way_map + np.array([0.0, 8.0 * row]) for row in range(5)])
    street = np.column_stack([np.arange(100.0, 240.0, 2.0), np.zeros(70)])
    position = np.concatenate([passes, street, passes + np.array([240.0, 0.0])])
    session = np.repeat(np.arange(11), [50] * 5 + [70] + [50] * 5)
    part = parts_of_way(position, session, 700.0)
    assert part.max() == 1
    assert len(set(part[:250].tolist())) == 1
    assert len(set(part[320:].tolist())) == 1


def finish(number, part, solution):
    """All that is compared, picklable."""
    corners = np.arange(part.problem.corner_count)[:, None]
    return {
        "part": part,
        "solution": replace(solution, covariance=None),
        "corners": solution.covariance.corners(corners),
        "pairs": solution.corner_covariance(np.arange(min(6, len(corners))).reshape(-1, 2)),
        "extrinsic": solution.extrinsic_covariance,
        "poses": solution.covariance.poses(),
    }


def in_sections(
    folder: Path,
    problem: Problem,
    options: SolveOptions,
    part_of_frame,
    at_once: int = 0,
    are_near: bool = False,
) -> list[dict]:
    """The results of all parts."""
    parts, links = cut(problem, part_of_frame, tuple(options.pose_states))
    for number, part in enumerate(parts):
        save_part(folder, number, part)
    shape = Shape.of(problem, options)
    joint = join_parts(
        folder, len(parts), links, shape, lambda number, part, solution: None,
        at_once=at_once, are_near=are_near,
    )  # fmt: skip
    return finish_parts(folder, joint, shape, finish)


def check(results: list[dict], problem: Problem, options: SolveOptions) -> None:
    """Corners within a hundredth of a millimetre of the joint solve, sigmas within a thousandth."""
    whole = solve(problem, options)
    every = whole.covariance.corners(np.arange(problem.corner_count)[:, None])
    poses = whole.covariance.poses()
    is_covered = np.zeros(problem.corner_count, dtype=bool)
    for result in results:
        part: Part = result["part"]
        solution = result["solution"]
        is_covered[part.corners] = True
        np.testing.assert_allclose(solution.corners_map, whole.corners_map[part.corners], atol=1e-5)
        np.testing.assert_allclose(solution.map_from_vehicle, whole.map_from_vehicle[part.frames], atol=1e-5)
        cameras = whole.cam_from_vehicle[part.cameras]
        np.testing.assert_allclose(solution.cam_from_vehicle, cameras, atol=1e-5)
        clock = whole.clock_offset_s[part.cameras]
        np.testing.assert_allclose(solution.clock_offset_s, clock, atol=1e-6)
        np.testing.assert_allclose(result["corners"], every[part.corners], rtol=2e-3, atol=1e-12)
        groups = part.corners[np.arange(min(6, len(part.corners))).reshape(-1, 2)]
        np.testing.assert_allclose(result["pairs"], whole.corner_covariance(groups), rtol=5e-3, atol=1e-9)
        extrinsic = whole.extrinsic_covariance[part.cameras]
        np.testing.assert_allclose(result["extrinsic"], extrinsic, rtol=5e-3, atol=1e-12)
        np.testing.assert_allclose(result["poses"], poses[part.frames], rtol=2e-3, atol=1e-14)
    assert is_covered.all()


def test_sections_of_a_street_are_the_street(tmp_path):
    scene = make_scene(3, frames=160, jitter=DRIFTING, outliers=0.03, start_error_deg=1.0)
    scene = with_ground(scene, 0.1, 0.01)
    position = scene.problem.map_from_vehicle[:, :2, 3]
    part = parts_of_way(position, np.zeros(len(position), dtype=np.int64), 26.0)
    assert part.max() == 3
    options = SolveOptions()
    check(in_sections(tmp_path, scene.problem, options, part), scene.problem, options)


def test_the_information_of_a_border_stays_in_a_file_until_it_is_joined(tmp_path):
    scene = make_scene(3, frames=40)
    options = SolveOptions()
    parts, _ = cut(scene.problem, np.arange(40) // 20, tuple(options.pose_states))
    save_part(tmp_path, 0, parts[0])
    state = Work(tmp_path, Shape.of(scene.problem, options))(Job(0))
    unknowns = len(state.told.slope)
    assert unknowns > 6
    assert state.told.information.size == 0
    information = load_told(tmp_path, 0, state).information
    assert information.shape == (unknowns, unknowns)
    np.testing.assert_allclose(information, information.T, rtol=1e-6, atol=1e-6 * information.max())


def test_sections_that_are_solved_at_once_are_the_street(tmp_path):
    """Two drives with late clocks, in whose parts corners and frames have numbers of their own."""
    scene = with_late_clocks(make_scene(3, frames=80, start_error_deg=0.5), np.array([0.004, -0.006]))
    problem = joined(scene.problem, visited_again(scene, DRIFTING, 5).problem)
    options = SolveOptions(clock_offset=True)
    part = np.tile(np.arange(80) // 40, 2)
    everything = len(problem.observations.corner)
    check(in_sections(tmp_path, problem, options, part, at_once=everything), problem, options)


def test_sections_that_start_near_their_joint_optimum_are_the_street(tmp_path):
    scene = make_scene(3, frames=100, jitter=DRIFTING, outliers=0.03, start_error_deg=0.5)
    options = SolveOptions()
    rough = solve(scene.problem, replace(options, gap_tolerance=1e-3))
    near_optimum = replace(
        scene.problem,
        cam_from_vehicle=rough.cam_from_vehicle,
        poses_start=rough.map_from_vehicle,
        corners_start=rough.corners_map,
    )
    check(
        in_sections(tmp_path, near_optimum, options, np.arange(100) // 50, are_near=True),
        scene.problem,
        options,
    )


def test_sections_without_frame_states_are_the_street(tmp_path):
    scene = make_scene(4, frames=100, start_error_deg=1.0)
    options = SolveOptions(pose_states=())
    check(in_sections(tmp_path, scene.problem, options, np.arange(100) // 50), scene.problem, options)


def test_sections_of_two_drives_with_late_clocks_are_both(tmp_path):
    scene = with_late_clocks(make_scene(3, frames=80, start_error_deg=0.5), np.array([0.004, -0.006]))
    again = visited_again(scene, DRIFTING, 5)
    problem = joined(scene.problem, again.problem)
    options = SolveOptions(clock_offset=True)
    part = np.tile(np.arange(80) // 40, 2)
    check(in_sections(tmp_path, problem, options, part), problem, options)


def test_surveyed_corners_and_known_lengths_count_once(tmp_path):
    scene = make_scene(3, frames=100, jitter=DRIFTING, start_error_deg=0.5)
    corners = np.arange(0, scene.problem.corner_count, 3)
    control = ControlPoints(corners, scene.corners_map[corners], np.full((len(corners), 2), 0.01))
    first = np.arange(0, scene.problem.corner_count - 3, 4)
    length_m = np.linalg.norm(scene.corners_map[first] - scene.corners_map[first + 2], axis=1)
    lengths = KnownLengths(first, first + 2, length_m, np.full(len(first), 0.005))
    problem = replace(scene.problem, control=control, lengths=lengths)
    options = SolveOptions()
    check(in_sections(tmp_path, problem, options, np.arange(100) // 50), problem, options)


def test_a_section_may_know_a_corner_along_one_line_alone(tmp_path):
    scene = make_scene(3, frames=100, jitter=DRIFTING, start_error_deg=0.5)
    observations = scene.problem.observations
    covariance = observations.covariance_px.copy()
    part = np.arange(100) // 50
    late = part[observations.frame] == 1
    early = np.isin(observations.corner, np.unique(observations.corner[~late]))
    covariance[late & early] = np.array([[0.25, 0.0], [0.0, 2500.0]])
    problem = replace(scene.problem, observations=replace(observations, covariance_px=covariance))
    check(in_sections(tmp_path, problem, SolveOptions(), part), problem, SolveOptions())


def test_a_section_of_two_observations_leaves_the_others_as_they_are(tmp_path):
    scene = make_scene(3, frames=100, jitter=DRIFTING, start_error_deg=0.5)
    observations = scene.problem.observations
    keep = np.concatenate(
        [np.flatnonzero(observations.frame < 96), np.flatnonzero(observations.frame >= 96)[:2]]
    )
    problem = replace(scene.problem, observations=observations.take(keep))
    part = (np.arange(100) >= 96).astype(np.int64)
    check(in_sections(tmp_path, problem, SolveOptions(), part), problem, SolveOptions())


def contradicting():
    """Two drives of one street, of which the second's poses are half a metre off, 25 sigmas."""
    scene = make_scene(3, frames=80, start_error_deg=0.5)
    again = visited_again(scene, DRIFTING, 5)
    off = again.problem.map_from_vehicle.copy()
    off[:, :2, 3] += 0.5
    return joined(scene.problem, replace(again.problem, map_from_vehicle=off))


def test_drives_whose_poses_contradict_each_other_end_in_one_line(tmp_path):
    problem = contradicting()
    with pytest.raises(
        AdjustError, match=r"the drives contradict each other, most about x .* chi-square 1\d for"
    ) as refused:
        in_sections(tmp_path, problem, SolveOptions(), np.repeat([0, 1], 80))
    assert "\n" not in str(refused.value)


def from_their_optimum(part: Part, options: SolveOptions) -> Part:
    """The part, whose problem starts where a solve of itself ends."""
    alone = solve(part.problem, options)
    return replace(
        part,
        problem=replace(
            part.problem,
            cam_from_vehicle=alone.cam_from_vehicle,
            poses_start=alone.map_from_vehicle,
            corners_start=alone.corners_map,
        ),
    )


def test_drives_that_contradict_each_other_do_so_from_their_own_optima(tmp_path):
    problem = contradicting()
    options = SolveOptions()
    parts, links = cut(problem, np.repeat([0, 1], 80), tuple(options.pose_states))
    for number, part in enumerate(parts):
        save_part(tmp_path, number, from_their_optimum(part, options))
    with pytest.raises(AdjustError, match=r"the drives contradict each other, .* chi-square 1\d for"):
        fit_parts(
            tmp_path, 2, links, Shape.of(problem, options), lambda number, part, solution: None,
            at_once=0, are_near=True,
        )  # fmt: skip


def test_rounds_go_on_from_a_whitening_of_an_earlier_one(tmp_path, monkeypatch):
    """A part is whitened where it starts, after the long first step, and for its covariances."""
    scene = make_scene(3, frames=100, jitter=DRIFTING, outliers=0.03, start_error_deg=0.5)
    options = SolveOptions()
    parts, links = cut(scene.problem, np.arange(100) // 50, tuple(options.pose_states))
    for number, part in enumerate(parts):
        save_part(tmp_path, number, from_their_optimum(part, options))
    whitened = []

    def counted(*inputs):
        whitened.append(inputs)
        return factorise(*inputs)

    monkeypatch.setattr(rounds, "factorise", counted)
    shape = Shape.of(scene.problem, options)
    joint = join_parts(
        tmp_path, 2, links, shape, lambda number, part, solution: None, at_once=0, are_near=True
    )
    assert joint.rounds > 3
    assert len(whitened) <= 2 * 3
    check(finish_parts(tmp_path, joint, shape, finish), scene.problem, options)
    assert len(whitened) <= 2 * 3


def test_a_single_section_is_the_street(tmp_path):
    scene = make_scene(3, frames=60, jitter=DRIFTING, start_error_deg=1.0)
    options = SolveOptions()
    part = np.zeros(60, dtype=np.int64)
    check(in_sections(tmp_path, scene.problem, options, part), scene.problem, options)


def compare_pairs(number, part, solution):
    """Covariances of groups of which some are known, beside those of groups that are asked for."""
    covariance = solution.covariance
    groups = np.arange(part.problem.corner_count // 3 * 3).reshape(-1, 3)[::-1]
    # Every third group is not known, and one corner stands twice in a group.
    groups[0, 1] = groups[0, 0]
    known = groups[np.arange(len(groups)) % 3 > 0]
    first, second = np.broadcast_arrays(known[:, :, None], known[:, None, :])
    knowing = covariance.with_pairs(first.ravel(), second.ravel())
    return knowing.corners(groups), covariance.corners(groups), knowing.pairs.of_groups(known).is_known


@pytest.mark.parametrize("states", [("roll", "pitch"), ()])
def test_covariances_of_pairs_are_those_of_groups(tmp_path, monkeypatch, states):
    """Also where the corners of a pair are solved for one after the other, as in a long section."""
    monkeypatch.setattr(summary, "_CORNERS_AT_ONCE", 7)
    scene = make_scene(3, frames=100, jitter=DRIFTING if states else None, start_error_deg=0.5)
    options = SolveOptions(pose_states=states)
    parts, links = cut(scene.problem, np.arange(100) // 50, states)
    for number, part in enumerate(parts):
        save_part(tmp_path, number, part)
    shape = Shape.of(scene.problem, options)
    joint = join_parts(tmp_path, 2, links, shape, lambda number, part, solution: None)
    for known, asked, is_known in finish_parts(tmp_path, joint, shape, compare_pairs):
        assert is_known.all()
        np.testing.assert_allclose(known, asked, rtol=1e-8, atol=1e-14)
