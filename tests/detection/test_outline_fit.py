"""Corners from the outline alone: right, honest about it, refused where it is no quadrilateral."""

from dataclasses import replace

import numpy as np
import pytest

from tests.detection.pictures import diamond, foreground_of, make_camera, to_image
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.evidence import Claim
from v2hdm.detection.corners.outline_fit import fit_outlines
from v2hdm.detection.corners.refine import QuadStart, fit_markings
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import MarkingDetection

DIAMOND = order_corners(np.array([[300.0, 200.0], [360.0, 180.0], [415.0, 206.0], [350.0, 232.0]]))


def outline_of(quad: np.ndarray, noise_px: float, seed: int = 0, cut: float = 3.0) -> np.ndarray:
    """Points along the sides, a pixel apart, corners rounded off, scattered by correlated noise."""
    rng = np.random.default_rng(seed)
    points = []
    for first, second in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        length = np.linalg.norm(second - first)
        s = np.arange(cut, length - cut, 1.0)[:, None] / length
        normal = np.array([-(second - first)[1], (second - first)[0]]) / length
        wander = np.convolve(rng.normal(0, noise_px, len(s) + 4), np.ones(5) / np.sqrt(5), mode="valid")
        points.append(first + s * (second - first) + wander[:, None] * normal)
    return np.concatenate(points)


def test_corners_come_out_and_their_errors_are_within_what_is_stated() -> None:
    ratio = []
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        outline = outline_of(DIAMOND, 0.4, seed)
        fit = fit_outlines([outline], (DIAMOND + rng.normal(0, 1.0, (4, 2)))[None])
        assert fit.found.all()
        error = (fit.corners_pinhole_px[0] - DIAMOND).ravel()
        assert np.abs(error).max() < 2.5
        ratio.append(error @ np.linalg.solve(fit.covariance[0], error) / 8)
    assert 0.05 < np.mean(ratio) < 1.0, "what the outline as a whole may be off is allowed for besides"


@pytest.mark.parametrize("spoil", ["round", "bite", "few"])
def test_what_is_no_quadrilateral_is_refused(spoil: str) -> None:
    outline = outline_of(DIAMOND, 0.2)
    if spoil == "round":
        angle = np.linspace(0, 2 * np.pi, 200)
        outline = DIAMOND.mean(axis=0) + np.column_stack([40 * np.cos(angle), 22 * np.sin(angle)])
    elif spoil == "bite":
        middle = (DIAMOND[0] + DIAMOND[1]) / 2
        inward = DIAMOND.mean(axis=0) - middle
        away = np.linalg.norm(outline - middle, axis=1, keepdims=True)
        outline = outline + np.clip(1 - away / 28, 0, None) * inward
    else:
        outline = outline[::25]
    fit = fit_outlines([outline], DIAMOND[None])
    spoilt = [True, True, False, False] if spoil == "bite" else [True] * 4
    assert (fit.found[0] == ~np.array(spoilt)).all()
    assert np.isnan(fit.corners_pinhole_px[0][spoilt]).all()


def fitted_on_a_blank_image(quad_vehicle: np.ndarray) -> tuple[np.ndarray, list[MarkingDetection]]:
    """A marking that only the network has seen: its corners, recorded px, and what is made of its outline."""
    camera = make_camera()
    view = CameraView(camera)
    corners_px = to_image(camera, quad_vehicle)
    quad = order_corners(view.undistort(corners_px))
    start = QuadStart(
        {"diamond": Claim(0.9, 1.0, 0.0, 0.0, False, False, 1.0)}, quad, 0, outline_of(quad, 0.1)
    )
    blank = np.full((camera.info.height, camera.info.width, 3), 90, dtype=np.uint8)
    owner = np.zeros((view.height // 2, camera.info.width // 2), dtype=np.int16)
    foreground = foreground_of(np.zeros(owner.shape, np.float32), owner, view.top)
    options = replace(DetectorOptions.for_mapping(), min_confidence=0.0)
    return view.distort(quad), fit_markings(blank, view, [start], foreground, options)


def test_a_marking_without_edges_in_the_image_takes_the_corners_of_its_outline() -> None:
    corners_px, (marking,) = fitted_on_a_blank_image(diamond(6.5, 0.3))
    assert marking.corner_valid.all()
    assert np.abs(marking.corners_px - corners_px).max() < 0.5
    sigma = np.sqrt(np.diagonal(marking.covariance_px))
    assert (sigma > 0.3).all(), "the outline is not trusted like an edge"


def test_an_outline_that_is_no_parallelogram_on_the_ground_is_not_taken() -> None:
    kite = np.array([[6.0, 0.0], [5.0, 0.5], [4.6, 0.0], [5.0, -0.5]])
    _, found = fitted_on_a_blank_image(kite)
    assert not any(marking.corner_valid.any() for marking in found)
