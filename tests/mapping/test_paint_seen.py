"""Whether an image shows paint, bare ground, or a box before it, where a marking was."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.mapping.scene import MOUNTS, extrinsic
from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.records import Camera, CameraInfo, Marking
from v2hdm.site.looks import Observer, Paint, learn_paint

INTRINSIC = np.array([[900.0, 0, 640], [0, 900, 350], [0, 0, 1]])
INFO = CameraInfo("front", 1280, 720, INTRINSIC, "plumb_bob", (-0.1, 0.02, 1e-4, -2e-4, 0.0))
CAMERA = Camera(INFO, {"estimated": np.eye(3)}, "estimated", np.array([[4.0, -4], [16, -4], [16, 4], [4, 4]]))
MOUNT = extrinsic(*MOUNTS["front"])
DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
PLACES = np.array([[6.0 + 3.0 * k, 2.5 * (-1) ** k] for k in range(12)])
GONE, HIDDEN = 4, 7


def poses() -> np.ndarray:
    out = np.tile(np.eye(4), (20, 1, 1))
    out[:, 0, 3] = 1.5 * np.arange(20)
    return out


def image(pose: np.ndarray, rng: np.random.Generator) -> NDArray[np.float32]:
    """Asphalt with all diamonds but one; a box with a sharp edge stands before another."""
    v, u = np.mgrid[0:720, 0:1280]
    grid = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    grey = rng.normal(60.0, 3.0, 720 * 1280)
    cam_from_map = MOUNT @ np.linalg.inv(pose)
    for number, place in enumerate(PLACES):
        pixel, depth = project_ground(INTRINSIC, cam_from_map, DIAMOND + place)
        if (depth < 1.0).any():
            continue
        corners = distort_points(INFO, pixel)
        if number == HIDDEN:
            low, high = corners.min(axis=0) - 60.0, corners.max(axis=0) + 60.0
            within = ((grid > low) & (grid < high)).all(axis=1)
            left = grid[:, 0] < corners[:, 0].mean() + 3.0 * rng.normal()
            grey[within & left], grey[within & ~left] = 140.0, 40.0
        elif number != GONE:
            low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
            near = np.flatnonzero(((grid > low) & (grid < high)).all(axis=1))
            sides = np.roll(corners, -1, axis=0) - corners
            off = grid[near][:, None] - corners
            inside = (sides[:, 0] * off[..., 1] - sides[:, 1] * off[..., 0] < 0).all(axis=1)
            grey[near[inside]] = rng.normal(130.0, 5.0, int(inside.sum()))
    return np.asarray(grey.reshape(720, 1280), dtype=np.float32)


@pytest.fixture(scope="module")
def observer() -> Observer:
    rng, route = np.random.default_rng(0), poses()
    made = {k: image(route[k], rng) for k in range(len(route))}
    frames, none = np.arange(len(route)), np.zeros(0, dtype=np.int64)
    seen = none, none, none, none, np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), np.zeros((0, 4), dtype=bool)
    sightings = Sightings(("front",), 0.1 * frames, route, *seen, ("diamond",), np.zeros_like(frames))
    views, rig = Views(frames, np.zeros_like(frames), frames), Rig(INTRINSIC[None], MOUNT[None], route)
    return Observer(sightings, views, (CAMERA,), rig, 0.0, made.__getitem__)


def contrasts_of(observer: Observer) -> tuple[Paint, np.ndarray]:
    outlines = DIAMOND + PLACES[:, None]
    mapped = [Marking("diamond", c, 9) for k, c in enumerate(outlines) if k not in (GONE, HIDDEN)]
    return learn_paint(observer, mapped, PLACES)["diamond"], observer.contrasts(outlines)


def test_paint_stands_out_and_bare_ground_does_not(observer: Observer) -> None:
    paint, contrast = contrasts_of(observer)
    assert paint.painted[0] == pytest.approx(np.log(130 / 60), abs=0.15)
    assert paint.bare[0] == pytest.approx(0.0, abs=0.03)
    assert contrast[GONE] == pytest.approx(0.0, abs=0.05)


def test_a_gone_marking_is_told_from_a_hidden_and_from_a_worn_one(observer: Observer) -> None:
    paint, contrast = contrasts_of(observer)
    odds = paint.log_bare(contrast) - paint.log_there(contrast)
    assert odds[GONE] > 1.5
    assert odds[HIDDEN] < 0.0
    worn = np.array([0.4 * paint.painted[0]])
    assert paint.log_bare(worn) - paint.log_there(worn) < -1.5


def test_too_few_markings_say_nothing_of_paint(observer: Observer) -> None:
    few = [Marking("diamond", DIAMOND + place, 9) for place in PLACES[:3]]
    assert learn_paint(observer, few, PLACES) == {}
