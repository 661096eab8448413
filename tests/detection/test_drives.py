"""Whole drives: any number of workers, the vehicle itself left out, and classes of a user's own."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.pictures import (
    STRIDES,
    bar,
    brightness_model,
    diamond,
    make_camera,
    picture,
    save_model,
    to_image,
)
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.batch import detect_all, with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import open_executor
from v2hdm.geometry.planar import order_corners
from v2hdm.records import Drive, Image


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Ten images of one camera that passes two diamonds."""
    root, camera = tmp_path_factory.mktemp("drive"), make_camera()
    images = []
    for n in range(10):
        path = root / f"{n:06d}.png"
        cv2.imwrite(
            str(path), picture(camera, [diamond(8.0 - 0.3 * n, 0.5), diamond(11.0 - 0.3 * n, -0.5)], seed=n)
        )
        images.append(Image("front", 0.1 * n, path, np.eye(4)))
    return Drive("ten", root, {"front": camera}, tuple(images))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return brightness_model(tmp_path_factory.mktemp("model"))


def test_the_result_does_not_depend_on_the_number_of_workers(drive, model):
    progress = []
    options = DetectorOptions(model=str(model))
    alone = detect_all(drive, options, progress=lambda finished, total: progress.append((finished, total)))
    with open_executor(2) as executor:
        together = detect_all(drive, options, executor)
    assert progress == [(n, 10) for n in range(1, 11)]
    assert [in_image.image for in_image in together] == list(range(10))
    for a, b in zip(alone, together, strict=True):
        assert len(a.markings) == len(b.markings) == 2
        for marking, other in zip(a.markings, b.markings, strict=True):
            np.testing.assert_array_equal(marking.corners_px, other.corners_px)


BONNET = (slice(330, 350), slice(250, 400))


def drive_past(folder, kind="diamond", images=14, step_m=2.5):
    """A drive along a row of diamonds 3.7 m apart, a bright strip of the bonnet in every image."""
    camera = make_camera("pinhole")
    views = []
    for number in range(images):
        x = number * step_m
        ahead = [diamond(3.7 * k - x, 0.6, 1.2, 0.7) for k in range(40) if 5 < 3.7 * k - x < 12]
        pixels = picture(camera, ahead, seed=number)
        pixels[BONNET] = 230
        path = folder / f"{number:03d}.png"
        cv2.imwrite(str(path), pixels)
        pose = np.eye(4)
        pose[0, 3] = x
        views.append(Image("front", 0.1 * number, path, pose))
    return Drive("past", folder, {"front": camera}, tuple(views))


@pytest.fixture
def options(tmp_path):
    return DetectorOptions(model=str(brightness_model(tmp_path)), min_confidence=0.0)


def test_paint_at_one_place_in_all_images_is_the_vehicle_and_is_left_out(tmp_path, options):
    drive = drive_past(tmp_path)
    learnt = with_own_vehicle(drive, Detector.load(options=options)).cameras["front"].own_vehicle
    assert learnt[BONNET].all()
    assert not learnt[:300].any(), "the diamonds pass by"
    for in_image in detect_all(drive, options):
        assert all(marking.corners_px[:, 1].mean() < 325 for marking in in_image.markings)


def test_a_vehicle_that_stands_still_tells_nothing(tmp_path, options):
    drive = drive_past(tmp_path, images=12, step_m=0.1)
    assert with_own_vehicle(drive, Detector.load(options=options)).cameras["front"].own_vehicle is None


def test_a_mask_that_was_given_is_obeyed_and_not_learnt_anew(tmp_path, options):
    drive = drive_past(tmp_path, images=3)
    mask = np.zeros((360, 640), dtype=bool)
    mask[:, :] = True
    masked = replace(drive, cameras={"front": replace(drive.cameras["front"], own_vehicle=mask)})
    assert all(not in_image.markings for in_image in detect_all(masked, options))


SIZES = {"length_m": [0.8, 1.4], "width_m": [0.4, 1.2]}
ENTRIES = {
    "parking_t": {"family": "symbol", **SIZES},
    "pad": {"family": "quadrilateral", **SIZES},
    "fleck": {"family": "other", **SIZES},
}
CLASSES = (*PAINT_CLASSES, *ENTRIES)


def detector_of(folder, kind):
    """A detector whose network calls everything bright paint of an own class."""
    kinds = np.full(len(CLASSES), -40.0)
    kinds[CLASSES.index(kind)] = 0.0
    metadata = {"classes": list(CLASSES), "multiple": 16, "strides": STRIDES, "own_classes": ENTRIES}
    path = folder / f"{kind}.onnx"
    save_model(path, (0.1, -13.5), kinds, metadata)
    return Detector.load(path, DetectorOptions(min_confidence=0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


def test_an_own_quadrilateral_is_found_with_its_corners(folder):
    camera, shape = make_camera(), bar(6.0, 0.4, 1.2, 0.6)
    markings, lanes = detector_of(folder, "pad").detect(picture(camera, [shape]), camera)
    assert [marking.kind for marking in markings] == ["pad"]
    assert not [lane for lane in lanes if lane.kind == "pad"]
    true_px = order_corners(to_image(camera, shape))
    distances_px = np.linalg.norm(markings[0].corners_px[:, None] - true_px, axis=2)
    assert distances_px.min(axis=1).max() < 0.5
    assert not len(markings[0].outline_px)


def test_paint_that_is_too_large_is_none_of_its_class(folder):
    camera = make_camera()
    whole, _ = detector_of(folder, "pad").detect(picture(camera, [bar(7.0, 0.4, 4.0, 2.0)]), camera)
    assert "pad" not in [marking.kind for marking in whole]


def test_an_own_symbol_is_found_with_its_outline(folder):
    camera, shape = make_camera(), bar(6.0, 0.4, 1.1, 0.9)
    markings, _ = detector_of(folder, "parking_t").detect(picture(camera, [shape]), camera)
    assert [marking.kind for marking in markings] == ["parking_t"]
    low, high = (getattr(to_image(camera, shape), which)(axis=0) for which in ("min", "max"))
    np.testing.assert_allclose(markings[0].outline_px.min(axis=0), low, atol=1.5)
    np.testing.assert_allclose(markings[0].outline_px.max(axis=0), high, atol=1.5)


def test_other_own_paint_is_seen_and_not_reported(folder):
    camera = make_camera()
    image = picture(camera, [bar(6.0, 0.4, 1.2, 0.6)])
    assert detector_of(folder, "fleck").detect(image, camera)[0] == ()
