"""Processes that share work: what they give, and that they end with the one that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from v2hdm.errors import DriveError, WorkerError
from v2hdm.store.files import whole_file
from v2hdm.workers import share_out

ROOT = Path(__file__).parents[1]


def nothing() -> None: ...


def slowly_doubled(number: int) -> int:
    time.sleep(0.2 if number % 3 == 0 else 0.0)
    return 2 * number


def refuse(name: str) -> None:
    raise DriveError(f"{name}: damaged")


def hang_while_writing(path: Path) -> None:
    with whole_file(path) as partial:
        partial.write_text("half")
        time.sleep(60)


def test_results_come_in_the_order_of_the_jobs() -> None:
    taken: list[int] = []
    share_out(slowly_doubled, range(9), 2, nothing, (), taken.append)
    assert taken == [0, 2, 4, 6, 8, 10, 12, 14, 16]


def test_a_failure_is_raised_here_and_tells_where_it_happened() -> None:
    with pytest.raises(DriveError, match=r"[ab]\.jpg: damaged") as caught:
        share_out(refuse, ["a.jpg", "b.jpg"], 2, nothing, (), print)
    assert "in refuse" in str(caught.value.__cause__)


def test_a_failure_of_the_start_is_raised_here() -> None:
    with pytest.raises(DriveError, match="model: damaged"):
        share_out(slowly_doubled, range(4), 2, refuse, ("model",), print)


def test_a_process_that_dies_is_one_error_and_no_endless_wait() -> None:
    with pytest.raises(WorkerError, match=r"exit code 9\).*workers="):
        share_out(os._exit, [9, 9], 2, nothing, (), print)


def hanging(folder: Path) -> subprocess.Popen[str]:
    """A session of processes, each of which has half written a file of ``folder``."""
    code = (
        "from pathlib import Path; from tests.test_workers import *; "
        # A shell's background job, as this test may be part of, ignores Ctrl-C and so would its processes.
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"share_out(hang_while_writing, [Path({str(folder)!r}, n) for n in 'ab'], 2, nothing, (), print)"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", f"if __name__ == '__main__':\n  {code}"],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    end_s = time.monotonic() + 60
    while len(list(folder.glob(".*"))) < 2:
        assert time.monotonic() < end_s
        time.sleep(0.05)
    return started


def test_ctrl_c_ends_all_processes_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    started = hanging(tmp_path)
    os.killpg(started.pid, signal.SIGINT)
    _, errors = started.communicate(timeout=120)  # returns when the last process has closed its end
    assert errors.count("Traceback") == 1, "only the process that was started may speak"
    assert "KeyboardInterrupt" in errors
    assert not list(tmp_path.iterdir())


def test_workers_whose_parent_was_killed_end_after_their_job() -> None:
    code = "from tests.test_workers import *; share_out(slowly_doubled, range(999), 2, nothing, (), print)"
    started = subprocess.Popen(
        [sys.executable, "-uc", f"if __name__ == '__main__':\n  {code}"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert started.stdout is not None
    started.stdout.readline()
    started.kill()
    _, errors = started.communicate(timeout=120)  # as above
    assert "Traceback" not in errors
