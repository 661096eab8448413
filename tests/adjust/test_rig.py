"""Where cameras alone move, a whitening and its evaluations made at once are those made step by step."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from tests.adjust.test_engines import assert_same, estimate_of, example
from v2hdm import native
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.kernels.engine import KernelEngine
from v2hdm.adjust.kernels.rig import make_rig
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Loss
from v2hdm.adjust.problem import LOSSES
from v2hdm.adjust.whitening import factorise

pytestmark = pytest.mark.skipif(native.kernels() is None, reason="without C++ all goes step by step")


class SteppingEngine(KernelEngine):
    """Kernels, called step by step."""

    _rig = None


def both(problem, robust, *, hold_cameras=False, behind=False, size=0.01):
    """Whitenings of an estimate, at once and step by step."""
    arrays = make_arrays(problem, (), "cpu")
    at_once = make_engine("native", arrays)
    estimate = estimate_of(at_once, problem, torch.Generator().manual_seed(5), size, behind=behind)
    return [
        factorise(engine, engine.plan(), estimate, robust, hold_cameras)
        for engine in (at_once, SteppingEngine(arrays))
    ]


@pytest.mark.parametrize("hold_cameras", [False, True])
@pytest.mark.parametrize("loss", LOSSES)
def test_whitenings_agree(loss, hold_cameras):
    """With surveys, planes of the ground and known lengths."""
    at_once, stepwise = both(example(), Loss(loss, 3.0), hold_cameras=hold_cameras)
    assert at_once.linearised.rig is not None
    assert stepwise.linearised.rig is None
    assert_same(at_once.terms, stepwise.terms)
    assert_same(at_once.gradient, stepwise.gradient, 1e-9)
    assert_same(at_once.reduced_factor.tip, stepwise.reduced_factor.tip, 1e-10)
    assert at_once.smallest_pivot == pytest.approx(stepwise.smallest_pivot, rel=1e-6)
    for name in ("gradient", "coupled", "whitened"):
        assert_same(getattr(at_once.linearised, name), getattr(stepwise.linearised, name), 1e-9)
    corners, expected = at_once.linearised.corner_factor, stepwise.linearised.corner_factor
    assert_same(corners.lower, expected.lower)
    for joint, expected_joint in zip(corners.joint, expected.joint, strict=True):
        assert_same(joint.factor, expected_joint.factor, 1e-9)
    if hold_cameras:
        assert_same(at_once.reduced_factor.held, stepwise.reduced_factor.held, 1e-10)


@pytest.mark.parametrize("hold_cameras", [False, True])
@pytest.mark.parametrize("loss", LOSSES)
def test_evaluations_agree(loss, hold_cameras):
    at_once, stepwise = both(example(), Loss(loss, 3.0), hold_cameras=hold_cameras)
    generator = torch.Generator().manual_seed(1)
    whitened = 0.001 * torch.randn(at_once.size, generator=generator, dtype=torch.float64)
    reached, expected = (whitening.reach(whitened) for whitening in (at_once, stepwise))
    assert_same(reached.estimate, expected.estimate, 1e-9)
    assert_same(reached.terms, expected.terms, 1e-9)
    assert_same(reached.gradient, expected.gradient, 1e-8)


def test_the_cameras_steps_agree():
    at_once, stepwise = both(example(), Loss("none", 1.0))
    step = at_once.camera_step(at_once.gradient)
    assert step.shape == (2, 6)
    assert_same(step, stepwise.camera_step(at_once.gradient), 1e-9)


def test_an_evaluation_of_no_step_is_the_whitening():
    at_once, _ = both(example(), Loss("cauchy", 3.0))
    reached = at_once.reach(torch.zeros(at_once.size, dtype=torch.float64))
    assert_same(reached.terms, at_once.terms)
    assert_same(reached.gradient, at_once.gradient, 1e-10)
    assert_same(reached.estimate, at_once.estimate)


def test_what_one_image_leaves_undetermined_is_damped_as_step_by_step():
    """Corners that one image shows follow any extrinsic, so that nothing is known of it."""
    scene = make_scene(1, frames=20, cameras=1).problem
    observations = scene.observations
    frame = np.bincount(observations.frame).argmax()
    rows = observations.frame == frame
    _, corner = np.unique(observations.corner[rows], return_inverse=True)
    columns = {
        name: getattr(observations, name)[rows] for name in ("camera", "frame", "pinhole_px", "covariance_px")
    }
    problem = replace(
        scene,
        observations=replace(observations, **columns, corner=corner),
        corner_count=int(corner.max()) + 1,
        centre_vehicle=None,
        centre_sigma_m=None,
        corners_start=None,
    )
    at_once, stepwise = both(problem, Loss("none", 1.0), size=0.0)
    assert at_once.is_singular
    assert stepwise.is_singular


def test_frames_with_states_go_step_by_step():
    arrays = make_arrays(make_scene(0, frames=12).problem, ("roll", "pitch"), "cpu")
    engine = make_engine("native", arrays)
    assert isinstance(engine, KernelEngine)
    assert make_rig(arrays, engine.layout) is None


def test_arrays_of_another_shape_are_refused():
    arrays = make_arrays(make_scene(0, frames=12).problem, (), "cpu")
    engine = make_engine("native", arrays)
    assert isinstance(engine, KernelEngine)
    rig = make_rig(arrays, engine.layout)
    with pytest.raises(ValueError, match="corners_map: of another shape"):
        rig.linearise(np.zeros((arrays.camera_count, 4, 4)), np.zeros((3, 2)), 0, 1.0)
    with pytest.raises(ValueError, match="cam_from_vehicle: of another shape"):
        rig.linearise(np.zeros((9, 4, 4)), np.zeros((arrays.corner_count, 2)), 0, 1.0)
