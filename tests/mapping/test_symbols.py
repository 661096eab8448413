"""Symbols are counted where they are; the map has the outline and class that most sightings share."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.cameras import mounted
from v2hdm.association.ground import images_with_symbol
from v2hdm.association.sightings import NO_SYMBOLS, Rig, Symbols
from v2hdm.geometry.planar import signed_area
from v2hdm.records import FloatArray, Marking
from v2hdm.site.symbols import map_symbols

INTRINSIC = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
ARROW = np.array(
    [[-1.5, -0.08], [0.5, -0.08], [0.5, -0.35], [1.5, 0.0], [0.5, 0.35], [0.5, 0.08], [-1.5, 0.08]]
)


def scene(arrow_x_m: float) -> tuple[Symbols, Rig]:
    """Three frames, a metre apart, that all see an arrow ahead of the first one."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 2.0]
    rig = Rig(INTRINSIC[None], mounted([0.0, 0.0, 2.0])[None], poses)
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


JITTER_RAD = 0.002
AT, OFF = np.array([9.0, 1.0]), np.array([0.1, 0.0])


def seen(shapes: list[FloatArray], kinds: list[str], poses_x: list[float]) -> tuple[Symbols, Rig]:
    """What a camera at so many places ahead says of shapes on the ground, one from each."""
    poses = np.tile(np.eye(4), (len(poses_x), 1, 1))
    poses[:, 0, 3] = poses_x
    rig = Rig(INTRINSIC[None], mounted([0.0, 0.0, 2.0])[None], poses)
    outlines = []
    for shape, pose in zip(shapes, poses, strict=True):
        ground = np.column_stack([shape, np.zeros(len(shape)), np.ones(len(shape))])
        cam = ground @ (rig.cam_from_vehicle[0] @ np.linalg.inv(pose)).T
        outlines.append((cam[:, :3] @ INTRINSIC.T)[:, :2] / cam[:, 2:3])
    count = len(poses_x)
    return Symbols(np.zeros(count, dtype=np.int64), np.arange(count), tuple(outlines), tuple(kinds)), rig


def overlap(one: FloatArray, other: FloatArray) -> float:
    """Intersection over union, by cells of a centimetre."""
    low = np.minimum(one.min(axis=0), other.min(axis=0)) - 0.1
    size = np.ceil((np.maximum(one.max(axis=0), other.max(axis=0)) + 0.1 - low) * 100).astype(int)
    masks = []
    for shape in (one, other):
        mask = np.zeros(size[::-1], dtype=np.uint8)
        cv2.fillPoly(mask, [np.round((shape - low) * 100).astype(np.int32)], 1)
        masks.append(mask > 0)
    return float((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())


def test_an_arrow_is_mapped_where_it_lies() -> None:
    symbols, rig = scene(9.0)
    (arrow,) = map_symbols(symbols, rig, JITTER_RAD, ())
    assert (arrow.kind, arrow.sightings) == ("arrow", 3)
    assert overlap(arrow.outline_map, ARROW + AT) > 0.97
    assert abs(signed_area(arrow.outline_map) - signed_area(ARROW)) < 0.01 * signed_area(ARROW)
    assert signed_area(arrow.outline_map) > 0
    assert arrow.sigma_m is not None
    assert arrow.sigma_m < 0.001


def test_a_sighting_that_is_off_moves_the_outline_little_and_shows_in_its_sigma() -> None:
    true = ARROW + AT
    shapes = [true, true + OFF, true, true, true]
    (arrow,) = map_symbols(*seen(shapes, ["arrow"] * 5, [0.0, 1.0, 2.0, 3.0, 4.0]), JITTER_RAD, ())
    assert overlap(arrow.outline_map, true) > 0.95
    assert arrow.sigma_m is not None
    assert 0.005 < arrow.sigma_m < 0.05


def test_the_class_is_what_most_sightings_say() -> None:
    shapes = [ARROW + AT] * 4
    kinds = ["arrow", "parking_t", "parking_t", "parking_t"]
    (symbol,) = map_symbols(*seen(shapes, kinds, [0.0, 1.0, 2.0, 3.0]), JITTER_RAD, ())
    assert (symbol.kind, symbol.sightings) == ("parking_t", 4)


def test_neighbours_are_symbols_of_their_own() -> None:
    bars = [np.array([[7.0, y], [9.0, y], [9.0, y + 0.4], [7.0, y + 0.4]]) for y in (-1.0, 0.0)]
    found = map_symbols(*seen(bars * 3, ["chevron"] * 6, [0.0, 0, 1, 1, 2, 2]), JITTER_RAD, ())
    assert len(found) == 2


@pytest.mark.parametrize("x", [40.0, 9.0])
def test_what_is_far_or_seen_seldom_is_left_out(x: float) -> None:
    symbols, rig = scene(x)
    if x == 9.0:
        seldom = replace(symbols, frame=np.array([0, 1, 1]))
        assert map_symbols(seldom, rig, JITTER_RAD, ()) == ()
    else:
        assert map_symbols(symbols, rig, JITTER_RAD, ()) == ()


def test_paint_that_is_a_marking_is_no_symbol() -> None:
    symbols, rig = scene(9.0)
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    on, beside = (Marking("pad", square + place, 9) for place in ([9.0, 1.0], [9.0, 3.0]))
    assert map_symbols(symbols, rig, JITTER_RAD, (on,)) == ()
    assert len(map_symbols(symbols, rig, JITTER_RAD, (beside,))) == 1


def test_without_sightings_there_are_no_symbols() -> None:
    _, rig = scene(9.0)
    assert map_symbols(NO_SYMBOLS, rig, JITTER_RAD, ()) == ()
