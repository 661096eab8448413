"""Paint stands out from bare ground: pieces over made roads with lines, edges and seams."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.lanes.bare import FITTED, features, paint_log_odds, painted, sections_of, shared
from v2hdm.records import LANE_DASH, LANE_LINE, FloatArray, LaneDetection

CAMERA = RoadCamera(camera_from_calibration(rough_calibration("front", 1280, 720, 1.6, 12.0, 80.0)))
CELL_M = 0.01
GREY = 90
AHEAD_M = np.arange(4.0, 12.01, 0.5)


def image_of(across: FloatArray, *, begins_m: float = 0.0, contrast: float = 1.0) -> np.ndarray:
    """A road that shows grey levels (N,) at N offsets to the right, from ``begins_m`` ahead on, else grey."""
    ground = np.full((2000, len(across)), float(GREY))
    ground[: 2000 - int(begins_m / CELL_M)] = GREY + contrast * (across - GREY)
    # The ground's first row is 20 m ahead, its middle column straight ahead.
    vehicle_from_cell = np.array(
        [[0.0, -CELL_M, 20.0], [-CELL_M, 0.0, CELL_M * len(across) / 2], [0, 0, 1.0]]
    )
    noisy = ground + np.random.default_rng(0).normal(0.0, 3.0, ground.shape)
    return cv2.warpPerspective(
        np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2),
        CAMERA.pinhole_px_from_vehicle @ vehicle_from_cell,
        (1280, 720),
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_REPLICATE,
    )


def offsets_m() -> FloatArray:
    """The offsets to the right of the ground's columns."""
    return CELL_M * (np.arange(400) + 0.5) - 2.0


def line(width_m: float, level: float = 190.0, at_m: float = 0.0) -> FloatArray:
    return np.where(np.abs(offsets_m() - at_m) < width_m / 2, level, GREY)


def edge(level: float = 150.0) -> FloatArray:
    return np.where(offsets_m() > 0.0, level, GREY)


CENTRE = np.column_stack([AHEAD_M, np.zeros(len(AHEAD_M))])
PIECE = LaneDetection(LANE_LINE, 0.7, CAMERA.project(CENTRE))


def odds(image: np.ndarray) -> float:
    """The log odds that the piece is paint, with a network that is as sure as not."""
    return paint_log_odds(features(sections_of([PIECE], image, CAMERA)), 0.7)


@pytest.mark.parametrize("width_m", [0.1, 0.12, 0.15, 0.2])
def test_lines_of_standard_widths_are_paint(width_m):
    assert painted([PIECE], image_of(line(width_m)), CAMERA) == [PIECE]


def test_both_strands_of_a_double_line_and_a_line_beside_what_was_traced_are_paint():
    assert odds(image_of(np.maximum(line(0.1, at_m=-0.1), line(0.1, at_m=0.1)))) > 0.0
    assert odds(image_of(line(0.12, at_m=0.08))) > 0.0


@pytest.mark.parametrize("across", [edge(), edge(level=40.0), line(0.05, level=40.0), line(1.5)])
def test_edges_dark_seams_and_bright_ground_are_not(across):
    assert painted([PIECE], image_of(across), CAMERA) == []


def test_pieces_of_dashes_stay_and_so_does_the_order():
    dash = replace(PIECE, kind=LANE_DASH)
    assert painted([dash, PIECE, dash], image_of(edge()), CAMERA) == [dash, dash]
    assert painted([], image_of(edge()), CAMERA) == []


def test_the_fainter_the_less_likely():
    by_contrast = [odds(image_of(line(0.12), contrast=contrast)) for contrast in (0.0, 0.1, 0.3, 0.6)]
    assert by_contrast == sorted(by_contrast)
    assert by_contrast[0] < 0.0 < by_contrast[-1]


def test_what_is_paint_in_the_sun_is_paint_in_the_shade():
    bright = image_of(line(0.12))
    assert odds(bright) == pytest.approx(odds((bright * 0.6).astype(np.uint8)), abs=0.3)


def test_of_what_an_image_does_not_show_the_network_alone_tells():
    doubtful = LaneDetection(LANE_LINE, 0.6, np.array([[1.0, 700.0], [1.0, 690.0], [1.0, 680.0]]))
    sure = replace(doubtful, score=0.8)
    assert painted([sure, doubtful], image_of(edge()), CAMERA) == [sure]


def test_the_surer_the_network_the_more_it_takes_to_contradict_it():
    ratio = np.array([[0.0, 0.3, 0.3]])
    assert paint_log_odds(ratio, 0.6) < 0.0 < paint_log_odds(ratio, 0.97)


def test_sections_that_err_together_count_as_fewer():
    three = np.array([0.4, 0.4, 0.4])
    assert shared(three, 0.0) == pytest.approx(1.2)
    assert shared(three, 1.0) == pytest.approx(0.4)
    assert 0.4 < shared(three, FITTED.correlation) < 1.2
