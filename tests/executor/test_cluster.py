"""Work on machines that run ``dask scheduler`` and ``dask worker``, and what is said where they cannot."""

import errno
import os
import signal
import socket
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import dask
import pytest
from distributed import Security

from tests.executor.machines import Machines, free_port
from tests.executor.test_local import nothing, refuse, slowly_doubled, step_by_step
from v2hdm.errors import ConfigError, DriveError, WorkerError
from v2hdm.executor import check_cluster, connecting, open_executor
from v2hdm.store.files import whole_file


def where(job, progress):
    return os.getpid(), str(Path.cwd())


def die_where_told(folder, progress):
    (folder / f"begun-{os.getpid()}").touch()
    time.sleep(2.0)
    return "alive"


@dataclass(frozen=True)
class Large:
    """Writes a file of so many bytes."""

    folder: Path

    def __call__(self, size, progress):
        with whole_file(self.folder / f"large_{size}") as partial:
            partial.write_bytes(bytes(size))
        return size


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """A scheduler and two workers, each started by one command."""
    started = Machines(tmp_path_factory.mktemp("machines"))
    started.worker()
    started.worker()
    yield started
    started.close()


def opened(machines, **paths):
    machines.wait_for(2)
    return open_executor(0, machines.address, **paths)


def test_jobs_are_done_by_workers_that_a_user_has_started_where_the_client_is(machines):
    with opened(machines) as executor:
        outcomes = dict(executor.side_by_side(where, range(8)))
        results = []
        executor.share_out(slowly_doubled, range(9), nothing, (), results.append)
        steps = []
        stepped = dict(executor.side_by_side(step_by_step, [5], lambda *step: steps.append(step)))
        with pytest.raises(DriveError, match="x: damaged"):
            executor.share_out(refuse, ["x"], nothing, (), print)
    assert executor.workers == 2
    assert {folder for _, folder in outcomes.values()} == {str(Path.cwd())}
    assert os.getpid() not in {process for process, _ in outcomes.values()}
    assert results == [0, 2, 4, 6, 8, 10, 12, 14, 16]
    assert stepped == {0: -5}
    assert steps[-1] == (5, "count", 3, 3)


def test_a_job_whose_worker_is_killed_is_done_again_and_one_that_is_killed_twice_is_an_error(
    machines, tmp_path
):
    def kill_first(times):
        killed = set()
        while len(killed) < times:
            for mark in tmp_path.glob("begun-*"):
                process = int(mark.name.partition("-")[2])
                if process not in killed:
                    killed.add(process)
                    time.sleep(0.3)
                    os.kill(process, signal.SIGKILL)
            time.sleep(0.05)

    with opened(machines) as executor:
        for times, result in ((1, "alive"), (2, WorkerError)):
            for mark in tmp_path.glob("begun-*"):
                mark.unlink()
            killer = threading.Thread(target=kill_first, args=(times,))
            killer.start()
            ((_, outcome),) = executor.side_by_side(die_where_told, [tmp_path])
            killer.join()
            if times == 1:
                assert outcome == result
            else:
                assert isinstance(outcome, WorkerError)
                assert "died twice over the same work" in str(outcome)


def test_a_worker_whose_disk_is_full_is_an_error_that_names_the_file_and_nothing_is_half_written(tmp_path):
    machines = Machines(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    try:
        machines.worker(most_bytes=65536)
        machines.wait_for(1)
        with open_executor(0, machines.address) as executor:
            work = Large(out)
            outcomes = executor.side_by_side(work, [10, 200_000])
            assert next(outcomes) == (0, 10)
            with pytest.raises(OSError, match="large") as failure:
                next(outcomes)
            assert failure.value.errno == errno.EFBIG
            assert [path.name for path in out.iterdir()] == ["large_10"]
            assert dict(executor.side_by_side(work, [20])) == {0: 20}
    finally:
        machines.close()


def test_a_worker_that_cannot_read_a_drive_is_one_line_with_its_address(machines, tmp_path, monkeypatch):
    drive = tmp_path / "drive"
    monkeypatch.setattr(os, "access", lambda path, mode: True)  # this machine has the drive
    problem = (
        r"cluster=tcp://127.0.0.1:\d+: the worker tcp://127.0.0.1:\d+ cannot read .*/drive; name a folder"
    )
    with pytest.raises(ConfigError, match=problem), opened(machines, readable=[str(drive)]):
        pass


def test_a_worker_of_another_version_is_one_line(machines, monkeypatch):
    versions = connecting.library_versions()
    monkeypatch.setattr(connecting, "library_versions", lambda: {**versions, "numpy": "1.0"})
    refused = pytest.raises(ConfigError, match=r"has numpy .*, and this machine 1\.0; install the same")
    with refused, opened(machines):
        pass
    monkeypatch.setattr(connecting, "library_versions", lambda: versions)
    monkeypatch.setattr(connecting, "code_key", lambda: "other")
    with pytest.raises(ConfigError, match=r"has another V2HDM than this machine"), opened(machines):
        pass


def test_a_worker_of_many_threads_is_one_line_with_the_right_command(tmp_path):
    machines = Machines(tmp_path)
    try:
        machines.worker("--nthreads", "3")
        refused = pytest.raises(ConfigError, match="has 3 threads; start it with dask worker --nthreads 1")
        with refused, open_executor(0, machines.address):
            pass
    finally:
        machines.close()


def certificates(folder):
    """The files of a cluster of its own: the arguments of its processes, and Dask's settings for a client."""
    security = Security.temporary()
    folder.mkdir()
    for name in ("tls_ca_file", "tls_client_cert", "tls_client_key"):
        (folder / name).write_text(getattr(security, name))
    ca, cert, key = (str(folder / name) for name in ("tls_ca_file", "tls_client_cert", "tls_client_key"))
    tls = "distributed.comm.tls"
    settings = {f"{tls}.ca-file": ca, f"{tls}.client.cert": cert, f"{tls}.client.key": key}
    return ["--tls-ca-file", ca, "--tls-cert", cert, "--tls-key", key], settings


def test_certificates_that_fit_open_a_cluster_and_others_are_one_line(tmp_path):
    arguments, settings = certificates(tmp_path / "ours")
    _, others = certificates(tmp_path / "others")
    machines = Machines(tmp_path, "tls", arguments)
    try:
        machines.worker()
        with dask.config.set(settings):
            machines.wait_for(1)
            with open_executor(0, machines.address) as executor:
                assert dict(executor.side_by_side(step_by_step, [5])) == {0: -5}
        for wrong in (others, {}):
            refused = pytest.raises(ConfigError, match=r"the certificates do not fit .*distributed.comm.tls")
            with dask.config.set(wrong), refused as caught, open_executor(0, machines.address):
                pass
            assert "\n" not in str(caught.value)
    finally:
        machines.close()


def test_an_address_where_nothing_listens_is_one_line(monkeypatch):
    monkeypatch.setattr("v2hdm.executor.connecting._CONNECT_S", 1.0)
    address = f"tcp://127.0.0.1:{free_port()}"
    refused = pytest.raises(ConfigError, match=rf"cluster={address}: no Dask scheduler answers there")
    with refused as caught, open_executor(0, address):
        pass
    assert "\n" not in str(caught.value)


def test_what_is_no_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr(connecting, "_CONNECT_S", 2.0)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(ConfigError, match="no Dask scheduler answers there"), open_executor(0, address):
            pass


def test_a_scheduler_without_workers_is_one_line_with_the_command_that_starts_one(tmp_path, monkeypatch):
    monkeypatch.setattr(connecting, "_CONNECT_S", 2.0)
    machines = Machines(tmp_path)
    try:
        refused = pytest.raises(ConfigError, match=rf"has no worker; start dask worker {machines.address}")
        with refused, open_executor(0, machines.address):
            pass
    finally:
        machines.close()


def test_a_scheduler_that_dies_is_an_error_and_no_endless_wait(tmp_path):
    machines = Machines(tmp_path)
    machines.worker()
    try:
        with open_executor(0, machines.address) as executor:
            outcomes = executor.side_by_side(die_where_told, [tmp_path] * 3)
            next(outcomes)
            os.kill(machines.scheduler.pid, signal.SIGKILL)
            with pytest.raises(WorkerError, match="the scheduler, or all workers, are gone; finished work"):
                list(outcomes)
    finally:
        machines.close()


@pytest.mark.parametrize("cluster", ["host:8786", "http://host:8786", "slum"])
def test_what_is_neither_an_address_nor_a_batch_system_is_refused(cluster):
    with pytest.raises(ConfigError, match=rf"cluster={cluster}: give the address of a Dask scheduler"):
        check_cluster(cluster)


def test_a_batch_system_without_its_package_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    refused = pytest.raises(ConfigError, match="cluster=slurm needs dask-jobqueue: pip install dask-jobqueue")
    with refused, open_executor(2, "slurm"):
        pass
