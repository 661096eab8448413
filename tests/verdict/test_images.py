"""Frozen, doubled and clipped images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.verdict.drives import drive, poses, raised
from v2hdm.errors import DriveError
from v2hdm.records import Drive
from v2hdm.verdict.inputs.recording import check_images

Paint = Callable[[int], np.ndarray]


def noisy(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(60, 160, (720, 1280), dtype=np.uint8)


def pictured(folder: Path, paint: Paint, suffix: str = ".png") -> Drive:
    """A drive of nine images, 2.5 m apart."""
    bare = drive(poses(straight_s=4.0, turn_s=0.5), every=10)
    images = []
    for k, image in enumerate(bare.images):
        path = folder / f"{k}{suffix}"
        cv2.imwrite(str(path), paint(k))
        images.append(replace(image, path=path))
    return replace(bare, images=images)


def test_images_of_a_moving_camera_pass(tmp_path: Path) -> None:
    findings = check_images(pictured(tmp_path, noisy))
    assert {finding.check for finding in findings} == {"frozen images", "bright images", "dark images"}
    assert not raised(findings)


def test_a_camera_that_freezes_is_told(tmp_path: Path) -> None:
    told = raised(check_images(pictured(tmp_path, lambda k: noisy(min(k, 4)))))
    assert "50 % of the images repeat the one before" in told["frozen images"]
    assert "first at 2.50 s" in told["frozen images"]


def test_a_frozen_picture_is_told_although_its_files_differ(tmp_path: Path) -> None:
    def encoded_anew(k: int) -> np.ndarray:
        image = noisy(0)
        image[0, 0] = k
        return image

    assert "100 %" in raised(check_images(pictured(tmp_path, encoded_anew)))["frozen images"]


@pytest.mark.parametrize(("grey", "check"), [(255, "bright images"), (2, "dark images")])
def test_road_that_is_clipped_is_told(grey: int, check: str, tmp_path: Path) -> None:
    def clipped(k: int) -> np.ndarray:
        image = noisy(k)
        image[360:] = grey
        return image

    assert list(raised(check_images(pictured(tmp_path, clipped)))) == [check]


def test_a_white_sky_is_no_overexposed_road(tmp_path: Path) -> None:
    def white_sky(k: int) -> np.ndarray:
        image = noisy(k)
        image[:150] = 255
        return image

    assert not raised(check_images(pictured(tmp_path, white_sky)))


def test_one_list_of_images_for_two_cameras_is_told(tmp_path: Path) -> None:
    one = pictured(tmp_path, noisy)
    rear = [replace(image, camera="rear") for image in one.images]
    both = replace(one, images=[*one.images, *rear], cameras={**one.cameras, "rear": one.cameras["front"]})
    assert "those of camera 'front' given twice" in raised(check_images(both))["own images"]


def test_a_damaged_image_is_one_line(tmp_path: Path) -> None:
    damaged = pictured(tmp_path, noisy)
    damaged.images[0].path.write_bytes(b"\x89PNG")
    with pytest.raises(DriveError, match=r"0\.png: not a PNG"):
        check_images(damaged)
