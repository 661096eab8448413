"""Labels from a finished map: its markings in every image of its drive, and which images hide them.

A marking that some images were mapped by is projected into all others by the adjusted calibration and poses:
corners to a fraction of a pixel, without a human hand. Whether an image shows it follows from all of them:
each side of an outline has a contrast to the ground beside it, which those images state that it was detected
in; whatever stands before it has another one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from v2hdm.association.sightings import row_shares
from v2hdm.catalogue import AREA, SHIPPED
from v2hdm.densities import log_normal_density
from v2hdm.detection.frames import read_image
from v2hdm.errors import ConfigError, MapFileError
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points, has_distortion
from v2hdm.geometry.planar import clip_convex, clip_half, densified, rectangle_size, signed_area
from v2hdm.geometry.rigid import camera_centre, interpolate, inverse
from v2hdm.progress import Steps
from v2hdm.records import (
    ACCURACIES,
    CROSSWALK,
    SIGMA_OF_MAD,
    BoolArray,
    CameraInfo,
    Drive,
    FloatArray,
    Image,
    IntArray,
    Trajectory,
)
from v2hdm.report.page.facts import CameraFacts, Facts, read_facts
from v2hdm.safe.pixels import grey_of
from v2hdm.site.living.looks import HIDDEN_SIGMA
from v2hdm.store.files import write_json
from v2hdm.surface.surface import Surface

FILE = "instances.json"
RANGE_M = 16.0  # how far from a camera markings are labelled: farther ones need not be in the map
UNKNOWN = "unknown"  # the category of what nobody knows, as `data.coco_classes` calls it

_AREAS = SHIPPED.of_family(AREA)

# States of a marking in an image, and their places in arrays of probabilities.
SHOWN, HIDDEN, PARTLY = range(3)

_SURE = 0.9  # posterior probability from which a marking counts as shown, or as hidden

_PRIOR = np.array([6.0, 3.0, 1.0])
"""Dirichlet prior of that an image in which a marking was not detected shows, hides or partly hides it."""

_DETECTED = np.array([0.98, 0.005, 0.015])
"""Probability that an image in which a marking was detected shows, hides or partly hides it."""

_FAINT_SHARE = 0.1  # share of the sides that are faint where shown
_ALIKE = 0.5  # power of the likelihood of one side: the four of one image err alike
_PAIRS_OF_BIN = 100  # least detected sides to learn the contrasts of one size in the image
_MOST_BINS = 8  # most sizes in the image with contrasts of their own
_LEAST_PAIRS = 8  # detected sides below which nothing is said of images without a detection
_LEAST_SIGMA = 0.03  # least standard deviation of a side's contrast about the expected one
_LEAST_IMAGES = 3  # images with a detection from which a side's contrast is taken from these alone
_LEAST_CORNERS = 3  # corners accepted as points from which a marking counts as detected in an image

_NEAREST_M = 0.3  # depth, m, below which ground is cut off
_LEAST_PX2 = 2.0  # area of the smallest piece that is labelled, px^2
_INSIDE_M = 0.06  # distance inside an edge, m, at most at which paint is sampled
_BESIDE_M = (0.1, 0.18)  # distances outside an edge, m, at which ground is sampled
_SAMPLES = 7  # samples along the middle part of an edge
_CLEAR_M = 1.0  # radius about a rejected candidate, m, that is labelled as unknown


@dataclass(frozen=True)
class _Outline:
    """One marking or symbol, counter-clockwise, and the samples beside its four sides or runs of edges."""

    id: int
    kind: str
    outline_map: FloatArray  # (N, 2)
    inside_map: FloatArray  # (K, 2) samples of paint
    beside_map: FloatArray  # (K, 2) samples of ground
    side: IntArray  # (K,) of each sample

    @classmethod
    def of(cls, number: int, kind: str, outline_map: FloatArray) -> _Outline:
        """With samples at the middle parts of all edges."""
        inset_m = min(_INSIDE_M, 0.3 * rectangle_size(outline_map)[1])
        ahead = np.roll(outline_map, -1, axis=0)
        inside = []
        beside = []
        side = []
        for n, (start, end) in enumerate(zip(outline_map, ahead, strict=True)):
            along = end - start
            outwards = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
            middle = start + np.linspace(0.2, 0.8, _SAMPLES)[:, None] * along
            for away_m in _BESIDE_M:
                inside.append(middle - inset_m * outwards)
                beside.append(middle + away_m * outwards)
            side += [4 * n // len(outline_map)] * (_SAMPLES * len(_BESIDE_M))
        return cls(number, kind, outline_map, np.concatenate(inside), np.concatenate(beside), np.array(side))


@dataclass(frozen=True)
class _View:
    """One outline in one image."""

    outline: int
    image: int
    polygon_px: FloatArray  # (N, 2) recorded px, the part in the image
    whole: bool  # that part is all of it
    contrast: FloatArray  # (4,) of each side, log ratio of grey values, or nan
    px_per_m: float  # how large a metre of it is
    detected: bool


@dataclass(frozen=True)
class _Eye:
    """An image's camera and its poses while the rows were read."""

    info: CameraInfo
    cam_from_map: FloatArray  # (2, 4, 4), when the first and the last row was read
    ground: Surface | None  # under the vehicle at these two times

    @classmethod
    def of(cls, image: Image, camera: CameraFacts, facts: Facts) -> _Eye:
        """By the adjusted poses of the run."""
        info = camera.calibration.info
        route = facts.route
        assert route is not None
        read_out_s = camera.read_out_s or 0.0
        taken_s = image.stamp_s + (camera.clock_offset_s or 0.0) + np.array([-0.5, 0.5]) * read_out_s
        poses = interpolate(Trajectory(route.stamp_s, route.flat), taken_s, np.inf)[0]
        ground = None if facts.surface is None else facts.surface.seen_from(poses)
        return cls(info, camera.calibration.cam_from_vehicle @ inverse(poses), ground)

    def project(self, points_map: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Recorded px (N, 2) of ground points (N, 2), and their depths (N,), m."""
        first_pose, last_pose = self.cam_from_map
        first_points = points_map
        last_points = points_map
        if self.ground is not None:
            first_points = self.ground.on_plane(points_map, first_pose, 0)
            last_points = self.ground.on_plane(points_map, last_pose, 1)
        first_px, depth_m = project_ground(self.info.intrinsic, first_pose, first_points)
        last_px, _ = project_ground(self.info.intrinsic, last_pose, last_points)
        px = distort_points(self.info, (first_px + last_px) / 2)
        if np.array_equal(first_pose, last_pose):
            return px, depth_m
        share = (row_shares(self.info, px) + 0.5)[:, None]
        return distort_points(self.info, (1 - share) * first_px + share * last_px), depth_m

    def polygon(self, outline_map: FloatArray) -> tuple[FloatArray, bool]:
        """The part (N, 2), recorded px, of an outline inside the image, and whether it is all of it."""
        depth_m = self.project(outline_map)[1]
        part = outline_map
        if (depth_m < _NEAREST_M).any():
            part = clip_half(outline_map, depth_m - _NEAREST_M)
        if has_distortion(self.info):  # lenses bend sides
            part = densified(part, 6)
        if not len(part):
            return part, False
        px = self.project(part)[0]
        last = np.array([self.info.width, self.info.height]) - 0.5
        window = np.array([[-0.5, -0.5], [last[0], -0.5], last, [-0.5, last[1]]])
        inside = bool((px >= -0.5).all() and (px <= last).all())
        return (px if inside else clip_convex(px, window)), inside and len(part) >= len(outline_map)

    def contrast(self, grey: NDArray[np.float32], outline: _Outline) -> FloatArray:
        """The contrast (4,) of each side, log ratio of grey values; nan where no sample is in the image."""
        values = []
        for points_map in (outline.inside_map, outline.beside_map):
            px, depth_m = self.project(points_map)
            px = np.where((depth_m > _NEAREST_M)[:, None], px, -9.0).astype(np.float32)
            sampled = cv2.remap(grey, px[None, :, 0], px[None, :, 1], cv2.INTER_LINEAR, borderValue=-1e4)[0]
            values.append(np.where(sampled < 0, np.nan, sampled + 1.0))
        ratio = np.log(values[0] / values[1])
        contrast = np.full(4, np.nan)
        for side in range(4):
            of_side = ratio[outline.side == side]
            of_side = of_side[np.isfinite(of_side)]
            contrast[side] = np.mean(of_side) if len(of_side) else np.nan
        return contrast


def write_labels(
    folder: Path, drive: Drive, output: Path, range_m: float = RANGE_M, progress: Steps | None = None
) -> dict[str, int]:
    """Write ``instances.json`` (COCO) of a result's map in all images of its drive into ``output``.

    Its ``file_name`` entries start from the drive's folder; markings are labelled up to ``range_m`` from a
    camera. Returns how many are whole and shown ("shown"), of unsure visibility ("unsure"), and in view but
    hidden ("hidden"). Raises MapFileError where the folder is no result or its verdict is FAIL, DriveError
    where an image cannot be read, ConfigError for a range that is not positive.
    """
    if not 0 < range_m < np.inf:
        raise ConfigError(f"a range of {range_m:g} m holds no labels; give metres, such as 16")
    facts = read_facts(folder, drive)
    status = (facts.metrics.get("verdict") or {}).get("status")
    if facts.hd_map is None or facts.route is None or status not in ("PASS", "WARN"):
        raise MapFileError(
            f"{folder}: its verdict is {status or 'missing'}: labels of a map that may be wrong would teach "
            "what is wrong; fix the drive (docs/verdict.md) and map it again"
        )
    outlines = [
        _Outline.of(marking.id or 0, marking.kind, marking.corners_map)
        for marking in facts.hd_map.markings
        if marking.accuracy != ACCURACIES[-1]
    ]
    outlines += [
        _Outline.of(symbol.id or 0, symbol.kind, symbol.outline_map)
        for symbol in facts.hd_map.symbols
        if symbol.accuracy != ACCURACIES[-1] and symbol.kind not in (CROSSWALK, *_AREAS)
    ]
    detected_in = _detected(facts)
    images: list[Image] = []
    views: list[_View] = []
    silent: list[tuple[int, FloatArray]] = []
    for number, image in enumerate(drive.images):
        if image.camera in facts.cameras:
            eye = _Eye.of(image, facts.cameras[image.camera], facts)
            grey = grey_of(read_image(image, drive.cameras[image.camera]))
            detected = detected_in.get(drive.name_of(image.path), set())
            views += _views(eye, grey, outlines, len(images), detected, range_m)
            silent += [(len(images), polygon) for polygon in _silent(eye, facts, range_m)]
            images.append(image)
        if progress:
            progress(number + 1, len(drive.images))
    states = _states(views, len(outlines))
    write_json(output / FILE, _coco(drive, images, outlines, views, states, silent))
    names = {SHOWN: "shown", HIDDEN: "hidden", PARTLY: "unsure"}
    counted = Counter(names[state] for state in states.tolist())
    return {"images": len(images), **{name: counted[name] for name in names.values()}}


def _detected(facts: Facts) -> Mapping[str, set[int]]:
    """For each image, the markings with three or more corners that the mapping accepted as points."""
    residuals = facts.residuals
    detected = dict[str, set[int]]()
    if residuals is not None:
        used = residuals.is_point & (residuals.marking > 0)
        pairs = np.stack([residuals.row_image[used], residuals.marking[used]], axis=1)
        unique_pairs, corners = np.unique(pairs, axis=0, return_counts=True)
        for row, marking in unique_pairs[corners >= _LEAST_CORNERS]:
            detected.setdefault(residuals.image[row], set()).add(int(marking))
    return detected


def _views(
    eye: _Eye,
    grey: NDArray[np.float32],
    outlines: Sequence[_Outline],
    image: int,
    detected: set[int],
    range_m: float,
) -> list[_View]:
    """The parts of the outlines that lie in an image, within range."""
    foot = camera_centre(eye.cam_from_map[:1])[0, :2]
    views = []
    for number, outline in enumerate(outlines):
        if np.linalg.norm(outline.outline_map - foot, axis=1).min() > range_m:
            continue
        polygon, whole = eye.polygon(outline.outline_map)
        area_px2 = abs(float(signed_area(polygon))) if len(polygon) > 2 else 0.0
        if area_px2 >= _LEAST_PX2:
            size = np.sqrt(area_px2 / abs(float(signed_area(outline.outline_map))))
            contrast = eye.contrast(grey, outline)
            views.append(_View(number, image, polygon, whole, contrast, size, outline.id in detected))
    return views


def _silent(eye: _Eye, facts: Facts, range_m: float) -> list[FloatArray]:
    """Polygons of an image where the map is silent: ground beyond the range, rejected candidates.

    Markings and symbols of accuracy C are candidates here: labels have to be right to some pixels.
    """
    centre = camera_centre(eye.cam_from_map[:1])[0]
    view = eye.cam_from_map[0, 2, :2]
    ahead = np.arctan2(view[1], view[0]) + np.linspace(-1.2, 1.2, 25)
    arc = np.column_stack([np.cos(ahead), np.sin(ahead)])
    beyond = np.concatenate([centre[:2] + range_m * arc, centre[:2] + 1e3 * arc[::-1]])
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    disc = _CLEAR_M * np.column_stack([np.cos(turn), np.sin(turn)])
    places = [exclusion.position_map for exclusion in facts.excluded]
    in_range = [place for place in places if np.linalg.norm(place - centre[:2]) < range_m + _CLEAR_M]
    coarse = _coarse_outlines(facts)
    coarse_in_range = [
        outline for outline in coarse if np.linalg.norm(outline - centre[:2], axis=1).min() < range_m
    ]
    outlines = [beyond, *(place + disc for place in in_range), *coarse_in_range]
    polygons = [eye.polygon(outline)[0] for outline in outlines]
    return [
        polygon for polygon in polygons if len(polygon) > 2 and abs(float(signed_area(polygon))) >= _LEAST_PX2
    ]


def _coarse_outlines(facts: Facts) -> list[FloatArray]:
    """Outlines (N, 2), m, of the markings and symbols of accuracy C, and of areas: paint and ground."""
    hd_map = facts.hd_map
    if hd_map is None:
        return []
    worst = ACCURACIES[-1]
    corners = [marking.corners_map for marking in hd_map.markings if marking.accuracy == worst]
    symbols = [symbol for symbol in hd_map.symbols if symbol.accuracy == worst or symbol.kind in _AREAS]
    return corners + [symbol.outline_map for symbol in symbols if symbol.kind != CROSSWALK]


def _states(views: Sequence[_View], outlines: int) -> IntArray:
    """Whether each view is shown, hidden, or partly so or unsure (V,), by the contrasts of all of them."""
    if not views:
        return np.zeros(0, dtype=np.int64)
    contrast = np.stack([view.contrast for view in views])
    detected = np.array([view.detected for view in views])
    outline = np.array([view.outline for view in views])
    usual = _usual_contrasts(contrast, outline, detected, outlines)[outline]
    size = np.array([view.px_per_m for view in views])
    expected, sigma = _expected(contrast, usual, size, detected)
    is_known = np.isfinite(contrast) & np.isfinite(usual)
    off = np.where(is_known, contrast - expected, 0.0)
    faint = log_normal_density(np.where(is_known, contrast - usual / 2, 0.0), 0.0, np.abs(usual) / 3 + sigma)
    clear = np.log1p(-_FAINT_SHARE) + log_normal_density(off, 0.0, sigma)
    shown = logsumexp([clear, np.log(_FAINT_SHARE) + faint], axis=0)
    hidden = log_normal_density(np.where(is_known, contrast, 0.0), 0.0, HIDDEN_SIGMA)
    either = np.logaddexp(shown, hidden) + np.log(0.5)
    sides = np.where(is_known[..., None], _ALIKE * np.stack([shown, hidden, either], axis=2), 0.0).sum(axis=1)
    share = _PRIOR / _PRIOR.sum()
    posterior = np.zeros((len(views), 3))
    for _ in range(10):  # settles within five
        prior = np.where(detected[:, None], _DETECTED, share)
        posterior = sides + np.log(prior)
        posterior = np.exp(posterior - logsumexp(posterior, axis=1, keepdims=True))
        share = (_PRIOR + posterior[~detected].sum(axis=0)) / (_PRIOR.sum() + (~detected).sum())
    states = np.full(len(views), PARTLY)
    states[posterior[:, SHOWN] >= _SURE] = SHOWN
    states[posterior[:, HIDDEN] >= _SURE] = HIDDEN
    states[~is_known.any(axis=1) & ~detected] = PARTLY
    return states


def _usual_contrasts(contrast: FloatArray, outline: IntArray, detected: BoolArray, count: int) -> FloatArray:
    """The contrast of sides (count, 4) by the images that an outline was detected in, if three, else all."""
    usual = np.full((count, 4), np.nan)
    for number in range(count):
        of_outline = outline == number
        if np.count_nonzero(of_outline & detected) >= _LEAST_IMAGES:
            of_outline &= detected
        values = contrast[of_outline]
        for side in range(4):
            of_side = values[np.isfinite(values[:, side]), side]
            usual[number, side] = np.median(of_side) if len(of_side) else np.nan
    return usual


def _expected(
    contrast: FloatArray, usual: FloatArray, size: FloatArray, detected: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Contrast (V, 4) and its sigma that sides have when shown, by how large a metre is in the image."""
    used = np.isfinite(contrast) & np.isfinite(usual) & detected[:, None]
    if used.sum() < _LEAST_PAIRS:
        return usual, np.full_like(usual, HIDDEN_SIGMA)
    order = np.sort(np.broadcast_to(size[:, None], used.shape)[used])
    bins = max(1, min(_MOST_BINS, len(order) // _PAIRS_OF_BIN))
    bin_of_view = np.searchsorted(order[:: -(-len(order) // bins)][1:], size)
    factor = np.ones(len(size))
    sigma = np.full(len(size), HIDDEN_SIGMA)
    for number in np.unique(bin_of_view):
        in_bin = bin_of_view == number
        rows = used & in_bin[:, None]
        if rows.sum() < _LEAST_PAIRS:
            continue
        shown = contrast[rows]
        as_usual = usual[rows]
        ratio = float((shown * as_usual).sum() / max((as_usual * as_usual).sum(), 1e-9))
        factor[in_bin] = ratio
        sigma[in_bin] = max(SIGMA_OF_MAD * float(np.median(np.abs(shown - ratio * as_usual))), _LEAST_SIGMA)
    return factor[:, None] * usual, np.broadcast_to(sigma[:, None], usual.shape)


def _coco(
    drive: Drive,
    images: Sequence[Image],
    outlines: Sequence[_Outline],
    views: Sequence[_View],
    states: IntArray,
    silent: Sequence[tuple[int, FloatArray]],
) -> dict[str, Any]:
    """COCO instances; unsure shapes and unknown ground are ``iscrowd``."""
    kinds = sorted({outline.kind for outline in outlines})
    number_of = {kind: n for n, kind in enumerate([*kinds, UNKNOWN], start=1)}
    # A marking that reaches beyond the range comes after the ground there, which does not contain it.
    annotations = [_instance(number_of[UNKNOWN], image, polygon, True) for image, polygon in silent]
    annotations += [
        # COCO has its origin at the corner of the first pixel, this project at its centre.
        {
            **_instance(number_of[outlines[view.outline].kind], view.image, view.polygon_px, state == PARTLY),
            "marking": outlines[view.outline].id,
            "whole": view.whole,
        }
        for view, state in zip(views, states.tolist(), strict=True)
        if state != HIDDEN
    ]
    infos = [drive.cameras[image.camera].info for image in images]
    return {
        "info": {"description": f"map of drive {drive.name} in its images, by v2hdm labels"},
        "images": [
            {"id": n + 1, "file_name": drive.name_of(image.path), "width": info.width, "height": info.height}
            for n, (image, info) in enumerate(zip(images, infos, strict=True))
        ],
        "categories": [{"id": number, "name": kind} for kind, number in number_of.items()],
        "annotations": [{"id": n, **annotation} for n, annotation in enumerate(annotations, start=1)],
    }


def _instance(category: int, image: int, polygon_px: FloatArray, unsure: bool) -> dict[str, Any]:
    """A COCO annotation of one polygon (N, 2) in an image."""
    points = polygon_px + 0.5
    low = points.min(axis=0)
    high = points.max(axis=0)
    return {
        "image_id": image + 1,
        "category_id": category,
        "segmentation": [np.round(points, 3).ravel().tolist()],
        "bbox": np.round([*low, *(high - low)], 3).tolist(),
        "area": round(abs(float(signed_area(points))), 2),
        "iscrowd": int(unsure),
    }
