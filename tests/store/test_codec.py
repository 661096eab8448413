"""What is kept comes back exactly, and bytes of strangers become nothing but values of the type asked for."""

from __future__ import annotations

import pickle
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

from v2hdm.ground import GroundStatus, Reading
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.pipeline.camera_sets import MappedSet
from v2hdm.pipeline.inspect import Inspection
from v2hdm.records import FloatArray, ImageDetections, MarkingDetection
from v2hdm.store.cache import CodecError, decode, encode


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
