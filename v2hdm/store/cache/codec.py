"""Values to bytes and back, exactly: dataclasses, enumerations, paths, numpy arrays, plain values.

The bytes hold no name of a class or function: what they become is decided by the type that the reader asks
for, so that nothing in a file, whoever wrote it, can choose what is made or run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar, get_origin

import msgspec
import numpy as np

_Value = TypeVar("_Value")

_PLAIN_KINDS = "biufc"
"""Kinds of numpy's element types that are numbers; objects are none."""


class CodecError(ValueError):
    """Bytes are not those of a value of the type that was asked for."""


def encode(value: Any) -> bytes:
    """The bytes of a value; equal values of one type and order have equal bytes.

    Raises:
        TypeError: it holds something that cannot be kept.
    """
    return _ENCODER.encode(value)


def decode(data: bytes, kind: type[_Value]) -> _Value:
    """The value of type ``kind`` that :func:`encode` made ``data`` of; arrays are laid out row by row.

    Raises:
        CodecError: the bytes are of no such value.
    """
    try:
        return msgspec.msgpack.decode(data, type=kind, dec_hook=_special)
    except (msgspec.DecodeError, ValueError, TypeError, RecursionError) as failure:
        raise CodecError(str(failure)) from None


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _PLAIN_KINDS:
            raise TypeError(f"an array of {value.dtype} cannot be kept")
        return value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be kept")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


def _special(kind: Any, content: Any) -> object:
    kind = get_origin(kind) or kind
    if kind is np.ndarray:
        name, shape, data = content
        dtype = np.dtype(name)
        if dtype.kind not in _PLAIN_KINDS:
            raise ValueError(f"an array of {dtype} is not read")
        return np.frombuffer(data, dtype).reshape(shape).copy()
    if isinstance(kind, type) and issubclass(kind, Path):
        return kind(content)
    raise TypeError(f"{kind} cannot be kept")
