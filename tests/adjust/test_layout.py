"""The solver's own tables, its minimiser, and what a process pays for its first solve."""

import dataclasses
import math
import os
import subprocess
import sys
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from v2hdm import native
from v2hdm.adjust import KnownLengths, PoseSigma, SolveOptions, arrays, covariance, solve
from v2hdm.adjust.covariance import Moves
from v2hdm.adjust.descent import minimise
from v2hdm.adjust.kernels.layout import Seen, arrange, find_touched, first_not_rigid, lay_out
from v2hdm.adjust.problem import LINE_EXCESS, POSE_STATES
from v2hdm.adjust.solution import Verdict, classify
from v2hdm.geometry.rigid import exp


def street(**changes):
    """Corners far apart on the route, joined by lengths: 0 to 5 to 40, and 7 to 9."""
    problem = make_scene(2, frames=40, jitter=PoseSigma(), **changes).problem
    lengths = KnownLengths(np.array([0, 5, 9]), np.array([5, 40, 7]), np.full(3, 2.0), np.full(3, 9.0))
    return dataclasses.replace(problem, lengths=lengths)


@pytest.mark.parametrize("pose_states", [(), POSE_STATES])
def test_the_optimum_is_the_same_in_short_runs_and_in_one(monkeypatch, pose_states):
    options = SolveOptions(pose_states=pose_states)
    whole = solve(street(outliers=0.02), options)
    monkeypatch.setattr(arrays, "_RUN", 50)
    parts = solve(street(outliers=0.02), options)
    assert parts.cost == pytest.approx(whole.cost, rel=1e-12)
    np.testing.assert_allclose(parts.corners_map, whole.corners_map, atol=1e-9)
    np.testing.assert_allclose(parts.mahalanobis2, whole.mahalanobis2, atol=1e-6)
    groups = np.array([[0, 40], [9, 12]])
    covariance = whole.corner_covariance(groups)
    np.testing.assert_allclose(parts.corner_covariance(groups), covariance, rtol=1e-6)


def test_the_covariance_of_corners_that_lengths_join_knows_the_lengths_however_they_are_grouped():
    problem = make_scene(3, frames=30, cameras=1, start_error_deg=0.0, start_error_m=0.0).problem
    first, second = np.array([2, 3]), np.array([3, 8])
    length_m = np.array([0.5, 3.0])
    lengths = KnownLengths(first, second, length_m, np.array([0.003, 0.004]))
    solution = solve(dataclasses.replace(problem, lengths=lengths), SolveOptions(pose_states=(), loss="none"))
    joint = solution.corner_covariance(np.array([2, 3, 8, 20]))
    part = solution.corner_covariance(np.array([[8, 20], [3, 2]]))
    np.testing.assert_allclose(part[0], joint[4:, 4:], rtol=1e-9)
    np.testing.assert_allclose(part[1], joint[[2, 3, 0, 1]][:, [2, 3, 0, 1]], rtol=1e-9)
    assert np.linalg.eigvalsh(joint).min() > 0
    for k, sigma_m in enumerate((0.003, 0.004)):
        difference_m = solution.corners_map[first[k]] - solution.corners_map[second[k]]
        direction = difference_m / np.linalg.norm(difference_m)
        along = np.zeros(8)
        along[2 * k : 2 * k + 4] = np.concatenate([direction, -direction])
        assert np.sqrt(along @ joint @ along) < sigma_m


def test_columns_are_solved_for_once_and_as_many_are_kept_as_memory_allows(monkeypatch):
    solution = solve(street(), SolveOptions(pose_states=POSE_STATES))
    groups = np.array([[0, 40], [9, 12]])
    alone = solution.corner_covariance(groups)
    for most in (2000, 0):
        monkeypatch.setattr(covariance, "_NUMBERS_KEPT", most)
        again = dataclasses.replace(solution.covariance, roots=type(solution.covariance.roots)())
        np.testing.assert_array_equal([again.corners(groups), again.corners(groups)], [alone, alone])
    common = Moves(np.ones((len(solution.corners_map), 2, 1)), np.zeros((2, 6, 1)), np.zeros((40, 6, 1)))
    monkeypatch.setattr(covariance, "reduced_root", None)
    uncertain = dataclasses.replace(solution.covariance, held=common)
    np.testing.assert_allclose(uncertain.corners(groups), alone + 1.0)


@pytest.mark.parametrize("compiled", [True, False])
def test_observations_are_sorted_by_corner_and_pair_whatever_was_in_memory(compiled):
    """Their room is not cleared: even what looks like duplicates there is none."""
    rng = np.random.default_rng(0)
    count, cameras, frames, corners = 300, 2, 15, 11
    chosen = rng.choice(cameras * frames * corners, count, replace=False)
    camera, frame, corner = np.unravel_index(chosen, (cameras, frames, corners))
    rank = rng.permutation(corners)
    sorted_observations = Seen.of(
        (camera, frame, corner, np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1))),
        np.ones((cameras, 4)),
    )
    order, rank_of_corner, pair = np.zeros((3, count), dtype=np.int32)
    corner_at = np.zeros(corners + 1, dtype=np.int64)
    with nullcontext() if compiled else native.numpy_alone():
        repeated = arrange(sorted_observations, rank, frames, corner_at, order, rank_of_corner, pair)
    assert repeated == -1
    np.testing.assert_array_equal(order, np.lexsort((frame, camera, rank[corner])))
    np.testing.assert_array_equal(rank_of_corner, rank[corner][order])
    np.testing.assert_array_equal(pair, (camera * frames + frame)[order])


@pytest.mark.parametrize("compiled", [True, False])
def test_the_first_observation_that_repeats_another_is_found(compiled):
    camera, frame, corner = np.array([[0, 1, 0, 1, 0], [2, 2, 1, 2, 0], [1, 0, 1, 0, 1]])
    sorted_observations = Seen.of(
        (camera, frame, corner, np.zeros((5, 2)), np.tile(np.eye(2), (5, 1, 1))), np.ones((2, 4))
    )
    order, rank_of_corner, pair = np.zeros((3, 5), dtype=np.int32)
    corner_at = np.zeros(3, dtype=np.int64)
    with nullcontext() if compiled else native.numpy_alone():
        repeated = arrange(sorted_observations, np.arange(2), 3, corner_at, order, rank_of_corner, pair)
    assert order[repeated - 1 : repeated + 1].tolist() == [1, 3]


@pytest.mark.parametrize("compiled", [True, False])
def test_pairs_that_a_chunk_touches_are_those_of_its_observations_in_order(compiled):
    pairs = 40
    pair = np.random.default_rng(1).integers(0, pairs, 200).astype(np.int32)
    chunk = np.array([0, 7, 7, 130, 200])
    touched = np.empty_like(pair)
    touched_at = np.empty(len(chunk), dtype=np.int64)
    with nullcontext() if compiled else native.numpy_alone():
        count = find_touched(pair, chunk, np.zeros(pairs, dtype=np.uint8), touched, touched_at)
    expected = [np.unique(pair[begin:end]) for begin, end in pairwise(chunk)]
    np.testing.assert_array_equal(touched[:count], np.concatenate(expected))
    np.testing.assert_array_equal(np.diff(touched_at), [len(part) for part in expected])


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("wrong", ["scale", "mirror", "last row", "nan"])
def test_the_first_transform_that_is_not_rigid_is_found(compiled, wrong):
    transforms = exp(0.3 * np.random.default_rng(2).standard_normal((9, 6)))
    with nullcontext() if compiled else native.numpy_alone():
        assert first_not_rigid(transforms, 1e-6) == -1
        for k in (4, 7):
            if wrong == "scale":
                transforms[k, :3, :3] *= 1 + 1e-5
            elif wrong == "mirror":
                transforms[k, :3, 1] *= -1
            else:
                transforms[k, 3 if wrong == "last row" else 1, 2] = math.nan if wrong == "nan" else 1e-9
        assert first_not_rigid(transforms, 1e-6) == 4


@pytest.mark.parametrize("compiled", [True, False])
def test_observations_of_lines_are_counted_as_they_are_laid_out(compiled):
    problem = make_scene(0, frames=12).problem
    sightings = problem.observations
    covariance_px = sightings.covariance_px.copy()
    covariance_px[::5, 0, 0] *= 1e5
    observations = dataclasses.replace(sightings, covariance_px=covariance_px)
    count = len(sightings.corner)
    order = np.arange(count, dtype=np.int32)
    frames = len(problem.map_from_vehicle)
    pair = (sightings.camera * frames + sightings.frame).astype(np.int32)
    with nullcontext() if compiled else native.numpy_alone():
        columns = Seen.of(observations.columns, problem.intrinsic)
        lines = lay_out(columns, order, pair, frames, LINE_EXCESS, np.empty((2, count)), np.empty((3, count)))
    assert lines == np.count_nonzero(observations.on_line) == -(-count // 5)


@pytest.mark.parametrize("compiled", [True, False])
def test_verdicts_are_by_gate_and_camera_and_the_last_of_several_is_unconfirmed(compiled):
    """Corner 0 keeps two, corner 1 the last of three, corner 2 its only one, corner 3 none."""
    corner = np.array([0, 1, 2, 1, 0, 1, 3, 0])
    squared = np.array([1.0, 30.0, 2.0, 3.0, 4.0, 5.0, 90.0, 50.0])
    behind = np.array([False, False, False, False, False, True, False, False])
    observations = dataclasses.replace(make_scene(0, frames=12).problem.observations, corner=corner)
    with nullcontext() if compiled else native.numpy_alone():
        verdict = classify(observations, squared, behind, math.exp(-10.0), 1.0)
    ok, far, alone, back = (
        Verdict.ACCEPTED, Verdict.CONTRADICTS, Verdict.UNCONFIRMED, Verdict.BEHIND_CAMERA
    )  # fmt: skip
    assert verdict.tolist() == [ok, far, ok, alone, ok, back, far, far]


CENTRE = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
CURVATURE = torch.tensor([1.0, 30.0, 900.0], dtype=torch.float64)


def bowl(whitened):
    off = whitened - CENTRE
    return 0.5 * float((CURVATURE * off * off).sum()), CURVATURE * off


@pytest.mark.parametrize("wrong", ["cost", "gradient", "both"])
@pytest.mark.parametrize("first_wrong", range(1, 12))
def test_where_the_objective_is_no_number_the_point_before_it_stands(wrong, first_wrong):
    calls = 0

    def objective(whitened):
        nonlocal calls
        calls += 1
        cost, gradient = bowl(whitened)
        if calls >= first_wrong:
            # A small gradient passes for the end of a line search, which then has no bracket to speak of.
            cost = cost * math.nan if wrong != "gradient" else cost
            gradient = gradient * (1e-3 if wrong == "cost" else math.nan)
        return cost, gradient

    start_cost, start_gradient = bowl(torch.zeros(3, dtype=torch.float64))
    minimum = minimise(objective, start_cost, start_gradient, 1e-12, 30)
    cost, gradient = bowl(minimum.whitened)
    assert minimum.cost <= start_cost
    assert minimum.cost == pytest.approx(cost)
    torch.testing.assert_close(minimum.gradient, gradient)


ROOT = Path(__file__).parents[2]

SOLVE = """
import sys
import numpy as np
{before}
from tests.adjust.scene import make_scene
from v2hdm.adjust import SolveOptions, solve
solution = solve(make_scene(0, frames=30).problem, SolveOptions(pose_states=()))
{after}
print(repr(solution.cost))
"""


def cost_in_a_fresh_process(before="", after=""):
    """That of a small problem; ``before`` and ``after`` are run around its solve."""
    return float(said_by(SOLVE.format(before=before, after=after)))


def said_by(program):
    """The output of a program, which must succeed and say nothing on stderr."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", program]
    process = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")
    return process.stdout.strip()


def test_torch_does_not_import_its_compiler_but_where_it_has_another_mark_than_we_know():
    """The mark is private: one that cannot be set stands for what a later torch may have."""
    before = """
import torch
from v2hdm.adjust import descent
class Shut:
    __slots__ = ()
    def __call__(self, *arguments): raise AssertionError
torch.optim.Optimizer.shut = type("Wrapper", (), {"__wrapped__": Shut()})()
"""
    usual = cost_in_a_fresh_process(after="assert 'torch._dynamo' not in sys.modules")
    assert cost_in_a_fresh_process(before) == usual


OWN_KERNEL = """
from v2hdm.compiled import kernel

@kernel
def double(values):
    for k in range(len(values)):
        values[k] *= 2
"""

KERNEL = """
import sys
from pathlib import Path

import numpy as np
from v2hdm import compiled
compiled.PLACES = (Path({place!r}),)
sys.path.insert(0, {folder!r})
from own_kernel import double
out = np.ones(1)
double(out)
print(out)
"""


def test_kernels_are_kept_and_where_they_cannot_be_they_are_compiled(tmp_path):
    """In a folder that is a file, or from damaged files, a process compiles for itself and says nothing."""
    blocked, cache = tmp_path / "file", tmp_path / "kept"
    blocked.write_text("")
    (tmp_path / "own_kernel.py").write_text(OWN_KERNEL)
    assert said_by(KERNEL.format(place=str(blocked), folder=str(tmp_path))) == "[2.]"
    program = KERNEL.format(place=str(cache), folder=str(tmp_path))
    assert said_by(program) == "[2.]"
    stamps = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}
    assert stamps
    assert said_by(program) == "[2.]"
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")} == stamps
    for path in stamps:
        path.write_bytes(b"damaged")
    assert said_by(program) == "[2.]"
