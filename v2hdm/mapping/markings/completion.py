"""The fourth corner of a marking of which only three were seen well enough.

A container's edge, a puddle or worn paint can hide one corner from every image, and where a shadow's
edge crosses it, the corner of the sunlit part may be taken for that of the marking in every image.
Diamonds and dashes are parallelograms on the ground, so three corners imply the fourth, p1 + p3 - p2,
and with it a covariance. Whether the marking is accepted is then up to the shape that results.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.quadrilateral import characteristic_lengths
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.markings.acceptance import count_peers, least_peers
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class SolvedCorners:
    """Corners (G, 4, 2) m and their joint covariances (G, 8, 8) m^2, nan where not even three are known.

    ``completed`` (G,) marks groups with a corner that was implied and not seen.
    """

    corners_map: FloatArray
    covariance_m2: FloatArray
    completed: BoolArray


def solved_corners(bundle: Bundle) -> SolvedCorners:
    """Corners of every group of ``bundle``, a single missing one completed.

    Covariances are scaled by chi^2 per degree of freedom where that exceeds one: residuals larger
    than their stated noise make the map less certain than the noise model claims.
    """
    known = bundle.corner_index >= 0
    covariance = np.full((len(known), 8, 8), np.nan)
    scale = max(1.0, bundle.solution.chi2_per_dof)
    for count in (3, 4):
        groups = np.flatnonzero(known.sum(axis=1) == count)
        if not len(groups):
            continue
        corner = np.nonzero(known[groups])[1].reshape(-1, count)
        indices = np.take_along_axis(bundle.corner_index[groups], corner, axis=1)
        rows = (2 * corner[..., None] + np.arange(2)).reshape(len(groups), -1)
        blocks = scale * bundle.solution.corner_covariance(indices)
        covariance[groups[:, None, None], rows[:, :, None], rows[:, None, :]] = blocks
    return completed_corners(bundle.corners_map, covariance)


def completed_corners(corners_map: FloatArray, covariance_m2: FloatArray) -> SolvedCorners:
    """Corners (G, 4, 2) and covariances (G, 8, 8), nan where unknown, a single missing corner implied."""
    missing = np.asarray(np.isnan(corners_map).any(axis=2))
    completed = missing.sum(axis=1) == 1
    covariance = covariance_m2.copy()
    for group in np.flatnonzero(completed):
        # Corners in circular order after the missing one: next, opposite, previous.
        others = (int(np.argmax(missing[group])) + np.arange(1, 4)) % 4
        columns = (2 * others[:, None] + np.arange(2)).ravel()
        spread = _spread(others)
        covariance[group] = spread @ covariance_m2[group][np.ix_(columns, columns)] @ spread.T
    return SolvedCorners(complete_corners(corners_map), covariance, completed)


def without_misplaced_corners(
    solved: SolvedCorners, odd: IntArray, kind: IntArray, accepted: IntArray, options: AcceptanceOptions
) -> SolvedCorners:
    """Replace the one corner of each group ``odd`` that keeps it from having its class's shape.

    Args:
        solved: The groups' corners.
        odd: (O,) groups of an odd shape.
        kind: (G,) class of every group.
        accepted: (A,) groups that were accepted, which give their classes their shapes.
        options: When shapes agree.

    Returns:
        The corners with those of odd groups replaced where that gives them an established shape; of the
        four ways to do it, the one with the most peers, and the nearest to what was seen if several do.
    """
    corners, covariance = solved.corners_map.copy(), solved.covariance_m2.copy()
    completed = solved.completed.copy()
    known = characteristic_lengths(solved.corners_map[accepted])
    for group in odd:
        peers = known[kind[accepted] == kind[group]]
        if completed[group] or not len(peers):
            continue
        ways = np.repeat(corners[group][None], 4, axis=0)
        ways[range(4), range(4)] = np.nan
        ways = complete_corners(ways)
        agreeing = count_peers(characteristic_lengths(ways), peers, options)
        moved_m = np.linalg.norm(ways - corners[group], axis=2).max(axis=1)
        best = int(np.lexsort((moved_m, -agreeing))[0])
        if agreeing[best] < least_peers(len(peers)):
            continue
        others = (best + np.arange(1, 4)) % 4
        columns = (2 * others[:, None] + np.arange(2)).ravel()
        spread = _spread(others)
        corners[group] = ways[best]
        covariance[group] = spread @ covariance[group][np.ix_(columns, columns)] @ spread.T
        completed[group] = True
    return SolvedCorners(corners, covariance, completed)


def complete_corners(corners_map: FloatArray) -> FloatArray:
    """Quadrilaterals (G, 4, 2) with a single nan corner replaced by that of the parallelogram."""
    out = corners_map.copy()
    missing = np.asarray(np.isnan(corners_map).any(axis=2))
    partial = np.flatnonzero(missing.sum(axis=1) == 1)
    corner = np.argmax(missing[partial], axis=1)
    after, opposite, before = (corners_map[partial, (corner + step) % 4] for step in (1, 2, 3))
    out[partial, corner] = after + before - opposite
    return out


def _spread(others: np.ndarray) -> FloatArray:
    """Matrix (8, 6) from the known corners (next, opposite, previous) to all four in order."""
    spread = np.zeros((8, 6))
    missing = (int(others[0]) - 1) % 4
    for k, corner in enumerate(others.tolist()):
        spread[2 * corner : 2 * corner + 2, 2 * k : 2 * k + 2] = np.eye(2)
    for k, sign in enumerate((1.0, -1.0, 1.0)):
        spread[2 * missing : 2 * missing + 2, 2 * k : 2 * k + 2] = sign * np.eye(2)
    return spread
