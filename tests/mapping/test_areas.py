"""A word and a crosswalk through the whole mapping: seen under a wrong mounting, mapped with the rest."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.painted import word
from tests.mapping.scene import SceneOptions, _placed, _project, make_scene
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import Marking, MarkingDetection
from v2hdm.site.composed import composed

STREET = SceneOptions(
    length_m=36.0, turns=False, seed=3, false_rate=0.0, wild_rate=0.0, hidden_corner_rate=0.0,
    rtk_m=0.0, heading_deg=0.0, jitter_deg=0.0,
)  # fmt: skip
BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])
WAY = np.array([0.0, 0.0, 0.3])  # from the origin straight ahead
LETTERS = _placed(word("EBH", (13.0, -2.0)).reshape(-1, 2), WAY)
BARS = [_placed(BAR + np.array([22.0, across]), WAY) for across in np.arange(-1.5, 4.0)]
BORDER = np.array([[0, 0], [1279, 0], [1279, 719], [0, 719]], dtype=np.float32)


def with_bars(markings):
    """The markings of the scene that are not where the crosswalk is, and its bars."""
    middle = np.concatenate(BARS).mean(axis=0)
    clear = [m for m in markings if np.linalg.norm(m.corners_map.mean(axis=0) - middle) > 5.0]
    return [*clear, *(Marking("crosswalk_bar", bar, 0) for bar in BARS)]


def hull_in(info, cam_from_map, rng):
    """The word in one image, cut by its border; None where little of it is in view."""
    points = LETTERS[cv2.convexHull(LETTERS.astype(np.float32), returnPoints=False).ravel()]
    px, depth = _project(info, cam_from_map, points)
    if (depth < 1.0).any() or depth.mean() > 14.0:
        return None
    px = px + rng.normal(0.0, 0.7, px.shape)
    area, part = cv2.intersectConvexConvex(px.astype(np.float32), BORDER)
    if area < 0.3 * cv2.contourArea(px.astype(np.float32)):
        return None
    outline = part.reshape(-1, 2).astype(float)
    inside = ((outline > 6) & (outline < [1273, 713])).all(axis=1)
    none = np.full((4, 2), np.nan), np.full((8, 8), np.nan), np.zeros(4, dtype=bool)
    return MarkingDetection("text", 0.9, *none, outline, inside & np.roll(inside, -1))


@pytest.fixture(scope="module")
def mapped():
    scene = make_scene(STREET, with_bars)
    rng = np.random.default_rng(1)
    detections = []
    for found in scene.detections:
        image = scene.drive.images[found.image]
        camera = scene.drive.cameras[image.camera]
        cam_from_map = scene.cam_from_vehicle[image.camera] @ np.linalg.inv(image.map_from_vehicle)
        hull = hull_in(camera.info, cam_from_map, rng)
        more = () if hull is None else (hull,)
        detections.append(replace(found, markings=(*found.markings, *more)))
    cut = [m for found in detections for m in found.markings if m.kind == "text" and not m.outline_seen.all()]
    assert len(cut) >= 2
    result = run_methods(scene.drive, detections, STREET.cameras, MappingOptions(pose_model="heave"))["Opt"]
    return composed(result.hd_map)


def test_a_word_is_mapped_as_the_rectangle_about_its_letters(mapped):
    (text,) = [symbol for symbol in mapped.symbols if symbol.kind == "text"]
    points = word("EBH", (13.0, -2.0)).reshape(-1, 2)
    (back, right), (front, left) = points.min(axis=0), points.max(axis=0)
    true = _placed(np.array([[back, right], [front, right], [front, left], [back, left]]), WAY)
    off = [np.linalg.norm(np.roll(text.outline_map, k, axis=0) - true, axis=1).max() for k in range(4)]
    assert min(off) < 0.05
    assert text.covariance_m2 is not None
    assert 0.004 < np.sqrt(np.diag(text.covariance_m2)).max() < 0.08


def test_a_crosswalk_is_mapped_with_its_bars_as_parts(mapped):
    (crosswalk,) = [symbol for symbol in mapped.symbols if symbol.kind == "crosswalk"]
    assert len(crosswalk.parts) == len(BARS)
    assert {m.kind for m in mapped.markings if m.id in crosswalk.parts} == {"crosswalk_bar"}
    true = _placed(np.array([[20.5, -1.75], [23.5, -1.75], [23.5, 3.75], [20.5, 3.75]]), WAY)
    off = [np.linalg.norm(np.roll(crosswalk.outline_map, k, axis=0) - true, axis=1).max() for k in range(4)]
    assert min(off) < 0.03
    assert crosswalk.covariance_m2 is not None
