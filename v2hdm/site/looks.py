"""How often images looked at places of a map, and whether they show paint or bare ground there.

A marking that was found in no image may be gone, or it may be worn, or a parked truck may hide it. The
contrast of its outline's inside to the ground around it decides: bare ground has next to none. The drive's
own markings show what contrast paint has in this light, and bare ground between them.
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

from v2hdm.association.ground import Views, easy_views, locate
from v2hdm.association.groups import near_pairs, squared_distances
from v2hdm.association.sightings import Rig, Sightings, row_shares
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import Quad, turned_left
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray, Marking
from v2hdm.site.fates import Watched
from v2hdm.site.posterior import log_found, log_found_where_none_is

Grey = Callable[[int], NDArray[np.float32]]  # the grey values (H, W) of an image, by its number in the drive

_INSIDE = np.linspace(0.2, 0.8, 7)
"""Where along either side an outline's inside is sampled: off its edges, which a pose's error blurs."""

_BESIDE_M = (0.12, 0.25)  # how far beside its edges the ground is sampled, m
_MOST_VIEWS = 6  # near views of a place that are looked at: the errors of more repeat themselves
_MOST_LEARNED = 40  # markings of a drive that its paint and its ground are learned from
_ASIDE_M = 1.3  # how far beside a marking bare ground is looked for, m
_CLEAR_M = 1.0  # distance from all known paint that makes ground bare, m
_LEAST_LEARNED = 8  # places from which the drive's own paint or ground is known; with fewer nothing is said
_HIDDEN_SIGMA = 0.5  # sigma of the contrast, log ratio of grey values, of whatever else hides the ground

_HIDDEN_SHARE = 0.5  # share of the markings there and not found that are hidden; the others are worn

_STRANGE_SHARE = 0.05  # share of bare places that are not: a stain, the edge of a shadow
_LEAST_SIGMA = 0.02  # floor of the sigma of bare ground's contrast: the grain of an image


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


def _samples(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points within an outline (4, 2), and beside its four edges."""
    inside = Quad(corners).at(*(grid.ravel() for grid in np.meshgrid(_INSIDE, _INSIDE)))
    beside = []
    for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = second - first
        outwards = np.array([side[1], -side[0]]) / max(float(np.linalg.norm(side)), 1e-9)
        for away_m in _BESIDE_M:
            beside.append(first + _INSIDE[:, None] * side + away_m * outwards)
    return inside, np.concatenate(beside)


def learn_paint(
    observer: Observer, markings: Sequence[Marking], paint_map: FloatArray
) -> Mapping[str, Paint]:
    """By class, of enough markings, the contrast of paint, at ``paint_map`` (N, 2), and of bare ground."""
    out = {}
    paint = cKDTree(paint_map)
    for kind in sorted({one.kind for one in markings}):
        own = np.stack([one.corners_map for one in markings if one.kind == kind])
        own = own[np.linspace(0, len(own) - 1, min(len(own), _MOST_LEARNED)).astype(int)]
        painted = observer.contrasts(own)
        # Across the longest extent, side or diagonal, of each.
        every = own[:, [1, 2, 2, 3]] - own[:, [0, 1, 0, 1]]
        extent_m = np.linalg.norm(every, axis=2)
        rows, longest = np.arange(len(every)), np.argmax(extent_m, axis=1)
        along = every[rows, longest] / extent_m[rows, longest, None]
        across = _ASIDE_M * turned_left(along)[:, None]
        aside = np.concatenate([own - across, own + across])
        clear = paint.query(aside.reshape(-1, 2))[0].reshape(-1, 4).min(axis=1) > _CLEAR_M
        bare = observer.contrasts(aside[clear]) if clear.any() else np.zeros(0)
        samples = [values[np.isfinite(values)] for values in (painted, bare)]
        if min(len(values) for values in samples) >= _LEAST_LEARNED:
            out[kind] = Paint(_robust(samples[0]), _robust(samples[1]))
    return out


def _robust(values: FloatArray) -> tuple[float, float]:
    """Median, and the sigma that the median deviation of normal values has."""
    middle = float(np.median(values))
    return middle, max(1.4826 * float(np.median(np.abs(values - middle))), _LEAST_SIGMA)


_MOST_SQUARED = 25.0
"""Squared distance of a sighting's corners from a place, in sigmas, up to which it shows what is there."""

_NEAR_M = 12.0  # distance from the camera, m, within which markings are found at about one rate

_SAME_PLACE_M = 0.05  # a marking that has one of its class nearer than this is there, m
_REACH_M = 2.0  # how far a sighting's middle may be from a place's centre, m: one may see a dash's end only


@dataclass(frozen=True)
class Looks:
    """Of N places, how many images had each in near ``views`` (N,), and in how many it was ``found`` (N,)."""

    views: IntArray
    found: IntArray

    def watched(self, rate: FloatArray) -> Watched:
        """The log odds of that, where markings of the class are found at a ``rate`` (N,)."""
        there = [log_found(k, n, r) for k, n, r in zip(self.found, self.views, rate, strict=True)]
        return Watched(np.array(there), log_found_where_none_is(self.found, self.views))


@dataclass(frozen=True)
class Observer:
    """The observations of a drive under a ``rig``; ``grey`` gives its images, None if not to be had."""

    sightings: Sightings
    views: Views
    cameras: tuple[Camera, ...]
    rig: Rig
    jitter_rad: float
    grey: Grey | None = None

    def easy_views(self, corners_map: FloatArray) -> tuple[IntArray, IntArray]:
        """(place, image) in which each of the places (N, 4, 2) is wholly in view, and near."""
        return easy_views(self.views, self.rig, list(self.cameras), corners_map, _NEAR_M)

    def looks(self, markings: Sequence[Marking], free: BoolArray) -> Looks:
        """How often it looked at ``markings``, and found one among the sightings that are ``free`` (S,)."""
        if not markings:
            return Looks(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        corners, count = np.stack([one.corners_map for one in markings]), len(markings)
        place, image = self.easy_views(corners)
        shown = self._shown(markings, corners, free)
        found = [pair in shown for pair in zip(place.tolist(), image.tolist(), strict=True)]
        views = np.bincount(place, minlength=count)
        return Looks(views, np.bincount(place[found], minlength=count).astype(np.int64))

    def _shown(
        self, markings: Sequence[Marking], corners: FloatArray, free: BoolArray
    ) -> set[tuple[int, int]]:
        """(place, image) of the sightings that fit a place."""
        located = locate(self.sightings, self.rig)
        rows = np.flatnonzero(free & (located.informs.sum(axis=1) >= 2))
        if not len(rows):
            return set()
        row, place = near_pairs(located, rows, corners.mean(axis=1), _REACH_M)
        kinds = np.array([one.kind for one in markings])
        alike = kinds[place] == np.array(self.sightings.kinds)[self.sightings.kind[row]]
        row, place = row[alike], place[alike]
        squared = squared_distances(
            self.sightings, located, self.rig, row, corners[place], self.jitter_rad
        ).min(axis=1, initial=np.inf)
        fits = squared <= _MOST_SQUARED
        return set(zip(place[fits].tolist(), self.sightings.image[row[fits]].tolist(), strict=True))

    def contrasts(self, corners_map: FloatArray) -> FloatArray:
        """The median contrast (N,) of places (N, 4, 2) over their nearest views; nan without a view."""
        assert self.grey is not None
        place, image = self.easy_views(corners_map)
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
        camera, frame = self.views.camera[row], self.views.frame[row]
        info, cam_from_map = self.cameras[camera].info, self.rig.cam_from_map(camera, frame)
        if self.rig.read_out_s is not None:  # the row that shows its middle says when the outline was read
            seen, _ = project_ground(self.rig.intrinsic[camera], cam_from_map, corners)
            middle = distort_points(info, seen.mean(axis=0, keepdims=True))
            cam_from_map = self.rig.cam_from_map(camera, frame, row_shares(info, middle)[0])
        means = []
        for points in _samples(corners):
            pinhole, depth_m = project_ground(self.rig.intrinsic[camera], cam_from_map, points)
            pixel = distort_points(info, pinhole).astype(np.float32)
            values = cv2.remap(grey, pixel[None, :, 0], pixel[None, :, 1], cv2.INTER_LINEAR, borderValue=-1.0)
            if not (depth_m > 0).all() or not (values >= 0).all():
                return float("nan")
            means.append(float(values.mean()) + 1.0)
        return float(np.log(means[0] / means[1]))


def find_rates(observer: Observer, markings: Sequence[Marking]) -> Mapping[str, float]:
    """By class the share of its easy views in which a marking of the drive's own map is found."""
    looks = observer.looks(markings, np.ones(len(observer.sightings), dtype=bool))
    kinds = np.array([one.kind for one in markings])
    return {
        str(kind): float((looks.found[kinds == kind].sum() + 1) / (looks.views[kinds == kind].sum() + 2))
        for kind in np.unique(kinds)
    }


def with_paint(
    watched: Watched, observer: Observer, old: Sequence[Marking], new: Sequence[Marking]
) -> Watched:
    """How ``old`` markings were ``watched``, and what images show where no ``new`` one of a class lies."""
    if observer.grey is None or not old or not new:
        return watched
    old_at, new_at = (np.array([one.corners_map.mean(axis=0) for one in some]) for some in (old, new))
    paint_map = np.concatenate([one.corners_map for one in (*old, *new)] + [old_at, new_at])
    there, bare = watched.there.copy(), watched.bare.copy()
    for kind, paint in learn_paint(observer, new, paint_map).items():
        alike = np.array([one.kind == kind for one in new])
        near_m = cKDTree(new_at[alike]).query(old_at)[0]
        doubtful = [k for k, one in enumerate(old) if one.kind == kind and near_m[k] > _SAME_PLACE_M]
        if not doubtful:
            continue
        contrast = observer.contrasts(np.stack([old[k].corners_map for k in doubtful]))
        known = np.isfinite(contrast)
        rows = np.array(doubtful)[known]
        there[rows] += paint.log_there(contrast[known])
        bare[rows] += paint.log_bare(contrast[known])
    return Watched(there, bare)
