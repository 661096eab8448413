"""Tests of clocks learn from poses and surveys, not from the noise of the poses."""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import Recipe, draw
from tests.benchmarks.made.faults import APART_S
from tests.benchmarks.made.world import drive_of, make
from v2hdm.faults import table
from v2hdm.faults.score_tests import score_faults
from v2hdm.mapping import recovery
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import PLANE, MappingOptions


def straight_in_turn(seed: int) -> Recipe:
    """A short straight drive whose cameras fire in turn, under a stream of noisy poses."""
    drawn = replace(draw(seed, "straight"), default_noise=False, road=None)
    route = replace(drawn.port.route, pieces=[[45.0, 0.0]], speed_mps=4.0)
    poses = replace(drawn.poses, position_white_m=0.02, heading_white_rad=1e-3)
    return replace(drawn, port=replace(drawn.port, route=route), poses=poses).in_turn(APART_S)


def test_a_clock_is_known_as_well_as_the_true_motion_tells_and_no_better(monkeypatch):
    world = make(straight_in_turn(4))
    drive = drive_of(world)
    solved = []

    def score(problem, solution):
        solved.append((problem, solution))
        return score_faults(problem, solution)

    monkeypatch.setattr(recovery, "score_faults", score)
    run_methods(drive, detect(world, drive)[0], ("front", "rear"), MappingOptions(ground=PLANE))
    problem, solution = solved[0]
    image_at = [image.map_from_vehicle[:2, 3] for image in drive.images]
    nearest = [
        int(np.linalg.norm(image_at - pose[:2, 3], axis=1).argmin()) for pose in problem.map_from_vehicle
    ]
    frame = [world.frame_of(drive.images[image]) for image in nearest]
    true = replace(problem, twist_vehicle=world.twist_vehicle[frame])
    sigma_s, true_sigma_s = (
        {
            test.camera: test.model_sigma
            for test in score_faults(problem_tested, solution)
            if test.fault is table.CLOCK
        }
        for problem_tested in (problem, true)
    )
    assert sigma_s == pytest.approx(true_sigma_s, rel=0.1)
