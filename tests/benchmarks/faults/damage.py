"""Damage to files as disks and cables do it: bits that flip, ends that are missing, blocks of zeros."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]

_BLOCK = 512


def flip_a_bit(data: bytes, rng: np.random.Generator) -> bytes:
    """Anywhere."""
    out = bytearray(data)
    out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def cut_off(data: bytes, rng: np.random.Generator) -> bytes:
    """The file ends at any place: all behind it is missing."""
    return data[: int(rng.integers(len(data)))]


def zero_a_block(data: bytes, rng: np.random.Generator) -> bytes:
    """A sector of a disk, or less at the end of the file."""
    start = int(rng.integers(len(data))) // _BLOCK * _BLOCK
    end = min(start + _BLOCK, len(data))
    return data[:start] + bytes(end - start) + data[end:]


DAMAGES: dict[str, Damage] = {
    "bit flipped": flip_a_bit,
    "cut off": cut_off,
    "sector of zeros": zero_a_block,
}


def damage(path: Path, rng: np.random.Generator) -> str:
    """Damage a file by chance, half the time by a bit; returns how.

    The file is replaced and not written to: its other names, if it has any, keep what they had.
    """
    kind = "bit flipped" if rng.integers(2) else list(DAMAGES)[int(rng.integers(1, len(DAMAGES)))]
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(DAMAGES[kind](data, rng) if data else b"\0")
    return kind
