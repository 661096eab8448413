"""Which offsets a straight drive leaves to the survey, and what a turn does about it."""

import numpy as np
import pytest

from tests.adjust.scene import make_scene
from v2hdm.adjust import PoseSigma, observability, solve


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_straight_drive_leaves_forward_and_left_to_the_survey(cameras):
    scene = make_scene(1, frames=40, turn_deg_per_m=0.0, cameras=cameras, jitter=PoseSigma())
    for camera in observability(scene.problem, solve(scene.problem)):
        assert camera.unobserved == ("forward", "left")
        # The direction is common to both cameras, so two surveys halve its variance.
        assert camera.sigma[0] == pytest.approx(0.03 / np.sqrt(cameras), rel=0.1)
        assert "turn" in camera.sentence("front")


def test_turns_fix_all_offsets():
    scene = make_scene(1, frames=90, turn_deg_per_m=8.0)
    for camera in observability(scene.problem, solve(scene.problem)):
        assert camera.unobserved == ()
        assert camera.sigma[:3].max() < 0.015
        assert "the drive fixes both" in camera.sentence("rear")


def test_what_is_said_of_the_centre_holds():
    scene = make_scene(2, frames=60, turn_deg_per_m=0.0, cameras=1)
    solution = solve(scene.problem)
    (camera,) = observability(scene.problem, solution)
    truth, found = (
        -m[0, :3, :3].T @ m[0, :3, 3] for m in (scene.cam_from_vehicle, solution.cam_from_vehicle)
    )
    assert np.all(np.abs(found - truth) < 4 * camera.sigma[:3])
