"""The stage cache gives back what was put, exactly, or nothing: never half of it, never something damaged."""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from v2hdm.errors import DriveError
from v2hdm.ground import GroundStatus, Reading
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.pipeline.camera_sets import MappedSet
from v2hdm.pipeline.inspect import Inspection
from v2hdm.records import FloatArray, ImageDetections, MarkingDetection
from v2hdm.store.cache import CodecError, StageCache, decode, encode

KEY = "ab" * 32


def made(cache: StageCache, value: list[int]) -> list[int]:
    return cache.get_or_make("stage", KEY, list[int], lambda: value)


def test_what_was_made_is_not_made_again(tmp_path: Path) -> None:
    assert made(StageCache(tmp_path), [1, 2]) == [1, 2]
    assert made(StageCache(tmp_path), [3]) == [1, 2]
    assert made(StageCache(tmp_path, resume=False), [4]) == [4]
    assert made(StageCache(tmp_path), [5]) == [4]
    assert made(StageCache(None), [6]) == [6]


def flipped(data: bytes, place: int) -> bytes:
    changed = bytearray(data)
    changed[place] ^= 1
    return bytes(changed)


@pytest.mark.parametrize("place", [0, 20, 47, -1])
@pytest.mark.parametrize("cut", [False, True])
def test_an_entry_with_a_flipped_bit_or_that_was_cut_is_made_anew(
    place: int, cut: bool, tmp_path: Path
) -> None:
    cache = StageCache(tmp_path)
    made(cache, [1, 2])
    path = cache.path("stage", KEY)
    data = path.read_bytes()
    path.write_bytes(data[:place] if cut else flipped(data, place))
    assert made(cache, [7]) == [7]
    assert made(cache, [8]) == [7]


def test_a_pipe_in_an_entrys_place_is_not_waited_for(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    cache.path("stage", KEY).parent.mkdir(parents=True)
    os.mkfifo(cache.path("stage", KEY))
    assert made(cache, [7]) == [7]
    assert made(cache, [8]) == [7]


def test_an_entry_of_another_type_is_made_anew(tmp_path: Path) -> None:
    StageCache(tmp_path).put("stage", KEY, str, "text")
    assert made(StageCache(tmp_path), [7]) == [7]


def test_what_was_logged_while_it_was_made_is_logged_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def make() -> int:
        logging.getLogger("v2hdm.some").warning("mind %s", "the gap")
        return 3

    for _ in range(2):
        caplog.clear()
        assert StageCache(tmp_path).get_or_make("stage", KEY, int, make) == 3
        assert [(one.name, one.levelno, one.message) for one in caplog.records] == [
            ("v2hdm.some", logging.WARNING, "mind the gap")
        ]


def test_a_cache_that_cannot_be_written_is_reported_once_and_work_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    cache = StageCache(tmp_path / "cache")
    for value in ([1], [2]):
        assert made(cache, value) == value
    assert len([one for one in caplog.records if "nothing can be kept" in one.message]) == 1


def test_a_process_killed_while_it_writes_leaves_the_entry_or_none(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from v2hdm.store.cache import StageCache\n"
        "cache = StageCache(Path(sys.argv[1])); print('go', flush=True)\n"
        "while True: cache.put('stage', 'ab' * 32, bytes, bytes(2_000_000))\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.02)
        process.kill()
        process.wait()
        process.stdout.close()
        assert StageCache(tmp_path).get("stage", KEY, bytes) in (None, bytes(2_000_000))


def test_a_use_is_an_entrys_time_of_change(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    made(cache, [1])
    os.utime(cache.path("stage", KEY), (1, 1))
    made(cache, [2])
    assert cache.path("stage", KEY).stat().st_mtime > 1


def test_of_several_results_the_missing_ones_are_begun_before_one_is_waited_for(tmp_path: Path) -> None:
    cache, order = StageCache(tmp_path), list[str]()
    made(cache, [7])

    def begin(value: int) -> Callable[[], list[int]]:
        def wait() -> list[int]:
            order.append(f"wait {value}")
            if value < 0:
                raise DriveError("unreadable")
            return [value]

        order.append(f"begin {value}")
        return wait

    jobs = [(key, partial(begin, value)) for key, value in (("a", 1), (KEY, 2), ("b", 3))]
    found = cache.get_or_make_each("stage", list[int], jobs)
    assert next(found) == [1]
    assert order == ["begin 1", "begin 3", "wait 1"]
    assert cache.get("stage", "a", list[int]) == [1]
    assert list(found) == [[7], [3]]
    with pytest.raises(DriveError, match="unreadable"):
        list(
            cache.get_or_make_each("stage", list[int], [("c", partial(begin, 4)), ("d", partial(begin, -1))])
        )
    assert cache.get("stage", "c", list[int]) == [4]


def test_the_base_install_imports_the_store_and_names_the_extra_that_the_cache_needs(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('msgspec', 'fsspec', 'filelock', 'scipy', 'torch')))\n"
        "import pkgutil, importlib, v2hdm.store; from pathlib import Path\n"
        "for one in pkgutil.iter_modules(v2hdm.store.__path__, 'v2hdm.store.'):\n"
        "    importlib.import_module(one.name)\n"
        "from v2hdm.store.cache import StageCache; from v2hdm.store.results import growing_folder\n"
        "with growing_folder(Path(sys.argv[1]) / 'drawn', '--draw') as folder: folder.write('a.jpg', b'a')\n"
        "from v2hdm.errors import ConfigError\n"
        "try: StageCache(Path(sys.argv[1])).key(1)\n"
        "except ConfigError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert "install the map extra, pip install 'v2hdm[map]'" in done.stdout, done.stderr
    assert (tmp_path / "drawn" / "a.jpg").is_file()


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


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return bool(one == other)


@given(
    number=st.floats(allow_nan=False),
    array=npst.arrays(np.float64, npst.array_shapes(min_dims=0, max_dims=4, min_side=0)),
)
def test_every_bit_comes_back(number: float, array: FloatArray) -> None:
    kept = Kept(
        number, -3, array, {Reading.MIRRORED: 0.1}, {Path("a/b.jpg"): 4}, array[..., None], ("x", "ü")
    )
    found = decode(encode(kept), Kept)
    assert same(found, kept)
    assert encode(found) == encode(kept)


@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int64, np.float32, np.complex128, ">f8"])
def test_element_types_come_back(kind: str) -> None:
    array = np.arange(12).reshape(3, 4).astype(kind)[::2]
    assert same(decode(encode(array), np.ndarray), array.copy())


@pytest.mark.parametrize("kind", [MappedSet, Inspection, ImageDetections, AdjustedPoses])
def test_what_the_stages_make_can_be_kept(kind: type[Any]) -> None:
    with pytest.raises(CodecError):
        decode(encode({"nothing": "of it"}), kind)


@given(st.binary(max_size=200))
def test_bytes_of_anyone_are_a_value_of_the_type_or_refused(data: bytes) -> None:
    try:
        found = decode(data, tuple[list[ImageDetections], GroundStatus])
    except CodecError:
        return
    assert isinstance(found[1], GroundStatus)


def test_neither_pickles_nor_arrays_of_objects_are_read(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "escaped",))

    for data in (pickle.dumps(Evil()), msgspec.msgpack.encode(["|O", [1], pickle.dumps(Evil())])):
        with pytest.raises(CodecError):
            decode(data, np.ndarray)
    assert not list(tmp_path.iterdir())
    with pytest.raises(TypeError):
        encode(np.array([Evil()]))


def test_arrays_that_claim_to_be_larger_than_they_are_are_refused() -> None:
    for shape in ([10**12], [2**40, 2**40], [-1, -1], [3]):
        with pytest.raises(CodecError):
            decode(msgspec.msgpack.encode(["<f8", shape, b"12345678"]), np.ndarray)


def test_nesting_without_end_is_refused() -> None:
    with pytest.raises(CodecError):
        decode(b"\x91" * 100_000, list[Any])


def test_a_marking_comes_back_as_it_was() -> None:
    found = MarkingDetection("a", 0.1, np.eye(4, 2), np.eye(8), np.ones(4, dtype=bool))
    assert same(decode(encode(found), MarkingDetection), found)
