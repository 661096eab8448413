"""One site from many drives: by workers, some of which die, it is the map of one process."""

import os
import signal
from contextlib import contextmanager

import pytest
import torch

pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")


from tests.fleet.run_files import written
from v2hdm.errors import DriveError, WorkerError
from v2hdm.fleet.plan import plan_site
from v2hdm.fleet.run import FleetOptions, run_fleet
from v2hdm.fleet.workers import RayExecutor, map_drive
from v2hdm.pipeline.run import run
from v2hdm.simulate import PortConfig, render_drive
from v2hdm.simulate.port.config import RouteConfig, YardConfig


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """One small port, seen on two visits."""
    folders = []
    for visit, name in enumerate(("monday", "friday")):
        route = RouteConfig(pieces=[[26.0, 0.0]], image_spacing_m=2.6)
        yard = YardConfig(parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0, shadow_strips=0)
        port = PortConfig(name=name, seed=3, visit=visit, initial_ipm="calibrated", route=route, yard=yard)
        port.cameras = {"front": port.cameras["front"]}
        folders.append(tmp_path_factory.mktemp("site") / name)
        render_drive(port, folders[-1], 1, lambda done, total: None)
    return folders


@pytest.mark.slow
def test_a_site_by_workers_one_of_which_dies_is_the_map_of_one_process(ray, drives, tmp_path, monkeypatch):
    @contextmanager
    def here(address, workers):
        yield ray

    died = tmp_path / "died"

    def mapping(*arguments):
        import v2hdm.fleet.workers as executor

        done = executor._done

        def dies_once(*work):
            if not died.exists():
                died.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return done(*work)

        executor._done = dies_once
        try:
            return map_drive(*arguments)
        finally:
            executor._done = done

    monkeypatch.setattr("v2hdm.fleet.run.cluster", here)
    monkeypatch.setattr("v2hdm.fleet.workers.map_drive", mapping)
    files = [written(tmp_path, one.name, one) for one in drives]
    settings = ["workers=1"]
    told: list[tuple[str, str, int, int]] = []

    def fleet():
        overrides = [*settings, f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
        options = FleetOptions(tmp_path / "table", site="port")
        (row,) = run_fleet(files, overrides, options, lambda *message: told.append(message))
        return row

    row = fleet()
    assert died.exists()
    assert (row.drive, row.status, row.kept) == ("port", "PASS", False), row.says
    assert {"check monday", "check friday"} <= {stage for drive, stage, *_ in told if drive == "port"}
    overrides = [*settings, f"output={tmp_path / 'alone'}", f"cache={tmp_path / 'other'}"]
    (job,) = plan_site(files, overrides, "port").jobs
    with one_thread():
        alone = run(job.config, job.config_yaml).folder
    result = tmp_path / "out" / "port"
    for name in ("map.geojson", "calibration_front.yaml", "residuals.csv", "trajectory_friday.tum"):
        assert (result / name).read_bytes() == (alone / name).read_bytes(), name
    logs = [(one / "run.log").read_text() for one in (result, alone)]
    for checks in ("v2hdm.pipeline.inspect: ", "v2hdm.mapping.optimise: "):
        of_checks = [[line.split(checks)[1] for line in log.splitlines() if checks in line] for log in logs]
        assert of_checks[0] == of_checks[1] != [], checks
    assert fleet().kept


@contextmanager
def one_thread():
    """As in workers: how many threads share a product decides its last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def test_what_is_wrong_in_a_task_is_told_as_by_one_process(ray, tmp_path, monkeypatch):
    def refuses():
        raise DriveError("images/3.jpg: cannot be read")

    def dies():
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr("v2hdm.fleet.workers.RETRIES", 0)
    executor = RayExecutor(2, str(tmp_path))
    waits = [executor.begin(work) for work in (refuses, dies)]
    with pytest.raises(DriveError, match="cannot be read"):
        waits[0]()
    with pytest.raises(WorkerError, match="died again and again"):
        waits[1]()
