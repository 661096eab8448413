"""Quadrilaterals of image and map: their order, sides and shape, and the cyclic alignment of two of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.quadrilateral import (
    Quad,
    align,
    diameters,
    is_convex,
    is_convex_px,
    long_axis,
    order_corners,
    quad_from_hull,
    side_frames,
)

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
KITE = order_corners(np.array([[20.3, 10.2], [40.1, 14.9], [19.4, 19.3], [3.2, 15.5]]))
OFFSET = np.array([0.1, -0.05])
ALL = np.ones(4, dtype=bool)


@pytest.mark.parametrize("shift", range(4))
def test_a_cyclic_shift_is_found_and_undone(shift: int) -> None:
    turned = np.roll(DIAMOND, shift, axis=0) + OFFSET
    found = align(DIAMOND, ALL, turned, ALL)
    assert found.shift == shift
    np.testing.assert_allclose(found.offset, OFFSET)
    np.testing.assert_allclose(turned[(np.arange(4) + found.shift) % 4], DIAMOND + OFFSET)
    assert found.deformation_m == pytest.approx(0.0, abs=1e-12)


def test_corners_that_are_not_valid_take_no_part_and_another_shape_shows_as_deformation() -> None:
    broken = DIAMOND.copy()
    broken[2] = np.nan
    found = align(DIAMOND, ALL, broken, np.array([True, True, False, True]))
    assert (found.shift, found.common) == (0, 3)
    assert found.deformation_m == pytest.approx(0.0, abs=1e-12)
    assert np.isinf(align(DIAMOND, ALL, DIAMOND, np.array([True, False, False, False])).deformation_m)
    assert align(DIAMOND, ALL, 1.5 * DIAMOND, ALL).deformation_m == pytest.approx(0.3)


def test_alignment_broadcasts_over_tracks_and_detections() -> None:
    tracks = np.stack([DIAMOND, DIAMOND + 5.0, DIAMOND - 3.0])[:, None]
    found = align(tracks, np.ones((3, 1, 4), bool), np.stack([DIAMOND] * 2), np.ones((2, 4), bool))
    assert found.shift.shape == (3, 2)
    np.testing.assert_allclose(found.offset[:, 0, 0], [0.0, -5.0, 3.0], atol=1e-12)


def test_area_sense_and_diameter_of_a_diamond_and_of_its_image_whose_second_axis_turns_down() -> None:
    in_image = DIAMOND * [1, -1]
    assert signed_area(DIAMOND) == pytest.approx(0.36) == -signed_area(in_image)
    assert diameters(DIAMOND, ALL) == pytest.approx(1.2)
    assert is_convex(DIAMOND)
    assert is_convex_px(in_image)
    assert not any([is_convex(DIAMOND[::-1]), is_convex_px(DIAMOND), is_convex(in_image)])


def test_ordered_corners_run_counter_clockwise_on_the_screen() -> None:
    assert signed_area(KITE) < 0
    assert is_convex_px(KITE)
    assert not is_convex_px(KITE[::-1])


@pytest.mark.parametrize(("corners", "outwards"), [(KITE, 1), (DIAMOND, -1)], ids=["image", "map"])
def test_normals_of_image_corners_point_outwards_and_of_map_corners_inwards(
    corners: np.ndarray, outwards: int
) -> None:
    _, normal, _ = side_frames(corners)
    middle = (corners + np.roll(corners, -1, axis=0)) / 2
    assert (outwards * ((middle - corners.mean(axis=0)) * normal).sum(axis=1) > 0).all()


def test_the_width_of_a_bar_is_its_breadth() -> None:
    assert Quad(order_corners(np.array([[0, 0], [30, 0], [30, 4], [0, 4.0]]))).width == pytest.approx(4.0)


def test_a_quadrilateral_is_found_again_from_points_on_its_outline() -> None:
    along = np.linspace(0, 1, 40, endpoint=False)[:, None]
    outline = np.concatenate([KITE[e] * (1 - along) + KITE[(e + 1) % 4] * along for e in range(4)])
    found = quad_from_hull(cv2.convexHull(outline.astype(np.float32)))
    assert found is not None
    distance = np.linalg.norm(found[:, None] - KITE, axis=-1).min(axis=1)
    assert distance.max() < 0.05


@pytest.mark.parametrize("outline", [np.zeros((3, 2)), np.zeros((9, 2)), np.arange(18.0).reshape(9, 2)])
def test_points_that_enclose_nothing_give_no_quadrilateral(outline: np.ndarray) -> None:
    assert quad_from_hull(cv2.convexHull(outline.astype(np.float32))) is None


@pytest.mark.parametrize("shift", range(4))
def test_the_axis_of_a_dash_does_not_depend_on_its_first_corner(shift: int) -> None:
    dash = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.12], [0.0, 0.12]])
    turned = np.roll(dash, shift, axis=0)
    np.testing.assert_allclose(long_axis(turned), [1.0, 0.0], atol=1e-12)
