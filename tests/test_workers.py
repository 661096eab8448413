"""Processes that share work, and how progress is told."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from train.bar import share_of_work
from v2hdm.errors import DriveError, WorkerError
from v2hdm.progress import progress_lines
from v2hdm.store.files import whole_file
from v2hdm.workers import share_out

ROOT = Path(__file__).parents[1]


def nothing(): ...


def slowly_doubled(number):
    time.sleep(0.2 if number % 3 == 0 else 0.0)
    return 2 * number


def refuse(name):
    raise DriveError(f"{name}: damaged")


def hang_while_writing(path):
    with whole_file(path) as partial:
        partial.write_text("half")
        time.sleep(60)


def test_results_come_in_the_order_of_the_jobs():
    taken: list[int] = []
    share_out(slowly_doubled, range(9), 2, nothing, (), taken.append)
    assert taken == [0, 2, 4, 6, 8, 10, 12, 14, 16]


def test_a_failure_is_raised_here_and_tells_where_it_happened():
    with pytest.raises(DriveError, match=r"[ab]\.jpg: damaged") as caught:
        share_out(refuse, ["a.jpg", "b.jpg"], 2, nothing, (), print)
    assert "in refuse" in str(caught.value.__cause__)


def test_a_failure_of_the_start_is_raised_here():
    with pytest.raises(DriveError, match="model: damaged"):
        share_out(slowly_doubled, range(4), 2, refuse, ("model",), print)


def test_a_process_that_dies_is_one_error_and_no_endless_wait():
    with pytest.raises(WorkerError, match=r"exit code 9\).*workers="):
        share_out(os._exit, [9, 9], 2, nothing, (), print)


def begun(code, **pipes):
    """A session of processes that runs this."""
    code = f"if __name__ == '__main__':\n  from tests.test_workers import *; {code}"
    given = {"cwd": ROOT, "stderr": subprocess.PIPE, "text": True, "start_new_session": True, **pipes}
    return subprocess.Popen([sys.executable, "-uc", code], **given)


def hanging(folder):
    """A session of processes, each of which has half written a file of ``folder``."""
    started = begun(
        # A shell's background job, as this test may be part of, ignores Ctrl-C and so would its processes.
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"share_out(hang_while_writing, [Path({str(folder)!r}, n) for n in 'ab'], 2, nothing, (), print)"
    )
    end_s = time.monotonic() + 60
    while len(list(folder.glob(".*"))) < 2:
        assert time.monotonic() < end_s
        time.sleep(0.05)
    return started


def test_ctrl_c_ends_all_processes_and_leaves_nothing_half_written(tmp_path):
    started = hanging(tmp_path)
    os.killpg(started.pid, signal.SIGINT)
    _, errors = started.communicate(timeout=120)  # returns when the last process has closed its end
    assert errors.count("Traceback") == 1, "only the process that was started may speak"
    assert "KeyboardInterrupt" in errors
    assert not list(tmp_path.iterdir())


def test_workers_whose_parent_was_killed_end_after_their_job():
    started = begun("share_out(slowly_doubled, range(999), 2, nothing, (), print)", stdout=subprocess.PIPE)
    started.stdout.readline()
    started.kill()
    _, errors = started.communicate(timeout=120)  # as above
    assert "Traceback" not in errors


def test_a_log_has_a_line_when_a_task_begins_and_ends():
    lines: list[str] = []
    tell = progress_lines(lines.append)
    for done in range(101):
        tell("detect", done, 100)
    tell("map", 0, 3)
    assert lines == ["detect: 0 of 100", "detect: 100 of 100", "map: 0 of 3"]


def test_a_share_of_work_is_told_in_lines_where_there_is_no_terminal():
    log = io.StringIO()
    with share_of_work(Console(file=log), "reading") as tell:
        for step in range(100):
            tell(step / 100, f"step [{step}]")
        tell(1.0, "done")
    assert log.getvalue().splitlines() == ["  0%  step [0]", "100%  done"]


def test_a_terminal_shows_a_bar():
    screen = io.StringIO()
    with share_of_work(Console(file=screen, force_terminal=True, width=80), "reading") as tell:
        tell(0.5, "halving")
    assert "50 %" in screen.getvalue()
    assert "halving" in screen.getvalue()
