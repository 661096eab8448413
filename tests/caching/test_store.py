"""A store gives back what was put, or nothing: never half of it, never something damaged."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from v2hdm.errors import DriveError
from v2hdm.store.cache import Room, Store

KEY = "ab" * 32


def made(room: Room, value: list[int]) -> list[int]:
    return room.made("stage", KEY, list[int], lambda: value)


def test_what_was_made_is_not_made_again(tmp_path: Path) -> None:
    assert made(Room(Store(tmp_path)), [1, 2]) == [1, 2]
    assert made(Room(Store(tmp_path)), [3]) == [1, 2]
    assert made(Room(Store(tmp_path), resume=False), [4]) == [4]
    assert made(Room(Store(tmp_path)), [5]) == [4]


@pytest.mark.parametrize("place", [0, 20, 47, -1])
def test_an_entry_with_a_flipped_bit_is_made_anew(place: int, tmp_path: Path) -> None:
    store = Store(tmp_path)
    made(Room(store), [1, 2])
    path = store.path("stage", KEY)
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)
    assert made(Room(store), [7]) == [7]
    assert made(Room(store), [8]) == [7]


@pytest.mark.parametrize("kept", [0, 10, 47])
def test_an_entry_that_was_cut_is_made_anew(kept: int, tmp_path: Path) -> None:
    store = Store(tmp_path)
    made(Room(store), [1, 2])
    path = store.path("stage", KEY)
    path.write_bytes(path.read_bytes()[:kept])
    assert made(Room(store), [7]) == [7]


def test_a_pipe_in_an_entrys_place_is_not_waited_for(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.path("stage", KEY).parent.mkdir(parents=True)
    os.mkfifo(store.path("stage", KEY))
    assert made(Room(store), [7]) == [7]
    assert made(Room(store), [8]) == [7]


def test_an_entry_of_another_type_is_made_anew(tmp_path: Path) -> None:
    Room(Store(tmp_path)).keep("stage", KEY, str, "text")
    assert made(Room(Store(tmp_path)), [7]) == [7]


def test_what_was_logged_while_it_was_made_is_logged_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def make() -> int:
        logging.getLogger("v2hdm.some").warning("mind %s", "the gap")
        return 3

    for _ in range(2):
        caplog.clear()
        assert Room(Store(tmp_path)).made("stage", KEY, int, make) == 3
        assert [(one.name, one.levelno, one.message) for one in caplog.records] == [
            ("v2hdm.some", logging.WARNING, "mind the gap")
        ]


def test_a_cache_that_cannot_be_written_is_told_once_and_work_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    room = Room(Store(tmp_path / "cache"))
    for value in ([1], [2]):
        assert made(room, value) == value
    told = [one for one in caplog.records if "nothing can be kept" in one.message]
    assert len(told) == 1


def test_a_process_killed_while_it_writes_leaves_the_entry_or_none(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from v2hdm.store.cache import Store\n"
        "store = Store(Path(sys.argv[1])); print('go', flush=True)\n"
        "while True: store.put('stage', 'ab' * 32, bytes(2_000_000))\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.02)
        process.kill()
        process.wait()
        process.stdout.close()
        assert Store(tmp_path).get("stage", KEY) in (None, bytes(2_000_000))


def test_a_use_is_an_entrys_time_of_change(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.put("stage", KEY, b"x")
    os.utime(store.path("stage", KEY), (1, 1))
    store.get("stage", KEY)
    assert store.path("stage", KEY).stat().st_mtime > 1


def test_of_several_results_the_missing_ones_are_begun_before_one_is_waited_for(tmp_path: Path) -> None:
    store, told = Store(tmp_path), list[str]()
    made(Room(store), [7])

    def begin(value: int) -> Callable[[], list[int]]:
        def wait() -> list[int]:
            told.append(f"wait {value}")
            if value < 0:
                raise DriveError("unreadable")
            return [value]

        told.append(f"begin {value}")
        return wait

    room = Room(store)
    jobs = [(key, partial(begin, value)) for key, value in (("a", 1), (KEY, 2), ("b", 3))]
    found = room.each_made("stage", list[int], jobs)
    assert next(found) == [1]
    assert told == ["begin 1", "begin 3", "wait 1"]
    assert Room(store).take("stage", "a", list[int]) == [1]
    assert list(found) == [[7], [3]]
    with pytest.raises(DriveError, match="unreadable"):
        list(room.each_made("stage", list[int], [("c", partial(begin, 4)), ("d", partial(begin, -1))]))
    assert Room(store).take("stage", "c", list[int]) == [4]
