"""Polygons and ground points, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2hdm.geometry.planar import clip_convex, inside_convex, signed_area
from v2hdm.geometry.rigid import ground_in_vehicle


def area(polygon: np.ndarray) -> float:
    return abs(float(signed_area(polygon)))


@pytest.mark.parametrize("order", [1, -1])
def test_inside_a_polygon_of_either_sense(order: int) -> None:
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])[::order]
    points = np.array([[1.0, 1.0], [3.0, 1.0], [np.nan, 1.0]])
    assert inside_convex(square, points).tolist() == [True, False, False]


def test_a_ground_point_ahead_is_on_the_vehicles_x_axis() -> None:
    map_from_vehicle = np.eye(4)
    map_from_vehicle[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    map_from_vehicle[:2, 3] = [10.0, 5.0]
    points = ground_in_vehicle(map_from_vehicle, np.array([[10.0, 8.0], [9.0, 5.0]]))
    assert points == pytest.approx(np.array([[3.0, 0.0], [0.0, 1.0]]), abs=1e-12)


@pytest.mark.parametrize("order", [1, -1])
def test_what_two_squares_share(order: int) -> None:
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    assert area(clip_convex(square, square[::order] + 1.0)) == pytest.approx(1.0)
    assert area(clip_convex(square, square[::order] + 1e-7)) == pytest.approx(4.0, abs=1e-5)
    assert len(clip_convex(square, square[::order] + 3.0)) == 0


def test_nearly_equal_polygons_share_nearly_all() -> None:
    """OpenCV's intersection of some such pairs is empty."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        turn = rng.uniform(0, 2 * np.pi)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        diamond = np.array([[0.6, 0], [0, 0.3], [-0.6, 0], [0, -0.3]]) @ rotation.T + rng.uniform(-50, 50, 2)
        other = diamond + rng.normal(0, 1e-3, (4, 2))
        assert area(clip_convex(diamond, other)) > 0.95 * area(diamond)
