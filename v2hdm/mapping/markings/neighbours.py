"""How well markings are known against each other: what they share, such as the receiver's drift, cancels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.mapping.bundle import Bundle
from v2hdm.records import FloatArray, Marking

IntArray = NDArray[np.int64]

_APART_M = 10.0
"""Distance, m, over which markings are compared: that of the next ones that a vehicle localises on."""

_OPPOSITE = ((0, 2), (1, 3))


def with_relative_sigma(
    markings: tuple[Marking, ...], groups: IntArray, bundle: Bundle
) -> tuple[Marking, ...]:
    """Markings with the standard deviation of their centres against those about ten metres away.

    Args:
        markings: with covariances.
        groups: (M,) the group of ``bundle`` that each marking is.
        bundle: the solve that they come from.

    Returns:
        The markings; one without two opposite solved corners, or alone in the map, stays as it is.
    """
    corner = bundle.corner_index[groups]
    pairs = np.stack([corner[:, list(pair)] for pair in _OPPOSITE], axis=1)
    whole = np.asarray((pairs >= 0).all(axis=2))
    known = np.flatnonzero(whole.any(axis=1))
    if len(known) < 2:
        return markings
    diagonal = pairs[known, np.argmax(whole[known], axis=1)]
    centres_map = np.array([markings[m].corners_map.mean(axis=0) for m in known])
    other = _about_ten_metres_away(centres_map)
    both = np.concatenate([diagonal, diagonal[other]], axis=1)
    scale = max(1.0, bundle.solution.chi2_per_dof)
    joint = scale * bundle.solution.corner_covariance(both)
    apart = np.kron([[0.5, 0.5, -0.5, -0.5]], np.eye(2))
    middle = np.kron([[0.5, 0.5]], np.eye(2))
    formal_m2 = np.trace(middle @ joint[:, :4, :4] @ middle.T, axis1=1, axis2=2)
    stated_m2 = np.array([_centre_variance_m2(markings[m]) for m in known])
    own_m2 = np.maximum(stated_m2 - formal_m2, 0.0)
    relative_m2 = np.trace(apart @ joint @ apart.T, axis1=1, axis2=2) + own_m2 + own_m2[other]
    out = list(markings)
    for m, variance_m2 in zip(known.tolist(), relative_m2.tolist(), strict=True):
        out[m] = replace(markings[m], relative_sigma_m=float(np.sqrt(variance_m2 / 2)))
    return tuple(out)


def _about_ten_metres_away(centres_map: FloatArray) -> IntArray:
    """For each of M places (M, 2) another one, that whose distance is the nearest to ten metres."""
    tree = cKDTree(centres_map)
    near = tree.query_ball_point(centres_map, 2 * _APART_M)
    nearest = tree.query(centres_map, k=2)[1][:, 1]
    other = np.empty(len(centres_map), dtype=np.int64)
    for m, candidates in enumerate(near):
        others = np.array([c for c in candidates if c != m] or [nearest[m]])
        distance_m = np.linalg.norm(centres_map[others] - centres_map[m], axis=1)
        other[m] = others[np.argmin(np.abs(distance_m - _APART_M))]
    return other


def _centre_variance_m2(marking: Marking) -> float:
    """Sum of the variances, m^2, of the two coordinates of a marking's centre."""
    assert marking.covariance_m2 is not None
    centre = np.kron([[0.25, 0.25, 0.25, 0.25]], np.eye(2))
    return float(np.trace(centre @ marking.covariance_m2 @ centre.T))
