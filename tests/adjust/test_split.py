"""Poses tell their likeliest states: a solve that starts at another's poses is at its end."""

from dataclasses import replace

import numpy as np

from tests.adjust.scene import make_scene
from tests.adjust.site import DRIFTING
from v2hdm.adjust import SolveOptions, solve
from v2hdm.adjust.layout import state_prior
from v2hdm.adjust.split import likeliest_states
from v2hdm.geometry.rigid import log
from v2hdm.records import FloatArray

_STATES = ("roll", "pitch", "heading", "x", "y", "height")


def _innovations(states: FloatArray, transition: FloatArray, root: FloatArray) -> FloatArray:
    out = root * states
    out[1:] -= root[1:] * np.einsum("jst,jt->js", transition[1:], states[:-1])
    return out


def test_no_other_states_of_the_same_poses_are_likelier() -> None:
    scene = make_scene(3, frames=40, jitter=DRIFTING)
    prior = state_prior(scene.problem, _STATES)
    axes = prior.columns.tolist()
    assert len(set(axes)) < len(axes)
    rng = np.random.default_rng(0)
    deviation = rng.normal(0.0, 0.01, (40, 6))

    states = likeliest_states(deviation, axes, prior.transition, prior.information_root)

    for axis in set(axes):
        total = states[:, [k for k, other in enumerate(axes) if other == axis]].sum(axis=1)
        np.testing.assert_allclose(total, deviation[:, axis], atol=1e-12)
    least = np.square(_innovations(states, prior.transition, prior.information_root)).sum()
    drifting = next(k for k, axis in enumerate(axes) if axis in axes[:k])
    for frame in range(0, 40, 7):
        for step in (1e-4, -1e-4):
            other = states.copy()
            other[frame, drifting] += step
            other[frame, axes.index(axes[drifting])] -= step
            cost = np.square(_innovations(other, prior.transition, prior.information_root)).sum()
            assert cost > least


def test_where_every_axis_has_one_state_it_is_the_deviation() -> None:
    deviation = np.arange(18.0).reshape(3, 6)
    states = likeliest_states(deviation, [3, 0], np.zeros((3, 2, 2)), np.ones((3, 2)))
    np.testing.assert_array_equal(states, deviation[:, [3, 0]])


def test_a_solve_from_the_end_of_another_ends_there() -> None:
    scene = make_scene(3, frames=100, jitter=DRIFTING, start_error_deg=0.5)
    options = SolveOptions(pose_states=_STATES, coarse=False)
    end = solve(scene.problem, options)
    again = replace(
        scene.problem,
        cam_from_vehicle=end.cam_from_vehicle,
        poses_start=end.map_from_vehicle,
        corners_start=end.corners_map,
    )
    solution = solve(again, options)
    assert solution.evaluations < 0.5 * end.evaluations
    moved = log(np.linalg.inv(end.map_from_vehicle) @ solution.map_from_vehicle)
    assert np.abs(moved).max() < 1e-5
