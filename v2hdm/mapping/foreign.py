"""Test whether a segment is of another drive: each misses markings that should be in the other's view."""

from __future__ import annotations

import numpy as np
from scipy.special import betaln

from v2hdm.association.ground import Views, easy_views
from v2hdm.association.sightings import Sightings
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.results import ForeignSegment
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray

_DISTANCES = 10  # bins of a camera's views by distance, each with its own detection rate
_ENDS = 60  # candidate ends of a segment within a session

_PSEUDO_VIEWS = 2.0
"""Views that the drive's detection rate is worth for that of one marking: some are worn or half hidden."""

_BY_MISTAKE = 0.05  # rate of a marking of one place being taken for one of the other
_CONFUSED = 0.3  # fraction of markings that mix two, one of each place

_HIDDEN = 0.08
"""Fraction of markings that a vehicle or a post hides in consecutive views: maximum likelihood for the 285
markings of eight simulated drives (right_drives, seeds 1030 to 1037)."""


def foreign_segment(
    bundle: Bundle, sightings: Sightings, views: Views, cameras: tuple[Camera, ...]
) -> ForeignSegment:
    """The most likely foreign segment, with its log-likelihood ratio.

    Markings of both places must be missing from the other's views, so that lorries and worn paint make no
    segment: the gain is the lower of both places'.
    """
    group, image = easy_views(views, bundle.rig, cameras, bundle.corners_map)
    accepted = bundle.inliers
    size = int(views.image.max()) + 1
    sighted = bundle.group[accepted] * size + sightings.image[bundle.row[accepted]]
    detected = np.isin(group * size + image, sighted)
    view = np.searchsorted(views.image, image)
    frame = views.frame[view]
    away_m = bundle.corners_map[group].mean(axis=1) - bundle.rig.map_from_vehicle[frame, :2, 3]
    # A miss counts less where markings at that distance are detected less often.
    counted = np.where(detected, 1.0, _ease(detected, views.camera[view], np.linalg.norm(away_m, axis=1)))
    best = ForeignSegment(0.0, 0.0, -np.inf)
    for session in np.unique(sightings.session):
        frames = np.flatnonzero(sightings.session == session)
        in_session = sightings.session[frame] == session
        in_session &= np.isin(group, group[in_session & detected])
        if not in_session.any():
            continue
        ends = np.unique(np.linspace(0, len(frames), _ENDS + 1).astype(np.int64))
        groups, number = np.unique(group[in_session], return_inverse=True)
        counts = np.zeros((2, len(ends), len(groups)))  # cumulative views: with a detection, and all
        step = np.searchsorted(ends, frame[in_session] - frames[0], side="right")
        for count, views_of_kind in zip(counts, (detected[in_session], counted[in_session]), strict=True):
            np.add.at(count, (step, number), views_of_kind)
        counts = counts.cumsum(axis=1)
        share = (detected[in_session].sum() + 1.0) / (counted[in_session].sum() + 2.0)
        for first in range(len(ends) - 1):
            gains = _gains(counts[:, first + 1 :] - counts[:, first, None], counts[:, -1, None], share)
            last = first + 1 + int(gains.argmax())
            gain = float(gains.max() - np.log(len(ends) * (len(ends) - 1) / 2))
            if gain > best.gain:
                begin_s, end_s = sightings.stamp_s[frames[[ends[first], ends[last] - 1]]]
                best = ForeignSegment(float(begin_s), float(end_s), gain)
    return best


def _ease(detected: BoolArray, camera: IntArray, distance_m: FloatArray) -> FloatArray:
    """Detection rate (P,) at a marking's distance from a camera, relative to the camera's best."""
    ease = np.ones(len(detected))
    for index in np.unique(camera):
        views = np.flatnonzero(camera == index)
        parts = np.array_split(views[np.argsort(distance_m[views])], _DISTANCES)
        rates = np.array([(detected[part].sum() + 1.0) / (len(part) + 2.0) for part in parts])
        for part, rate in zip(parts, rates / rates.max(), strict=True):
            ease[part] = rate
    return ease


def _gains(within: FloatArray, all_over: FloatArray, share: float) -> FloatArray:
    """Gains (E,) of segments, from views (2, E, G) within them, with detections and in all; and overall."""
    beyond = all_over - within
    together = _log_likelihood(all_over, share)
    mistake = np.log([_BY_MISTAKE, 1 - _BY_MISTAKE])

    def of_place(inside: FloatArray, outside: FloatArray) -> FloatArray:
        likelihood = _log_likelihood(inside, share)
        return np.asarray(likelihood + outside[0] * mistake[0] + (outside[1] - outside[0]) * mistake[1])

    home = of_place(beyond, within)
    foreign = of_place(within, beyond)
    hidden = np.maximum(home, foreign) + np.log(_HIDDEN / np.maximum(all_over[1], 1.0))
    usual = np.logaddexp(np.log(1 - _HIDDEN) + together, hidden)
    home = home - usual
    foreign = foreign - usual
    home = np.where(beyond[0] > 0, home, -np.inf)
    foreign = np.where(within[0] > 0, foreign, -np.inf)
    gain = np.maximum(np.maximum(home, foreign), np.log(_CONFUSED))
    is_mixed = (within[0] > 0) & (beyond[0] > 0)
    of_home = np.sum(gain, axis=1, where=~is_mixed & (home >= foreign))
    of_foreign = np.sum(gain, axis=1, where=~is_mixed & (home < foreign))
    return np.asarray(np.sum(gain, axis=1, where=is_mixed) + np.minimum(of_home, of_foreign))


def _log_likelihood(counts: FloatArray, share: float) -> FloatArray:
    """Beta-binomial log-likelihood of each marking's detections in its views."""
    a = _PSEUDO_VIEWS * share
    b = _PSEUDO_VIEWS * (1 - share)
    return np.asarray(betaln(counts[0] + a, counts[1] - counts[0] + b) - betaln(a, b))
