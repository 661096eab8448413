"""A result at a store is whole or told not to be, and what others put beside it stays as it is."""

import os
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from v2hdm.errors import ConfigError
from v2hdm.store.inputs import LIST
from v2hdm.store.remote import UNFINISHED, RemoteFolder, contents_of, is_whole_at, upload


def quiet(done, total):
    pass


def put(place, writer="us", **contents):
    """Put a result; whether it is whole."""
    upload(place.below("run"), contents, writer, quiet)
    return is_whole_at(place.below("run"))


def there(place):
    run = place.below("run")
    return {name: run.read(name) for name in run.listed() if name != LIST}


def test_a_result_is_replaced_whole_and_what_it_no_longer_has_goes(memory):
    assert put(memory, map=b"1", log=b"2")
    assert put(memory, map=b"1", report=b"3")
    assert there(memory) == {"map": b"1", "report": b"3"}


def test_what_is_not_ours_is_neither_replaced_nor_removed(memory):
    memory.write("run/notes", b"mine")
    with pytest.raises(ConfigError, match="holds objects that are not results of V2HDM"):
        put(memory, map=b"1")
    assert there(memory) == {"notes": b"mine"}
    memory.remove("run/notes")
    put(memory, map=b"1")
    memory.write("run/notes", b"mine")
    put(memory, map=b"2")
    with pytest.raises(ConfigError, match="run/notes: was not written by V2HDM"):
        put(memory, map=b"3", notes=b"ours")
    assert there(memory) == {"map": b"2", "notes": b"mine"}


def test_what_was_changed_is_not_replaced_and_the_result_not_taken(memory):
    put(memory, map=b"1", log=b"2")
    memory.write("run/map", b"9")
    assert not is_whole_at(memory.below("run"))
    with pytest.raises(ConfigError, match="run/map: was changed after we wrote it"):
        put(memory, map=b"3")
    assert there(memory) == {"map": b"9", "log": b"2"}


def test_what_a_store_was_restored_from_counts_by_its_content(memory):
    put(memory, map=b"1", log=b"2")
    memory.write("run/map", b"1")
    assert put(memory, map=b"3")


def test_an_object_that_is_missing_is_no_whole_result(memory):
    put(memory, map=b"1", log=b"2")
    memory.remove("run/log")
    assert not is_whole_at(memory.below("run"))
    assert put(memory, map=b"1", log=b"2")


class Stop(BaseException):
    pass


def stopping(place, calls):
    """The place, whose process ends before its ``calls``-th change of an object."""

    class Files:
        def __init__(self, files):
            self.files, self.left = files, calls

        def __getattr__(self, name):
            if name in ("pipe_file", "put_file", "rm_file"):
                self.left -= 1
                if self.left < 0:
                    raise Stop
            return getattr(self.files, name)

    stopped = place.below("run")
    stopped._files = Files(stopped._files)
    return stopped


@pytest.mark.parametrize("calls", range(11))
def test_an_upload_that_stopped_anywhere_is_no_result_and_is_done_again(calls, memory):
    put(memory, map=b"1", log=b"2", old=b"3")
    new = {"map": b"4", "log": b"5", "own": b"6"}
    with suppress(Stop):
        upload(stopping(memory, calls), new, "us", quiet)
    old_files = {"map": b"1", "log": b"2", "old": b"3"}
    whole = is_whole_at(memory.below("run"))
    files = {name: data for name, data in there(memory).items() if name != UNFINISHED}
    assert not whole or files in (old_files, new)
    assert whole == (calls < 2 or calls > 8)
    assert put(memory, **new)
    assert there(memory) == new


def test_what_came_to_be_while_an_upload_had_stopped_is_not_taken_for_ours(memory):
    with pytest.raises(Stop):
        upload(stopping(memory, 2), {"map": b"4", "own": b"6"}, "us", quiet)
    memory.write("run/own", b"7")
    with pytest.raises(ConfigError, match="run/own: was changed after we wrote it"):
        put(memory, map=b"4", own=b"6")
    assert there(memory)["own"] == b"7"


def test_an_object_that_was_put_in_part_is_no_result(memory):
    class Files:
        def __init__(self, files):
            self.files = files

        def __getattr__(self, name):
            return getattr(self.files, name)

        def pipe_file(self, path, value, **how):
            self.files.pipe_file(path, value[:2] if path.endswith("/log") else value, **how)

    short = memory.below("run")
    short._files = Files(short._files)
    with pytest.raises(ConfigError, match="run/log: differs from what was uploaded"):
        upload(short, {"map": b"123", "log": b"456"}, "us", quiet)
    assert not is_whole_at(memory.below("run"))


def test_what_others_put_there_during_an_upload_is_not_replaced(memory):
    def meanwhile(done, total):
        if done == 1:
            memory.write("run/log", b"mine")

    with pytest.raises(ConfigError, match="run/log: was not written by V2HDM"):
        upload(memory.below("run"), {"map": b"1", "log": b"2"}, "us", meanwhile)
    assert there(memory)["log"] == b"mine"


def test_a_second_writer_is_refused_until_the_first_has_finished(memory):
    with suppress(Stop):
        upload(stopping(memory, 3), {"map": b"1", "log": b"2"}, "one host", quiet)
    before = there(memory)
    with pytest.raises(ConfigError, match="is being written by one host, or was when it stopped"):
        put(memory, "other host", map=b"3")
    assert there(memory) == before
    assert put(memory, "one host", map=b"1", log=b"2")
    assert put(memory, "other host", map=b"3")


@pytest.mark.parametrize(
    ("calls", "says"), [(2, "is being written by other host"), (99, "another process has just put a result")]
)
def test_of_two_writers_that_begin_at_once_one_is_refused(calls, says, memory):
    class Files:
        """Another writer begins after this one has looked, and before it writes."""

        def __init__(self, files):
            self.files, self.begun = files, False

        def __getattr__(self, name):
            if name == "pipe_file" and not self.begun:
                self.begun = True
                with suppress(Stop):
                    upload(stopping(memory, calls), {"map": b"1"}, "other host", quiet)
            return getattr(self.files, name)

    slow = memory.below("run")
    slow._files = Files(slow._files)
    with pytest.raises(ConfigError, match=says):
        upload(slow, {"map": b"2"}, "us", quiet)
    assert there(memory).get("map") in (None, b"1")
    assert is_whole_at(memory.below("run")) == (calls == 99)


def test_a_list_that_is_damaged_is_told(memory):
    put(memory, map=b"1")
    memory.write(f"run/{LIST}", b"{}\n[" * 9)
    with pytest.raises(ConfigError, match="is damaged"):
        put(memory, map=b"2")


UPLOAD = """
import sys, time
from pathlib import Path
from v2hdm.store.remote import RemoteFolder, contents_of, upload
def report(done, total):
    print(done, flush=True)
    time.sleep(0.02)
place = RemoteFolder.at("s3://bucket/killed/run", "output=")
upload(place, contents_of(Path(sys.argv[1])), "us", report)
"""


def test_a_process_killed_in_the_middle_of_an_upload_leaves_no_result(s3, tmp_path):
    place = RemoteFolder.at("s3://bucket/killed/run", "output=")
    for number in range(12):
        (tmp_path / f"{number}").write_bytes(os.urandom(300_000))
    for after in (1, 5):
        (tmp_path / "0").write_bytes(os.urandom(300_000))
        process = subprocess.Popen(
            [sys.executable, "-c", UPLOAD, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        for line in process.stdout:
            if line.strip() == str(after):
                break
        time.sleep(0.005 * after)
        process.kill()
        process.wait()
        process.stdout.close()
        assert not is_whole_at(place)
    upload(place, contents_of(tmp_path), "us", quiet)
    assert is_whole_at(place)
    for number in range(12):
        assert place.read(f"{number}") == (tmp_path / f"{number}").read_bytes()
