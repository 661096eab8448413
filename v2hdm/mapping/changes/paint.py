"""Whether images show paint, bare ground or something before it where a marking should be.

A marking that was found in no image may be gone, or it may be worn, or a parked truck may hide it. The
contrast of its outline's inside to the ground around it tells: bare ground has next to none. What contrast
paint has in this light, and bare ground between the markings, the drive's own markings say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logsumexp
from scipy.stats import norm

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.views import Views
from v2hdm.records import Camera, FloatArray, IntArray, Marking

Grey = Callable[[int], NDArray[np.float32]]
"""The grey values (H, W) of an image, by its number in the drive."""

_INSIDE = np.linspace(0.2, 0.8, 7)
"""Where along either side an outline's inside is sampled: off its edges, which a pose's error blurs."""

_BESIDE_M = (0.12, 0.25)
"""How far beside its edges the ground is sampled, m."""

_MOST_VIEWS = 6
"""Near views of a place that are looked at: the errors of more repeat themselves."""

_MOST_LEARNED = 40
"""Markings of a drive that its paint and its ground are learned from."""

_ASIDE_M = 1.3
"""How far beside a marking bare ground is looked for, m."""

_CLEAR_M = 1.0
"""Distance from all known paint that makes ground bare, m."""

_LEAST_LEARNED = 8
"""Places from which the drive's own paint or ground is known; with fewer nothing is said."""

_HIDDEN_SIGMA = 0.5
"""Sigma of the contrast, log ratio of grey values, of whatever else stands before the ground."""

_HIDDEN_SHARE = 0.5
"""Share of the markings which are there and not found that are hidden; the others are worn."""

_STRANGE_SHARE = 0.05
"""Share of bare places that are not: a stain, the edge of a shadow."""

_LEAST_SIGMA = 0.02
"""Floor of the sigma of bare ground's contrast: the grain of an image."""


@dataclass(frozen=True)
class Paint:
    """Contrasts of a drive's ``painted`` and ``bare`` places by mean and sigma, log ratios of grey values."""

    painted: tuple[float, float]
    bare: tuple[float, float]

    def log_there(self, contrast: FloatArray) -> FloatArray:
        """Log density (N,) of contrasts where there is a marking that was not found: worn, or hidden."""
        worn = norm.logpdf(contrast, self.painted[0] / 2, abs(self.painted[0]) / 3 + self.painted[1])
        hidden = norm.logpdf(contrast, 0.0, _HIDDEN_SIGMA)
        return _mixed(hidden, worn, _HIDDEN_SHARE)

    def log_bare(self, contrast: FloatArray) -> FloatArray:
        """Log density (N,) of contrasts of bare ground."""
        strange = norm.logpdf(contrast, 0.0, _HIDDEN_SIGMA)
        return _mixed(strange, norm.logpdf(contrast, *self.bare), _STRANGE_SHARE)


def _mixed(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    return np.asarray(logsumexp([np.log(share) + first, np.log1p(-share) + second], axis=0))


@dataclass(frozen=True)
class Pictures:
    """The images of a drive, and from where they were taken."""

    grey: Grey
    views: Views
    cameras: tuple[Camera, ...]
    rig: Rig

    def contrasts(self, corners_map: FloatArray, place: IntArray, image: IntArray) -> FloatArray:
        """The median contrast (N,) of places (N, 4, 2) over their nearest views; nan without a view.

        Pairs of ``place`` (P,) and ``image`` (P,) say which images have a place in view.
        """
        row_of = {int(one): row for row, one in enumerate(self.views.image)}
        wanted: dict[int, list[int]] = {}
        for number in range(len(corners_map)):
            rows = np.array([row_of[int(one)] for one in image[place == number]], dtype=np.int64)
            at = self.rig.map_from_vehicle[self.views.frame[rows]][:, :2, 3]
            away_m = np.linalg.norm(at - corners_map[number].mean(axis=0), axis=1)
            for row in rows[np.argsort(away_m)[:_MOST_VIEWS]].tolist():
                wanted.setdefault(row, []).append(number)
        found: list[list[float]] = [[] for _ in corners_map]
        for row, numbers in sorted(wanted.items()):
            grey = self.grey(int(self.views.image[row]))
            for number in numbers:
                found[number].append(self._contrast(grey, row, corners_map[number]))
        return np.array([np.nanmedian(own) if np.isfinite(own).any() else np.nan for own in found])

    def _contrast(self, grey: NDArray[np.float32], row: int, corners: FloatArray) -> float:
        """The log ratio of the mean grey values within an outline (4, 2) and beside it."""
        inside, beside = _samples(corners)
        camera = self.views.camera[row]
        cam_from_map = self.rig.cam_from_vehicle[camera] @ np.linalg.inv(
            self.rig.map_from_vehicle[self.views.frame[row]]
        )
        means = []
        for points in (inside, beside):
            pinhole, depth_m = project_ground(self.rig.intrinsic[camera], cam_from_map, points)
            if not (depth_m > 0).all():
                return float("nan")
            pixel = distort_points(self.cameras[camera].info, pinhole).astype(np.float32)
            values = cv2.remap(grey, pixel[None, :, 0], pixel[None, :, 1], cv2.INTER_LINEAR, borderValue=-1.0)
            if not (values >= 0).all():
                return float("nan")
            means.append(float(values.mean()) + 1.0)
        return float(np.log(means[0] / means[1]))


def _samples(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points within an outline (4, 2), and beside its four edges."""
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(_INSIDE, _INSIDE))
    a, b, c, d = corners
    inside = (1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d
    beside = []
    for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = second - first
        outwards = np.array([side[1], -side[0]]) / max(float(np.linalg.norm(side)), 1e-9)
        for away_m in _BESIDE_M:
            beside.append(first + _INSIDE[:, None] * side + away_m * outwards)
    return inside, np.concatenate(beside)


def learn_paint(
    pictures: Pictures,
    markings: Sequence[Marking],
    paint_map: FloatArray,
    near_views: Callable[[FloatArray], tuple[IntArray, IntArray]],
) -> Mapping[str, Paint]:
    """By class what contrast paint and bare ground have in a drive; classes of too few markings are left out.

    Args:
        pictures: its images.
        markings: of its own map.
        paint_map: (N, 2) places where there is, or was, paint.
        near_views: gives (place, image) of the views of places (N, 4, 2).
    """
    out = {}
    paint = cKDTree(paint_map)
    for kind in sorted({one.kind for one in markings}):
        own = np.stack([one.corners_map for one in markings if one.kind == kind])
        own = own[np.linspace(0, len(own) - 1, min(len(own), _MOST_LEARNED)).astype(int)]
        painted = pictures.contrasts(own, *near_views(own))
        aside = np.concatenate([own + _across(own, sign * _ASIDE_M)[:, None] for sign in (-1, 1)])
        clear = paint.query(aside.reshape(-1, 2))[0].reshape(-1, 4).min(axis=1) > _CLEAR_M
        bare = pictures.contrasts(aside[clear], *near_views(aside[clear])) if clear.any() else np.zeros(0)
        samples = [values[np.isfinite(values)] for values in (painted, bare)]
        if min(len(values) for values in samples) >= _LEAST_LEARNED:
            out[kind] = Paint(_robust(samples[0]), _robust(samples[1]))
    return out


def _across(corners: FloatArray, by_m: float) -> FloatArray:
    """Shifts (N, 2) across the longest extent of outlines (N, 4, 2)."""
    spans = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]], axis=1)
    diagonals = np.stack([corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]], axis=1)
    every = np.concatenate([spans, diagonals], axis=1)
    longest = np.argmax(np.linalg.norm(every, axis=2), axis=1)
    along = every[np.arange(len(every)), longest]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(by_m * np.column_stack([-along[:, 1], along[:, 0]]))


def _robust(values: FloatArray) -> tuple[float, float]:
    """Median, and the sigma that the median deviation of normal values has."""
    middle = float(np.median(values))
    return middle, max(1.4826 * float(np.median(np.abs(values - middle))), _LEAST_SIGMA)
