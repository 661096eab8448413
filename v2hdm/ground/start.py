"""A first mounting that lets the ground match: the guess, or one that looks further up or down.

How the recorded poses can be read, and under which reading the ground fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.rigid import heading_rad
from v2hdm.ground.adjust import Beliefs, adjust
from v2hdm.ground.model import Mount
from v2hdm.ground.motion import motion_of, spread_pairs, turning_pairs
from v2hdm.ground.patches import Matcher
from v2hdm.ground.results import Reading
from v2hdm.records import Drive, FloatArray, IntArray

_PAIRS = 10
_SHORT_M = (0.3, 1.6)
"""Distance between the images of a pair: a wrong guess shifts the ground by a part of it."""

_TOLERANCE = 8.0
"""Factor on the residual from which on a match loses its weight: the guess is degrees off."""

_SEARCH_M = (0.9, 0.5)
_GRID_M = 0.06
_PASSES = 0.15
"""Share of patches that must find a partner; a fifth do on the even asphalt of real roads."""

_TURNS_DEG = (0.0, 3.0, -3.0, 6.0, -6.0, 9.0, -9.0, 12.0, -12.0)
"""Pitches that are tried in turn."""

_FARTHEST_DEG = 20.0
"""A start further off its guess is none."""

_LEAST_MATCHES = 30
"""Ten for each angle of the mounting."""


@dataclass(frozen=True)
class Start:
    """Where the adjustment starts, the share of patches that match there, and how many there were."""

    mount: Mount | None
    share: float
    sought: int


def find_start(matcher: Matcher, beliefs: Beliefs, guess: Mount) -> Start:
    """The first of the guess and its turned copies from which the ground matches.

    Args:
        matcher: of the camera.
        beliefs: of its images.
        guess: the mounting as stated.
    """
    pairs = short_pairs(beliefs.path_m())
    best = Start(None, 0.0, 0)
    for turn_deg in _TURNS_DEG:
        # Pitch is about the camera's own sideways axis: a camera may look anywhere.
        sideways = guess.vehicle_from_cam_rotation[:, 0]
        tried = _settle(
            matcher, beliefs, pairs, guess.moved(np.deg2rad(turn_deg) * sideways, np.zeros(3)), guess
        )
        if tried.mount is not None:
            return tried
        best = max(best, tried, key=lambda start: start.share)
    return best


def short_pairs(path_m: FloatArray) -> IntArray:
    """Pairs of neighbouring images, or of those next to each other where images are rarer."""
    pairs = spread_pairs(path_m, _PAIRS, *_SHORT_M)
    if len(pairs) < _PAIRS // 2:
        pairs = spread_pairs(path_m, _PAIRS, _SHORT_M[0], 2 * _SHORT_M[1])
    return pairs


def _settle(matcher: Matcher, beliefs: Beliefs, pairs: IntArray, mount: Mount, guess: Mount) -> Start:
    share, sought = 0.0, 0
    prior = beliefs.camera.centre_prior
    # Between neighbouring images a higher camera and a longer way look alike; the survey tells them apart.
    surveyed = beliefs if prior is None else replace(beliefs, centre_sigma_m={2: float(prior.sigma_m[2])})
    for search_m in _SEARCH_M:
        matched = matcher.match(mount, beliefs.poses(), pairs, search_m, _GRID_M)
        share, sought = matched.share, matched.sought
        if len(matched.correlation) < _LEAST_MATCHES or share < _PASSES:
            return Start(None, share, sought)
        used, believed, _ = surveyed.about(matched.observations)
        mount = adjust(used, believed, mount, tolerance=_TOLERANCE).mount
        away = guess.vehicle_from_cam_rotation.T @ mount.vehicle_from_cam_rotation
        if np.trace(away) < 1 + 2 * np.cos(np.deg2rad(_FARTHEST_DEG)):
            return Start(None, 0.0, sought)
    return Start(mount, share, sought)


_READING_PAIRS = 10
_APART_M = (1.2, 2.8)
"""Distance between the images of a pair: poses read wrongly move the ground further than the search."""

_TURN_RAD = np.deg2rad(2)
"""A turn between the images of a pair that is no noise of the path."""

_READING_SEARCH_M = 0.6
_READING_GRID_M = 0.06

_RIVAL = 0.5
"""As given, the share of matching patches must not fall below this part of another reading's."""

_CLEAR_SHARE = 0.2
"""Share from which on another reading is one: on even asphalt of real roads a fifth of the patches match."""


@dataclass(frozen=True)
class Readings:
    """The start as given, the shares of all readings and the best one."""

    start: Start
    shares: Mapping[Reading, float]
    best: Reading


def try_readings(drive: Drive, camera: str, matcher: Matcher, beliefs: Beliefs, others: bool) -> Readings:
    """Find a start and compare the readings of the poses; without ``others`` only the one as given."""
    start = find_start(matcher, beliefs, beliefs.guess)
    pairs = _telling_pairs(drive, camera)
    shares = {Reading.AS_GIVEN: 0.0}
    if start.mount is not None:
        shares[Reading.AS_GIVEN] = _share(matcher, beliefs, start.mount, pairs)
    if others:
        for reading in Reading:
            if reading is not Reading.AS_GIVEN:
                shares[reading] = _share_under(reading, drive, camera, matcher, beliefs, start.mount, pairs)
    best = max(shares, key=lambda reading: shares[reading])
    given = shares[Reading.AS_GIVEN]
    if shares[best] < _CLEAR_SHARE or given >= _RIVAL * shares[best]:
        best = Reading.AS_GIVEN
    return Readings(start, shares, best)


def _share_under(
    reading: Reading,
    drive: Drive,
    camera: str,
    matcher: Matcher,
    beliefs: Beliefs,
    found: Mount | None,
    pairs: IntArray,
) -> float:
    motion = motion_of(drive, camera, reading)
    backwards = reading is Reading.BACKWARDS
    guess = beliefs.guess if found is None else found
    guess = _turned(guess) if backwards else guess
    other = matcher.under(motion, turned=backwards)
    believed = replace(beliefs, motion=motion, guess=guess, surveyed=not backwards)
    if found is not None:
        return _share(other, believed, guess, pairs)
    start = find_start(other, believed, guess)
    return 0.0 if start.mount is None else _share(other, believed, start.mount, pairs)


def _telling_pairs(drive: Drive, camera: str) -> IntArray:
    """Those between which the vehicle turns most along its path; evenly spread ones on a straight route."""
    motion = motion_of(drive, camera, Reading.HEADING_FROM_PATH)
    poses = motion.poses()
    yaw = np.unwrap(heading_rad(poses))
    pairs = turning_pairs(motion.path_at_images(), yaw, _READING_PAIRS, *_APART_M)
    if len(pairs) and np.median(np.abs(yaw[pairs[:, 1]] - yaw[pairs[:, 0]])) > _TURN_RAD:
        return pairs
    return spread_pairs(motion.path_at_images(), _READING_PAIRS, *_APART_M)


def _share(matcher: Matcher, beliefs: Beliefs, mount: Mount, pairs: IntArray) -> float:
    return matcher.match(mount, beliefs.poses(), pairs, _READING_SEARCH_M, _READING_GRID_M).share


def _turned(mount: Mount) -> Mount:
    """A camera at the vehicle's other end that looks the other way."""
    half = np.diag([-1.0, -1.0, 1.0])
    return replace(
        mount,
        vehicle_from_cam_rotation=half @ mount.vehicle_from_cam_rotation,
        centre_vehicle=half @ mount.centre_vehicle,
    )
