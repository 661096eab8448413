"""The share of paint that a marking has left, against what the renderer has painted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.ports import TINY_ROUTE, short_port, small_port
from v2hdm.detection.frames import read_image
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import Calibration, HDMap, PaintLeft
from v2hdm.simulate.port.build import build_port
from v2hdm.simulate.port.config import PaintConfig, RouteConfig
from v2hdm.simulate.render import ground
from v2hdm.simulate.render.view import Bands
from v2hdm.site.living import wear
from v2hdm.site.living.wear import Footage, with_wear

FOOTPRINT_M = 0.012  # of a pixel of the nearest images, at which the renderer draws the flakes


def share_rendered(paint):
    """The mean opacity of a marking's clean paint, by the renderer itself."""
    low, high = paint.polygon_map.min(axis=0), paint.polygon_map.max(axis=0)
    x, y = np.meshgrid(*(np.arange(a, b, 0.01, dtype=np.float32) for a, b in zip(low, high, strict=True)))
    tiles = [ground._WEAR_TILE, ground.MEDIUM_TILE, ground.fine_tile("asphalt")]
    shift = (float(paint.seed % 97) * 0.53, float(paint.seed % 89) * 0.71)
    scales = np.array([[ground.scale_of(tile, shift) for tile in tiles]], dtype=np.float32)
    covered = np.array([[0, 0, 1]] * 4, dtype=np.float32)  # all of every pixel lies within the outline
    white = np.ones((*x.shape, 3), dtype=np.float32)
    black = ground._look(replace(paint, dirt=0.0, albedo_bgr=(0.0, 0.0, 0.0)))
    whole = Bands(np.array([[0, x.shape[0], 0, x.shape[1]]]), np.array([0, 1]))
    footprint_m = np.full_like(x, FOOTPRINT_M)
    ground.drawing.draw_paint(
        whole, 0, covered, np.array([0, 4]), (x, y), (x, y, footprint_m),
        tuple(tile.padded for tile in tiles), scales, black[None], np.ones(1, np.uint8),
        np.empty_like(x[:1]), white.reshape(len(x), -1), np.zeros(x.shape, np.uint8),
    )  # fmt: skip
    opacity = 1 - white[..., 0]
    pixels = np.round((paint.polygon_map - low) / 0.01).astype(np.int32)
    inside = cv2.fillConvexPoly(np.zeros(x.shape, np.uint8), pixels, 1) > 0
    return float(opacity[inside].mean())


def reader(drive):
    return lambda image: read_image(image, drive.cameras[image.camera])


def measured(folder, port, earlier=None):
    """(map, rendered shares by marking) under the true geometry: markings that half the images show whole."""
    drive = read_drive(folder)
    truth = read_truth(drive)
    calibrations = {
        k: Calibration(camera.info, truth.cam_from_vehicle[k]) for k, camera in drive.cameras.items()
    }
    visible = truth.visibility > 0.95
    rows = np.flatnonzero(visible.sum(axis=0) >= 2)
    markings = [replace(truth.map.markings[k], id=int(k) + 1) for k in rows]
    shown = {(int(image), int(number)) for image, number in np.argwhere(visible[:, rows])}
    paints = build_port(port).renderer.scene.paints
    centres = np.array([paint.polygon_map.mean(axis=0) for paint in paints])
    nearest = [np.argmin(((centres - m.corners_map.mean(axis=0)) ** 2).sum(axis=1)) for m in markings]
    poses = truth.map_from_vehicle
    footage = Footage(drive.images, poses, calibrations, None)
    hd_map = with_wear(HDMap(tuple(markings)), footage, reader(drive), shown, earlier)
    return hd_map, {m.id: share_rendered(paints[k]) for m, k in zip(markings, nearest, strict=True)}


def shares(hd_map, true_share):
    """Measured shares of paint, their sigmas and the true shares (3, N) of the markings that have one."""
    rows = [
        (marking.paint.share, marking.paint.sigma, true_share[marking.id])
        for marking in hd_map.markings
        if marking.paint
    ]
    return np.array(rows).T


def test_the_share_of_paint_left_is_within_five_hundredths_of_what_was_rendered(short_drive):
    hd_map, true_share = measured(short_drive, short_port())
    share, sigma, true = shares(hd_map, true_share)
    assert len(share) > 20
    assert true.min() < 0.4  # some are nearly gone
    assert np.abs(share - true).mean() <= 0.05
    assert np.mean(np.abs(share - true) <= 2 * sigma) >= 0.85
    assert np.corrcoef(share, true)[0, 1] > 0.9


def test_shadows_and_vehicles_of_a_port_that_nothing_was_tuned_on_are_no_wear(rendered):
    route = RouteConfig(pieces=TINY_ROUTE, image_spacing_m=2.0)
    port = replace(short_port(), seed=10, route=route)
    hd_map, true_share = measured(rendered(port), port)
    share, sigma, true = shares(hd_map, true_share)
    assert len(share) > 10
    assert np.abs(share - true).mean() <= 0.06
    assert np.mean(np.abs(share - true) <= 2 * sigma) >= 0.95


def test_two_sessions_keep_the_order_and_the_second_states_the_change(rendered):
    worn = small_port(paint=replace(PaintConfig(), wear=0.3))
    first, before = measured(rendered(small_port()), small_port())
    second, after = measured(rendered(worn), worn, first)
    compared = [marking for marking in second.markings if marking.paint and marking.paint.change is not None]
    true = np.array([after[marking.id] - before[marking.id] for marking in compared])
    change = np.array([marking.paint.change for marking in compared])
    clearly = true < -0.1
    assert clearly.sum() >= 5
    assert (change[clearly] < 0).all()
    sigma = np.array([marking.paint.change_sigma for marking in compared])
    assert np.mean(np.abs(change - true) <= 2 * sigma) >= 0.85


def test_a_marking_that_no_image_shows_keeps_what_the_earlier_map_says(small_drive):
    drive = read_drive(small_drive)
    away = replace(read_truth(drive).map.markings[0], corners_map=np.eye(4)[:, :2] + 1e4, id=1)
    before = HDMap((replace(away, paint=PaintLeft(0.7, 0.1)),))
    footage = Footage(drive.images, [image.map_from_vehicle for image in drive.images], {}, None)
    updated = with_wear(HDMap((away,)), footage, reader(drive), set(), before)
    assert updated.markings[0].paint == PaintLeft(0.7, 0.1)
    assert with_wear(HDMap((away,)), footage, reader(drive), set()).markings[0].paint is None


@pytest.mark.parametrize("corner_px", [(4.3, 7.8), (-0.6, 9.0), (51.0, 37.5)])
def test_the_light_at_a_place_is_that_of_the_whole_image(corner_px):
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    px = corner_px + rng.uniform(0.0, 12.5, (7, 5, 2))
    whole = cv2.LUT((pixels.sum(axis=2) // 3).astype(np.uint8), wear._LIGHT)
    expected = cv2.remap(whole, *np.moveaxis(px.astype(np.float32), 2, 0), cv2.INTER_LINEAR)
    assert np.array_equal(wear._light_at(px, pixels), expected)
