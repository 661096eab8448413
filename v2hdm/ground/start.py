"""An initial mounting under which the ground matches, and the reading of the poses that fits it best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from v2hdm.geometry.rigid import heading_rad
from v2hdm.ground.adjust import adjust
from v2hdm.ground.model import Mount, hit_ground
from v2hdm.ground.motion import changing_pairs, motion_of, spread_pairs
from v2hdm.ground.patches import Matcher, Matches
from v2hdm.ground.prior import Stated
from v2hdm.ground.results import Reading
from v2hdm.records import Drive, FloatArray, IntArray

_PAIRS = 10  # pairs of images for a start, and for a comparison of readings
_GRID_M = 0.06  # spacing of the resampled ground, m
_SHORT_M = (0.3, 1.6)
"""Shortest and longest baseline of a pair for the start, m: a wrong guess shifts the ground by a share."""

_TOLERANCE = 8.0  # factor on the residual at which weights fall: the guess is degrees off
_SEARCH_M = (0.9, 0.5)  # distances, m, within which a patch is looked for in the rounds of a start

_LEAST_SHARE = 0.1
"""Least matched fraction of patches: 0.16 to 0.43 in parts of a real drive half in the shade of trees, once
the pitch has settled; at most 0.09 with positions in feet or images upside down."""

_TURNS_DEG = (0.0, 3.0, -3.0, 6.0, -6.0, 9.0, -9.0, 12.0, -12.0)  # pitch offsets, tried in this order
_FARTHEST_DEG = 20.0  # largest angle between a start and its guess
_LEAST_MATCHES = 30  # matches of a start at least: ten for each angle of the mounting

# Shortest and longest baseline of a pair that separates readings, m: wrongly read poses move the ground
# beyond the search.
_APART_M = (1.2, 2.8)
_TURN_RAD = np.deg2rad(2)  # largest turn within a pair from the noise of a path
_READING_SEARCH_M = 0.6  # distance, m, within which a patch is looked for under a reading
_RIVAL = 0.5  # least matched fraction as given, relative to another reading's

# Factor on the stated motion within which the ground agrees: guesses 10 deg off in pitch yield 0.75 to 1.06,
# positions in feet 3.3.
_STRETCHED = 2.0
_CLEAR_SHARE = 0.2  # least matched fraction of another reading: a fifth, on even asphalt of real roads


@dataclass(frozen=True)
class Start:
    """The initial mounting, the matched fraction of patches under it, and the number sought."""

    mount: Mount | None
    share: float
    sought: int


def find_start(matcher: Matcher, stated: Stated, guess: Mount) -> Start:
    """The first of the guess and its copies at other pitches under which the ground matches."""
    pairs = start_pairs(stated)
    best = Start(None, 0.0, 0)
    for turn_deg in _TURNS_DEG:
        # The turn is about the camera's own x axis: a camera may look anywhere.
        sideways = guess.vehicle_from_cam_rotation[:, 0]
        turned = guess.moved(np.deg2rad(turn_deg) * sideways, np.zeros(3))
        tried = _settle(matcher, stated, pairs, turned, guess)
        if tried.mount is not None:
            return tried
        best = max(best, tried, key=lambda start: (start.share, start.sought))
    return best


def start_pairs(stated: Stated) -> IntArray:
    """Pairs (P, 2) of images for the start."""
    path_m = stated.path_m()
    pairs = spread_pairs(path_m, _PAIRS, _SHORT_M)
    if len(pairs) < _PAIRS // 2:  # images are rarer: those next to each other
        pairs = spread_pairs(path_m, _PAIRS, (_SHORT_M[0], 2 * _SHORT_M[1]))
    return pairs


def contradicts(matcher: Matcher, stated: Stated) -> bool:
    """Whether ground that fails to match in the pairs of a start contradicts the drive's statements.

    It does if patches match elsewhere and show, in most pairs, less than half or more than twice the stated
    motion, or another turn: no error of the guess explains that. Patches without a match lack texture, which
    is no evidence.
    """
    pairs = start_pairs(stated)
    pairs = pairs[:: -(-len(pairs) // _PAIRS)]
    matches_of_pair = matcher.match_anywhere(stated.guess, pairs, _GRID_M)
    share = []
    turn_rad = []
    for matches, (first, second) in zip(matches_of_pair, stated.poses()[pairs], strict=True):
        motion = _motion(matches, stated.guess)
        if motion is not None:
            stated_motion = np.linalg.inv(first) @ second
            way = stated_motion[:2, 3]
            share.append(motion[:, 2] @ way / (way @ way))
            turn_rad.append(heading_rad(motion[:, :2].T @ stated_motion[:2, :2]))
    if sum(map(len, matches_of_pair)) < _LEAST_MATCHES or not share:
        return False
    as_far = 1 / _STRETCHED < np.median(share) < _STRETCHED
    return not as_far or bool(np.median(np.abs(turn_rad)) > _TURN_RAD)


def _motion(matches: Matches, mount: Mount) -> FloatArray | None:
    """Pose (2, 3) of the vehicle at the second image relative to the first, up to scale."""
    at_origin = np.broadcast_to(np.eye(4), (len(matches), 4, 4))
    first = hit_ground(mount, matches.first_px, at_origin).points_map
    second = hit_ground(mount, matches.second_px, at_origin).points_map
    on_ground = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if np.count_nonzero(on_ground) < 2:
        return None
    motion, _ = cv2.estimateAffinePartial2D(second[on_ground], first[on_ground])
    return None if motion is None else motion.astype(np.float64)


def _settle(matcher: Matcher, stated: Stated, pairs: IntArray, mount: Mount, guess: Mount) -> Start:
    """The start that matching and adjusting in turn lead to from ``mount``."""
    surveyed = stated.with_surveyed_height()
    for search_m in _SEARCH_M:
        matched = matcher.match(mount, stated.poses(), pairs, search_m, _GRID_M)
        if len(matched) < _LEAST_MATCHES or matched.share < _LEAST_SHARE:
            return Start(None, matched.share, matched.sought)
        observed = surveyed.prior_of(matched.observations)
        mount = adjust(observed.observations, observed.prior, mount, tolerance=_TOLERANCE).mount
        away = guess.vehicle_from_cam_rotation.T @ mount.vehicle_from_cam_rotation
        if np.trace(away) < 1 + 2 * np.cos(np.deg2rad(_FARTHEST_DEG)):
            return Start(None, 0.0, matched.sought)
    return Start(mount, matched.share, matched.sought)


@dataclass(frozen=True)
class Readings:
    """The start as given, the matched fraction under every reading, and the best reading."""

    start: Start
    shares: Mapping[Reading, float]
    best: Reading


def try_readings(drive: Drive, camera: str, matcher: Matcher, stated: Stated, others: bool) -> Readings:
    """Find a start and compare readings of the poses; without ``others`` the given one only."""
    start = find_start(matcher, stated, stated.guess)
    pairs = _distinctive_pairs(drive, camera)
    shares = {Reading.AS_GIVEN: 0.0}
    if start.mount is not None:
        shares[Reading.AS_GIVEN] = _share(matcher, stated, start.mount, pairs)
    if others:
        for reading in Reading:
            if reading is not Reading.AS_GIVEN:
                shares[reading] = _share_under(reading, camera, matcher, stated, start.mount, pairs)
    best = max(shares, key=lambda reading: shares[reading])
    if shares[best] < _CLEAR_SHARE or shares[Reading.AS_GIVEN] >= _RIVAL * shares[best]:
        best = Reading.AS_GIVEN
    return Readings(start, shares, best)


def _share_under(
    reading: Reading,
    camera: str,
    matcher: Matcher,
    stated: Stated,
    start_mount: Mount | None,
    pairs: IntArray,
) -> float:
    """The matched fraction of patches under a reading of the poses; a start is found if there is none."""
    motion = motion_of(stated.drive, camera, reading)
    backwards = reading is Reading.BACKWARDS
    guess = stated.guess if start_mount is None else start_mount
    guess = guess.turned_around() if backwards else guess
    other = matcher.under(motion, turned=backwards)
    read = replace(stated, motion=motion, guess=guess, surveyed=not backwards)
    mount = guess if start_mount is not None else find_start(other, read, guess).mount
    return 0.0 if mount is None else _share(other, read, mount, pairs)


def _distinctive_pairs(drive: Drive, camera: str) -> IntArray:
    """Pairs with the largest turns along the path; evenly spread pairs on a straight route."""
    motion = motion_of(drive, camera, Reading.HEADING_FROM_PATH)
    yaw = np.unwrap(heading_rad(motion.poses()))
    pairs = changing_pairs(motion.path_at_images(), yaw[:, None], _PAIRS, _APART_M)
    if len(pairs) and np.median(np.abs(yaw[pairs[:, 1]] - yaw[pairs[:, 0]])) > _TURN_RAD:
        return pairs
    return spread_pairs(motion.path_at_images(), _PAIRS, _APART_M)


def _share(matcher: Matcher, stated: Stated, mount: Mount, pairs: IntArray) -> float:
    """The matched fraction of patches."""
    return matcher.match(mount, stated.poses(), pairs, _READING_SEARCH_M, _GRID_M).share
