"""The table of faults: what a new one touches, and what reads it."""

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.adjust.scene import make_scene
from v2hdm.adjust import PoseSigma, SolveOptions, solve
from v2hdm.faults import FAULTS, Contradiction, Fault, Recovery, columns, table
from v2hdm.faults.columns import Hypothesis
from v2hdm.faults.odds import is_contradicted, log_odds
from v2hdm.faults.score_tests import score_faults
from v2hdm.mapping import recovery
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import CameraFit, ForeignSegment, SolveEvidence
from v2hdm.store.cache import decode, encode
from v2hdm.verdict import Status
from v2hdm.verdict.results.solution import check_inputs

ROLLED = Fault(
    "rolled", "rad", least=0.001, observable_sigma=0.01, usual=0.02, most=0.5,
    check="tyres",
    remedy="pump them up",
    sentence=lambda error: f"the vehicle leans by {error.size:.2f} rad to the {error.word('right', 'left')}",
    recovery=Recovery.DROP_SIZES,
    corrected_by="no size was trusted",
)  # fmt: skip
"""A fault that nobody has heard of: the vehicle leans to one side."""


def leaning(_):
    def rolled(arrays, out):
        out[..., 3:] = torch.tensor([1.0, 0.0, 0.0], dtype=out.dtype)
        return out

    yield Hypothesis(ROLLED, columns._moving(rolled))


@pytest.fixture
def with_a_new_fault(monkeypatch):
    monkeypatch.setitem(FAULTS, ROLLED.name, ROLLED)
    monkeypatch.setitem(columns.OF_DRIVE, ROLLED, leaning)


def evidence(**changes):
    fine = SolveEvidence(
        score_tests=(),
        corrected=(),
        pose_model="none",
        held_out={},
        fits={"front": CameraFit(100, 0.2, 0.0, 25.0)},
        variance_factor=0.2,
        pose_noise={},
        worst_innovation=1.0,
        worst_innovation_s=0.0,
    )
    return replace(fine, **changes)


@pytest.mark.usefixtures("with_a_new_fault")
def test_a_new_fault_is_tested_for_weighed_named_and_recovered_from_by_its_record_and_column_alone():
    poses = PoseSigma(0.01, 0.001, 0.002, 0.005)
    problem = make_scene(3, frames=60, every_m=3.0, jitter=poses, start_error_deg=0.5).problem
    tests = score_faults(problem, solve(problem, SolveOptions(coarse=False, loss="none")))
    (test,) = [test for test in tests if test.fault is ROLLED]
    assert np.isfinite(test.sigma), "it is tested for"
    assert not is_contradicted(test)

    leans = replace(test, value=0.03, sigma=0.002, model_sigma=0.002, p_value=1e-40, gain=100.0)
    assert is_contradicted(leans), "it is weighed"
    assert log_odds(leans) == pytest.approx(100.0 - np.log1p(1.5**2))

    contradiction = Contradiction(**vars(leans), cameras=("front", "rear"))
    finding = check_inputs(evidence(score_tests=(contradiction,)))[0]
    assert (finding.check, finding.status) == ("tyres", Status.FAIL), "it is named"
    assert finding.says.startswith("the vehicle leans by 0.03 rad to the right (13 sigmas)")
    assert finding.says.endswith("pump them up")
    quiet = replace(contradiction, value=0.0, p_value=0.5)
    assert ("tyres", Status.PASS) in [
        (f.check, f.status) for f in check_inputs(evidence(score_tests=(quiet,)))
    ]
    mended = check_inputs(evidence(corrected=(contradiction,)))[0]
    assert "no size was trusted" in mended.says

    inputs = Inputs(None, (), (), MappingOptions())  # type: ignore[arg-type]
    left = recovery._recovered(inputs, leans, None)  # type: ignore[arg-type]
    assert left is not None, "it is recovered from"
    assert left.options.known_sizes.by_class_m == {}


@pytest.mark.usefixtures("with_a_new_fault")
def test_evidence_comes_back_from_the_cache_and_from_other_processes_as_it_was():
    contradiction = Contradiction(ROLLED.name, -1, 0, -1, 0.03, 0.002, 0.002, 1e-40, 100.0, ("front", "rear"))
    whole = evidence(score_tests=(contradiction,), foreign=ForeignSegment(1.0, 2.0, 3.0))
    for copy in (decode(encode(whole), SolveEvidence), pickle.loads(pickle.dumps(whole))):
        assert copy.score_tests == whole.score_tests
        assert copy.score_tests[0].fault is ROLLED
        assert copy.foreign.gain == 3.0


def test_every_fault_has_columns_but_that_of_single_points_which_needs_none():
    assert {*columns.OF_CAMERAS, *columns.OF_DRIVE} == {*FAULTS.values()} - {table.CONTROL}


def test_the_sizes_of_every_fault_rise_from_what_matters_over_what_is_usual_to_what_is_physical():
    for fault in FAULTS.values():
        assert fault.least < fault.usual < fault.most


def test_the_table_and_the_odds_are_read_without_torch():
    code = "import sys, v2hdm.faults.table, v2hdm.faults.odds; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_slip_is_named_before_a_clock_that_explains_as_much_and_contradicts_nothing():
    cameras = ("front", "rear")
    slip = Contradiction(table.SLIP.name, -1, 0, -1, 0.004, 0.001, 0.001, 3e-5, 8.0)
    clock = Contradiction(table.CLOCK.name, -1, 0, -1, 0.015, 0.0036, 0.003, 3e-5, 8.0, cameras)
    assert log_odds(slip) > log_odds(clock) + np.log(10)
    assert not is_contradicted(slip)
    findings = check_inputs(evidence(score_tests=(slip, clock)))
    raised = [finding for finding in findings if finding.status is not Status.PASS]
    assert [finding.status for finding in raised] == [Status.WARN]
    assert raised[0].check == "heading slip"
    assert raised[0].says.startswith("in bends the headings, an antenna's course, are off by 0.23 deg")
