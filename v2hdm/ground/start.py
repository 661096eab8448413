"""A first mounting that lets the ground match: the guess, or one that looks further up or down."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.ground.adjust import adjust
from v2hdm.ground.beliefs import Beliefs
from v2hdm.ground.matcher import Matcher
from v2hdm.ground.mount import Mount
from v2hdm.ground.pairs import spread_pairs
from v2hdm.records import FloatArray, IntArray

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
