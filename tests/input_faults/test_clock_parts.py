"""Errors of clocks of a drive in parts are those of the drive: none of its parts tells them by itself."""

import numpy as np
import pytest

from tests.input_faults.test_clock_errors import seen_later, street
from v2hdm.adjust import SolveOptions, solve
from v2hdm.adjust.sections.parts import chains_of, cut
from v2hdm.adjust.sections.rounds import Shape, save_part
from v2hdm.adjust.sections.solve import finish_parts, join_parts
from v2hdm.faults.clock_errors import ClockErrors, errors_of_clocks, moves_with_clocks
from v2hdm.faults.clock_parts import Along, evidence_of, follow_of, segments_of, slopes_of
from v2hdm.faults.score_tests import noise_multiples
from v2hdm.faults.sensitivity import Sensitivity, stretches_of_way, to_optimum
from v2hdm.records import PoseNoise

OPTIONS = SolveOptions(coarse=False, loss="none")
NOISES = [PoseNoise(clock_s=0.03, clock_drift_s=0.05)]


@pytest.fixture(scope="module")
def problem():
    """A street that bends, whose clock runs 20 ms fast."""
    scene = street(turn_deg_per_m=1.5)
    return seen_later(scene, np.linspace(-0.01, 0.01, 60))


@pytest.fixture(scope="module")
def whole(problem):
    return solve(problem, OPTIONS)


@pytest.fixture(scope="module")
def parts(problem, tmp_path_factory):
    """The evidence of three parts on the errors, and how each of them follows these."""
    folder = tmp_path_factory.mktemp("parts")
    part_of_frame = np.arange(60) // 20
    cuts, links = cut(problem, part_of_frame, tuple(OPTIONS.pose_states))
    is_start = chains_of(problem, part_of_frame, tuple(OPTIONS.pose_states)).is_start
    stretch = stretches_of_way(problem.map_from_vehicle[:, :2, 3], np.zeros(60, dtype=np.int64))
    rising = np.linspace(-0.5, 0.5, 60)
    for number, part in enumerate(cuts):
        save_part(folder, number, part)
    shape = Shape.of(problem, OPTIONS)
    joint = join_parts(folder, 3, links, shape, lambda number, part, solution: None)

    def along(number):
        frames = cuts[number].frames
        is_linked = is_start[frames] & (number > 0)
        return Along(number, stretch[frames], int(stretch.max()) + 1, rising[frames], is_linked)

    def told(number, part, solution):
        return slopes_of(part.problem, solution, NOISES, along(number))

    steps = joint.steps(finish_parts(folder, joint, shape, told))

    def weighed(number, part, solution):
        return segments_of(part.problem, solution, NOISES, along(number), steps[number])

    segments = finish_parts(folder, joint, shape, weighed)

    def moved(number, part, solution):
        follow = follow_of(solution, steps[number][:, :2])
        errors = ClockErrors(np.eye(2), rising[part.frames], follow)
        return part, moves_with_clocks(part.problem, solution, NOISES, errors)

    return segments, finish_parts(folder, joint, shape, moved)


def test_parts_together_tell_as_much_of_the_clock_as_the_whole(problem, whole, parts):
    segments, _ = parts
    solved = Sensitivity.at(whole.covariance.whitening)
    late = [error.hypothesis(problem) for error in errors_of_clocks(problem, NOISES)]
    net = solved.efficient_columns([hypothesis.column(solved) for hypothesis in late])
    information = np.sum([part.products for part in segments], axis=(0, 3))
    np.testing.assert_allclose(information / (net @ net.T), 1.0, rtol=0.01)
    score = np.sum([part.score for part in segments], axis=(0, 2))
    # The priors of two of the sixty frames, which are predicted from another part, are counted in none.
    off = score + net @ solved.flat(solved.residuals)
    assert (np.abs(off) < 0.15 * np.sqrt(np.diag(information))).all()
    # Noise that is drawn for parts and for the whole is not the same.
    joined = evidence_of(segments)
    multiple = noise_multiples(late, solved)
    np.testing.assert_allclose(np.diag(information) / np.diag(joined.information), multiple, rtol=0.1)


def test_parts_follow_an_error_of_the_clock_as_the_whole_does(problem, whole, parts):
    _, moved = parts
    errors = ClockErrors(np.eye(2), np.linspace(-0.5, 0.5, 60), to_optimum)
    moves = moves_with_clocks(problem, whole, NOISES, errors)
    for part, of_part in moved:
        for name, index in (("corners", part.corners), ("poses", part.frames), ("extrinsic", part.cameras)):
            ours = getattr(of_part, name)
            theirs = getattr(moves, name)[index]
            np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max(), err_msg=name)


def test_clocks_that_are_stated_to_be_right_are_asked_of_no_part(problem, tmp_path):
    cuts, links = cut(problem, np.zeros(60, dtype=np.int64), tuple(OPTIONS.pose_states))
    save_part(tmp_path, 0, cuts[0])
    shape = Shape.of(problem, OPTIONS)
    joint = join_parts(tmp_path, 1, links, shape, lambda number, part, solution: None)
    none = np.zeros(60, dtype=np.int64)
    along = Along(0, none, 1, np.zeros(60), none > 0)

    def told(number, part, solution):
        return slopes_of(part.problem, solution, [PoseNoise()], along)

    assert finish_parts(tmp_path, joint, shape, told) == [None]
