"""An object store behind a cache: entries go there and come from there, whatever becomes of it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from v2hdm.cli.main import run
from v2hdm.store.cache.room import Room
from v2hdm.store.cache.store import Store, name_of
from v2hdm.store.objects.bucket import Bucket

pytestmark = pytest.mark.usefixtures("quick")
KEY = "ab" * 32


def made(store: Store, value: list[int]) -> list[int]:
    return Room(store).made("stage", KEY, list[int], lambda: value)


def test_what_one_machine_has_made_another_takes_and_keeps(memory: Bucket, tmp_path: Path) -> None:
    assert made(Store(tmp_path / "one", memory), [1]) == [1]
    assert made(Store(tmp_path / "two", memory), [2]) == [1]
    memory.remove(name_of("stage", KEY))
    assert made(Store(tmp_path / "two", memory), [3]) == [1]
    assert made(Store(tmp_path / "three", memory), [4]) == [4]


def test_what_is_damaged_there_is_made_anew(memory: Bucket, tmp_path: Path) -> None:
    made(Store(tmp_path / "one", memory), [1])
    data = memory.read(name_of("stage", KEY)) or b""
    memory.write(name_of("stage", KEY), data[:-1] + b"x")
    assert made(Store(tmp_path / "two", memory), [2]) == [2]
    assert made(Store(tmp_path / "three", memory), [3]) == [2]


def test_what_is_of_this_machine_alone_does_not_go_there(memory: Bucket, tmp_path: Path) -> None:
    assert made(Store(tmp_path, memory).on_disk, [1]) == [1]
    assert not memory.listed()


def test_a_store_that_fails_is_told_once_and_work_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Gone:
        def __getattr__(self, name: str) -> Any:
            raise OSError("no route to host")

    store = Store(tmp_path, Bucket(Gone(), "b", "s3://b/cache", "cache="))
    caplog.set_level(logging.WARNING)
    assert made(store, [1]) == [1]
    store.put("other", KEY, b"x")
    told = [one.message for one in caplog.records if "goes on without" in one.message]
    assert len(told) == 1
    assert made(Store(tmp_path), [2]) == [1]


def test_the_door_lists_verifies_and_prunes_a_store(
    memory: Bucket, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = [f"{number:064x}" for number in range(3)]
    for key in keys:
        memory.write(name_of("detect", key), b"no entry")
    Store(tmp_path, memory).put("map", KEY, bytes(1000))
    memory.write("stages/detect/notes", b"mine")
    memory.write("notes", b"mine")
    assert run(["cache", "list", "--cache", str(memory)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in told[1:]] == [["detect", "3"], ["map", "1"], ["all", "4"]]
    assert run(["cache", "verify", "--cache", str(memory)]) == 0
    assert "read 4 entries, 3 of them damaged" in capsys.readouterr().out
    assert run(["cache", "prune", "--cache", str(memory), "--gb", "0"]) == 0
    assert "removed 1 entries" in capsys.readouterr().out
    assert set(memory.listed()) == {"stages/detect/notes", "notes"}
