"""A fleet on a Dask scheduler and two workers, as a user starts them, gives what one process gives."""

import pytest

from tests.executor.machines import Machines
from tests.fleet.runs import written
from v2hdm.fleet import FleetOptions, run_fleet


@pytest.mark.slow
def test_results_of_two_workers_are_byte_for_byte_those_of_one_process(drive, alone, tmp_path):
    machines = Machines(tmp_path)
    steps = []
    try:
        for _ in range(2):
            machines.worker()
        machines.wait_for(2)
        files = [written(tmp_path, name, drive) for name in ("good", "other")]
        places = [f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
        overrides = [*places, f"cluster={machines.address}"]
        rows = run_fleet(files, overrides, FleetOptions(tmp_path / "table"), lambda *step: steps.append(step))
    finally:
        machines.close()
    assert [(row.drive, row.status, row.kept) for row in rows] == [
        ("good", "PASS", False),
        ("other", "PASS", False),
    ]
    assert {step[0] for step in steps if step[1] == "detect"} == {"good", "other"}
    for name in ("map.geojson", "calibration_front.yaml", "residuals.csv", "trajectory.tum"):
        expected = (alone / name).read_bytes()
        for run in ("good", "other"):
            assert (tmp_path / "out" / run / name).read_bytes() == expected, (run, name)
