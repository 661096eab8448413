"""What the training adds to its scenes: seams along sides, light ground, junctions, low and high cameras."""

import cv2
import numpy as np

from train.scenes.hardships import (
    Hardships,
    bleached,
    junction_approach,
)
from train.scenes.paint import Bend, random_brush
from train.scenes.scenes import training_sample
from train.scenes.views import mounted_otherwise, random_view
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import ARROW, CROSSWALK_BAR, STOP_LINE
from v2hdm.simulate.render.scene import Ground


def test_bleached_ground_keeps_its_tint_and_is_clipped_together_with_its_paint() -> None:
    ground = Ground(albedo_bgr=(0.1, 0.12, 0.14))
    lighter = bleached(np.random.default_rng(0), ground, 1.0)
    assert 0.35 < max(lighter.albedo_bgr) < 0.55
    np.testing.assert_allclose(np.array(lighter.albedo_bgr) / ground.albedo_bgr, lighter.albedo_bgr[0] / 0.1)
    assert bleached(np.random.default_rng(0), ground, 0.0) is ground
    samples = [(0.0, 2, index) for index in range(50)], [(1.0, 2, index) for index in range(50)]
    clipped = [np.mean([_clipped_beside_paint(*sample) for sample in each]) for each in samples]
    assert clipped[0] < 0.01
    assert clipped[1] > 0.05


def _clipped_beside_paint(share: float, seed: int, index: int) -> float:
    """The share of the seam of ground about paint in which a channel is clipped, as the paint in it is."""
    sample = training_sample(seed, index, 160, 96, 1.0, Hardships(bleached=share))
    paint = (sample.labels > 0).astype(np.uint8)
    about = (cv2.dilate(paint, np.ones((7, 7), np.uint8)) > 0) & (paint == 0)
    return float((sample.image.max(axis=2) >= 250)[about].mean()) if about.any() else 0.0


def test_a_junction_has_arrows_before_its_stop_line_and_a_crosswalk_behind_it() -> None:
    kinds: list[str] = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        paints, ground = junction_approach(rng, random_brush(rng, 0.0), Bend(0.0))
        along = {kind: [p.polygon_map[:, 0] for p in paints if p.kind == kind] for kind in PAINT_CLASSES}
        assert len(along[STOP_LINE]) == 1
        stop_m = along[STOP_LINE][0]
        assert all(x.max() < stop_m.min() for x in along[ARROW])
        assert all(x.min() > stop_m.max() for x in along[CROSSWALK_BAR])
        assert all(inside_convex(ground, p.polygon_map).all() for p in paints if p.kind == CROSSWALK_BAR)
        kinds += [paint.kind for paint in paints]
    assert {ARROW, STOP_LINE, CROSSWALK_BAR} == set(kinds)


def test_cameras_mounted_otherwise_keep_their_place_and_look_from_low_or_high() -> None:
    heights = []
    for seed in range(40):
        view = random_view(np.random.default_rng(seed), 160, 96)
        other = mounted_otherwise(np.random.default_rng(seed), view, 1.0)
        before, after = camera_centre(view.cam_from_map), camera_centre(other.cam_from_map)
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        np.testing.assert_array_equal(other.cam_from_map[:3, :3], view.cam_from_map[:3, :3])
        heights.append(after[2])
    low = [height for height in heights if height < 2]
    assert 8 < len(low) < 32
    assert 0.5 <= min(low) < max(low) <= 1.1
    assert all(3.6 <= height <= 5 for height in heights if height >= 2)
    view = random_view(np.random.default_rng(0), 160, 96)
    assert mounted_otherwise(np.random.default_rng(0), view, 0.0) is view
