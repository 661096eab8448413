"""Work in this process and in others of this machine, by Dask or in a base install, and how it ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from v2hdm.errors import ConfigError, DriveError, WorkerError
from v2hdm.executor import HERE, open_executor, opening
from v2hdm.executor.processes import ProcessExecutor
from v2hdm.store.files import whole_file

ROOT = Path(__file__).parents[2]


def nothing(): ...


def slowly_doubled(number):
    time.sleep(0.2 if number % 3 == 0 else 0.0)
    return 2 * number


def doubled(number):
    return 2 * number


def refuse(name):
    raise DriveError(f"{name}: damaged")


def hang_while_writing(path):
    with whole_file(path) as partial:
        partial.write_text("half")
        for _ in range(600):
            time.sleep(0.1)


def step_by_step(job, progress):
    for step in range(3):
        progress("count", step + 1, 3)
    return -job


def die_once(folder, progress):
    mark = folder / "died"
    if not mark.exists():
        mark.touch()
        os._exit(9)
    return "alive"


def die_at_two(job, progress):
    if job == 2:
        os._exit(9)
    time.sleep(0.1)
    return job


def variables(job, progress):
    import cv2

    return os.environ["OMP_NUM_THREADS"], cv2.getNumThreads(), os.getpid()


@pytest.fixture(scope="module", params=["dask", "base"])
def two(request):
    """Two processes, those of Dask warm for all tests."""
    if request.param == "base":
        yield ProcessExecutor(2)
        return
    with open_executor(2) as executor:
        yield executor


def test_results_come_in_the_order_of_the_jobs(two):
    results: list[int] = []
    two.share_out(slowly_doubled, range(9), nothing, (), results.append)
    assert results == [0, 2, 4, 6, 8, 10, 12, 14, 16]


def test_many_jobs_are_handed_over_together_and_their_results_come_in_order(two):
    taken: list[int] = []
    two.share_out(doubled, range(99), nothing, (), taken.append, together=4)
    assert taken == [2 * number for number in range(99)]


def test_a_failure_is_raised_here_and_tells_where_it_happened(two):
    with pytest.raises(DriveError, match=r"[ab]\.jpg: damaged") as caught:
        two.share_out(refuse, ["a.jpg", "b.jpg"], nothing, (), print)
    assert "in refuse" in str(caught.value.__cause__)


def test_a_failure_of_the_start_is_raised_here(two):
    with pytest.raises(DriveError, match="model: damaged"):
        two.share_out(slowly_doubled, range(4), refuse, ("model",), print)


def test_a_process_that_dies_is_one_error_and_no_endless_wait(two):
    with pytest.raises(WorkerError, match=r"died twice over the same work.*workers="):
        two.share_out(os._exit, [9, 9], nothing, (), print)


def test_a_job_whose_process_died_once_is_done_again(two, tmp_path):
    assert list(two.side_by_side(die_once, [tmp_path])) == [(0, "alive")]


def test_a_job_that_kills_its_processes_takes_no_other_with_it(two):
    outcomes = dict(two.side_by_side(die_at_two, range(6)))
    assert [outcomes[number] for number in (0, 1, 3, 4, 5)] == [0, 1, 3, 4, 5]
    assert isinstance(outcomes[2], WorkerError)


def test_each_process_has_one_thread(two):
    outcomes = dict(two.side_by_side(variables, range(2)))
    assert {outcome[:2] for outcome in outcomes.values()} == {("1", 1)}
    assert os.getpid() not in {outcome[2] for outcome in outcomes.values()}


def test_no_more_processes_start_than_there_are_jobs():
    with open_executor(3) as executor:
        counts = []
        for jobs in (1, 2):
            dict(executor.side_by_side(variables, range(jobs)))
            counts.append(len(multiprocessing.active_children()))
    assert counts[1] == counts[0] + 1
    assert executor.workers == 3


def test_jobs_tell_their_steps_and_processes_stay_for_the_next_stage():
    steps = []
    with open_executor(2) as executor:
        outcomes = dict(executor.side_by_side(step_by_step, [5, 6], lambda *step: steps.append(step)))
        first = {outcomes[number] for number in outcomes}
        processes = [
            {outcome[2] for _, outcome in executor.side_by_side(variables, range(8))} for _ in range(2)
        ]
    assert first == {-5, -6}
    assert {(5, "count", 3, 3), (6, "count", 3, 3)} <= set(steps)
    assert len(processes[0] | processes[1]) <= 2


def take_a_gigabyte(job, progress):
    memory = np.ones(125_000_000)
    time.sleep(5.0)
    return memory.nbytes


def test_a_process_that_takes_more_memory_than_it_may_is_an_error_of_its_job_alone():
    with open_executor(1, isolated=True, memory_gb=0.5) as executor:
        ((_, outcome),) = executor.side_by_side(take_a_gigabyte, [None])
        assert isinstance(outcome, WorkerError)
        assert "perhaps for lack of memory" in str(outcome)
        assert list(executor.side_by_side(step_by_step, [5])) == [(0, -5)]


def share_out_further(numbers, progress):
    results = []
    with open_executor(2) as executor:
        executor.share_out(slowly_doubled, numbers, nothing, (), results.append)
    return results


def test_a_job_may_share_its_work_out_to_the_same_processes():
    with open_executor(2) as executor:
        outcomes = dict(executor.side_by_side(share_out_further, [range(6), range(4)]))
        before = len(multiprocessing.active_children())
        dict(executor.side_by_side(share_out_further, [range(5)]))
        assert len(multiprocessing.active_children()) == before
    assert outcomes == {0: [0, 2, 4, 6, 8, 10], 1: [0, 2, 4, 6]}


def test_one_worker_is_this_process_unless_a_death_must_be_survived():
    with open_executor(1) as executor:
        assert executor is HERE
    with open_executor(1, isolated=True) as executor:
        assert executor is not HERE
        assert executor.workers == 1


def test_a_base_install_has_processes_without_dask(monkeypatch):
    monkeypatch.setattr(opening, "find_spec", lambda name: None)
    with open_executor(2) as executor:
        assert isinstance(executor, ProcessExecutor)
    needs = pytest.raises(
        ConfigError, match=r"cluster=tcp://host:8786 needs Dask: pip install 'v2hdm\[map\]'"
    )
    with needs, open_executor(2, "tcp://host:8786"):
        pass


def begun(code, **pipes):
    """A session of processes that runs this."""
    code = f"if __name__ == '__main__':\n  from tests.executor.test_local import *; {code}"
    options = {"cwd": ROOT, "stderr": subprocess.PIPE, "text": True, "start_new_session": True, **pipes}
    return subprocess.Popen([sys.executable, "-uc", code], **options)


def opened(kind, work):
    """Code that does work with an executor of a kind, named ``two``."""
    if kind == "base":
        return f"two = ProcessExecutor(2); {work}"
    return f"\n  with open_executor(2) as two: {work}"


def hanging(kind, folder):
    """A session of processes, each of which has half written a file of ``folder``."""
    # A shell's background job, as this test may be part of, ignores Ctrl-C and so would its processes.
    hang = f"two.share_out(hang_while_writing, [Path({str(folder)!r}, n) for n in 'ab'], nothing, (), print)"
    started = begun(f"signal.signal(signal.SIGINT, signal.default_int_handler); {opened(kind, hang)}")
    end_s = time.monotonic() + 60
    while len(list(folder.glob(".*"))) < 2:
        assert time.monotonic() < end_s
        time.sleep(0.05)
    return started


@pytest.mark.parametrize("kind", ["dask", "base"])
def test_ctrl_c_ends_all_processes_and_leaves_nothing_half_written(kind, tmp_path):
    started = hanging(kind, tmp_path)
    os.killpg(started.pid, signal.SIGINT)
    _, errors = started.communicate(timeout=120)  # returns when the last process has closed its end
    assert errors.count("Traceback") == 1, f"only the process that was started may speak: {errors}"
    assert "KeyboardInterrupt" in errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["dask", "base"])
def test_a_kill_of_the_client_leaves_no_process_and_nothing_half_written(kind, tmp_path):
    started = hanging(kind, tmp_path)
    began_s = time.monotonic()
    started.kill()
    _, errors = started.communicate(timeout=60)
    assert time.monotonic() - began_s < 10
    assert errors == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["dask", "base"])
def test_workers_whose_parent_was_killed_end_after_their_job(kind):
    work = opened(kind, "two.share_out(slowly_doubled, range(999), nothing, (), print)")
    started = begun(work, stdout=subprocess.PIPE)
    started.stdout.readline()
    started.kill()
    _, errors = started.communicate(timeout=120)  # as above
    assert "Traceback" not in errors
