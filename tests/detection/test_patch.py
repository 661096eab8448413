"""Patches, cut out of an image once, and frames in which the lens bends nothing."""

import numpy as np
import pytest

from tests.detection.pictures import LENSES, bar, brightness_model, diamond, make_camera, picture, to_image
from v2hdm.detection import patch
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.patch import ImageQuads, LensFrames
from v2hdm.geometry.quadrilateral import order_corners

SHAPES = [bar(5.0, 0.3, 0.15, 4.0), bar(9.0, -2.0, 3.0, 0.15), diamond(7.0, 1.0)]
SHARES = np.linspace(0.0, 1.0, 9)[:, None]


def seen(lens: str) -> tuple[RoadCamera, np.ndarray, np.ndarray]:
    """A view, recorded corners (3, 4, 2) of shapes, and points (3, 9, 2) along one side of each."""
    camera = make_camera(lens)
    ground = np.stack(SHAPES)
    corners_px = np.stack([order_corners(to_image(camera, shape)) for shape in ground])
    along = ground[:, [0]] + SHARES * (ground[:, [1]] - ground[:, [0]])
    return RoadCamera(camera, 16), corners_px, np.stack([to_image(camera, line) for line in along])


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_what_is_straight_on_the_ground_is_straight_in_the_frames_and_as_large_as_in_the_image(lens):
    view, corners_px, lines_px = seen(lens)
    frames = LensFrames.about(view, corners_px)
    lines = frames.from_image(lines_px)
    np.testing.assert_allclose(frames.to_px(lines), lines_px, atol=0.02)
    for line, line_px in zip(lines, lines_px, strict=True):
        bent = np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1]
        assert bent < 0.05
        assert np.linalg.norm(line[-1] - line[0]) == pytest.approx(
            np.linalg.norm(line_px[-1] - line_px[0]), rel=0.12
        )


@pytest.mark.parametrize("lens", ["plumb_bob", "equidistant"])
def test_covariances_in_the_image_are_those_of_scattered_corners(lens):
    view, corners_px, _ = seen(lens)
    frames = LensFrames.about(view, corners_px)
    corners = frames.from_image(corners_px)
    root = np.tril(np.random.default_rng(0).normal(0, 0.05, (3, 8, 8))) + 0.1 * np.eye(8)
    np.testing.assert_allclose(frames.to_px(corners), corners_px, atol=0.02)
    moves = frames.jacobian(corners) @ root
    covariance = moves @ moves.swapaxes(1, 2)
    noise = np.random.default_rng(1).normal(size=(4000, 3, 8, 1))
    moved = corners + (root @ noise).reshape(4000, 3, 4, 2)
    scattered = np.stack([frames.to_px(sample) for sample in moved]).reshape(4000, 3, 8)
    for m in range(3):
        drawn = np.cov(scattered[:, m].T)
        np.testing.assert_allclose(covariance[m], drawn, atol=0.06 * np.diag(drawn).max())


def test_only_what_the_lens_bows_notably_is_looked_at_along_the_bow():
    assert not ImageQuads.of(*seen("pinhole")[:2]).bowed.any()
    view, corners_px, lines_px = seen("equidistant")
    quads = ImageQuads.of(view, corners_px)
    assert quads.bowed.tolist() == [True, True, False]
    middles = (quads.corners + np.roll(quads.corners, -1, axis=1)) / 2
    sides_px = quads.px(middles)
    nearest = np.linalg.norm(sides_px[0][:, None] - lines_px[0], axis=2).min()
    assert nearest < 0.3, "the middle of one of its sides lies on the side as the lens shows it"
    some = quads.take(np.array([2, 1, 0, 0]))
    assert some.bowed.tolist() == [False, True, True, True]
    np.testing.assert_allclose(some.px(middles[[2, 1, 0, 0]]), sides_px[[2, 1, 0, 0]])
    np.testing.assert_array_equal(quads.px(middles)[2], middles[2])


class Image(np.ndarray):
    """An image that counts how often it is looked into."""

    looks = 0

    def __getitem__(self, index):
        type(self).looks += 1
        return np.asarray(self)[index]


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_an_image_is_sampled_once_per_marking(tmp_path, monkeypatch, lens):
    camera = make_camera(lens)
    shapes = [diamond(x, y, 1.2, 0.7) for x in (6.0, 9.0) for y in (-1.2, 0.6)] + [bar(8.0, 2.4, 2.0, 0.2)]
    image = picture(camera, shapes)
    detector = Detector.load(brightness_model(tmp_path), DetectorOptions(min_confidence=0.0))
    found = detector.propose(detector.run_network(image, camera), camera)
    cut, once = [], patch._cut
    monkeypatch.setattr(patch, "_cut", lambda *given: cut.append(given[1]) or once(*given))
    monkeypatch.setattr(Image, "looks", 0)
    detector.read(image.view(Image), found)
    assert len(cut) == len(shapes) == Image.looks
