"""Stated covariances are those of the errors, alone and over many drives."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from v2hdm.adjust import ControlPoints, Drift, KnownLengths, PoseSigma, SolveOptions, solve
from v2hdm.adjust.covariance import corner_gain
from v2hdm.adjust.descent import Objective
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.adjust.tiles import TIP, TiledMatrix, factorise_tiles, find_pattern
from v2hdm.adjust.whitening import factorise

POSES = PoseSigma(position_drift=Drift(0.01, 10.0), roll_pitch_drift=Drift(0.003, 2.0))


@pytest.mark.parametrize(
    ("pose_states", "clock"),
    [((), False), (("roll", "pitch"), True), (POSE_STATES, False), (POSE_STATES, True)],
)
def test_where_all_residuals_vanish_the_whitened_hessian_is_the_identity(pose_states, clock):
    """At a perfect fit the Gauss-Newton Hessian is the true one, so the gradient at y is y."""
    scene = make_scene(2, frames=40, pixel_sigma=0.0, jitter=None, prior_sigma_m=0.03)
    centre = -np.einsum("cji,cj->ci", scene.cam_from_vehicle[:, :3, :3], scene.cam_from_vehicle[:, :3, 3])
    twist = np.tile([5.0, 0.0, 0.0, 0.0, 0.0, 0.3], (40, 1))
    control = ControlPoints(np.array([3]), scene.corners_map[3:4], np.array([[0.01, 0.03]]))
    first, second = np.array([8, 9, 20, 12]), np.array([9, 11, 14, 13])
    length_m = np.linalg.norm(scene.corners_map[first] - scene.corners_map[second], axis=1)
    problem = replace(
        scene.problem,
        centre_vehicle=centre,
        pose_sigma=POSES,
        twist_vehicle=twist,
        control=control,
        lengths=KnownLengths(first, second, length_m, np.array([0.01, 0.002, 0.003, 0.1])),
    )
    arrays = make_arrays(problem, pose_states, "cpu", clock)
    estimate = Estimate(
        torch.as_tensor(scene.cam_from_vehicle),
        torch.zeros_like(arrays.state_information_root),
        torch.as_tensor(scene.corners_map)[arrays.corner_order],
        arrays.no_clock(),
    )
    engine = make_engine("auto", arrays)
    last = engine, engine.plan(), estimate, Loss("none", 1.0)
    objective = Objective(factorise(*last))
    direction = torch.randn(
        objective.whitening.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    step = 1e-5 * direction
    _, gradient = objective(step)
    _, opposite = objective(-step)
    # The frames that fill up the last tile are variables that nothing depends on.
    moves = (gradient - opposite).abs() > 0
    torch.testing.assert_close(((gradient - opposite) / 2)[moves], step[moves], rtol=1e-4, atol=1e-8)
    assert int((~moves).sum()) < 96
    held, tip = factorise(*last, hold_cameras=True), objective.whitening.reduced_factor.tip
    torch.testing.assert_close(held.reduced_factor.held, tip @ tip.mT, rtol=1e-8, atol=1e-4)
    np.testing.assert_allclose(corner_gain(held), corner_gain(objective.whitening), rtol=1e-8, atol=1e-9)


def dense(tiles, pattern, size, tip):
    count = len(pattern.below)
    matrix = torch.zeros(count * size + tip, count * size + tip, dtype=torch.float64)
    for (row, column), tile in tiles.items():
        r = count * size if row == TIP else row * size
        c = count * size if column == TIP else column * size
        matrix[r : r + len(tile), c : c + tile.shape[1]] = tile
        matrix[c : c + tile.shape[1], r : r + len(tile)] = tile.T
    return matrix


@pytest.mark.parametrize(
    "cliques",
    [
        [],
        [[0, 1, 2], [2, 3], [3, 4], [4, 5]],
        [[0, 1], [1, 2], [3, 4], [4, 5], [0, 4], [1, 5]],
        [list(range(6))],
    ],
)
@pytest.mark.parametrize("least_degree", [False, True])
@pytest.mark.parametrize("tip", [4, 12])  # a few cameras, and more than fit a tile
@pytest.mark.parametrize("last", [(), (1, 4)])
def test_the_tiled_factor_is_that_of_the_dense_matrix(cliques, least_degree, tip, last):
    size, count = 5, 6
    generator = torch.Generator().manual_seed(1)
    pattern = find_pattern(count, cliques, least_degree, last)
    assert {pattern.position[tile] for tile in last} == set(range(count - len(last), count))
    arrow = TiledMatrix.zeros(pattern, size, tip, torch.zeros((), dtype=torch.float64))
    tiles = arrow.tiles
    for tile in (*(tiles[k, k] for k in range(count)), arrow.tip):
        tile += 50 * torch.eye(len(tile), dtype=torch.float64)
    for column in range(count):
        tiles[TIP, column].normal_(generator=generator)
    for clique in cliques:
        places = sorted(pattern.position[tile] for tile in clique)
        for n, column in enumerate(places):
            for row in places[n + 1 :]:
                tiles[row, column] += torch.randn(size, size, generator=generator, dtype=torch.float64)
    matrix = dense(tiles, pattern, size, tip)
    lower = torch.linalg.cholesky(matrix)
    indefinite = copy.deepcopy(arrow)
    indefinite.tip.neg_()
    assert factorise_tiles(indefinite) is None
    factor = factorise_tiles(arrow)
    right = torch.randn(len(matrix), 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve_triangular(lower, right, upper=False))
    torch.testing.assert_close(
        factor.solve_transposed(right), torch.linalg.solve_triangular(lower.T, right, upper=True)
    )
    torch.testing.assert_close(factor.pivots(), lower.diagonal().square())
    # The last two tiles and the tip, once all others are eliminated.
    at_end = slice(4 * size, None)
    solved = torch.linalg.solve_triangular(lower[at_end, at_end], right[at_end], upper=False)
    torch.testing.assert_close(factor.tail(2).solve(right[at_end]), solved)


def test_laps_fill_in_only_where_they_meet():
    lap = [[k, k + 1] for k in range(39)]
    second_lap = [[k, k + 20] for k in range(20)]
    filled = sum(len(rows) for rows in find_pattern(40, lap + second_lap).below)
    assert filled < 40 * 39 / 2 / 4


def test_covariances_agree_with_the_scatter_of_many_solves():
    """Small Monte Carlo: 24 draws of noise, states and prior on one street."""
    street = {"frames": 14, "step_m": 1.0, "jitter": PoseSigma(), "cameras": 1, "start_error_deg": 0.2}
    corners, extrinsics = [], []
    base, mark = make_scene(20, **street), np.arange(8)
    for seed in range(24):
        scene = make_scene(20, **street, noise_seed=1000 + seed)
        assert np.array_equal(scene.corners_map, base.corners_map)
        last = solve(scene.problem, SolveOptions(loss="none", coarse=False))
        corners.append((last.corners_map[mark] - scene.corners_map[mark]).ravel())
        off = last.cam_from_vehicle[0, :3, :3] @ scene.cam_from_vehicle[0, :3, :3].T
        extrinsics.append([off[2, 1], off[0, 2], off[1, 0]])
    stated = np.diag(last.corner_covariance(mark))
    scatter = np.mean(np.square(corners), axis=0)
    assert np.mean(scatter / stated) == pytest.approx(1, abs=0.3)
    rotation = np.diag(last.extrinsic_covariance[0])[3:]
    np.testing.assert_allclose(np.mean(np.square(extrinsics), axis=0) / rotation, 1, atol=0.6)


DRIFTING = PoseSigma(
    position_drift=Drift(0.018, 30.0), heading_drift=Drift(0.0007, 5.0), roll_pitch_drift=Drift(0.002, 1.2)
)


@pytest.mark.parametrize(("jitter", "drives"), [(PoseSigma(), 32), (DRIFTING, 16)])
def test_the_normalised_error_of_a_marking_is_chi_square_distributed(jitter, drives):
    squares = []
    for seed in range(drives):
        scene = make_scene(40 + seed, frames=24, step_m=0.8, jitter=jitter, start_error_deg=0.5)
        solution = solve(scene.problem, SolveOptions(coarse=False))
        groups = np.arange(scene.problem.corner_count)[:, None]
        covariance = solution.corner_covariance(groups)
        error = solution.corners_map - scene.corners_map
        squares.append(np.einsum("na,nab,nb->n", error, np.linalg.inv(covariance), error).mean())
    # Corners of one drive share the camera's error: each drive is about one draw of a chi-square with two
    # degrees of freedom, whose standard deviation is 2. Three standard errors of the mean are allowed.
    assert np.mean(squares) == pytest.approx(2, abs=3 * 2 / np.sqrt(drives))
