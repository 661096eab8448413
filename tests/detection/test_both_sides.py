"""Dashes whose piece runs on along a seam of the surface, as a network draws them."""

from functools import lru_cache

import cv2
import numpy as np
import pytest

from tests.detection.pictures import bar, foreground_of, make_camera, picture, to_image
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.both_sides import painted_parts
from v2hdm.detection.corners.evidence import Claim
from v2hdm.detection.corners.foreground import Foreground
from v2hdm.detection.corners.grey import linear_grey
from v2hdm.detection.corners.refine import QuadStart, fit_markings
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import LANE_DASH

VIEW = CameraView(make_camera("plumb_bob"))
GROUND, LIGHT, PAINT = 0.12, 0.3, 0.6
WIDE_M, HALF_M = 0.3, 0.15
SEAM_M = 0.15
"""The light pavement begins so far to the left of the dashes' left side."""


@lru_cache
def lit(name: str) -> np.ndarray:
    """Dashes on the middle line, beside a pavement that is much lighter."""
    middles = {"one": [7.0], "two": [6.0, 12.0], "none": []}[name]
    dashes = [bar(x, 0.0, 3.0, WIDE_M) for x in middles]
    pavement = bar(12.0, HALF_M + SEAM_M + 1.5, 18.0, 3.0)
    return np.maximum(
        picture(VIEW.camera, dashes, ground=GROUND, paint=PAINT) if dashes else 0,
        picture(VIEW.camera, [pavement], ground=GROUND, paint=LIGHT, seed=1),
    )


def piece(begin_m: float, end_m: float, left_m: float = HALF_M + SEAM_M) -> np.ndarray:
    """Corners (4, 2), pinhole px, of a piece from the right side of the dashes to the seam."""
    shape = bar((begin_m + end_m) / 2, (left_m - HALF_M) / 2, end_m - begin_m, left_m + HALF_M)
    return order_corners(VIEW.undistort(to_image(VIEW.camera, shape)))


def parts_of(
    image: np.ndarray, corners: np.ndarray, sure: tuple[float, ...] = (7.0,)
) -> list[np.ndarray] | None:
    """Ends along the road and sides of the parts of one piece, m; None if it is all paint."""
    whole = np.array([[0, 0, image.shape[1], image.shape[0]]])
    grey = linear_grey(image, 0, len(image), whole, False)
    found = painted_parts(grey, foreground(sure), VIEW, corners[None])
    return None if not found else [VIEW.ground(quad) for quad in found[0]]


def foreground(sure: tuple[float, ...]) -> Foreground:
    """A network that takes all for paint, and dashes about these places for quite sure."""
    odds = np.full((VIEW.height // 2, VIEW.info.width // 2), 2.0, dtype=np.float32)
    for x in sure:
        px = (to_image(VIEW.camera, bar(x, 0.0, 3.0, 1.5 * WIDE_M)) - [0, VIEW.top]) / 2
        cv2.fillConvexPoly(odds, np.round(px).astype(np.int32), 6.0)
    return foreground_of(odds, np.zeros(odds.shape, np.int16), VIEW.top)


@pytest.mark.parametrize(("begin_m", "end_m"), [(5.5, 12.0), (4.5, 8.5), (4.6, 11.0)])
def test_a_dash_that_runs_on_along_a_seam_is_cut_where_its_paint_ends(begin_m, end_m):
    (part,) = parts_of(lit("one"), piece(begin_m, end_m))
    assert part[:, 0].min() == pytest.approx(5.5, abs=0.15)
    assert part[:, 0].max() == pytest.approx(8.5, abs=0.3)
    np.testing.assert_allclose(np.sort(part[:, 1]), [-HALF_M, -HALF_M, HALF_M, HALF_M], atol=0.03)


def test_two_dashes_that_a_seam_joins_are_two():
    parts = parts_of(lit("two"), piece(4.5, 13.5), (6.0, 12.0))
    middles = sorted(part[:, 0].mean() for part in parts)
    np.testing.assert_allclose(middles, [6.0, 12.0], atol=0.3)


def test_what_shows_paint_on_both_sides_all_along_stays_as_it_is():
    assert parts_of(lit("one"), piece(5.5, 8.5, HALF_M)) is None
    assert parts_of(lit("none"), piece(5.5, 8.5)) is None, "no paint at all is for others to judge"


def test_shade_and_worn_gaps_cut_no_dash():
    corners = piece(5.5, 8.5, HALF_M)
    image = picture(VIEW.camera, [bar(7.0, 0.0, 3.0, WIDE_M)], ground=GROUND, paint=PAINT)
    shaded = image.astype(np.float64)
    border = int(to_image(VIEW.camera, np.array([[7.0, 0.0]]))[0, 1])
    shaded[:border] = np.minimum(0.35 * shaded[:border], 40)
    assert parts_of(shaded.astype(np.uint8), corners, ()) is None
    worn = [bar(x, 0.0, 0.6, 0.4) for x in (6.4, 7.6)]
    holed = picture(VIEW.camera, [bar(7.0, 0.0, 3.0, WIDE_M)], ground=GROUND, paint=PAINT, holes=worn)
    assert parts_of(holed, corners, ()) is None


def test_what_the_network_is_as_sure_of_as_of_the_paint_is_not_cut():
    assert parts_of(lit("one"), piece(5.5, 10.0), (7.0, 9.5)) is None


def test_what_is_longer_than_any_dash_and_holds_none_is_dropped():
    assert parts_of(lit("none"), piece(4.5, 18.0), ()) == []


@pytest.mark.parametrize("vague", [False, True])
def test_the_corners_of_a_dash_with_a_tail_are_those_of_its_paint(vague):
    corners = piece(5.5, 12.0)
    share = np.linspace(0, 1, 50, endpoint=False)[:, None]
    outline = np.concatenate([corners[e] * (1 - share) + corners[(e + 1) % 4] * share for e in range(4)])
    start = QuadStart({LANE_DASH: Claim(0.9, 1.0, 0.0, 0.0, False, False, 1.0)}, corners, 0, outline)
    options = DetectorOptions(min_confidence=0.0, vague_corners=vague)
    (found,) = fit_markings(lit("one"), VIEW, [start], foreground((7.0,)), options)
    true_px = to_image(VIEW.camera, bar(7.0, 0.0, 3.0, WIDE_M))
    off_px = np.linalg.norm(found.corners_px[:, None] - true_px, axis=2).min(axis=1)
    assert found.corner_valid.all()
    assert off_px.max() < 0.5
