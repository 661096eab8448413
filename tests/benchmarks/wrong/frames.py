"""Frames that were dropped, doubled, mixed up or exchanged, and poses where RTK was lost."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.wrong.fault import CAMERAS, Fault, edit_poses
from v2hdm.io.image_lists import read_image_list, write_image_list
from v2hdm.records import FloatArray

_Names = list[str]


def _edit_list(change: Callable[[FloatArray, _Names], tuple[FloatArray, _Names]], folder: Path) -> None:
    """Change times (I,) and names of every camera's images."""
    for camera in CAMERAS:
        path = folder / camera / "images.txt"
        stamp_s, names = read_image_list(path)
        write_image_list(*change(stamp_s, list(names)), path)


def _drop(stamp_s: FloatArray, names: _Names) -> tuple[FloatArray, _Names]:
    rows = np.flatnonzero(np.random.default_rng(5).random(len(names)) > 1 / 3)
    return stamp_s[rows], [names[k] for k in rows]


def _double(stamp_s: FloatArray, names: _Names) -> tuple[FloatArray, _Names]:
    for k in range(3, len(names) - 1, 8):
        names[k + 1] = names[k]
    return stamp_s, names


def _mix(stamp_s: FloatArray, names: _Names) -> tuple[FloatArray, _Names]:
    begin = len(names) // 3
    order = begin + np.random.default_rng(5).permutation(10)
    return stamp_s, names[:begin] + [names[k] for k in order] + names[begin + 10 :]


def _exchange_two(stamp_s: FloatArray, names: _Names) -> tuple[FloatArray, _Names]:
    a, b = len(names) // 2, len(names) // 2 + 4
    names[a], names[b] = names[b], names[a]
    return stamp_s, names


def _exchange_cameras(folder: Path) -> None:
    """Ten images of each camera are those of the other."""
    lists = {camera: read_image_list(folder / camera / "images.txt") for camera in CAMERAS}
    for camera, other in (CAMERAS, CAMERAS[::-1]):
        stamp_s, names = lists[camera]
        theirs = [f"../{other}/{name}" for name in lists[other][1]]
        begin = min(len(names), len(theirs)) // 2
        mixed = [*names[:begin], *theirs[begin : begin + 10], *names[begin + 10 :]]
        write_image_list(stamp_s, mixed, folder / camera / "images.txt")


def _lost(seconds: float, stamp_s: FloatArray, poses: FloatArray) -> Any:
    """No poses at all."""
    middle = (stamp_s[0] + stamp_s[-1]) / 2
    is_kept = np.abs(stamp_s - middle) > seconds / 2
    return stamp_s[is_kept], poses[is_kept]


def _drifting(off_m: float, seconds: float, stamp_s: FloatArray, poses: FloatArray) -> Any:
    """The position runs away sideways, and is back at once when RTK is."""
    since_s = stamp_s - (stamp_s[0] + stamp_s[-1]) / 2
    away = np.where((since_s > 0) & (since_s < seconds), since_s / seconds, 0.0)
    poses[:, :2, 3] += off_m * away[:, None] * np.array([0.6, 0.8])
    return stamp_s, poses


def frame_faults() -> list[Fault]:
    """All that can be wrong with the sequence of images and poses."""
    order = "clock|reorder|order|repeat|identical|jump|frozen|ground|exchang"
    return [
        Fault("a third of the images dropped", None, partial(_edit_list, _drop)),
        Fault("an image in eight doubled", "repeat|identical|frozen|twice", partial(_edit_list, _double)),
        Fault("ten images mixed up", order, partial(_edit_list, _mix)),
        Fault("two images exchanged", None, partial(_edit_list, _exchange_two)),
        Fault("ten images of each camera exchanged", None, _exchange_cameras),
        Fault("RTK lost for 2 s, no poses", r"\bgap|without pose", partial(edit_poses, partial(_lost, 2.0))),
        Fault(
            "RTK lost for 4 s, 2 m off",
            r"\bjump|\bposition|\bfix\b",
            partial(edit_poses, partial(_drifting, 2.0, 4.0)),
        ),
    ]
