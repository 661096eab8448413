"""The drawing tools are checked on a rendered road: a line of dashes and an arrow on grained asphalt."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.benchmarks.real_align import align, edge_offsets
from tests.benchmarks.real_draw import Tile, stitch
from tests.benchmarks.real_reference import Route, read_reference
from tests.benchmarks.real_view import View
from v2hdm.records import CameraInfo, FloatArray

INFO = CameraInfo("front", 1200, 600, np.array([[700.0, 0, 600], [0, 700.0, 200], [0, 0, 1]]))
# The camera stands 1.6 m above the origin and looks along the map's x.
VIEW = View(INFO, np.array([[0.0, -1, 0, 0], [0, 0, -1, 1.6], [1, 0, 0, 0], [0, 0, 0, 1]]))
ROUTE = Route(np.column_stack([np.linspace(0, 40, 81), np.zeros(81)]))
ARROW = np.array([[6, -0.1], [10, -0.1], [10, -0.4], [12, 0], [10, 0.4], [10, 0.1], [6, 0.1]])


def dash(x: float, y: float) -> FloatArray:
    return np.array([[x, y - 0.1], [x + 3, y - 0.1], [x + 3, y + 0.1], [x, y + 0.1]])


PAINTED = [*(dash(x, 1.7) for x in (5, 11, 17)), *(dash(x, -1.7) for x in (6, 12, 18)), ARROW]


def turned(right_deg: float, down_deg: float, forward_deg: float, left_m: float) -> View:
    cam_from_map = VIEW.cam_from_map.copy()
    turn = cv2.Rodrigues(np.radians([right_deg, down_deg, forward_deg]))[0]
    cam_from_map[:3] = turn @ cam_from_map[:3]
    cam_from_map[0, 3] += left_m
    return replace(VIEW, cam_from_map=cam_from_map)


def rendered(view: View, painted: list[FloatArray], seed: int = 0) -> np.ndarray:
    """A grey image (H, W) uint8, antialiased by four samples a pixel each way, with grain of 4 levels."""
    fine = 4
    large = np.full((fine * INFO.height, fine * INFO.width), 90, dtype=np.uint8)
    for polygon in painted:
        corners = (view.project(polygon) + 0.5) * fine - 0.5
        cv2.fillPoly(large, [np.round(corners * 256).astype(np.int32)], 200, shift=8)
    grey = cv2.resize(large, (INFO.width, INFO.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    grain = np.random.default_rng(seed).normal(0, 4, grey.shape)
    return np.asarray(np.clip(cv2.GaussianBlur(grey, (0, 0), 0.6) + grain, 0, 255).astype(np.uint8))


def gap_px(aligned: View, truth: View, polygons: list[FloatArray]) -> float:
    return float(max(np.abs(aligned.project(p) - truth.project(p)).max() for p in polygons))


@pytest.mark.parametrize("motion", [(0.15, 0.3, 0.1, 0.03), (-0.2, -0.3, -0.1, -0.03)])
def test_a_camera_that_is_off_is_moved_until_the_drawing_lies_on_its_paint(
    motion: tuple[float, float, float, float],
) -> None:
    truth = turned(*motion)
    assert gap_px(VIEW, truth, PAINTED) > 4
    alignment = align(VIEW, rendered(truth, PAINTED), PAINTED)
    assert gap_px(alignment.view, truth, PAINTED) < 0.4
    assert alignment.spread_px < 0.4
    np.testing.assert_allclose(np.degrees(alignment.motion[:2]), motion[:2], atol=0.1)


def test_what_stands_before_the_road_moves_the_camera_only_if_it_is_not_said_to_hide() -> None:
    truth = turned(0.0, 0.1, 0.0, 0.0)
    grey = rendered(truth, PAINTED)
    u, v = np.round(truth.project(PAINTED[0]).mean(axis=0)).astype(int)
    box = np.array([u - 120.0, v - 120.0, u + 120.0, v + 120.0])
    grey[v - 120 : v + 120, u - 120 : u + 120] = np.where(np.arange(240) // 20 % 2, 30, 220)
    hidden = align(VIEW, grey, PAINTED, [box])
    assert hidden.edges < align(VIEW, grey, PAINTED).edges
    assert gap_px(hidden.view, truth, PAINTED) < 0.4


def test_a_camera_that_sees_nothing_of_the_drawing_stays() -> None:
    alignment = align(VIEW, rendered(VIEW, []), [dash(40, 0)])
    assert alignment.edges == 0
    np.testing.assert_array_equal(alignment.view.cam_from_map, VIEW.cam_from_map)


def test_a_drawing_of_the_other_turning_has_the_same_edges() -> None:
    truth = turned(0.1, 0.2, 0.0, 0.0)
    alignment = align(VIEW, rendered(truth, PAINTED), [polygon[::-1] for polygon in PAINTED])
    assert gap_px(alignment.view, truth, PAINTED) < 0.4


def test_an_edge_is_found_between_pixels_and_none_where_grey_only_rises() -> None:
    # A soft step from 200 down to 50, its middle at u = 20.3.
    u = np.arange(40)
    grey = np.tile(np.round(125 - 75 * np.tanh((u - 20.3) / 0.8)), (9, 1)).astype(np.uint8)
    offset, fall = edge_offsets(grey, np.array([[19.0, 4.0]]), np.array([[1.0, 0.0]]), 3.0)
    np.testing.assert_allclose(offset, 1.3, atol=0.05)
    assert fall[0] > 100
    offset, fall = edge_offsets(grey, np.array([[19.0, 4.0]]), np.array([[-1.0, 0.0]]), 3.0)
    assert fall[0] < 3


def test_a_tile_shows_paint_where_it_lies_on_the_road() -> None:
    image = cv2.cvtColor(rendered(VIEW, PAINTED), cv2.COLOR_GRAY2BGR)
    tile = Tile((36.0, 48.0), (-3.0, 3.0), 0.05)
    picture = stitch(tile, ROUTE, [VIEW], [image])
    for polygon in PAINTED[3], ARROW:
        middle = polygon[[0, 1, -2, -1]].mean(axis=0)
        places = tile.pixels(ROUTE.along(np.array([middle, middle + np.array([0, 0.5])])))
        (u, v), (beside_u, beside_v) = np.round(places).astype(int)
        assert picture[v, u].mean() > 180
        assert picture[beside_v, beside_u].mean() < 120
    # Nearer than the camera sees the road, there is nothing to show.
    assert not stitch(Tile((30.0, 32.0), (-3.0, 3.0), 0.05), ROUTE, [VIEW], [image]).any()


def test_a_place_of_a_tile_is_taken_from_the_nearest_image() -> None:
    near_view = replace(VIEW, cam_from_map=VIEW.cam_from_map.copy())
    near_view.cam_from_map[2, 3] = -6.0
    images = [np.full((INFO.height, INFO.width, 3), level, dtype=np.uint8) for level in (60, 160)]
    tile = Tile((34.0, 48.0), (-1.0, 1.0), 0.1)
    picture = stitch(tile, ROUTE, [VIEW, near_view], images)
    for way, level in ((38.0, 60), (45.0, 160)):
        x, y = np.round(tile.pixels(np.array([[way, 0.0]]))[0]).astype(int)
        assert (picture[y, x] == level).all()


def test_a_polygon_drawn_along_the_road_lies_beside_the_driven_path(tmp_path: Path) -> None:
    path = tmp_path / "drawn.json"
    route_map = np.column_stack([np.zeros(81), np.linspace(0, 40, 81)])
    road = [[35.0, 1.5], [38.0, 1.5], [38.0, 1.7]]
    path.write_text(json.dumps({"markings": [{"kind": "arrow", "polygon_road": road}], "whole": True}))
    polygon = read_reference(path, route_map).markings[0].polygon_map
    # The route goes north, from 29.9 m before its start on; left of it is west.
    np.testing.assert_allclose(polygon, [[-1.5, 5.1], [-1.5, 8.1], [-1.7, 8.1]], atol=0.01)
