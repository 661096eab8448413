"""Ends of markings at which something hides the rest of the paint, as far as one image tells.

Where paint ends, the ground beside it goes on; where a thing stands on the paint, it ends with it, on both
sides. So the ground before the end, on each side, is compared with what lies beyond. One image seldom tells
for sure: shadows, seams and patches end with paint by chance, and things may have the ground's tone. What
several images show settles the rest (:mod:`v2hdm.site.standing`).
"""

from __future__ import annotations

import numpy as np

from v2hdm.detection.quads.patch import ImageQuads, Patches, grey_of, log_light
from v2hdm.geometry.planar import Quad
from v2hdm.records import BoolArray, FloatArray, IntArray

_ASPECT = 2.0  # length over width from which a marking has ends, which things hide a part at a time

_BESIDE_PX = np.array([2.5, 4.5, 6.5, 8.5])  # distances from the long sides, px, of the ground looked at
_ACROSS_PX = np.array([1.5, 2.5, 3.5, 4.5])  # distances from an end, px; nearer to it the edge blurs

_HIDDEN = 0.01
"""Prior probability that an end is behind a thing: 14 of 583 were in renders, none of 750 in photographs."""

_SURE = 0.9  # least posterior probability of an end that is taken to be hidden

# Logistic regression by the smaller of the steps of log grey on the two sides, on 157 ends hidden by boxes in
# renders, and on 954 ends there and 150 in photographs that nothing hides, renders and photographs of equal
# weight. It ranks 78 % of the pairs of a hidden and a visible end in renders right. The script is not kept.
_BIAS = -0.6  # log-likelihood ratio of a hidden end where there is no step
_PER_STEP = 4.5  # log-likelihood ratio that a step of one in log grey adds


def hidden_ends(patches: Patches, quads: ImageQuads, ground: Quad) -> BoolArray:
    """Which sides (M, 4) are ends of long markings at which something surely hides the rest of the paint.

    ``quads`` are in the image, ``ground`` on the ground.
    """
    longer = np.roll(ground.length, 1, axis=1) + np.roll(ground.length, -1, axis=1)
    hidden = longer > 2 * _ASPECT * ground.length
    marking, side = np.nonzero(hidden)
    if not len(marking):
        return np.asarray(hidden)
    points = _places(quads.take(marking), side)
    step = _step(log_light(grey_of(patches.light_at(points))))
    in_image = ~patches.outside(points).any(axis=(1, 2, 3))
    log_odds = _BIAS + _PER_STEP * step - np.log(1 / _HIDDEN - 1)
    hidden[marking, side] = in_image & (log_odds > np.log(_SURE / (1 - _SURE)))
    return np.asarray(hidden)


def _places(quads: ImageQuads, side: IntArray) -> FloatArray:
    """Where (E, 2, 4, 8, 2), recorded px, an image is looked at about a ``side`` (E,) of E quadrilaterals.

    The 2 are the sides of its paint, the 4 distances from it; four of the 8 lie beyond the end, four before.
    """
    end = np.arange(len(side))
    first, last, after, before = quads.corners[end, (side + np.arange(4)[:, None]) % 4]
    inward = before - first + after - last
    inward = inward / np.maximum(np.linalg.norm(inward, axis=-1), 1e-6)[:, None]
    aside = quads.tangent[end, side][:, None] * _BESIDE_PX[:, None]
    beside = np.stack([first[:, None] - aside, last[:, None] + aside], axis=1)
    across = np.concatenate([-_ACROSS_PX, _ACROSS_PX])[:, None] * inward[:, None]
    points = beside[:, :, :, None] + across[:, None, None]
    return quads.px(points.reshape(len(end), -1, 2)).reshape(points.shape)


def _step(light: FloatArray) -> FloatArray:
    """Size (E,) of the smaller step on the two sides, of ``light`` (E, 2, 4, 8) at :func:`_places`."""
    beyond = light[..., : len(_ACROSS_PX)].mean(axis=-1)
    before = light[..., len(_ACROSS_PX) :].mean(axis=-1)
    return np.asarray(np.abs(np.median(beyond - before, axis=2)).min(axis=1), dtype=np.float64)
