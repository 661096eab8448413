"""Arrows on the ground are counted where they are, and nowhere else."""

from __future__ import annotations

import numpy as np

from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.symbols import NO_SYMBOLS, Symbols, images_with_symbol

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


def test_points_on_the_arrow_are_counted_in_every_image_that_shows_it() -> None:
    symbols, rig = scene(9.0)
    points = np.array([[8.5, 1.0], [9.0, 1.3], [9.9, 1.05], [5.0, 1.0], [np.nan, np.nan]])
    assert images_with_symbol(symbols, rig, points).tolist() == [3, 0, 3, 0, 0]


def test_far_arrows_say_nothing() -> None:
    symbols, rig = scene(40.0)
    assert images_with_symbol(symbols, rig, np.array([[40.0, 1.0]])).tolist() == [0]


def test_without_symbols_there_is_nothing_to_count() -> None:
    _, rig = scene(9.0)
    assert images_with_symbol(NO_SYMBOLS, rig, np.zeros((4, 2))).tolist() == [0, 0, 0, 0]
