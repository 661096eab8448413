"""A cache stays below its limit, and nothing goes that is in use or not ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from v2hdm.cli.main import run
from v2hdm.store.cache import StageCache
from v2hdm.store.folders import LIST, note_use
from v2hdm.store.lock import IN_USE, in_use
from v2hdm.store.pruning import DRIVES, items_of, prune

KEYS = [f"{number:064x}" for number in range(4)]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Four entries of 1 kB, the first one not used for longest, beside files that are not ours."""
    cache = StageCache(tmp_path / "cache")
    for age, key in enumerate(KEYS):
        cache.put("detect", key, bytes, bytes(1000))
        os.utime(cache.path("detect", key), (1000 + age, 1000 + age))
    (tmp_path / "cache" / "stages" / "detect" / "notes.txt").write_text("mine")
    (tmp_path / "cache" / "drive").mkdir()
    (tmp_path / "cache" / "drive" / "image.jpg").write_bytes(bytes(9000))
    return tmp_path / "cache"


def left(cache: Path) -> list[str]:
    return [key for key in KEYS if StageCache(cache).path("detect", key).is_file()]


def test_what_was_not_used_for_longest_goes_first(cache: Path) -> None:
    assert [item.path.stem for item in prune(cache, 2500)] == KEYS[:2]
    assert left(cache) == KEYS[2:]
    assert not prune(cache, 2500)


def test_what_is_not_ours_stays(cache: Path) -> None:
    prune(cache, 0)
    assert not left(cache)
    assert (cache / "stages" / "detect" / "notes.txt").read_text() == "mine"
    assert (cache / "drive" / "image.jpg").is_file()


def test_nothing_goes_that_a_run_in_progress_has_used(cache: Path) -> None:
    with in_use(cache):
        StageCache(cache).get("detect", KEYS[0], bytes)
        prune(cache, 0)
        assert left(cache) == KEYS[:1]
    StageCache(cache).put("detect", KEYS[1], bytes, b"")
    os.utime(StageCache(cache).path("detect", KEYS[0]), (1000, 1000))
    prune(cache, 0)
    assert KEYS[0] not in left(cache)


def test_a_run_in_another_process_protects_its_entries_until_it_is_killed(cache: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from v2hdm.store.cache import StageCache\n"
        "cache = StageCache(Path(sys.argv[1]))\n"
        "with cache.in_use():\n"
        f"    cache.get('detect', '{KEYS[3]}', bytes); print('in use', flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(cache)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline()
        prune(cache, 0)
        assert left(cache) == KEYS[3:]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    prune(cache, 0)
    assert not left(cache)
    assert not list((cache / IN_USE).glob("*"))


def test_a_lock_that_cannot_be_looked_at_counts_as_held(cache: Path) -> None:
    held = cache / IN_USE / "0123456789abcdef.lock"
    held.parent.mkdir()
    held.mkdir()  # opened, it is an error that is not its absence
    os.utime(held, (1001, 1001))
    assert [item.path.stem for item in prune(cache, 0)] == KEYS[:1]


def test_what_killed_runs_have_left_goes(cache: Path) -> None:
    partial = cache / "stages" / "detect" / ".some-host-0123456789abcdef.part"
    partial.write_bytes(b"half")
    os.utime(partial, (1000, 1000))
    for name, used_s in (("old", 1000.0), ("new", time.time())):
        folder = cache / f".bag-{name}.some-host-01234567.part" / "front"
        folder.mkdir(parents=True)
        (folder / "0.png").write_bytes(b"half")
        for path in (folder / "0.png", folder, folder.parent):
            os.utime(path, (used_s, used_s))
    prune(cache, 1e9)
    assert not partial.exists()
    assert [path.name for path in cache.glob(".*.part")] == [".bag-new.some-host-01234567.part"]
    assert left(cache) == KEYS


def folder_of_ours(cache: Path) -> Path:
    folder = cache / "port-0123456789"
    (folder / "front").mkdir(parents=True)
    (folder / "drive.yaml").write_text("name: port")
    (folder / "front" / "0.jpg").write_bytes(bytes(5000))
    note_use(folder)
    os.utime(folder / LIST, (1, 1))
    return folder


def test_a_rendered_drive_goes_but_for_what_the_user_put_there(tmp_path: Path) -> None:
    folder = folder_of_ours(tmp_path)
    (folder / "front" / "notes.txt").write_text("mine")
    (found,) = items_of(tmp_path)
    assert (found.kind, found.path) == (DRIVES, folder)
    assert found.size > 5000
    found.remove()
    assert [path.name for path in folder.rglob("*") if path.is_file()] == ["notes.txt"]
    (folder / "front" / "notes.txt").unlink()


def test_a_list_that_names_files_elsewhere_removes_none_of_them(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    folder = folder_of_ours(cache)
    precious = tmp_path / "precious.txt"
    precious.write_text("not ours")
    (folder / "way").symlink_to(tmp_path)
    listing = json.loads((folder / LIST).read_text())
    names = ["../../precious.txt", str(precious), "way/precious.txt", *listing["files"]]
    (folder / LIST).write_text(json.dumps({**listing, "files": names}))
    for item in items_of(cache):
        item.remove()
    assert precious.read_text() == "not ours"
    assert not (folder / "drive.yaml").exists()


def test_the_command_lists_and_prunes(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cache", "list", "--cache", str(cache)]) == 0
    assert "detect" in capsys.readouterr().out
    assert run(["cache", "prune", "--cache", str(cache), "--gb", "0"]) == 0
    assert "removed 4 entries" in capsys.readouterr().out
    assert not left(cache)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(["list", "--cache", "nowhere"], "no such folder"), (["prune", "--gb", "-1"], "give 0 or more")],
)
def test_the_command_reports_in_one_line(
    arguments: list[str], says: str, cache: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(cache.parent)
    assert run(["cache", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
