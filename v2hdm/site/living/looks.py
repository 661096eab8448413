"""Looks of images at places of a map, and whether they show paint or bare ground there.

An undetected marking may be gone, worn or hidden by a parked truck. The contrast of its outline's inside to
the ground around it decides: bare ground has nearly none. The drive's own markings give the contrast of paint
in this light, bare ground between them that of ground.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from v2hdm.association.ground import Views, easy_views, locate
from v2hdm.association.groups import near_pairs, squared_distances
from v2hdm.association.sightings import Rig, Sightings, row_shares
from v2hdm.densities import log_normal_density
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray, Marking
from v2hdm.safe.pixels import grey_of
from v2hdm.site.contrast import Contrast, places_aside, samples_of, usual_contrast
from v2hdm.site.living.fates import Watched
from v2hdm.site.posterior import log_found, log_found_where_none_is
from v2hdm.site.standing import Grey

_BESIDE_M = (0.12, 0.25)  # offsets from an outline's edges at which the ground is sampled, m
_MOST_VIEWS = 6  # most views of a place that are used, the nearest ones: errors of more repeat
_MOST_LEARNED = 40  # most markings of a class from which a drive's contrast of paint and ground is learned
_CLEAR_M = 1.0  # least distance of bare ground from all known paint, m
_LEAST_LEARNED = 8  # least places for the drive's own contrast of paint or ground; with fewer it is unknown

HIDDEN_SIGMA = 0.5  # sigma of the contrast, log ratio of grey values, of anything that hides the ground
_HIDDEN_SHARE = 0.5  # fraction of the existing, undetected markings that are hidden; the others are worn
_STRANGE_SHARE = 0.05  # fraction of bare places with something else: a stain, the edge of a shadow


@dataclass(frozen=True)
class Paint:
    """Contrasts of a drive's ``painted`` and ``bare`` places."""

    painted: Contrast
    bare: Contrast

    def log_painted(self, contrast: FloatArray) -> FloatArray:
        """Log density (N,) of contrasts at undetected markings: worn, or hidden."""
        mean, sigma = self.painted
        worn = log_normal_density(contrast, mean / 2, abs(mean) / 3 + sigma)
        hidden = log_normal_density(contrast, 0.0, HIDDEN_SIGMA)
        return _mixed(hidden, worn, _HIDDEN_SHARE)

    def log_bare(self, contrast: FloatArray) -> FloatArray:
        """Log density (N,) of contrasts of bare ground."""
        mean, sigma = self.bare
        strange = log_normal_density(contrast, 0.0, HIDDEN_SIGMA)
        return _mixed(strange, log_normal_density(contrast, mean, sigma), _STRANGE_SHARE)


def _mixed(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Log density of a mixture, a ``share`` of which is ``first``."""
    return np.asarray(logsumexp([np.log(share) + first, np.log1p(-share) + second], axis=0))


def learn_paint(
    observer: Observer, markings: Sequence[Marking], paint_map: FloatArray
) -> Mapping[str, Paint]:
    """By class with enough markings, the contrast of paint at ``paint_map`` (N, 2), and of bare ground."""
    paint_of_kind = {}
    paint = cKDTree(paint_map)
    for kind in sorted({marking.kind for marking in markings}):
        corners = np.stack([marking.corners_map for marking in markings if marking.kind == kind])
        corners = corners[np.linspace(0, len(corners) - 1, min(len(corners), _MOST_LEARNED)).astype(int)]
        painted = observer.contrasts(corners)
        aside = places_aside(corners)
        clear = paint.query(aside.reshape(-1, 2))[0].reshape(-1, 4).min(axis=1) > _CLEAR_M
        bare = observer.contrasts(aside[clear]) if clear.any() else np.zeros(0)
        samples = [values[np.isfinite(values)] for values in (painted, bare)]
        if min(len(values) for values in samples) >= _LEAST_LEARNED:
            paint_of_kind[kind] = Paint(usual_contrast(samples[0]), usual_contrast(samples[1]))
    return paint_of_kind


_MOST_SQUARED = 25.0
"""Largest squared Mahalanobis distance of a sighting's corners from a place that it shows."""

_NEAR_M = 12.0  # largest range, m, of a constant detection rate
_SAME_PLACE_M = 0.05  # largest distance, m, of another marking of the class that occupies a place
_REACH_M = 2.0  # largest distance, m, of a sighting's centre from a place's: it may show a dash's end alone


@dataclass(frozen=True)
class Looks:
    """Numbers of near ``views`` (N,) of N places, and of ``detections`` in them (N,)."""

    views: IntArray
    detections: IntArray

    def watched(self, rate: FloatArray) -> Watched:
        """Log-likelihoods with and without a marking, whose detection rate is ``rate`` (N,)."""
        painted = [log_found(k, n, r) for k, n, r in zip(self.detections, self.views, rate, strict=True)]
        return Watched(np.array(painted), log_found_where_none_is(self.detections, self.views))


@dataclass(frozen=True)
class Observer:
    """The observations of a drive under a ``rig``; ``grey`` reads its images, None if unavailable."""

    sightings: Sightings
    views: Views
    cameras: tuple[Camera, ...]
    rig: Rig
    jitter_rad: float
    grey: Grey | None = None

    def easy_views(self, corners_map: FloatArray) -> tuple[IntArray, IntArray]:
        """(place, image) of unobstructed near views of whole places (N, 4, 2)."""
        return easy_views(self.views, self.rig, list(self.cameras), corners_map, _NEAR_M)

    def looks(self, markings: Sequence[Marking], free: BoolArray) -> Looks:
        """Views of ``markings``, and detections of them among the sightings ``free`` (S,)."""
        if not markings:
            return Looks(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        corners = np.stack([marking.corners_map for marking in markings])
        count = len(markings)
        place, image = self.easy_views(corners)
        shown = self._shown(markings, corners, free)
        is_shown = [pair in shown for pair in zip(place.tolist(), image.tolist(), strict=True)]
        views = np.bincount(place, minlength=count)
        return Looks(views, np.bincount(place[is_shown], minlength=count).astype(np.int64))

    def _shown(
        self, markings: Sequence[Marking], corners: FloatArray, free: BoolArray
    ) -> set[tuple[int, int]]:
        """(place, image) of sightings that match a place."""
        located = locate(self.sightings, self.rig)
        rows = np.flatnonzero(free & (located.informs.sum(axis=1) >= 2))
        if not len(rows):
            return set()
        row, place = near_pairs(located, rows, corners.mean(axis=1), _REACH_M)
        kinds = np.array([marking.kind for marking in markings])
        alike = kinds[place] == np.array(self.sightings.kinds)[self.sightings.kind[row]]
        row = row[alike]
        place = place[alike]
        squared = squared_distances(
            self.sightings, located, self.rig, row, corners[place], self.jitter_rad
        ).min(axis=1, initial=np.inf)
        fits = squared <= _MOST_SQUARED
        return set(zip(place[fits].tolist(), self.sightings.image[row[fits]].tolist(), strict=True))

    def contrasts(self, corners_map: FloatArray) -> FloatArray:
        """Median contrast (N,) of places (N, 4, 2) over their nearest views; nan without any."""
        assert self.grey is not None
        place, image = self.easy_views(corners_map)
        row_of = {int(image_of_row): row for row, image_of_row in enumerate(self.views.image)}
        places_of_row: dict[int, list[int]] = {}
        for number in range(len(corners_map)):
            rows = np.array([row_of[int(index)] for index in image[place == number]], dtype=np.int64)
            vehicle_map = self.rig.map_from_vehicle[self.views.frame[rows]][:, :2, 3]
            away_m = np.linalg.norm(vehicle_map - corners_map[number].mean(axis=0), axis=1)
            for row in rows[np.argsort(away_m)[:_MOST_VIEWS]].tolist():
                places_of_row.setdefault(row, []).append(number)
        contrasts: list[list[float]] = [[] for _ in corners_map]
        for row, numbers in sorted(places_of_row.items()):
            grey = grey_of(self.grey(int(self.views.image[row])))
            for number in numbers:
                contrasts[number].append(self._contrast(grey, row, corners_map[number]))
        return np.array(
            [np.nanmedian(values) if np.isfinite(values).any() else np.nan for values in contrasts]
        )

    def _contrast(self, grey: NDArray[np.float32], row: int, corners: FloatArray) -> float:
        """Log ratio of mean grey values within an outline (4, 2) and beside it."""
        camera = self.views.camera[row]
        frame = self.views.frame[row]
        info = self.cameras[camera].info
        cam_from_map = self.rig.cam_from_map(camera, frame)
        if self.rig.read_out_s is not None:  # its middle's row gives the outline's read-out
            outline_px, _ = project_ground(self.rig.intrinsic[camera], cam_from_map, corners)
            middle = distort_points(info, outline_px.mean(axis=0, keepdims=True))
            cam_from_map = self.rig.cam_from_map(camera, frame, row_shares(info, middle)[0])
        means = []
        for points in samples_of(corners, _BESIDE_M):
            pinhole, depth_m = project_ground(self.rig.intrinsic[camera], cam_from_map, points)
            pixel = distort_points(info, pinhole).astype(np.float32)
            values = cv2.remap(grey, pixel[None, :, 0], pixel[None, :, 1], cv2.INTER_LINEAR, borderValue=-1.0)
            if not (depth_m > 0).all() or not (values >= 0).all():
                return float("nan")
            means.append(float(values.mean()) + 1.0)
        return float(np.log(means[0] / means[1]))


def find_rates(observer: Observer, markings: Sequence[Marking]) -> Mapping[str, float]:
    """Detection rate by class in easy views of the drive's own markings."""
    looks = observer.looks(markings, np.ones(len(observer.sightings), dtype=bool))
    kinds = np.array([marking.kind for marking in markings])
    return {
        str(kind): float((looks.detections[kinds == kind].sum() + 1) / (looks.views[kinds == kind].sum() + 2))
        for kind in np.unique(kinds)
    }


def with_paint(
    watched: Watched, observer: Observer, old: Sequence[Marking], new: Sequence[Marking]
) -> Watched:
    """``watched`` old markings with the images' evidence at places without a ``new`` one of the class."""
    if observer.grey is None or not old or not new:
        return watched
    old_at = np.array([marking.corners_map.mean(axis=0) for marking in old])
    new_at = np.array([marking.corners_map.mean(axis=0) for marking in new])
    paint_map = np.concatenate([marking.corners_map for marking in (*old, *new)] + [old_at, new_at])
    painted = watched.painted.copy()
    bare = watched.bare.copy()
    for kind, paint in learn_paint(observer, new, paint_map).items():
        alike = np.array([marking.kind == kind for marking in new])
        distance_m = cKDTree(new_at[alike]).query(old_at)[0]
        doubtful = [
            k for k, marking in enumerate(old) if marking.kind == kind and distance_m[k] > _SAME_PLACE_M
        ]
        if not doubtful:
            continue
        contrast = observer.contrasts(np.stack([old[k].corners_map for k in doubtful]))
        is_visible = np.isfinite(contrast)
        rows = np.array(doubtful)[is_visible]
        painted[rows] += paint.log_painted(contrast[is_visible])
        bare[rows] += paint.log_bare(contrast[is_visible])
    return Watched(painted, bare)
