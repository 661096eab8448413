"""The stage cache gives back what was put or nothing, and stays below its limit."""

import errno
import fcntl
import itertools
import json
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from tests.drive.example import make_map
from v2hdm.cli.main import run
from v2hdm.ground.results import GroundStatus, Reading
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.pipeline.inspect import Inspection
from v2hdm.pipeline.stages import MappedSet
from v2hdm.records import FloatArray, ImageDetections
from v2hdm.store.cache import DRIVES, CodecError, StageCache, decode, encode, items_of, prune
from v2hdm.store.folders import IN_USE, LIST, in_use, is_whole, new_entry, note_use, take_lock
from v2hdm.store.results import result_folder

KEY = "ab" * 32


def made(cache, value):
    return cache.get_or_make("stage", KEY, list[int], lambda: value)


def test_what_was_made_is_not_made_again(tmp_path):
    assert made(StageCache(tmp_path), [1, 2]) == [1, 2]
    assert made(StageCache(tmp_path), [3]) == [1, 2]
    assert made(StageCache(tmp_path, resume=False), [4]) == [4]
    assert made(StageCache(tmp_path), [5]) == [4]
    assert made(StageCache(None), [6]) == [6]


def flipped(data, place):
    changed = bytearray(data)
    changed[place] ^= 1
    return bytes(changed)


@pytest.mark.parametrize("place", [0, 20, 47, -1])
@pytest.mark.parametrize("cut", [False, True])
def test_an_entry_with_a_flipped_bit_or_that_was_cut_is_made_anew(place, cut, tmp_path):
    cache = StageCache(tmp_path)
    made(cache, [1, 2])
    path = cache.path("stage", KEY)
    data = path.read_bytes()
    path.write_bytes(data[:place] if cut else flipped(data, place))
    assert made(cache, [7]) == [7]
    assert made(cache, [8]) == [7]


def test_a_pipe_in_an_entrys_place_is_not_waited_for(tmp_path):
    cache = StageCache(tmp_path)
    cache.path("stage", KEY).parent.mkdir(parents=True)
    os.mkfifo(cache.path("stage", KEY))
    assert made(cache, [7]) == [7]
    assert made(cache, [8]) == [7]


def test_an_entry_of_another_type_is_made_anew(tmp_path):
    StageCache(tmp_path).put("stage", KEY, str, "text")
    assert made(StageCache(tmp_path), [7]) == [7]


def test_what_was_logged_while_it_was_made_is_logged_again(tmp_path, caplog):
    def make():
        logging.getLogger("v2hdm.some").warning("mind %s", "the gap")
        return 3

    for _ in range(2):
        caplog.clear()
        assert StageCache(tmp_path).get_or_make("stage", KEY, int, make) == 3
        assert [(record.name, record.levelno, record.message) for record in caplog.records] == [
            ("v2hdm.some", logging.WARNING, "mind the gap")
        ]


def test_a_cache_that_cannot_be_written_is_reported_once_and_work_goes_on(tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    cache = StageCache(tmp_path / "cache")
    for value in ([1], [2]):
        assert made(cache, value) == value
    assert len([record for record in caplog.records if "later runs cannot resume" in record.message]) == 1


def test_a_process_killed_while_it_writes_leaves_the_entry_or_none(tmp_path):
    code = (
        "import sys; from pathlib import Path; from v2hdm.store.cache import StageCache\n"
        "cache = StageCache(Path(sys.argv[1])); print('go', flush=True)\n"
        "while True: cache.put('stage', 'ab' * 32, bytes, bytes(2_000_000))\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(0.02)
        process.kill()
        process.wait()
        process.stdout.close()
        assert StageCache(tmp_path).get("stage", KEY, bytes) in (None, bytes(2_000_000))


def test_a_use_is_an_entrys_time_of_change(tmp_path):
    cache = StageCache(tmp_path)
    made(cache, [1])
    os.utime(cache.path("stage", KEY), (1, 1))
    made(cache, [2])
    assert cache.path("stage", KEY).stat().st_mtime > 1


@dataclass(frozen=True)
class Kept:
    """One of everything."""

    number: float
    count: int
    array: FloatArray
    by_reading: Mapping[Reading, float]
    frame: Mapping[Path, int]
    maybe: FloatArray | None = None
    names: tuple[str, ...] = ()


def same(value, other):
    if isinstance(value, np.ndarray):
        return (
            value.dtype == other.dtype and value.shape == other.shape and value.tobytes() == other.tobytes()
        )
    if is_dataclass(value):
        return all(same(getattr(value, f.name), getattr(other, f.name)) for f in fields(value))
    return bool(value == other)


@given(
    number=st.floats(allow_nan=False),
    array=npst.arrays(np.float64, npst.array_shapes(min_dims=0, max_dims=4, min_side=0)),
)
def test_every_bit_comes_back(number, array):
    values = Kept(
        number, -3, array, {Reading.MIRRORED: 0.1}, {Path("a/b.jpg"): 4}, array[..., None], ("x", "ü")
    )
    decoded = decode(encode(values), Kept)
    assert same(decoded, values)
    assert encode(decoded) == encode(values)


@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int64, np.float32, np.complex128, ">f8"])
def test_element_types_come_back(kind):
    array = np.arange(12).reshape(3, 4).astype(kind)[::2]
    assert same(decode(encode(array), np.ndarray), array.copy())


@pytest.mark.parametrize("kind", [MappedSet, Inspection, ImageDetections, AdjustedPoses])
def test_what_the_stages_make_can_be_kept(kind):
    with pytest.raises(CodecError):
        decode(encode({"nothing": "of it"}), kind)


@given(st.binary(max_size=200))
def test_bytes_of_anyone_are_a_value_of_the_type_or_refused(data):
    try:
        decoded = decode(data, tuple[list[ImageDetections], GroundStatus])
    except CodecError:
        return
    assert isinstance(decoded[1], GroundStatus)


def test_neither_pickles_nor_arrays_of_objects_are_read(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "escaped",))

    texts = msgspec.msgpack.encode(["<U2", [1], b"12345678"])  # numpy itself would read these
    for data in (pickle.dumps(Evil()), msgspec.msgpack.encode(["|O", [1], pickle.dumps(Evil())]), texts):
        with pytest.raises(CodecError):
            decode(data, np.ndarray)
    assert not list(tmp_path.iterdir())
    with pytest.raises(TypeError):
        encode(np.array([Evil()]))


def test_arrays_that_claim_to_be_larger_than_they_are_are_refused():
    for shape in ([10**12], [2**40, 2**40], [-1, -1], [3]):
        with pytest.raises(CodecError):
            decode(msgspec.msgpack.encode(["<f8", shape, b"12345678"]), np.ndarray)


def test_nesting_without_end_is_refused():
    with pytest.raises(CodecError):
        decode(b"\x91" * 100_000, list[Any])


KEYS = [f"{number:064x}" for number in range(4)]


@pytest.fixture
def cache(tmp_path):
    """Four entries of 1 kB, the first one not used for longest, beside files that are not ours."""
    cache = StageCache(tmp_path / "cache")
    for age, key in enumerate(KEYS):
        cache.put("detect", key, bytes, bytes(1000))
        os.utime(cache.path("detect", key), (1000 + age, 1000 + age))
    (tmp_path / "cache" / "stages" / "detect" / "notes.txt").write_text("mine")
    (tmp_path / "cache" / "drive").mkdir()
    (tmp_path / "cache" / "drive" / "image.jpg").write_bytes(bytes(9000))
    return tmp_path / "cache"


def left(cache):
    return [key for key in KEYS if StageCache(cache).path("detect", key).is_file()]


def test_what_was_not_used_for_longest_goes_first(cache):
    assert [item.path.stem for item in prune(cache, 2500)] == KEYS[:2]
    assert left(cache) == KEYS[2:]
    assert not prune(cache, 2500)


def test_what_is_not_ours_stays(cache):
    foreign = cache / ".thesis.part"
    foreign.mkdir()
    os.utime(foreign, (1000, 1000))
    prune(cache, 0)
    assert foreign.is_dir()
    assert not left(cache)
    assert (cache / "stages" / "detect" / "notes.txt").read_text() == "mine"
    assert (cache / "drive" / "image.jpg").is_file()


def test_nothing_goes_that_a_run_in_progress_has_used(cache):
    with in_use(cache):
        StageCache(cache).get("detect", KEYS[0], bytes)
        prune(cache, 0)
        assert left(cache) == KEYS[:1]
    StageCache(cache).put("detect", KEYS[1], bytes, b"")
    os.utime(StageCache(cache).path("detect", KEYS[0]), (1000, 1000))
    prune(cache, 0)
    assert KEYS[0] not in left(cache)


def test_a_run_in_another_process_protects_its_entries_until_it_is_killed(cache):
    code = (
        "import sys, time; from pathlib import Path; from v2hdm.store.cache import StageCache\n"
        "cache = StageCache(Path(sys.argv[1]))\n"
        "with cache.in_use():\n"
        f"    cache.get('detect', '{KEYS[3]}', bytes); print('in use', flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(cache)], stdout=subprocess.PIPE)
    try:
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


def test_a_lock_that_cannot_be_looked_at_counts_as_held(cache):
    held = cache / IN_USE / "0123456789abcdef.lock"
    held.parent.mkdir()
    held.mkdir()  # opened, it is an error that is not its absence
    os.utime(held, (1001, 1001))
    assert [item.path.stem for item in prune(cache, 0)] == KEYS[:1]


def test_a_file_system_without_locks_is_reported(tmp_path, monkeypatch, caplog):
    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with (tmp_path / "a.lock").open("w") as stream:
        assert take_lock(stream)
    assert "a.lock: no lock is possible here" in caplog.text


def test_what_killed_runs_have_left_goes(cache):
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


def folder_of_ours(cache):
    folder = cache / "port-0123456789"
    (folder / "front").mkdir(parents=True)
    (folder / "drive.yaml").write_text("name: port")
    (folder / "front" / "0.jpg").write_bytes(bytes(5000))
    note_use(folder)
    os.utime(folder / LIST, (1, 1))
    return folder


def test_a_rendered_drive_goes_but_for_what_the_user_put_there(tmp_path):
    folder = folder_of_ours(tmp_path)
    (folder / "front" / "notes.txt").write_text("mine")
    (folder / "front" / "0.jpg").rename(tmp_path / "0.jpg")
    (folder / "front" / "0.jpg").symlink_to(tmp_path / "0.jpg")
    (item,) = items_of(tmp_path)
    assert (item.kind, item.path) == (DRIVES, folder)
    assert item.size > 5000
    item.remove()
    assert {path.name for path in folder.rglob("*") if path.is_file()} == {"notes.txt", "0.jpg"}


def test_a_folder_with_a_list_of_somebody_elses_is_not_ours(tmp_path):
    folder = folder_of_ours(tmp_path)
    listing = json.loads((folder / LIST).read_text())
    (folder / LIST).write_text(json.dumps(listing | {"about": "files of mine"}))
    assert not items_of(tmp_path)


@pytest.mark.parametrize(("name", "stays"), [("old", True), ("some-host-01234567", False)])
def test_of_hidden_folders_beside_an_import_only_what_a_kill_has_left_goes(name, stays, tmp_path):
    hidden = tmp_path / f".bag-front.{name}.part"
    hidden.mkdir()
    os.utime(hidden, (1000, 1000))
    with new_entry(tmp_path / "bag-front") as partial:
        write_entry(partial)
    assert hidden.is_dir() is stays


def test_an_import_is_not_made_anew_where_a_link_leads(tmp_path):
    folder, elsewhere = tmp_path / "cache" / "bag-front", tmp_path / "elsewhere"
    damaged_entry(folder)
    (folder / "front").rename(elsewhere)
    (folder / "front").symlink_to(elsewhere)
    before = sorted(path.name for path in elsewhere.iterdir())
    with new_entry(folder) as partial:
        write_entry(partial)
    assert is_whole(folder)
    assert sorted(path.name for path in elsewhere.iterdir()) == before


def damaged_entry(folder):
    """An import that has lost a file, in which a user has put notes."""
    shutil.rmtree(folder, ignore_errors=True)
    with new_entry(folder) as partial:
        write_entry(partial)
    (folder / "front" / "0.png").unlink()
    for note in (folder / "notes.md", folder / "front" / "notes.md"):
        note.write_text("mine")


def write_entry(partial):
    (partial / "front").mkdir()
    for name in ("images.txt", "front/0.png", "front/1.png"):
        (partial / name).write_text(name)


def renew_and_die(folder, at):
    """Make an entry anew in a fork, which is killed at so many lines; whether it was."""

    def trace(frame, event, arg):
        nonlocal at
        if not frame.f_code.co_filename.endswith(("store/folders.py", "shutil.py")):
            return None
        at -= event == "line"
        if at < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return trace

    process = os.fork()
    if not process:
        sys.settrace(trace)
        with new_entry(folder) as partial:
            write_entry(partial)
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(process, 0)[1])


def test_a_note_in_an_import_outlives_a_kill_at_any_line_while_it_is_made_anew(tmp_path):
    folder = tmp_path / "bag-front"
    for at in itertools.count(0, 3):
        damaged_entry(folder)
        killed = renew_and_die(folder, at)
        with new_entry(folder) as partial:
            write_entry(partial)
        assert is_whole(folder)
        assert [path.read_text() for path in folder.rglob("notes.md")] == ["mine", "mine"], at
        assert list(tmp_path.glob(".*")) == []
        if not killed:
            assert at > 100
            return


def test_a_list_that_names_files_elsewhere_removes_none_of_them(tmp_path):
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


def test_the_command_lists_and_prunes(cache, capsys):
    assert run(["cache", "list", "--cache", str(cache)]) == 0
    assert "detect" in capsys.readouterr().out
    assert run(["cache", "prune", "--cache", str(cache), "--gb", "0"]) == 0
    assert "removed 4 entries" in capsys.readouterr().out
    assert not left(cache)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(["list", "--cache", "nowhere"], "no such folder"), (["prune", "--gb", "-1"], "give 0 or more")],
)
def test_the_command_reports_in_one_line(arguments, says, cache, capsys, monkeypatch):
    monkeypatch.chdir(cache.parent)
    assert run(["cache", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.fixture
def written(tmp_path):
    with result_folder(tmp_path / "run") as folder:
        write_geojson(make_map(), folder / "map.geojson")
    return tmp_path / "run" / "map.geojson"


def test_a_file_as_it_was_written_is_no_matter(written, caplog):
    read_geojson(written)
    assert not caplog.records


def test_a_changed_file_is_read_and_told_of_once(written, caplog):
    written.write_text(written.read_text() + "\n")
    for _ in range(2):
        read_geojson(written)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert str(written) in record.getMessage()
    assert "has changed since we wrote it" in record.getMessage()


def test_a_damaged_list_says_nothing(written, caplog):
    listing = written.parent / ".v2hdm-results.jsonl"
    listing.write_bytes(listing.read_bytes()[:90] + b"\xff[{")
    read_geojson(written)
    assert not caplog.records
