"""Words and boxes seen on the last metres, as evidence of where a vehicle is before it has a place.

A pattern of dashes repeats every few metres; a word among them does not. What a word says is not read here,
and several look alike: only where a map has a word tells places apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.localization.areas import AreaMap, middle_of_hull
from v2hdm.localization.belief import Plane
from v2hdm.localization.seeing import Hull, ground_points
from v2hdm.records import Calibration, FloatArray

_RANGE_M = 14.0  # distance, m, of words that count: farther ones are misplaced by a nod of the vehicle
_WAY_M = 25.0  # way, m, over which the odometry lays words out
_SAME_M = 1.5  # distance, m, of detections that are one word
_SIGMA_M = 0.3  # standard deviation, m, of a word's middle in a patch that is in place: a letter, a nod
_SLACK_M = 0.9  # distance, m, of a detection from its word: three of these
# Log likelihood of a word that lies on a word of the map over that of one that lies anywhere: 0.7 of a
# bivariate normal of 30 cm, against one false or unmapped word in 600 m2 (a rendered port has four).
_MATCHED = 6.6
_MISSED = -1.2  # of one that lies on none: log of the share of seen words that are false or in parts


@dataclass
class _Word:
    kind: str
    middle: complex  # in the frame in which the odometry counts
    way_m: float
    views: int = 1


@dataclass
class WordPatch:
    """Words and boxes seen lately, in the frame in which the odometry counts."""

    words: list[_Word] = field(default_factory=list)

    def add(
        self, hulls: Sequence[Hull], calibration: Calibration, local_from_vehicle: FloatArray, way_m: float
    ) -> None:
        """Take the hulls of an image taken at a pose (3,) of the odometry."""
        self.words = [word for word in self.words if way_m - word.way_m < _WAY_M]
        turn = np.exp(1j * local_from_vehicle[2])
        begin = complex(local_from_vehicle[0], local_from_vehicle[1])
        for hull in hulls:
            ground = ground_points(hull.points_px, np.eye(4), Plane(), calibration)
            if not np.isfinite(ground).all():
                continue
            x, y = middle_of_hull(ground).tolist()
            if np.hypot(x, y) < _RANGE_M:
                self._take(_Word(hull.kind, complex(turn * complex(x, y) + begin), way_m))

    def _take(self, newer: _Word) -> None:
        """Keep a word, or the mean of its places if it was seen before."""
        for word in self.words:
            if word.kind == newer.kind and abs(word.middle - newer.middle) < _SAME_M:
                word.middle += (newer.middle - word.middle) / (word.views + 1)
                word.views += 1
                word.way_m = newer.way_m
                return
        self.words.append(newer)

    def scores(self, poses: FloatArray, area_map: AreaMap) -> FloatArray:
        """Log likelihoods (C,) of the words by the map over those of chance, at places (C, 3) of the patch.

        A place is x and y, m, and turn, rad. Only words that two images or more showed count.
        """
        scores = np.zeros(len(poses))
        places = area_map.places_map[:, 0] + 1j * area_map.places_map[:, 1]
        for word in self.words:
            if word.views < 2:
                continue
            alike = places[area_map.kinds == word.kind]
            at = np.exp(1j * poses[:, 2]) * word.middle + poses[:, 0] + 1j * poses[:, 1]
            apart_m = np.abs(at[:, None] - alike[None]).min(axis=1, initial=np.inf)
            matched = _MATCHED - 0.5 * (np.minimum(apart_m, _SLACK_M) / _SIGMA_M) ** 2
            scores += np.where(apart_m < _SLACK_M, matched, _MISSED)
        return scores
