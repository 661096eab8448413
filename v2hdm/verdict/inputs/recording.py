"""Stamps of poses and images, their gaps and repeats, and a sample of the images themselves."""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import distort_points
from v2hdm.io.trajectory import known_offset
from v2hdm.records import Camera, Drive, Image
from v2hdm.safe.pixels import read_pixels
from v2hdm.verdict.inputs.poses import Motion
from v2hdm.verdict.verdict import Finding, Status, judge, passed

_Item = TypeVar("_Item")
# Acceleration and turning of ordinary driving: between poses t apart a line errs by this times t^2 / 8.
_DRIVEN_MPS2 = 2.0
_WITHOUT_POSE = 0.1  # more than this share of images without a pose is no brief loss at the ends of a drive
_HALF = 0.5  # beyond this share of the recording the drive is not the one that was meant
_HELD = 0.02  # more than this share of repeated poses on the way is a receiver slower than its log
_VIEWS = 2.0  # a marking must be in the ROI of at least two images to be placed and checked
_SAMPLES = 12  # pairs of consecutive images looked at in each camera; each costs about 15 ms
_REDUCED = 4  # images are decoded at a quarter of their size
_MOVED_M = 0.2  # between images that far apart the near road moves by tens of pixels
# Mean difference in grey values below which two images are one, encoded twice; noise alone makes more.
_SAME_GREY = 0.5
# Share of repeated images on the way that passes: a dropped frame now and then, filled by the one before.
_FROZEN = 0.02
_STUCK = 3  # repeats in a row that no single dropped frame makes
_BRIGHTEST = 250  # grey value from which an image of 8 bits is clipped to white
_DARKEST = 5  # grey value up to which an image of 8 bits is black
_CLIPPED = 0.25  # share of clipped road that hides markings; paint itself takes a few percent


def check_clocks(drive: Drive, motion: Motion) -> Iterator[Finding]:
    """Whether poses come often enough, and images have poses."""
    if motion.moving.any():
        yield from _pose_rate(drive, motion)
        yield _held(motion)
    stamps = {
        name: [image.stamp_s for image in drive.images if image.camera == name] for name in drive.cameras
    }
    spans = {name: (stamp_s[0], stamp_s[-1]) for name, stamp_s in stamps.items() if stamp_s}
    for name, stamp_s in stamps.items():
        yield _posed(drive, name, len(stamp_s))
        if stamp_s and len(stamps) > 1:
            yield _overlap(spans, name)
        if stamp_s:
            yield from _spacing(drive, motion, name)


def _pose_rate(drive: Drive, motion: Motion) -> Iterator[Finding]:
    interval_s = float(np.median(motion.interval_s[motion.moving]))
    longest_s = float(motion.interval_s[motion.moving].max())
    limit_s = float(np.sqrt(8 * max(drive.pose_noise.position_m, 0.01) / _DRIVEN_MPS2))
    error_m = _DRIVEN_MPS2 * longest_s**2 / 8
    rare = judge(
        "pose rate", "poses", interval_s, limit_s, "s",
        fine=f"{1 / interval_s:.0f} poses per second are enough",
        wrong=f"poses are {interval_s:.2f} s apart: between them they err by more than the stated noise; "
        "record the receiver's full rate",
        status=Status.WARN,
    )  # fmt: skip
    yield rare
    if rare.status is Status.PASS:
        yield judge(
            "pose gaps", "poses", longest_s, max(2 * limit_s, 3 * interval_s), "s",
            fine="the poses have no gap while the vehicle moves",
            wrong=f"the poses have a gap of {longest_s:.2f} s while the vehicle moves, across which images' "
            f"poses err by {error_m:.2f} m; lower drive.max_gap_s below it or restore the missing poses",
            status=Status.WARN,
        )  # fmt: skip


def _held(motion: Motion) -> Finding:
    """Poses that repeat the previous one while the vehicle moves."""
    same = (np.diff(motion.position, axis=0) == 0).all(axis=1) & motion.moving
    share = float(same.sum() / motion.moving.sum())
    jump_m = float(motion.step_m[1:][same[:-1]].max(initial=0.0))
    return judge(
        "repeated poses", "poses", share, _HELD, "",
        fine="no pose repeats the previous one while the vehicle moves",
        wrong=f"{100 * share:.0f} % of the poses repeat the previous one while the vehicle moves, up to "
        f"{jump_m:.2f} m off: the log is faster than the receiver, or the receiver froze; drop the repeats",
    )  # fmt: skip


def _posed(drive: Drive, name: str, posed: int) -> Finding:
    without = drive.unposed.get(name, 0)
    share = without / max(1, posed + without)
    cause = (
        "poses and images overlap only in part, or the poses have gaps; check that both are from the same "
        "drive and on one clock"
    )
    if name in drive.listed_s and drive.recorded is not None:
        clocks = known_offset(drive.listed_s[name], drive.recorded.stamp_s)
        cause = clocks or cause
    return judge(
        "images without pose", name, share, _WITHOUT_POSE, "",
        fine="the images have poses",
        wrong=f"{without} of {posed + without} images have no pose at their time: {cause}",
        status=Status.FAIL if share > _HALF else Status.WARN,
    )  # fmt: skip


def _overlap(spans: dict[str, tuple[float, float]], name: str) -> Finding:
    """The fraction of all cameras' recording time that this one misses."""
    start = min(first for first, _ in spans.values())
    end = max(last for _, last in spans.values())
    missed = 1 - (spans[name][1] - spans[name][0]) / max(end - start, 1e-9)
    return judge(
        "camera span", name, missed, _HALF / 2, "",
        fine="the camera records as long as the others",
        wrong=f"the camera misses {100 * missed:.0f} % of the time that another records; check that its "
        "stamps are on the common clock",
        status=Status.WARN,
    )  # fmt: skip


def _spacing(drive: Drive, motion: Motion, name: str) -> Iterator[Finding]:
    """Distance between images where the vehicle moves, against the depth of the ROI."""
    centres = np.array([image.map_from_vehicle[:2, 3] for image in drive.images if image.camera == name])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    steps = steps[steps > 0]
    if not len(steps) or not len(motion.chords):
        return
    depth_m = float(np.ptp(drive.cameras[name].roi_vehicle[:, 0]))
    spacing_m = float(np.median(steps))
    yield judge(
        "image spacing", name, spacing_m, depth_m / _VIEWS, "m",
        fine="markings stay in the ROI for several images",
        wrong=f"images are {spacing_m:.1f} m apart and the ROI is {depth_m:.1f} m deep: markings are "
        "seen less than twice; drive slower, record more images or enlarge roi_vehicle",
        status=Status.WARN,
    )  # fmt: skip


def check_images(drive: Drive) -> list[Finding]:
    """Whether each camera's images differ while it moves, and show road; DriveError for a damaged one."""
    findings = _shared(drive)
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        if len(images) >= 2:
            findings += [_frozen(name, images), *_exposure(name, camera, images)]
    return findings


def _shared(drive: Drive) -> list[Finding]:
    """Images listed for two cameras."""
    owner: dict[Path, str] = {}
    for image in drive.images:
        other = owner.setdefault(image.path.resolve(), image.camera)
        if other != image.camera:
            says = f"the images are those of camera '{other}' given twice; give this one its own list"
            return [Finding("own images", Status.FAIL, 1.0, 0.0, "", says, image.camera)]
    return []


def _frozen(name: str, images: Sequence[Image]) -> Finding:
    """The fraction of images that repeat the previous one while the vehicle moves."""
    steps_m = np.diff([image.map_from_vehicle[:2, 3] for image in images], axis=0)
    moving = (np.flatnonzero(np.linalg.norm(steps_m, axis=1) > _MOVED_M) + 1).tolist()
    if not moving:
        says = "the vehicle does not move between the images, so repeated ones cannot be recognised"
        return passed("frozen images", name, says)
    copied = [k for k in moving if filecmp.cmp(images[k - 1].path, images[k].path, shallow=False)]
    share = len(copied) / len(moving)
    at = copied
    if share <= _FROZEN:
        sampled = _spread(moving, _SAMPLES)
        alike = [k for k in sampled if _alike(images[k - 1].path, images[k].path)]
        if len(alike) > 1:  # one alone may be a dropped frame
            share = len(alike) / len(sampled)
            at = alike
    if share <= _FROZEN:
        # Within a run of successive numbers, number minus index is constant.
        runs = [
            [k for _, k in run]
            for _, run in groupby(enumerate(copied), lambda numbered: numbered[1] - numbered[0])
        ]
        longest = max(runs, key=len, default=[])
        if len(longest) >= _STUCK:
            says = (
                f"{len(longest) + 1} images in a row from {images[longest[0] - 1].stamp_s:.2f} s on are one "
                "and the same while the vehicle moves: the camera froze there; drop the repeats from the list"
            )
            return Finding("frozen images", Status.WARN, float(len(longest)), _STUCK - 1.0, "", says, name)
    where = f", first at {images[at[0]].stamp_s:.2f} s" if at else ""
    return judge(
        "frozen images", name, share, _FROZEN, "",
        fine="each image differs from the previous one",
        wrong=f"{100 * share:.0f} % of the images repeat the one before while the vehicle moves{where}: the "
        "camera froze, or one file is listed several times; drop the repeats from the list",
    )  # fmt: skip


def _exposure(name: str, camera: Camera, images: Sequence[Image]) -> Iterator[Finding]:
    """The clipped fraction of the ROI in sampled images."""
    first, *others = _spread(images, _SAMPLES)
    greys = [_read(first.path)]
    mask = _roi_mask(camera, greys[0])
    if not mask.any():
        return
    greys += [_read(image.path) for image in others]
    bright = [float((grey[mask] >= _BRIGHTEST).mean()) for grey in greys]
    dark = [float((grey[mask] <= _DARKEST).mean()) for grey in greys]
    for check, shares, how, cause in (
        ("bright images", bright, "clipped to white", "overexposed"),
        ("dark images", dark, "black", "underexposed, or the lens is covered"),
    ):
        share = float(np.median(shares))
        yield judge(
            check, name, share, _CLIPPED, "",
            fine="the road is well exposed",
            wrong=f"{100 * share:.0f} % of the road in the ROI is {how}: the images are {cause}; set the "
            "camera's exposure for the road",
            status=Status.WARN,
        )  # fmt: skip


def _alike(first: Path, second: Path) -> bool:
    grey = _read(first)
    other = _read(second)
    return grey.shape == other.shape and float(cv2.absdiff(grey, other).mean()) < _SAME_GREY


def _read(path: Path) -> np.ndarray:
    """Grey values of an image at a quarter of its size."""
    return read_pixels(path, cv2.IMREAD_REDUCED_GRAYSCALE_4)


def _roi_mask(camera: Camera, grey: np.ndarray) -> np.ndarray:
    """Pixels of the reduced image that show the ROI under the guess."""
    pinhole = apply_homography(np.asarray(np.linalg.inv(camera.ipm[camera.initial_ipm])), camera.roi_vehicle)
    corners = distort_points(camera.info, pinhole) / _REDUCED
    mask = np.zeros(grey.shape, np.uint8)
    limit = 4.0 * max(grey.shape)
    cv2.fillConvexPoly(mask, np.round(np.clip(corners, -limit, limit)).astype(np.int32), 1)
    return mask.astype(bool)


def _spread(items: Sequence[_Item], count: int) -> list[_Item]:
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]
