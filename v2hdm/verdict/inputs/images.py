"""A sample of each camera's images: frozen, given twice, too dark or too bright on the road."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import distort_points
from v2hdm.io.safe.pixels import read_pixels
from v2hdm.records import Camera, Drive, Image
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.verdict import Finding, Status

_Item = TypeVar("_Item")

_SAMPLES = 12
"""Pairs of consecutive images looked at in each camera; each costs about 15 ms."""

_REDUCED = 4
"""Images are decoded at a quarter of their size."""

_MOVED_M = 0.2
"""Between images that far apart the near road moves by tens of pixels."""

_SAME_GREY = 0.5
"""Mean difference in grey values below which two images are one, encoded twice; noise alone makes more."""

_FROZEN = 0.02
"""Share of repeated images on the way that passes: a dropped frame now and then, filled by the one before."""

_STUCK = 3
"""Repeats in a row that no single dropped frame makes."""

_BRIGHTEST, _DARKEST = 250, 5
"""Grey values at which an image of 8 bits is clipped."""

_CLIPPED = 0.25
"""Share of clipped road that leaves markings unseen; paint itself takes a few percent."""


def check_images(drive: Drive) -> list[Finding]:
    """Whether the images are those of a moving camera each, and show road.

    Raises:
        DriveError: a sampled image cannot be decoded.
    """
    findings = [*_shared(drive)]
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        if len(images) < 2:
            continue
        findings += [_frozen(name, images), *_exposure(name, camera, images)]
    return findings


def _shared(drive: Drive) -> list[Finding]:
    """Images that two cameras both claim as theirs."""
    owner: dict[Path, str] = {}
    for image in drive.images:
        other = owner.setdefault(image.path.resolve(), image.camera)
        if other != image.camera:
            says = f"the images are those of camera '{other}' given twice; give this one its own list"
            return [Finding("own images", Status.FAIL, 1.0, 0.0, "", says, image.camera)]
    return []


def _frozen(name: str, images: Sequence[Image]) -> Finding:
    """The share of images that repeat the one before while the vehicle moves."""
    moving = [k for k in range(1, len(images)) if _distance_m(images[k - 1], images[k]) > _MOVED_M]
    if not moving:
        says = "the vehicle does not move between the images, so that repeated ones cannot be told"
        return Finding("frozen images", Status.PASS, None, None, "", says, name)
    copied = [k for k in moving if _same_file(images[k - 1].path, images[k].path)]
    share = len(copied) / len(moving)
    at = copied
    if share <= _FROZEN:
        sampled = _spread(moving, _SAMPLES)
        alike = [k for k in sampled if _alike(images[k - 1].path, images[k].path)]
        if len(alike) > 1:  # one alone may be a dropped frame
            share, at = len(alike) / len(sampled), alike
    if share <= _FROZEN:
        begin, length = _longest_run(copied)
        if length >= _STUCK:
            says = (
                f"{length + 1} images in a row from {images[begin - 1].stamp_s:.2f} s on are one and the "
                "same while "
                "the vehicle moves: the camera froze there; drop the repeats from the list"
            )
            return Finding("frozen images", Status.WARN, float(length), _STUCK - 1.0, "", says, name)
    where = f", first at {images[at[0]].stamp_s:.2f} s" if at else ""
    return judge(
        "frozen images", name, share, _FROZEN, "",
        fine="each image differs from the one before",
        wrong=f"{100 * share:.0f} % of the images repeat the one before while the vehicle moves{where}: the "
        "camera froze, or one file is listed several times; drop the repeats from the list",
    )  # fmt: skip


def _longest_run(numbers: Sequence[int]) -> tuple[int, int]:
    """The first of the most successive ``numbers`` and how many these are."""
    best, begin = (0, 0), 0
    for k, number in enumerate(numbers):
        if k and number != numbers[k - 1] + 1:
            begin = k
        if k + 1 - begin > best[1]:
            best = numbers[begin], k + 1 - begin
    return best


def _exposure(name: str, camera: Camera, images: Sequence[Image]) -> list[Finding]:
    """The clipped share of the ROI in sampled images."""
    bright, dark = [], []
    mask = None
    for image in _spread(images, _SAMPLES):
        grey = _read(image.path)
        if mask is None:
            mask = _roi_mask(camera, grey)
        road = grey[mask]
        if not len(road):
            return []
        bright.append(float((road >= _BRIGHTEST).mean()))
        dark.append(float((road <= _DARKEST).mean()))
    return [
        judge(
            check, name, float(np.median(shares)), _CLIPPED, "",
            fine="the road is well exposed",
            wrong=f"{100 * np.median(shares):.0f} % of the road in the ROI is {how}: the images are "
            f"{cause}; set the camera's exposure for the road",
            status=Status.WARN,
        )
        for check, shares, how, cause in (
            ("bright images", bright, "clipped to white", "overexposed"),
            ("dark images", dark, "black", "underexposed, or the lens is covered"),
        )
    ]  # fmt: skip


def _distance_m(first: Image, second: Image) -> float:
    return float(np.linalg.norm(second.map_from_vehicle[:2, 3] - first.map_from_vehicle[:2, 3]))


def _same_file(first: Path, second: Path) -> bool:
    """Whether two files are one, or hold the same bytes; files of other sizes are not opened."""
    if first == second:
        return True
    if first.stat().st_size != second.stat().st_size:
        return False
    return _digest(first) == _digest(second)


def _digest(path: Path) -> bytes:
    return hashlib.blake2b(path.read_bytes()).digest()


def _alike(first: Path, second: Path) -> bool:
    one, other = _read(first), _read(second)
    return one.shape == other.shape and float(cv2.absdiff(one, other).mean()) < _SAME_GREY


def _read(path: Path) -> np.ndarray:
    """Grey values of an image at a quarter of its size."""
    return read_pixels(path, cv2.IMREAD_REDUCED_GRAYSCALE_4)


def _roi_mask(camera: Camera, grey: np.ndarray) -> np.ndarray:
    """Where the reduced image shows the ROI, as the guess says."""
    pinhole = apply_homography(np.asarray(np.linalg.inv(camera.ipm[camera.initial_ipm])), camera.roi_vehicle)
    corners = distort_points(camera.info, pinhole) / _REDUCED
    mask = np.zeros(grey.shape, np.uint8)
    limit = 4.0 * max(grey.shape)
    cv2.fillConvexPoly(mask, np.round(np.clip(corners, -limit, limit)).astype(np.int32), 1)
    return mask.astype(bool)


def _spread(items: Sequence[_Item], count: int) -> list[_Item]:
    """At most ``count`` items, evenly spread."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]
