"""Whole drives."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import brightness_model, diamond, make_camera, picture
from v2hdm.detection.batch import detect_all, read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import DriveError
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
    seen = []
    options = DetectorOptions(model=str(model))
    alone = detect_all(drive, options, workers=1, progress=lambda done, total: seen.append((done, total)))
    together = detect_all(drive, options, workers=2)
    assert seen == [(n, 10) for n in range(1, 11)]
    assert [found.image for found in together] == list(range(10))
    for a, b in zip(alone, together, strict=True):
        assert len(a.markings) == len(b.markings) == 2
        for one, other in zip(a.markings, b.markings, strict=True):
            np.testing.assert_array_equal(one.corners_px, other.corners_px)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_truncated_image_is_refused_by_name(drive, tmp_path, suffix):
    path = tmp_path / f"cut{suffix}"
    noisy = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, noisy)[1].tobytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DriveError, match=f"cut{suffix}: image is truncated"):
        read_image(Image("front", 0.0, path, np.eye(4)), drive.cameras["front"])


def test_a_missing_image_and_one_of_another_size_are_refused_by_name(drive, tmp_path):
    camera = drive.cameras["front"]
    with pytest.raises(DriveError, match=r"gone\.png: image listed but missing"):
        read_image(Image("front", 0.0, tmp_path / "gone.png", np.eye(4)), camera)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((20, 40, 3), dtype=np.uint8))
    with pytest.raises(DriveError, match="40x20 but the camera_info"):
        read_image(Image("front", 0.0, tmp_path / "small.png", np.eye(4)), camera)
