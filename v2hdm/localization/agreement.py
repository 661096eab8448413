"""Whether map, calibration and odometry explain what is seen: counted by markings, and tested as it comes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from v2hdm.localization.belief import Plane
from v2hdm.localization.motion import Piece, moved
from v2hdm.localization.paint import Paint
from v2hdm.localization.seeing import Look, Sighted, ground_points
from v2hdm.records import BoolArray, Calibration, FloatArray, IntArray

_WAY_M = 12.0  # way, m, over which agreement is counted
_SAME_M = 0.6  # distance, m, of sightings that are one object
_FROM = 6  # objects from which a share says something
_LEAST_SHARE = 0.67
"""Least share of what is seen that the map explains: of a right one it is 0.86 and more, with half of the
markings moved about 0.5, of another site's 0.04."""
# Log likelihood ratios of an object by a map with half of the markings moved and by a right one: of an object
# that lies beside a marking of its class that is not seen itself (right maps: 0.02, twice what drives with
# false detections show), of another that is not explained, and of one that is.
_DISPLACED = np.log(0.3 / 0.02)
_NOT_EXPLAINED = np.log(0.2 / 0.13)
_EXPLAINED = np.log(0.5 / 0.85)
_DIFFERS_LIMIT = 7.0  # sum of these, since it began to rise, from which a map differs (Page 1954)
_DISPLACED_M = (
    0.12,
    0.9,
)  # distance, m, from where the map has such a marking: repainted, but for the same use
_LOST_SHARE = 0.34  # share below which the map explains next to nothing

# Log likelihood ratio at which the odometry counts as off by a factor: one in e^9 of right ones comes so far.
_PACE_LIMIT = 9.0
_PACE_STEP_M = 0.5  # least way between two looks that are compared, m
_PACE_SAME_M = 0.2  # distance, m, of two sightings of one marking, when the way is right
_PACE_RANGE_M = 10.0  # distance, m, of the detections that are compared
_PACE_MATCH = 1.0  # log likelihood of a detection that fits over one that does not: neighbours share a cause
_PACES = {
    1 / 3.6: "its speeds look like km/h; state m/s",
    0.44704: "its speeds look like miles per hour; state m/s",
    3.6: "its speeds are too low by 3.6; state m/s",
    -1.0: "its speeds have the wrong sign; forward is positive",
    0.1: "its speeds are ten times too high; state m/s",
    0.0: "it moves while the images stand still",
}
"""By true over stated speed, what is wrong."""


@dataclass
class _Object:
    place_map: FloatArray
    kind: str
    way_m: float
    explained: int = 0
    not_explained: int = 0
    displaced: int = 0  # views, of those not explained, that lie beside an unseen marking of the class

    @property
    def gain(self) -> float:
        """The log likelihood ratio of a map that differs."""
        if self.explained >= self.not_explained:
            return float(_EXPLAINED)
        return float(_DISPLACED if 2 * self.displaced > self.not_explained else _NOT_EXPLAINED)


class Detected(NamedTuple):
    """The whole detections (D) of an image near the vehicle, on the ground of the map."""

    places_map: FloatArray  # (D, 2) their centres, m
    kinds: tuple[str, ...]
    is_explained: BoolArray  # (D,) by the map
    is_displaced: BoolArray  # (D,) beside a marking of their class that is not seen itself


def displaced(
    places_map: FloatArray, kinds: Sequence[str], explained: BoolArray, paint: Paint, matched: IntArray
) -> BoolArray:
    """Which detections (D,) at places (D, 2) that the map does not explain lie beside an unseen marking."""
    out = np.zeros(len(kinds), dtype=bool)
    for row in np.flatnonzero(~explained).tolist():
        numbers = paint.near(places_map[row], _DISPLACED_M[1])
        numbers = numbers[paint.looks_like(numbers, kinds[row])]
        numbers = numbers[~np.isin(numbers, matched)]
        apart_m = np.linalg.norm(paint.centres_map[numbers] - places_map[row], axis=1)
        out[row] = bool((apart_m > _DISPLACED_M[0]).any() and not (apart_m <= _DISPLACED_M[0]).any())
    return out


@dataclass
class Agreement:
    """Objects that images showed within the last metres, and whether the map has them."""

    objects: list[_Object] = field(default_factory=list)

    def note(self, detected: Detected, way_m: float) -> None:
        """Take the detections of an image."""
        self.objects = [spot for spot in self.objects if way_m - spot.way_m < _WAY_M]
        rows = zip(*(part.tolist() for part in (detected.is_explained, detected.is_displaced)), strict=True)
        for place, kind, (is_explained, is_displaced) in zip(
            detected.places_map, detected.kinds, rows, strict=True
        ):
            spot = self._of(place, kind)
            if spot is None:
                spot = _Object(place, kind, way_m)
                self.objects.append(spot)
            spot.explained += is_explained
            spot.not_explained += not is_explained
            spot.displaced += is_displaced

    def _of(self, place: FloatArray, kind: str) -> _Object | None:
        for spot in self.objects:
            if spot.kind == kind and float(np.abs(spot.place_map - place).max()) < _SAME_M:
                return spot
        return None

    @property
    def _several(self) -> list[_Object]:
        return [spot for spot in self.objects if spot.explained + spot.not_explained > 1]

    @property
    def quads(self) -> int:
        """The number of objects that more than one image showed."""
        return len(self._several)

    @property
    def share(self) -> float:
        """The share of these that the map explains; 1 where too few were seen to say."""
        several = self._several
        if len(several) < _FROM:
            return 1.0
        explained = [spot.explained >= spot.not_explained for spot in several]
        return float(np.mean(explained))

    @property
    def differs(self) -> bool:
        """Whether the map has too little of what is seen: of all in the last metres, or of what came last."""
        evidence = 0.0
        for spot in self._several:
            evidence = max(0.0, evidence + spot.gain)
        return self.share < _LEAST_SHARE or evidence > _DIFFERS_LIMIT

    @property
    def is_lost(self) -> bool:
        """Whether the map explains next to nothing."""
        return self.share < _LOST_SHARE


class _Seen(NamedTuple):
    stamp_s: float
    kinds: tuple[str, ...]
    middles: FloatArray  # (D,) complex, in the vehicle's frame


@dataclass
class Pace:
    """A test of the odometry by markings that two images of a camera show, whatever the map says."""

    before: dict[str, _Seen] = field(default_factory=dict)
    evidence: dict[float, float] = field(default_factory=dict)

    def note(self, look: Look, quads: Sighted, calibration: Calibration, pieces: list[Piece]) -> str | None:
        """Take a look; ``pieces`` lead to it from :meth:`since` of its camera. A sentence once it is off."""
        ground = ground_points(quads.corners_px, np.eye(4), Plane(), calibration)
        middles = ground.mean(axis=1) @ np.array([1.0, 1.0j])
        is_near = quads.valid.all(axis=1) & np.isfinite(middles.real) & (np.abs(middles) < _PACE_RANGE_M)
        kinds = tuple(kind for kind, is_kept in zip(quads.kinds, is_near.tolist(), strict=True) if is_kept)
        now = _Seen(look.stamp_s, kinds, middles[is_near])
        before = self.before.get(look.camera)
        if before is None or not pieces:
            self.before[look.camera] = now
            return None
        way = moved(pieces)
        if abs(complex(way[0], way[1])) < _PACE_STEP_M and look.stamp_s - before.stamp_s < 1.0:
            return None
        self.before[look.camera] = now
        right = _fitting(before, now, way, 1.0)
        for factor in _PACES:
            gain = _PACE_MATCH * (_fitting(before, now, way, factor) - right)
            self.evidence[factor] = max(0.0, self.evidence.get(factor, 0.0) + gain)
        factor = max(self.evidence, key=lambda factor: self.evidence[factor])
        return _PACES[factor] if self.evidence[factor] > _PACE_LIMIT else None

    def since(self, camera: str) -> float | None:
        """When the look was taken with which the next one of a camera is compared."""
        return self.before[camera].stamp_s if camera in self.before else None


def _fitting(before: _Seen, now: _Seen, way: FloatArray, factor: float) -> int:
    """How many detections are where they were before, if the vehicle moved by a factor of a way."""
    if not len(before.middles) or not len(now.middles):
        return 0
    expected = (before.middles - factor * complex(way[0], way[1])) * np.exp(-1j * way[2])
    alike = np.array(before.kinds)[:, None] == np.array(now.kinds)[None]
    apart_m = np.where(alike, np.abs(expected[:, None] - now.middles[None]), np.inf)
    return int((apart_m.min(axis=1) < _PACE_SAME_M).sum())
