"""The probability that what the network names an arrow is one: by name, length and the way it points.

Spokes of wheels, reflections and door handles are named so, too. They are shorter than arrows, and what
stands points to the camera's foot on the ground, wherever the road leads. Both add to the log odds of the
network's name. The length of one that the image's border cuts says nothing, and neither does the width of
any: shadows leave narrow parts of arrows.
"""

from __future__ import annotations

import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import as_log_odds
from v2hdm.detection.quads.propose import BORDER_PX, Proposal
from v2hdm.geometry.planar import smallest_rectangle
from v2hdm.records import FloatArray

FEATURES = ("short", "standing")
"""Log of the length over the least usual one where it is less; :meth:`RoadCamera.standing` of that side."""

_USUAL_LENGTH_M = 2.0  # of the shortest arrows of standards less what an outline loses, m
_OUTLINE_PX = 2.0  # an outline may be this much too short, px: one at either end

FITTED = (6.01, -3.59)
"""Weights of the features, fitted to photographs and renders by ``python -m train.fit_arrows``."""


def arrow_features(
    outline_vehicle: FloatArray, camera: RoadCamera, spare_m: float = 0.0, *, is_whole: bool = True
) -> FloatArray:
    """The :data:`FEATURES` (F,) of a piece with an outline (N, 2) on the ground, m.

    It may be longer by ``spare_m``. It is whole if the image's border does not cut it.
    """
    corners = smallest_rectangle(outline_vehicle)
    sides = np.diff(corners[:3], axis=0)
    length_m = np.linalg.norm(sides, axis=1)
    longest_m = max(float(length_m.max()), 1e-6)
    ahead = sides[length_m.argmax()] / longest_m
    short = min(float(np.log((longest_m + spare_m) / _USUAL_LENGTH_M)), 0.0) if is_whole else 0.0
    return np.array([short, *camera.standing(corners.mean(axis=0, keepdims=True), ahead[None])])


def features_of(piece: Proposal, camera: RoadCamera) -> FloatArray:
    """The :data:`FEATURES` (F,) of a piece of an image."""
    is_whole = bool(camera.inside(piece.blob.outline_px, BORDER_PX).all())
    middle_px = camera.undistort(piece.blob.outline_px.mean(axis=0))
    spare_m = _OUTLINE_PX * float(np.linalg.norm(camera.ground_jacobian(middle_px)[0], ord=2))
    return arrow_features(piece.outline_vehicle, camera, spare_m, is_whole=is_whole)


def arrow_probability(share: float, features: FloatArray, weights: tuple[float, ...] = FITTED) -> float:
    """The probability that a piece of such features (F,), named an arrow by ``share``, is one."""
    odds = float(as_log_odds(np.array(share))) + float(features @ np.array(weights))
    return float(1.0 / (1.0 + np.exp(-odds)))
