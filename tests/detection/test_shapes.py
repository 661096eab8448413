"""Quadrilaterals, their blurred coverage, and blobs of logits: what the corner fits stand on."""

import cv2
import numpy as np
import pytest

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.coverage import blurred_coverage, normal_cdf, normal_pdf
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.propose import Blob, find_blobs, outline_polygon, zero_crossings
from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.quadrilateral import (
    Quad,
    order_corners,
    side_frames,
)

KITE = order_corners(np.array([[20.3, 10.2], [40.1, 14.9], [19.4, 19.3], [3.2, 15.5]]))


def output_of(labels: np.ndarray, top: int = 0) -> NetworkOutput:
    """What a confident network says of a label picture (h, w) at the resolution of its paint."""
    paint = np.where(labels > 0, 5.0, -5.0).astype(np.float32)
    kinds = np.stack([np.where(labels == 1 + c, 5.0, -5.0) for c in range(len(PAINT_CLASSES))])
    coarse = kinds.reshape(len(kinds), labels.shape[0] // 2, 2, labels.shape[1] // 2, 2).mean(axis=(2, 4))
    return NetworkOutput(paint, coarse.astype(np.float32), [], tuple(PAINT_CLASSES), 2, top)


def test_the_normal_distribution_is_right_to_four_digits():
    x = np.array([-2.0, -1.0, 0.0, 1.0, 1.959964])
    pdf = normal_pdf(x)
    cdf = normal_cdf(x, pdf)
    np.testing.assert_allclose(cdf, [0.0227501, 0.1586553, 0.5, 0.8413447, 0.975], atol=2e-5)
    np.testing.assert_allclose(pdf[2:4], [0.3989423, 0.2419707], atol=1e-6)


def lattice(columns: int, rows: int) -> np.ndarray:
    """Pixel centres (1, 3, N) as the coverage takes them."""
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])[None].astype(np.float32)


def test_blurred_coverage_is_that_of_a_finely_drawn_and_blurred_shape():
    blur_px, fine = 0.7, 15
    u, v = np.meshgrid((np.arange(45 * fine) + 0.5) / fine - 0.5, (np.arange(28 * fine) + 0.5) / fine - 0.5)
    _, normal, _ = side_frames(KITE)
    offset = np.stack([u, v], axis=-1)[:, :, None] - KITE
    drawn = ((offset * normal).sum(axis=-1) < 0).all(axis=-1).astype(np.float32)
    drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px * fine)[fine // 2 :: fine, fine // 2 :: fine]
    coverage, _ = blurred_coverage(Quad(KITE[None]), lattice(45, 28), blur_px)
    np.testing.assert_allclose(coverage.reshape(28, 45), drawn, atol=4e-3)
    assert coverage.sum() == pytest.approx(-signed_area(KITE), rel=1e-4)


def test_the_derivative_of_coverage_is_its_slope():
    """Corner c is the start of side c and the end of side c - 1, and moves each along its normal."""
    points, step = lattice(45, 28), 0.15
    _, by_side = blurred_coverage(Quad(KITE[None]), points, 0.7)
    _, normal, _ = side_frames(KITE)
    for corner, axis in np.ndindex(4, 2):
        shift = np.zeros((1, 4, 2))
        shift[0, corner, axis] = step
        moved = [blurred_coverage(Quad(KITE + k * shift), points, 0.7)[0] for k in (-2, -1, 1, 2)]
        difference = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * step)
        before = (corner - 1) % 4
        slope = normal[corner, axis] * by_side[:, corner] + normal[before, axis] * by_side[:, 4 + before]
        np.testing.assert_allclose(slope, difference, atol=2e-3)


def test_zero_crossings_are_interpolated_between_neighbours():
    level = np.array([[-1.0, 3.0, -1.0]])
    np.testing.assert_allclose(zero_crossings(level), [[0.25, 0.0], [1.75, 0.0]])


def test_the_outline_polygon_of_an_arrow_encloses_its_cells():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:24] = labels[10:16, 14:30] = 1 + PAINT_CLASSES.index("arrow")
    blobs, _ = find_blobs(output_of(labels, 50))
    (arrow,) = blobs
    assert arrow.kind == "arrow"
    polygon = outline_polygon(arrow)
    area_px = cv2.contourArea(polygon.astype(np.float32))
    assert area_px == pytest.approx(4 * np.count_nonzero(labels), rel=0.06)
    np.testing.assert_allclose(polygon.min(axis=0), [2 * 13.5 + 0.5, 50 + 2 * 9.5 + 0.5], atol=0.6)


def test_paint_that_is_hardly_any_has_an_outline_too():
    level = np.full((5, 9), -6.0, dtype=np.float32)
    level[2, 2:7] = 1e-3
    polygon = outline_polygon(Blob({"arrow": 0.6}, level, np.array([10.0, 20.0]), 2, np.zeros((0, 2))))
    np.testing.assert_allclose(np.ptp(polygon, axis=0), [10.0, 2.0], atol=0.6)
    np.testing.assert_allclose((polygon.min(axis=0) + polygon.max(axis=0)) / 2, [18.0, 24.0], atol=0.3)


def test_a_diamond_that_touches_a_line_is_split_from_it():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:40] = 1 + PAINT_CLASSES.index("diamond")
    labels[:, 40:44] = 1 + PAINT_CLASSES.index("lane_line")
    blobs, owner = find_blobs(output_of(labels))
    assert blobs[0].parts == 2
    assert sorted(blob.kind for blob in blobs[1:]) == ["diamond", "lane_line"]
    square = next(blob for blob in blobs[1:] if blob.kind == "diamond")
    assert square.outline_px[:, 0].max() == pytest.approx(2 * 39.5 + 0.5, abs=0.1)
    assert owner[20, 30] != owner[20, 42]


def test_a_dash_that_looks_like_a_line_here_and_there_stays_one_blob():
    labels = np.zeros((40, 60), dtype=int)
    labels[5:35, 20:24] = 1 + PAINT_CLASSES.index("lane_dash")
    labels[5:14, 20:24] = 1 + PAINT_CLASSES.index("lane_line")
    blobs, _ = find_blobs(output_of(labels))
    assert [blob.kind for blob in blobs] == ["lane_dash"]


def test_worn_holes_do_not_add_to_the_outline():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:40] = 1
    labels[18:22, 28:32] = 0
    blobs, _ = find_blobs(output_of(labels, 100))
    inner = np.abs(blobs[0].outline_px - [2 * 29.5 + 0.5, 100 + 2 * 19.5 + 0.5]).max(axis=1)
    assert inner.min() > 15


def test_an_empty_picture_has_no_blobs():
    blobs, owner = find_blobs(output_of(np.zeros((8, 8), dtype=int)))
    assert blobs == []
    assert not owner.any()


def test_a_piece_of_two_classes_comes_whole_and_in_its_parts():
    labels = np.zeros((60, 60), dtype=int)
    labels[20:50, 28:32] = 1 + PAINT_CLASSES.index("lane_dash")
    labels[8:20, 20:40] = 1 + PAINT_CLASSES.index("arrow")
    blobs, owner = find_blobs(output_of(labels))
    assert [blob.parts for blob in blobs] == [2, 0, 0]
    assert sorted(blob.kind for blob in blobs[1:]) == ["arrow", "lane_dash"]
    assert all(blob.touches_symbol for blob in blobs[1:])
    assert {owner[40, 30], owner[12, 30]} == {2, 3}, "the parts own their paint"


def test_blobs_in_each_others_boxes_keep_to_themselves():
    labels = np.zeros((60, 60), dtype=int)
    for k in range(10, 50):
        labels[k, k : k + 4] = 1
    labels[15:20, 40:46] = labels[40:45, 12:18] = 1
    blobs, owner = find_blobs(output_of(labels))
    assert len(blobs) == 3
    for index, blob in enumerate(blobs):
        mine = np.argwhere(owner == index + 1)
        outline = (blob.outline_px - 0.5) / 2
        assert np.count_nonzero(blob.level > 0) == len(mine)
        np.testing.assert_allclose(outline.min(axis=0), mine[:, ::-1].min(axis=0) - 0.5, atol=0.01)
        np.testing.assert_allclose(outline.max(axis=0), mine[:, ::-1].max(axis=0) + 0.5, atol=0.01)
