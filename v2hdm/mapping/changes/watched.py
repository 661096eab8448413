"""How often the images of a drive looked at places of a map, and what they showed there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.mapping.association.attach import squared_distances
from v2hdm.mapping.changes.decide import Watched
from v2hdm.mapping.changes.paint import Grey, Pictures, learn_paint
from v2hdm.mapping.sightings.location import locate
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views, easy_views
from v2hdm.mapping.site_model.posterior import log_found, log_found_where_none_is
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray, Marking

_MOST_SQUARED = 25.0
"""Squared distance of a sighting's corners from a place, in sigmas, up to which it shows what is there."""

_NEAR_M = 12.0
"""Distance from the camera, m, within which markings are found at about one rate, as those of a map say."""

_SAME_PLACE_M = 0.05
"""A marking that has one of its class nearer than this is there, m."""

_REACH_M = 2.0
"""How far the middle of a sighting may be from a place's centre, m: of a dash one may see an end only."""


@dataclass(frozen=True)
class Looks:
    """Of N places, how many images had each in near ``views`` (N,), and in how many it was ``found`` (N,)."""

    views: IntArray
    found: IntArray

    def watched(self, rate: FloatArray) -> Watched:
        """What that says, where markings of each place's class are found at a ``rate`` (N,)."""
        return Watched(
            there=np.array(
                [log_found(k, n, r) for k, n, r in zip(self.found, self.views, rate, strict=True)]
            ),
            bare=log_found_where_none_is(self.found, self.views),
        )


@dataclass(frozen=True)
class Observer:
    """What a drive has seen and from where: its ``sightings``, images and cameras, under a ``rig``.

    ``jitter_rad`` is how far the attitude of a pose is off. ``grey`` gives its images, None where they are
    not to be had.
    """

    sightings: Sightings
    views: Views
    cameras: tuple[Camera, ...]
    rig: Rig
    jitter_rad: float
    grey: Grey | None = None

    @property
    def pictures(self) -> Pictures | None:
        """Its images, None where they are not to be had."""
        return None if self.grey is None else Pictures(self.grey, self.views, self.cameras, self.rig)

    def easy_views(self, corners_map: FloatArray) -> tuple[IntArray, IntArray]:
        """(place, image) in which each of the places (N, 4, 2) is wholly in view, and near."""
        return easy_views(self.views, self.rig, list(self.cameras), corners_map, _NEAR_M)

    def looks(self, markings: Sequence[Marking], free: BoolArray) -> Looks:
        """How often it looked at ``markings``, and found one among the sightings that are ``free`` (S,)."""
        if not markings:
            return Looks(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        corners = np.stack([one.corners_map for one in markings])
        group, image = self.easy_views(corners)
        shown = self._shown(markings, corners, free)
        found = [(int(g), int(i)) in shown for g, i in zip(group, image, strict=True)]
        count = len(markings)
        return Looks(
            np.bincount(group, minlength=count), np.bincount(group[found], minlength=count).astype(np.int64)
        )

    def _shown(
        self, markings: Sequence[Marking], corners: FloatArray, free: BoolArray
    ) -> set[tuple[int, int]]:
        """(place, image) of the sightings that fit a place."""
        located = locate(self.sightings, self.rig)
        rows = np.flatnonzero(free & (located.informs.sum(axis=1) >= 2))
        if not len(rows):
            return set()
        informs = located.informs[rows][..., None]
        middle = np.where(informs, located.corners_map[rows], 0.0).sum(axis=1) / informs.sum(axis=1)
        near = cKDTree(corners.mean(axis=1)).query_ball_point(middle, _REACH_M)
        row = np.repeat(rows, [len(places) for places in near])
        place = np.concatenate([np.asarray(places, dtype=np.int64) for places in near])
        kinds = [one.kind for one in markings]
        alike = [
            kinds[p] == self.sightings.kinds[k] for p, k in zip(place, self.sightings.kind[row], strict=True)
        ]
        row, place = row[alike], place[alike]
        squared = squared_distances(
            self.sightings, located, self.rig, row, corners[place], self.jitter_rad
        ).min(axis=1, initial=np.inf)
        fits = squared <= _MOST_SQUARED
        images = self.sightings.image[row[fits]]
        return {(int(p), int(i)) for p, i in zip(place[fits], images, strict=True)}


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
    """What was ``watched`` of ``old`` markings, and what images show where no ``new`` one of a class lies."""
    pictures = observer.pictures
    if pictures is None or not old or not new:
        return watched
    old_at, new_at = (np.array([one.corners_map.mean(axis=0) for one in some]) for some in (old, new))
    paint_map = np.concatenate([one.corners_map for one in (*old, *new)] + [old_at, new_at])
    paints = learn_paint(pictures, new, paint_map, observer.easy_views)
    there, bare = watched.there.copy(), watched.bare.copy()
    for kind, paint in paints.items():
        alike = np.array([one.kind == kind for one in new])
        near_m = cKDTree(new_at[alike]).query(old_at)[0]
        doubtful = [k for k, one in enumerate(old) if one.kind == kind and near_m[k] > _SAME_PLACE_M]
        if not doubtful:
            continue
        corners = np.stack([old[k].corners_map for k in doubtful])
        contrast = pictures.contrasts(corners, *observer.easy_views(corners))
        known = np.isfinite(contrast)
        rows = np.array(doubtful)[known]
        there[rows] += paint.log_there(contrast[known])
        bare[rows] += paint.log_bare(contrast[known])
    return Watched(there, bare)
