"""Maps of a straight made drive whose clocks are stated to be right, or of which nothing is stated."""

from dataclasses import replace

import pytest

from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import draw
from tests.benchmarks.made.world import drive_of, make
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import BEST
from v2hdm.verdict import Status, Verdict
from v2hdm.verdict.results.accuracy import check_goal
from v2hdm.verdict.results.solution import check_solution

_GOAL_M = 0.06  # which positions and mountings of this drive meet, and unknown clocks do not


def mapped(clock_s: float | None) -> tuple[MethodResult, Verdict]:
    """Best map of a made straight drive, and its verdict without that on the inputs before the mapping."""
    recipe = replace(draw(105, "straight").with_noise_stated(), clock_s=clock_s)
    world = make(recipe)
    drive = drive_of(world)
    detections, _ = detect(world, drive)
    best = run_methods(drive, detections, tuple(drive.cameras), MappingOptions(), naive=False)[BEST]
    return best, Verdict.of([*check_solution(drive, best), *check_goal(best, _GOAL_M, "poses")])


@pytest.mark.parametrize(("clock_s", "status"), [(0.001, Status.PASS), (None, Status.WARN)])
def test_a_straight_drive_passes_where_the_receiver_is_stated_to_trigger_its_cameras(clock_s, status):
    best, verdict = mapped(clock_s)
    assert verdict.status is status, verdict.lines
    assert [finding.check for finding in verdict.raised[:1]] == ["clock"] * (clock_s is None)
    assert best.evidence is not None
    assert (best.evidence.clock_m < 0.03) is (clock_s is not None)
