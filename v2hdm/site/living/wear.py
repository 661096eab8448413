"""Fraction of paint left of each marking, from the nearest images.

Images are decoded to linear light, in which a pixel half on paint lies half way, and divided by the ground
beside the marking; a cell may be lit like either side, the nearer one more likely, as shadow edges often
cross. Each cell takes the median of images that show all corners. Cells are then a mixture of full paint,
bare ground and partial paint; the contrast of full paint is the marking's own, with a prior from its class:
dirt dims whole paint.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr

from v2hdm.densities import log_normal_density, normal_density
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import Quad
from v2hdm.geometry.rigid import inverse
from v2hdm.records import Calibration, FloatArray, HDMap, Image, PaintLeft
from v2hdm.surface.surface import Surface

_CELL_M = 0.02  # size of a cell of a marking, m
_EDGE_M = 0.03  # margin inside the sides that is left out, m: blurred, and uncertain by pose errors
_BESIDE_M = np.array([0.06, 0.10, 0.14, 0.18])  # distances, m, from the long sides at which ground is sampled
_MOST_CELLS = (60, 24)  # most cells of a marking along and across

_NEAR_M = 12.0  # largest range, m, at which images resolve flakes of paint
_VIEWS = (2, 6)  # fewest and most images of a marking: errors of more repeat

_GROUND_SIGMA = 0.08  # sigma of the contrast of bare ground (43 rendered markings)
_PAINT_SIGMA = 0.09  # sigma of the contrast of full paint, as a share of that contrast (the same markings)
_INDEPENDENT = 12.0  # cells that count as independent: flakes, stains and the blur of images span many
_CONTRASTS = np.exp(np.linspace(np.log(0.2), np.log(4.0), 28))
"""Contrasts of full paint over its ground that are tested."""

_AHEAD = 4  # most decoded images in memory for each thread that reads; chosen
_ROUNDS = 12  # rounds of expectation maximisation
_FITTED = 160  # most cells of a marking that take part in the fit

# Contrast of full paint of a class before its markings are seen; the prior is worth four markings.
_USUAL_LOG_CONTRAST = np.log(1.3)  # mean of its logarithm
_USUAL_SPREAD = 0.5  # standard deviation of its logarithm

_MODEL_SIGMA = (0.045, 0.3)
"""Sigma of a fraction beside the fit's, and its growth with wear: flakes finer than a pixel look like dirt, a
shadow narrower than a marking like wear (143 rendered markings of ports 5 to 8 and 11)."""


class Fit(NamedTuple):
    """A marking's paint under each of C contrasts of full paint, :data:`_CONTRASTS`."""

    log_likelihood: FloatArray  # (C,)
    share: FloatArray  # (C,) fraction of paint left
    sigma: FloatArray  # (C,) its standard deviation, from cells and images


@dataclass(frozen=True)
class Cells:
    """Points (along, across, 2) in and beside a marking; the first and last columns lie on the ground."""

    places_map: FloatArray
    contrasts: list[FloatArray]  # by image (3, along, across): over one side's ground, the other's, both

    @classmethod
    def of(cls, corners_map: FloatArray) -> Cells:
        """The cells of a marking's corners (4, 2)."""
        sides = np.linalg.norm(np.roll(corners_map, -1, axis=0) - corners_map, axis=1)
        if sides[1] + sides[3] > sides[0] + sides[2]:
            corners_map = np.roll(corners_map, -1, axis=0)
            sides = np.roll(sides, -1)
        length_m, width_m = (max(float(sides[k] + sides[k + 2]) / 2, 4 * _EDGE_M) for k in (0, 1))
        most_along, most_across = _MOST_CELLS
        along = _shares_of_side(length_m, 3, most_along)
        across = _shares_of_side(width_m, 2, most_across)
        across = np.concatenate([-_BESIDE_M[::-1] / width_m, across, 1 + _BESIDE_M / width_m])
        s, t = np.meshgrid(along, across, indexing="ij")
        places_map = Quad(corners_map).at(s.ravel(), t.ravel()).reshape(len(along), len(across), 2)
        return cls(places_map, [])

    def add(self, light: FloatArray) -> None:
        """Add the light (along, across) of one image."""
        count = len(_BESIDE_M)
        beside = _median_along(np.stack([light[:, :count], light[:, -count:]]))
        window = np.arange(len(light))[:, None] + np.arange(-4, 5)
        ground = _median_along(beside[:, np.clip(window, 0, len(light) - 1)])
        ground = np.stack([*ground, ground.mean(axis=0)])
        self.contrasts.append(light[:, count:-count] / np.maximum(ground, 1e-4)[..., None] - 1.0)

    def fit(self) -> Fit:
        """The paint left, by the contrast of full paint."""
        contrasts = np.clip(np.median(self.contrasts, axis=0), -0.5, 4.0)
        # A shadow's edge is anywhere between the sides.
        distance = np.broadcast_to(
            (np.arange(contrasts.shape[2]) + 0.5) / contrasts.shape[2], contrasts.shape[1:]
        )
        lit_like = np.stack([1 - distance, distance, np.full(distance.shape, 0.5)]).reshape(3, 1, -1) / 1.5
        contrasts = contrasts.reshape(3, 1, -1)
        step = -(-distance.size // _FITTED)
        cells = contrasts[..., ::step]
        lit_like = lit_like[..., ::step]
        paint = _CONTRASTS[:, None]
        sigma = np.hypot(_PAINT_SIGMA * _CONTRASTS, _GROUND_SIGMA)[:, None]
        partly = ndtr(cells / _GROUND_SIGMA) - ndtr((cells - paint) / sigma)
        bare = np.broadcast_to(normal_density(cells, 0.0, _GROUND_SIGMA), partly.shape)
        by_side = np.stack([normal_density(cells, paint, sigma), bare, np.maximum(partly, 0.0) / paint])
        densities = (by_side * lit_like).sum(axis=1) + 1e-6
        cells = (cells * lit_like).sum(axis=0)
        weight = np.broadcast_to(np.array([0.6, 0.2, 0.2])[:, None, None], (3, len(paint), 1))
        for _ in range(_ROUNDS):
            joint = weight * densities
            member = joint / joint.sum(axis=0)
            weight = (member.sum(axis=2, keepdims=True) + np.array([1.0, 0.3, 0.3])[:, None, None]) / (
                cells.size + 1.6
            )
        share = (member[0] + member[2] * np.clip(cells / paint, 0.0, 1.0)).mean(axis=1)
        log_likelihood = np.log((weight * densities).sum(axis=0)).sum(axis=1)
        doubt = 2 * (member[0] * member[1]).mean(axis=1)
        of_images = np.median(np.mean(self.contrasts, axis=1), axis=(1, 2)) / _CONTRASTS[:, None]
        scatter = np.median(np.abs(of_images - np.median(of_images, axis=1, keepdims=True)), axis=1)
        return Fit(log_likelihood * min(1.0, _INDEPENDENT / cells.size), share, np.hypot(doubt, scatter))


def _median_along(values: FloatArray) -> FloatArray:
    """Medians along the last axis of finite values; numpy's own take several times as long."""
    ordered = np.sort(values, axis=-1)
    count = values.shape[-1]
    return np.asarray(ordered[..., (count - 1) // 2 : count // 2 + 1].mean(axis=-1))


def _shares_of_side(side_m: float, least: int, most: int) -> FloatArray:
    """Cells along a side, as fractions of its length, ``least`` to ``most`` of them."""
    count = int(np.clip((side_m - 2 * _EDGE_M) / _CELL_M, least, most))
    return np.linspace(_EDGE_M / side_m, 1 - _EDGE_M / side_m, count)


def with_wear(
    hd_map: HDMap,
    footage: Footage,
    colours: Callable[[Image], NDArray[np.uint8]],
    shown: Set[tuple[int, int]],
    earlier: HDMap | None = None,
    threads: int = 1,
) -> HDMap:
    """``hd_map`` with the fraction of paint left of each marking that two or more images show near.

    ``colours`` reads an image (H, W, 3) of the ``footage``; ``shown`` are (image, marking) pairs without
    occlusion. A marking of the ``earlier`` map with the same id states the change, and keeps its value if
    unseen here.
    """
    cells = [Cells.of(marking.corners_map) for marking in hd_map.markings]
    for number, light in _lights(cells, footage, _best_views(cells, footage, shown), colours, threads):
        cells[number].add(light)
    measured = [k for k, cells_of_marking in enumerate(cells) if len(cells_of_marking.contrasts) >= _VIEWS[0]]
    shares = _shares([cells[k].fit() for k in measured], [hd_map.markings[k].kind for k in measured])
    earlier_paint_of_id = (
        {} if earlier is None else {marking.id: marking.paint for marking in earlier.markings}
    )
    paint_of_marking = dict(zip(measured, shares, strict=True))
    markings = []
    for k, marking in enumerate(hd_map.markings):
        earlier_paint = earlier_paint_of_id.get(marking.id) if marking.id is not None else None
        paint = paint_of_marking[k].since(earlier_paint) if k in paint_of_marking else earlier_paint
        markings.append(replace(marking, paint=paint))
    return replace(hd_map, markings=tuple(markings))


def _shares(fits: Sequence[Fit], kinds: Sequence[str]) -> list[PaintLeft]:
    """The fractions, with the contrast of full paint learned per class."""
    paint_of_fit: dict[int, PaintLeft] = {}
    log_contrasts = np.log(_CONTRASTS)
    for kind in set(kinds):
        members = [k for k, kind_of_marking in enumerate(kinds) if kind_of_marking == kind]
        likelihood = np.stack([fits[k].log_likelihood for k in members])
        share = np.stack([fits[k].share for k in members])
        own_sigma = np.stack([fits[k].sigma for k in members])
        middle = _USUAL_LOG_CONTRAST
        spread = _USUAL_SPREAD
        for _ in range(3):
            log_posterior = likelihood + log_normal_density(log_contrasts, middle, spread)
            posterior = np.exp(log_posterior - log_posterior.max(axis=1, keepdims=True))
            posterior /= posterior.sum(axis=1, keepdims=True)
            log_contrast = posterior @ log_contrasts
            # A small class keeps to the wide prior, which is worth four markings.
            middle = (log_contrast.sum() + 4 * _USUAL_LOG_CONTRAST) / (len(members) + 4)
            squared = ((log_contrast - middle) ** 2).sum() + 4 * _USUAL_SPREAD**2
            spread = float(np.sqrt(squared / (len(members) + 4)))
        mean = (posterior * share).sum(axis=1)
        variance = (posterior * ((share - mean[:, None]) ** 2 + own_sigma**2)).sum(axis=1)
        floor, growth = _MODEL_SIGMA
        sigma = np.sqrt(variance + floor**2 + (growth * (1.0 - mean)) ** 2)
        paint_of_fit |= {
            k: PaintLeft(float(m), float(s)) for k, m, s in zip(members, mean, sigma, strict=True)
        }
    return [paint_of_fit[k] for k in range(len(kinds))]


_GREY = np.arange(256, dtype=np.float32) / 255  # grey values of sRGB, relative to white
_LIGHT = np.where(_GREY <= 0.04045, _GREY / 12.92, ((_GREY + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear light by the grey value (0 to 255) of sRGB, an adequate model of cameras for a ratio."""


@dataclass(frozen=True)
class Footage:
    """Images with their poses (4, 4) on the flat road, their calibrations, and the ground unless a plane."""

    images: Sequence[Image]
    map_from_vehicle: Sequence[FloatArray]
    calibrations: Mapping[str, Calibration]
    ground: Surface | None

    def read(
        self, indices: Sequence[int], pixels_of: Callable[[Image], np.ndarray], threads: int
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Indices and pixels of these images, in order; threads read a few ahead."""
        with ThreadPoolExecutor(threads) as readers:
            coming: deque[Future[np.ndarray]] = deque()
            for number, index in enumerate(indices):
                for index_ahead in indices[number + len(coming) : number + _AHEAD * threads]:
                    coming.append(readers.submit(pixels_of, self.images[index_ahead]))
                yield index, coming.popleft().result()

    def pinhole_px(self, index: int, places_map: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pinhole px (N, 2) and depth (N,), m, of ground points (N, 2) in an image."""
        calibration = self.calibrations[self.images[index].camera]
        cam_from_map = calibration.cam_from_vehicle @ inverse(self.map_from_vehicle[index])
        if self.ground is not None:
            places_map = self.ground.on_plane(places_map, cam_from_map, index)
        return project_ground(calibration.info.intrinsic, cam_from_map, places_map)


def _best_views(
    cells: Sequence[Cells], footage: Footage, shown: Set[tuple[int, int]]
) -> dict[int, list[int]]:
    """By image, the markings that it shows whole, as one of the nearest images of each."""
    if not cells:
        return {}
    tree = cKDTree([cells_of_marking.places_map.mean(axis=(0, 1)) for cells_of_marking in cells])
    corners_map = np.array([of_marking.places_map[[0, 0, -1, -1], [0, -1, 0, -1]] for of_marking in cells])
    views: list[list[tuple[float, int]]] = [[] for _ in cells]
    for index, (image, pose) in enumerate(zip(footage.images, footage.map_from_vehicle, strict=True)):
        if image.camera not in footage.calibrations:
            continue
        info = footage.calibrations[image.camera].info
        neighbours = tree.query_ball_point(pose[:2, 3], _NEAR_M)
        numbers = np.array([number for number in neighbours if (index, number) in shown], dtype=np.intp)
        if not len(numbers):
            continue
        corners = corners_map[numbers]
        pinhole, depth_m = footage.pinhole_px(index, corners.reshape(-1, 2))
        before = (depth_m.reshape(-1, 4) > 0.3).all(axis=1)
        px = distort_points(info, pinhole.reshape(-1, 4, 2)[before].reshape(-1, 2)).reshape(-1, 4, 2)
        is_seen = ((px >= 2) & (px <= (info.width - 3, info.height - 3))).all(axis=(1, 2))
        range_m = np.linalg.norm(corners[before][is_seen].mean(axis=1) - pose[:2, 3], axis=1)
        for number, away_m in zip(numbers[before][is_seen].tolist(), range_m.tolist(), strict=True):
            views[number].append((away_m, index))
    markings_of_image: dict[int, list[int]] = {}
    fewest, most = _VIEWS
    for number, views_of_marking in enumerate(views):
        if len(views_of_marking) < fewest:
            continue
        for _, index in sorted(views_of_marking)[:most]:
            markings_of_image.setdefault(index, []).append(number)
    return markings_of_image


def _lights(
    cells: Sequence[Cells],
    footage: Footage,
    markings_of_image: Mapping[int, Sequence[int]],
    colours: Callable[[Image], NDArray[np.uint8]],
    threads: int,
) -> Iterator[tuple[int, FloatArray]]:
    """Each wanted marking of each image, and the light of its cells (along, across) there."""
    for index, pixels in footage.read(sorted(markings_of_image), colours, threads):
        info = footage.calibrations[footage.images[index].camera].info
        places_map = [cells[number].places_map for number in markings_of_image[index]]
        flat_map = np.concatenate([places.reshape(-1, 2) for places in places_map])
        px = distort_points(info, footage.pinhole_px(index, flat_map)[0])
        parts = np.split(px, np.cumsum([places.size // 2 for places in places_map])[:-1])
        for number, places, part in zip(markings_of_image[index], places_map, parts, strict=True):
            yield number, _light_at(part.reshape(places.shape), pixels)


def _light_at(px: FloatArray, pixels: NDArray[np.uint8]) -> FloatArray:
    """Light (along, across) at px (along, across, 2) of an image (H, W, 3)."""
    # The few pixels around a marking alone are converted, not the whole image.
    first = np.clip(np.floor(px.min(axis=(0, 1))), 0, None).astype(np.intp)
    last = np.ceil(px.max(axis=(0, 1))).astype(np.intp)
    around = pixels[first[1] : last[1] + 1, first[0] : last[0] + 1]
    blue, green, red = np.moveaxis(around.astype(np.uint16), 2, 0)
    light = _LIGHT[(blue + green + red) // 3]
    x, y = np.moveaxis(px.astype(np.float32) - first.astype(np.float32), 2, 0)
    return np.asarray(cv2.remap(light, x, y, cv2.INTER_LINEAR), dtype=np.float64)
