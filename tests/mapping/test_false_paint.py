"""Paint that is none, and paint that drives: neither gets into the map, nor moves what is in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import Scene, SceneOptions, _detection, _inside, _project, make_scene
from v2hdm.mapping.methods import run_methods
from v2hdm.records import DIAMOND, FloatArray, HdMap, ImageDetections, MarkingDetection

OPTIONS = SceneOptions(seed=5, length_m=90.0, wild_rate=0.0, false_rate=0.0)
_DIAMOND_M = np.array([[0.6, 0.0, 0.0], [0.0, 0.3, 0.0], [-0.6, 0.0, 0.0], [0.0, -0.3, 0.0]])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(OPTIONS)


def mapped(scene: Scene, detections: list[ImageDetections]) -> HdMap:
    return run_methods(scene.drive, detections, OPTIONS.cameras)["Opt"].hd_map


def errors_m(scene: Scene, hd_map: HdMap) -> tuple[FloatArray, int]:
    """The largest corner error of each marking that is there, and how many are not."""
    centres = np.array([one.corners_map.mean(axis=0) for one in scene.markings])
    found, false = [], 0
    for one in hd_map.markings:
        i = int(np.linalg.norm(centres - one.corners_map.mean(axis=0), axis=1).argmin())
        true = scene.markings[i]
        rolled = [np.roll(one.corners_map, k, axis=0) - true.corners_map for k in range(4)]
        off_m = min(float(np.linalg.norm(each, axis=1).max()) for each in rolled)
        if true.kind != one.kind or off_m > 0.3:
            false += 1
        else:
            found.append(off_m)
    return np.array(found), false


@pytest.fixture(scope="module")
def clean_m(scene: Scene) -> FloatArray:
    """Errors of the map of what is painted and nothing else."""
    return errors_m(scene, mapped(scene, scene.detections))[0]


def with_paint(
    scene: Scene, more: Callable[[ImageDetections], list[MarkingDetection]]
) -> list[ImageDetections]:
    return [replace(one, markings=(*one.markings, *more(one))) for one in scene.detections]


def anywhere(scene: Scene, share: float) -> list[ImageDetections]:
    """So many of all detections are diamonds anywhere in the image."""
    rng = np.random.default_rng(8)

    def more(seen: ImageDetections) -> list[MarkingDetection]:
        count = rng.poisson(len(seen.markings) * share / (1 - share))
        places = rng.uniform([100, 320], [1180, 680], (count, 2))
        shape = np.array([[30.0, 0], [0, -15], [-30, 0], [0, 15]])
        return [
            _detection(DIAMOND, place + shape * rng.uniform(0.5, 2), np.ones(4, bool), OPTIONS, rng)
            for place in places
        ]

    return with_paint(scene, more)


def on_a_truck(scene: Scene, ahead_m: float, gains_m: float) -> list[ImageDetections]:
    """A diamond, flat on a low trailer at the height of the ground, that drives ahead and draws away."""
    rng = np.random.default_rng(9)

    def more(seen: ImageDetections) -> list[MarkingDetection]:
        image = scene.drive.images[seen.image]
        vehicle = _DIAMOND_M + np.array([ahead_m + gains_m * image.stamp_s, 0.4, 0.0])
        matrix = image.map_from_vehicle
        on_map = vehicle @ matrix[:3, :3].T + matrix[:3, 3]
        cam_from_map = scene.cam_from_vehicle[image.camera] @ np.linalg.inv(matrix)
        px, depth = _project(scene.drive.cameras[image.camera].info, cam_from_map, on_map[:, :2])
        inside = _inside(px, depth, OPTIONS)
        return [_detection(DIAMOND, px, inside, OPTIONS, rng)] if inside.all() else []

    return with_paint(scene, more)


SPOILT: dict[str, Callable[[Scene], list[ImageDetections]]] = {
    "30 % of all detections are false": lambda scene: anywhere(scene, 0.3),
    "a truck ahead at the same speed": lambda scene: on_a_truck(scene, 8.0, 0.0),
    "a truck that draws away": lambda scene: on_a_truck(scene, 5.0, 0.8),
    "a truck that is caught up with": lambda scene: on_a_truck(scene, 16.0, -0.8),
}


@pytest.mark.parametrize("name", SPOILT)
def test_false_and_moving_paint_stays_out_of_the_map(scene: Scene, clean_m: FloatArray, name: str) -> None:
    detections = SPOILT[name](scene)
    added = sum(len(one.markings) for one in detections) - sum(len(one.markings) for one in scene.detections)
    assert added > 20
    found, false = errors_m(scene, mapped(scene, detections))
    assert false == 0
    assert len(found) >= len(clean_m) - 1
    assert np.sqrt(np.mean(found**2)) < 1.3 * np.sqrt(np.mean(clean_m**2))
