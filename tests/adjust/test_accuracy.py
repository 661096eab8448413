"""Small editions of the benchmarks of accuracy and convergence: the same figures over few drives."""

from functools import partial

import numpy as np
import pytest

from tests.benchmarks.adjust_accuracy import (
    ALL_DRIFTING,
    PAPER,
    PLAIN,
    ROBUST,
    WHITE,
    honesty,
    root_ratio,
    squared_bound_m2,
    squared_error_m2,
    street,
)
from tests.benchmarks.adjust_convergence import by_us, reaches_the_optimum

SHORT = {"frames": 40, "every_m": 3.0}
SEEDS = range(6)


@pytest.mark.parametrize("jitter", [WHITE, ALL_DRIFTING])
def test_nearly_all_corners_lie_within_their_stated_regions(jitter):
    """Corners of one drive share the camera's error, so six drives are a coarse check of 95 %."""
    found = [honesty(street(seed, jitter, **SHORT)) for seed in SEEDS]
    assert np.mean([one.corner_coverage for one in found]) > 0.8
    assert 0.3 < np.mean([one.corner_nees for one in found]) < 2.2
    assert 0.3 < np.mean([one.rotation_nees for one in found]) < 2.2


def test_the_error_is_about_the_cramer_rao_bound_and_the_papers_far_above_it():
    scenes = [street(seed, WHITE, **SHORT) for seed in SEEDS]
    bound = [squared_bound_m2(scene) for scene in scenes]
    assert 0.6 < root_ratio([squared_error_m2(scene, PLAIN) for scene in scenes], bound) < 1.5
    assert root_ratio([squared_error_m2(scene, PAPER) for scene in scenes], bound) > 2


def test_wrong_associations_cost_little():
    sound, soiled = (
        [squared_error_m2(street(seed, WHITE, share, **SHORT), ROBUST) for seed in SEEDS]
        for share in (0.0, 0.03)
    )
    assert root_ratio(soiled, sound) < 1.3


@pytest.mark.parametrize("seed", range(3))
def test_a_start_ten_degrees_away_ends_in_the_optimum(seed):
    scene = street(seed, WHITE, **{**SHORT, "start_error_deg": 10.0})
    assert reaches_the_optimum(scene, partial(by_us, options=ROBUST))
