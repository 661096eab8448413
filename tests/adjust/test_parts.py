"""A problem in parts, a visit each, comes out as it does in one piece."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.site import site
from v2hdm.adjust import ControlPoints, KnownLengths, Problem, Solution, SolveOptions, Status, solve
from v2hdm.adjust.engines import numba as kernels
from v2hdm.adjust.parts import Local, solve_in_parts
from v2hdm.adjust.parts.condense import Base
from v2hdm.adjust.parts.split import split
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.errors import AdjustError

NEAR = SolveOptions(coarse=False)
SAME_M = 1e-11


@pytest.fixture(scope="module")
def street() -> Problem:
    return site(3, 40, 12)


def assert_same(one: Solution, other: Solution) -> None:
    assert one.status is other.status is Status.CONVERGED
    assert one.evaluations == other.evaluations
    for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle", "clock_offset_s"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), abs=SAME_M), name
    assert one.cost == pytest.approx(other.cost, rel=1e-11)
    assert (one.verdict == other.verdict).all()


def with_knowledge(problem: Problem) -> Problem:
    """A survey and known lengths, of shared corners and of others, and clocks to be found."""
    _, shared = split(problem, (), False)
    own = np.setdiff1d(np.arange(problem.corner_count), shared)
    first = np.concatenate([shared[:6:2], own[:6:2], own[-1:]])
    second = np.concatenate([shared[1:6:2], own[1:6:2], shared[-1:]])  # the last makes an own corner shared
    start = solve(problem, NEAR).corners_map
    length = np.linalg.norm(start[first] - start[second], axis=1)
    surveyed = np.array([shared[3], own[2], own[-2]])
    step = problem.map_from_vehicle[1, :2, 3] - problem.map_from_vehicle[0, :2, 3]
    twist = np.zeros((len(problem.map_from_vehicle), 6))
    twist[:, 0] = 4 + np.sin(np.arange(len(twist)) / 5) * np.linalg.norm(step)
    return replace(
        problem,
        control=ControlPoints(surveyed, start[surveyed] + 0.01, np.full((3, 2), 0.005)),
        lengths=KnownLengths(first, second, length + 0.003, np.full(len(first), 0.002)),
        twist_vehicle=twist,
    )


@pytest.mark.parametrize(
    ("states", "loss", "gap"),
    [
        (POSE_STATES, "cauchy", 1e-11),
        (("roll", "pitch"), "huber", 1e-11),
        # Which pairs torch's LBFGS keeps depends on |g|_1, which a rotation changes.
        ((), "none", 1e-17),
    ],
)
def test_visits_apart_are_adjusted_as_together(
    street: Problem, states: tuple[str, ...], loss: str, gap: float
) -> None:
    options = replace(NEAR, pose_states=states, loss=loss, gap_tolerance=gap)
    assert_same(solve_in_parts(street, options, Local()), solve(street, options))


def test_so_they_are_with_clocks_lengths_and_a_survey(street: Problem) -> None:
    problem, options = with_knowledge(street), replace(NEAR, clock_offset=True)
    assert_same(solve_in_parts(problem, options, Local()), solve(problem, options))


def test_so_they_are_without_the_kernels(street: Problem) -> None:
    with kernels.reference():
        assert_same(solve_in_parts(street, NEAR, Local()), solve(street, NEAR))


def test_so_they_are_where_a_visit_sees_nothing_of_its_own_or_nothing_shared(street: Problem) -> None:
    alone = site(2, 40, 40)  # both drive the same
    assert all((part.shared >= 0).any() for part in split(alone, (), False)[0])
    apart = site(2, 30, 0, every_m=25.0)
    for problem in (alone, apart):
        assert_same(solve_in_parts(problem, NEAR, Local()), solve(problem, NEAR))


def test_an_own_corner_that_a_length_joins_to_a_shared_one_is_shared(street: Problem) -> None:
    problem = with_knowledge(street)
    _, before = split(street, (), False)
    _, after = split(problem, (), False)
    joined = problem.lengths.first[-1]
    assert joined not in before
    assert joined in after


def test_covariances_of_a_solution_in_parts_are_those_of_the_joint_one(street: Problem) -> None:
    whole, parted = solve(street, NEAR), solve_in_parts(street, NEAR, Local())
    corners = np.array([0, 7, street.corner_count - 1])
    expected = whole.corner_covariance(corners)
    assert parted.corner_covariance(corners) == pytest.approx(expected, rel=1e-6, abs=1e-12)


class Watched(Local):
    """Notes the sizes of all that comes up from a part, and what the median of residuals is."""

    def start(self, parts):
        self.parts, self.sizes = parts, {}
        return super().start(parts)

    def ask(self, question, bases, *arguments):
        answers = super().ask(question, bases, *arguments)
        if question == "quantiles":
            everything = [
                worker._laid.squared(base) for worker, base in zip(self._workers, bases, strict=True)
            ]
            self.medians = [*getattr(self, "medians", []), float(torch.cat(everything).median())]
        if question == "between":
            self.travelled = sum(len(values) for _, values in answers)
        if question == "hand_on":
            self.sizes[question] = [one.information.shape for one in answers]
        return answers


def test_of_a_part_only_the_system_of_what_is_shared_travels(street: Problem) -> None:
    team = Watched()
    solve_in_parts(street, NEAR, team)
    for part, shape in zip(team.parts, team.sizes["hand_on"], strict=True):
        unknowns = 6 * 2 + 2 * int((part.shared >= 0).sum())
        assert shape == (unknowns, unknowns)


def test_the_median_of_all_residuals_is_found_without_them(
    street: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []

    def scale(squared, least):
        found.append(float(squared.median()))
        return least

    monkeypatch.setattr("v2hdm.adjust.parts.solve.annealed_scale", scale)
    team = Watched()
    solve_in_parts(street, NEAR, team)
    assert found == team.medians
    assert team.travelled < 0.05 * len(street.observations.corner)


def test_a_worker_that_is_replaced_answers_the_same(street: Problem) -> None:
    class Forgetful(Local):
        def ask(self, question, bases: list[Base], *arguments):
            self._workers = [
                type(worker)(part) for worker, part in zip(self._workers, self.parts, strict=True)
            ]
            return super().ask(question, bases, *arguments)

        def start(self, parts):
            self.parts = parts
            return super().start(parts)

    known, anew = (solve_in_parts(street, NEAR, team) for team in (Local(), Forgetful()))
    assert (known.corners_map == anew.corners_map).all()
    assert (known.map_from_vehicle == anew.map_from_vehicle).all()


def test_what_cannot_be_parted_is_refused(street: Problem) -> None:
    with pytest.raises(AdjustError, match="by lbfgs on the CPU"):
        solve_in_parts(street, replace(NEAR, solver="lm"), Local())
