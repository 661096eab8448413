"""Arrows on the ground are counted where they are, and nowhere else."""

from __future__ import annotations

import numpy as np

from v2hdm.association.ground import images_with_symbol
from v2hdm.association.sightings import NO_SYMBOLS, Rig, Symbols

INTRINSIC = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
ARROW = np.array(
    [[-1.5, -0.08], [0.5, -0.08], [0.5, -0.35], [1.5, 0.0], [0.5, 0.35], [0.5, 0.08], [-1.5, 0.08]]
)


def level_camera(height_m: float) -> np.ndarray:
    """``cam_from_vehicle`` of a camera that looks straight ahead."""
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    cam_from_vehicle[:3, 3] = -cam_from_vehicle[:3, :3] @ [0.0, 0.0, height_m]
    return cam_from_vehicle


def scene(arrow_x_m: float) -> tuple[Symbols, Rig]:
    """Three frames, a metre apart, that all see an arrow ahead of the first one."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 2.0]
    rig = Rig(INTRINSIC[None], level_camera(2.0)[None], poses)
    outlines = []
    for pose in poses:
        vehicle = np.column_stack(
            [ARROW + np.array([arrow_x_m, 1.0]), np.zeros(len(ARROW)), np.ones(len(ARROW))]
        )
        cam = vehicle @ (rig.cam_from_vehicle[0] @ np.linalg.inv(pose)).T
        outlines.append((cam[:, :3] @ INTRINSIC.T)[:, :2] / cam[:, 2:3])
    return Symbols(np.zeros(3, dtype=np.int64), np.arange(3), tuple(outlines), ("arrow",) * 3), rig


def rectangle(centre: tuple[float, float], length_m: float, width_m: float) -> np.ndarray:
    """Corners (4, 2) of a rectangle, long in x."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length_m / 2, width_m / 2]
    return np.asarray(centre) + half


def test_parts_of_the_arrow_are_counted_in_every_image_that_shows_it() -> None:
    symbols, rig = scene(9.0)
    shaft, head = rectangle((8.5, 1.0), 1.6, 0.15), rectangle((9.8, 1.02), 0.5, 0.3)
    beside, far = rectangle((9.0, 1.4), 1.6, 0.15), rectangle((5.0, 1.0), 1.6, 0.15)
    corners = np.stack([shaft, head, beside, far, np.full((4, 2), np.nan)])
    assert images_with_symbol(symbols, rig, corners).tolist() == [3, 3, 0, 0, 0]


def test_what_an_arrow_crosses_is_no_part_of_it() -> None:
    symbols, rig = scene(9.0)
    stop_line = rectangle((8.5, 1.0), 0.4, 3.0)
    assert images_with_symbol(symbols, rig, stop_line[None]).tolist() == [0]


def test_far_arrows_say_nothing() -> None:
    symbols, rig = scene(40.0)
    assert images_with_symbol(symbols, rig, rectangle((40.0, 1.05), 0.5, 0.3)[None]).tolist() == [0]


def test_without_symbols_there_is_nothing_to_count() -> None:
    _, rig = scene(9.0)
    assert images_with_symbol(NO_SYMBOLS, rig, np.zeros((4, 4, 2))).tolist() == [0, 0, 0, 0]
