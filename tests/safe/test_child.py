"""Work in a process of its own: its answer, errors and limits reach whoever has asked, in one line."""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.safe import work
from v2hdm.errors import DriveError, MapFileError
from v2hdm.safe.child import Limits, in_child

SMALL = Limits(memory_bytes=300_000_000, file_bytes=2_000_000, step_s=1.0)


def ask(function, *arguments):
    return in_child(function, *arguments, limits=SMALL, where="a.bag", error=MapFileError)


def test_the_answer_and_the_log_of_a_child_are_its_parents(caplog, capfd):
    with caplog.at_level(logging.INFO):
        answer = ask(work.answer, 1, "two", Path("three").name)
    assert answer == {"arguments": [1, "two", "three"], "heavy": []}
    assert [(record.name, record.getMessage()) for record in caplog.records] == [
        ("v2hdm.io.somewhere", "a line 1")
    ]
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "a library's own words\non stdout, too\n")


def test_errors_of_a_child_are_raised_as_they_were(tmp_path):
    with pytest.raises(DriveError, match=r"^a\.bag: is cut off; copy it again$"):
        ask(work.refuse)
    missing = tmp_path / "none" / "a"
    with pytest.raises(FileNotFoundError) as failure:
        ask(work.fail, str(missing))
    assert failure.value.filename == str(missing)


def test_a_child_works_where_its_parent_does_in_its_environment_and_in_a_scratch_folder(
    tmp_path, monkeypatch
):
    scratches = set()
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        monkeypatch.setenv("V2HDM_SAID", name)
        answer = ask(work.surroundings)
        scratches.add(answer.pop("temporary"))
        assert answer == {"folder": str(tmp_path / name), "said": name}
    assert len(scratches) == 2
    assert not any(Path(scratch).exists() for scratch in scratches)


def test_a_child_leaves_nothing_to_the_next_one(monkeypatch):
    monkeypatch.delenv("V2HDM_SAID", raising=False)
    assert [ask(work.remember, word) for word in ("a", "b")] == [["a"], ["b"]]
    assert ask(work.surroundings)["said"] is None


@pytest.mark.skipif(sys.platform != "linux", reason="has no fork server")
def test_children_are_forks_of_a_process_that_serves_their_parent_alone():
    server = ask(work.forked_by)
    with pytest.raises(MapFileError):
        ask(work.crash)
    assert ask(work.forked_by) == server
    fork = os.fork()
    if not fork:
        os._exit(ask(work.forked_by) == server)
    assert os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]) == 0
    assert ask(work.forked_by) == server


@pytest.mark.skipif(sys.platform != "linux", reason="has no fork server")
def test_a_server_that_was_killed_or_has_other_limits_is_replaced(monkeypatch):
    killed = ask(work.forked_by)
    os.kill(killed, signal.SIGKILL)
    wait_until(lambda: Path("/proc", str(killed), "stat").read_text().split()[2] == "Z")
    server = ask(work.forked_by)
    assert server != killed
    import resource

    kind = resource.RLIMIT_NOFILE
    before, most = resource.getrlimit(kind)
    resource.setrlimit(kind, (before - 1, most))
    try:
        assert ask(work.forked_by) != server
    finally:
        resource.setrlimit(kind, (before, most))


ENDS = {
    "memory": (work.take_memory, (1_000_000_000,), "takes more than 0.3 GB of memory"),
    "time": (work.take_time, (), "takes more than 1 s of a processor for one piece"),
    "a crash": (work.crash, (), r"the process that reads it ended by signal 11 \("),
}


@pytest.mark.skipif(sys.platform == "win32", reason="has no limits")
@pytest.mark.parametrize("name", ENDS)
def test_a_child_that_a_limit_or_a_signal_ends_is_one_line(name, capfd):
    function, arguments, says = ENDS[name]
    with pytest.raises(MapFileError, match=f"^a.bag: {says}") as refused:
        ask(function, *arguments)
    assert "\n" not in str(refused.value)
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(sys.platform == "win32", reason="has no limits")
def test_a_child_writes_no_larger_file_than_its_limit(tmp_path):
    with pytest.raises(MapFileError, match=r"^a\.bag: becomes a file of more than 0\.0 GB"):
        ask(work.fill, str(tmp_path / "a"))
    assert (tmp_path / "a").stat().st_size <= 2_000_001


def test_every_step_of_a_child_has_its_own_time():
    assert ask(work.take_time_in_steps) == "done"


SCRIPT = """
import signal, sys
from tests.safe import work
from v2hdm.errors import DriveError
from v2hdm.safe.child import Limits, in_child
# A shell's background job, as this test may be part of, ignores Ctrl-C, and so would its processes.
signal.signal(signal.SIGINT, signal.default_int_handler)
print("once")
in_child(work.wait, sys.argv[1], limits=Limits.of([]), where="a.bag", error=DriveError)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_child_of_a_script_without_a_guard_ends_with_it_and_leaves_nothing(number, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    report_file = tmp_path / "told"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [Path(__file__).parents[2]]))}
    command = [sys.executable, str(script), str(report_file)]
    parent = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, start_new_session=True
    )
    wait_until(lambda: report_file.is_file() and report_file.read_text().count(" ") == 1)
    child, scratch = report_file.read_text().split(" ")
    assert Path(scratch).is_dir()
    os.killpg(parent.pid, number)
    assert parent.communicate(timeout=60)[0] == b"once\n"
    wait_until(lambda: not Path("/proc", child).exists() and not Path(scratch).exists())


def wait_until(is_so):
    end_s = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)
