"""Whether map, calibration and odometry explain what is seen: counted by markings, and tested as it comes."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median  # of a few numbers in a tenth of numpy's time
from typing import NamedTuple

import numpy as np

from v2hdm.localization.belief import Plane
from v2hdm.localization.joint import Located, Scene, offsets
from v2hdm.localization.motion import Piece, moved
from v2hdm.localization.seeing import Look, Sighted, ground_points
from v2hdm.records import BoolArray, Calibration, FloatArray

_WAY_M = 12.0  # way, m, over which agreement is counted
_JUDGED_M = 22.0  # distance, m, of detections that are counted for the map or against it
_SAME_M = 0.6  # distance, m, of sightings that are one object
_FROM = 6  # objects from which a share says something
_LEAST_SHARE = 0.67
"""Least share of what is seen that the map explains: of a right one it is 0.86 and more, with half of the
markings moved about 0.5, of another site's 0.04."""
_DIFFERS_LIMIT = 7.0  # log likelihood ratio, since it began to rise, from which a map differs (Page 1954)
_DOUBTFUL = 2.0  # log likelihood ratio from which images are searched for more of it
# Shares of what is seen that lies on its marking, was repainted beside it, or is on no marking (false
# detections, new paint): of a right map, as drives with false detections show, and of one with half of its
# markings moved.
_RIGHT = np.array([0.85, 0.02, 0.13])  # of a right map
_MOVED = np.array([0.5, 0.3, 0.2])  # of one with half of its markings moved
_MOVED_M = 0.22  # standard deviation, m, of each coordinate of a repainted marking: for the same use
_ELSEWHERE_M = 2.8  # the same of what is on no marking: one piece of unmapped paint in 50 m2
_BESIDE_M = 0.9  # distance, m, within which a marking may have been repainted
_BLUNDER_M = 0.03  # standard deviation, m, of a detection's place beyond its covariance: shadow and wear
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
    gains: list[float] = field(default_factory=list)  # of each view
    scores: list[float] = field(default_factory=list)  # of each view
    images: list[tuple[str, float]] = field(default_factory=list)  # camera and time of each view
    # The medians of its views, whose errors are alike:
    gain: float = 0.0  # the log likelihood ratio of a map that differs
    score: float = 0.0  # the log likelihood by the map over that of chance

    def note(self, gain: float, score: float, image: tuple[str, float]) -> None:
        """Take a view; an image counts once."""
        if image in self.images:
            return
        self.images.append(image)
        self.gains.append(gain)
        self.scores.append(score)
        self.gain = median(self.gains)
        self.score = median(self.scores)


class Detected(NamedTuple):
    """The detections (D) of an image on the ground of the map."""

    places_map: FloatArray  # (D, 2) their centres, m
    kinds: tuple[str, ...]
    is_judged: BoolArray  # (D,) whole and near the vehicle
    gains: FloatArray  # (D,) log likelihood ratios of a map with half of its markings moved and a right one
    scores: FloatArray  # (D,) log likelihoods by the map over those of chance


def detected(scene: Scene, located: Located) -> Detected:
    """The detections (D) of an image, as those near the vehicle count for the map or against it.

    Each is on its marking, beside it, or on none. How far it lies from a marking is measured in the image,
    with the covariances of detection, shape and belief.
    """
    pose = located.belief.map_from_vehicle(scene.plane)
    places = ground_points(scene.quads.corners_px, pose, scene.plane, scene.calibration)
    is_whole: BoolArray = np.asarray(np.isfinite(places).all(axis=(1, 2)) & scene.quads.valid.all(axis=1))
    centres = np.where(is_whole[:, None], places.mean(axis=1), np.inf)
    is_judged = np.asarray(np.linalg.norm(centres - pose[:2, 3], axis=1) < _JUDGED_M)
    rows, numbers = [], []
    for row in np.flatnonzero(is_judged).tolist():
        beside = _beside(scene, located, centres[row], row)
        rows += len(beside) * [row]
        numbers += beside
    gains = np.full(len(centres), np.log(_MOVED[2] / _RIGHT[2]))
    scores = np.full(len(centres), np.log(_RIGHT[2]))
    if rows:
        offset = offsets(located.belief, scene, np.array(rows), np.array(numbers))
        likelihood = offset_likelihood(*offset)
        is_ahead = np.isfinite(likelihood.score)  # in front of the camera
        order = np.argsort(likelihood.score[is_ahead])
        at = np.array(rows)[is_ahead][order]  # the last of a detection is its likeliest marking
        gains[at] = likelihood.gain[is_ahead][order]
        scores[at] = likelihood.score[is_ahead][order]
    return Detected(centres, scene.quads.kinds, is_judged, gains, scores)


def _beside(scene: Scene, located: Located, place_map: FloatArray, row: int) -> list[int]:
    """The marking that a detection shows, or else those beside it that no other shows."""
    shown = located.pairs.marking[located.pairs.detection == row]
    if len(shown):
        return [int(shown[0])]
    numbers = scene.paint.near(place_map, _BESIDE_M)
    numbers = numbers[scene.paint.looks_like(numbers, scene.quads.kinds[row])]
    numbers = numbers[~np.isin(numbers, located.pairs.marking)]
    return [int(number) for number in numbers]


class OffsetLikelihood(NamedTuple):
    """How offsets (...) from markings count; not a number where there is none."""

    gain: FloatArray  # (...) log likelihood ratio of a map with half of its markings moved and of a right one
    score: FloatArray  # (...) log likelihood by a right map over that of chance


def offset_likelihood(off_m: FloatArray, covariance_m2: FloatArray) -> OffsetLikelihood:
    """How offsets (..., 2) of covariances (..., 2, 2) from markings count."""
    densities = []
    for spread_m in (_BLUNDER_M, _MOVED_M, _ELSEWHERE_M):
        total_m2 = covariance_m2 + spread_m**2 * np.eye(2)
        squared = (off_m * np.linalg.solve(total_m2, off_m[..., None])[..., 0]).sum(axis=-1)
        densities.append(np.exp(-0.5 * squared) / np.sqrt(np.linalg.det(total_m2)))
    density = np.stack(densities, axis=-1)
    right = np.log(density @ _RIGHT)
    moved_log = np.log(density @ _MOVED)
    return OffsetLikelihood(np.asarray(moved_log - right), np.asarray(right - np.log(density[..., 2])))


@dataclass
class Agreement:
    """Objects that images showed within the last metres, and whether the map has them."""

    objects: list[_Object] = field(default_factory=list)

    def note(self, judged: Detected, way_m: float, look: Look) -> None:
        """Take the detections of a look."""
        image = (look.camera, look.stamp_s)
        self.objects = [spot for spot in self.objects if way_m - spot.way_m < _WAY_M]
        for row in np.flatnonzero(judged.is_judged).tolist():
            spot = self._of(judged.places_map[row], judged.kinds[row])
            if spot is None:
                spot = _Object(judged.places_map[row], judged.kinds[row], way_m)
                self.objects.append(spot)
            spot.note(float(judged.gains[row]), float(judged.scores[row]), image)

    def _of(self, place_map: FloatArray, kind: str) -> _Object | None:
        """The object of a class at a place."""
        alike = [spot for spot in self.objects if spot.kind == kind]
        if not alike:
            return None
        places_map = np.array([spot.place_map for spot in alike])
        is_there = np.abs(places_map - place_map).max(axis=1) < _SAME_M
        return alike[int(is_there.argmax())] if is_there.any() else None

    @property
    def _several(self) -> list[_Object]:
        return [spot for spot in self.objects if len(spot.gains) > 1]

    @property
    def score(self) -> float:
        """The log likelihood of these objects by the map over that of chance."""
        return sum(spot.score for spot in self._several)

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
        return sum(spot.gain <= 0 for spot in several) / len(several)

    @property
    def differs(self) -> bool:
        """Whether the map has too little of what is seen: of all in the last metres, or of what came last."""
        return self.share < _LEAST_SHARE or self._evidence > _DIFFERS_LIMIT

    @property
    def is_doubtful(self) -> bool:
        """Whether what came last speaks for another map, surely or not."""
        return self.share < _LEAST_SHARE or self._evidence > _DOUBTFUL

    @property
    def _evidence(self) -> float:
        """The log likelihood ratio of a map that differs, since it began to rise."""
        evidence = 0.0
        for spot in self._several:
            evidence = max(0.0, evidence + spot.gain)
        return evidence

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
