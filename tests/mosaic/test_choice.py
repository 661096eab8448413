"""Leaving images out changes no pixel by more than the weight that they have, and no outline."""

import numpy as np
import pytest

from tests.mosaic import scene
from v2hdm.mosaic import blend, choice
from v2hdm.mosaic.choice import LEFT_OUT, Candidate, chosen
from v2hdm.mosaic.views import Canvas, lens_of, recorded_shots


def candidates(weights, opacities=None):
    """One tile in several images, by weights at its nodes."""
    tile = np.array([[3, 5]])
    opacities = np.ones_like(weights) if opacities is None else opacities
    return [
        Candidate(index, tile, weight[None], opacity[None])
        for index, (weight, opacity) in enumerate(zip(weights, opacities, strict=True))
    ]


def test_what_is_left_out_has_a_small_share_of_the_weight_everywhere():
    distance_m = np.arange(4.0, 19.0, 0.5)[:, None] + np.linspace(0, 1.2, 81)
    weights = np.random.default_rng(4).uniform(0.5, 1, (30, 81)) / distance_m**6
    kept = [index for index, _ in chosen(candidates(weights))]
    assert len(kept) < 15
    share = weights[kept].sum(axis=0) / weights.sum(axis=0)
    assert share.min() >= 1 - LEFT_OUT


def test_an_image_that_alone_shows_a_corner_of_a_tile_is_kept():
    weights = np.full((3, 4), [[1e6, 1e6, 1e6, 0.0]])
    weights[2] = [1.0, 1.0, 1.0, 1e-3]
    assert 2 in [index for index, _ in chosen(candidates(weights))]


def test_a_place_stays_as_opaque_as_it_was():
    weights = np.array([[1e6], [1.0], [1.0], [1.0]])
    opacities = np.array([[0.4], [0.3], [0.3], [0.3]])
    kept = [index for index, _ in chosen(candidates(weights, opacities))]
    assert opacities[kept].sum() >= 1


def test_tiles_that_nothing_shows_are_left_out():
    assert chosen(candidates(np.zeros((2, 4)))) == []


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Images of squares whose poses are off, so that they differ."""
    return scene.drive_of(tmp_path_factory.mktemp("drive"), scene.squares, 0.1)


def test_no_pixel_differs_by_more_than_the_share_that_is_left_out(drive, monkeypatch):
    lenses = {"front": lens_of(drive.cameras["front"], scene.cam_from_vehicle())}
    canvas = Canvas(np.array([5.0, 3.0]), 0.02, 300, 400)
    monkeypatch.setattr(choice, "LEFT_OUT", 0.0)
    monkeypatch.setattr(choice, "_FAINTER", 0.0)
    complete = blend.whole(canvas, recorded_shots(drive), lenses).astype(float)
    monkeypatch.undo()
    rgba = blend.whole(canvas, recorded_shots(drive), lenses)
    assert np.abs(rgba[..., 3] - complete[..., 3]).max() <= 4
    shown = complete[..., 3] >= 128
    off = np.abs(rgba[..., 0] - complete[..., 0])[shown]
    assert 0 < off.max() <= LEFT_OUT * (210 - 60) + 3
    assert off.mean() < 0.5
