"""The vehicle itself is no paint: learnt from what never moves in the image, or told."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.pictures import brightness_model, diamond, make_camera, picture
from v2hdm.detection.batch import detect_all, with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import Drive, Image

BONNET = (slice(330, 350), slice(250, 400))


def drive_past(folder, kind="diamond", images=14, step_m=2.5):
    """A drive along a row of diamonds 3.7 m apart, a bright strip of the bonnet in every image."""
    camera = make_camera("pinhole")
    taken = []
    for number in range(images):
        x = number * step_m
        ahead = [diamond(3.7 * k - x, 0.6, 1.2, 0.7) for k in range(40) if 5 < 3.7 * k - x < 12]
        pixels = picture(camera, ahead, seed=number)
        pixels[BONNET] = 230
        path = folder / f"{number:03d}.png"
        cv2.imwrite(str(path), pixels)
        pose = np.eye(4)
        pose[0, 3] = x
        taken.append(Image("front", 0.1 * number, path, pose))
    return Drive("past", folder, {"front": camera}, tuple(taken))


@pytest.fixture
def options(tmp_path):
    return DetectorOptions(model=str(brightness_model(tmp_path)), min_confidence=0.0)


def test_paint_at_one_place_in_all_images_is_the_vehicle_and_is_left_out(tmp_path, options):
    drive = drive_past(tmp_path)
    learnt = with_own_vehicle(drive, Detector.load(options=options)).cameras["front"].own_vehicle
    assert learnt[BONNET].all()
    assert not learnt[:300].any(), "the diamonds pass by"
    for found in detect_all(drive, options):
        assert all(marking.corners_px[:, 1].mean() < 325 for marking in found.markings)


def test_a_vehicle_that_stands_still_tells_nothing(tmp_path, options):
    drive = drive_past(tmp_path, images=12, step_m=0.1)
    assert with_own_vehicle(drive, Detector.load(options=options)).cameras["front"].own_vehicle is None


def test_a_mask_that_was_given_is_obeyed_and_not_learnt_anew(tmp_path, options):
    drive = drive_past(tmp_path, images=3)
    mask = np.zeros((360, 640), dtype=bool)
    mask[:, :] = True
    given = replace(drive, cameras={"front": replace(drive.cameras["front"], own_vehicle=mask)})
    assert all(not found.markings for found in detect_all(given, options))
