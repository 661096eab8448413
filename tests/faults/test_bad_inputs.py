"""Every bad input ends in one line that says what is wrong; the table is in tests/faults/cases.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.cases import all_cases
from tests.faults.judge import HYDRA_DOORS, Case, judge

CASES = all_cases()
QUICK = [case for number, case in enumerate(CASES) if case.door not in HYDRA_DOORS or number % 8 == 0]
"""The doors that load torch and Hydra take half a second a case: of those every eighth."""


def test_the_table_is_large_and_names_each_case_once() -> None:
    names = [case.name for case in CASES]
    assert len(names) >= 250
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("case", QUICK, ids=[case.name for case in QUICK])
def test_a_bad_input_ends_well(case: Case, tmp_path: Path) -> None:
    outcome = judge(case, tmp_path)
    assert not outcome.faults(case), outcome.error
