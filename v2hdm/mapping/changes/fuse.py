"""One map of two: corners that both have are estimated anew from both, with what the errors of each share.

The errors are those of :mod:`v2hdm.mapping.changes.field`. Given the shared ones, each marking is a mean of
two by its own errors alone; what both maps have in common tells the shared ones. So a drift of one map counts
once, however many markings it moved, and what only one map has is shifted along with its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from v2hdm.geometry.quadrilateral import SHIFTS
from v2hdm.mapping.changes.decide import Decision
from v2hdm.mapping.changes.field import SHIFT, Errors, Shift
from v2hdm.records import FloatArray, Marking


def fused(old: Marking, new: Marking, turn: int, pair: int, shift: Shift) -> Marking:
    """A marking that both maps have: the old one's id and order of corners, both maps' sightings."""
    of_old, of_new = shift.of_old.own_m2[shift.old[pair]], shift.of_new.own_m2[shift.new[pair]]
    order = SHIFTS[turn]
    rows = (2 * order[:, None] + np.arange(2)).ravel()
    information = [np.linalg.inv(of_old), np.linalg.inv(of_new[np.ix_(rows, rows)])]
    own = np.linalg.inv(information[0] + information[1])
    shared, spread = shift.of_both(pair)
    corners = [old.corners_map.ravel(), new.corners_map[order].ravel()]
    parts = [
        own @ one @ (stated - SHIFT @ part)
        for one, stated, part in zip(information, corners, shared.reshape(2, 2), strict=True)
    ]
    gain = np.concatenate([own @ one @ SHIFT for one in information], axis=1)
    covariance = own + gain @ spread @ gain.T
    return replace(
        old,
        corners_map=(parts[0] + parts[1]).reshape(4, 2),
        sightings=old.sightings + new.sightings,
        covariance_m2=(covariance + covariance.T) / 2,
        relative_sigma_m=_relative(own),
    )


def shifted_with(markings: Sequence[Marking], errors: Errors, of_old: bool, shift: Shift) -> list[Marking]:
    """Markings that one map alone has, moved by the error that it shares with those which both have."""
    at = shift.of_old_at if of_old else shift.of_new_at
    mean, spread = at(errors.centres_map, errors.shared_m2)
    covariance = errors.own_m2 + SHIFT @ spread @ SHIFT.T
    return [
        replace(
            one,
            corners_map=one.corners_map - mean[k],
            covariance_m2=covariance[k],
            relative_sigma_m=one.relative_sigma_m,
        )
        for k, one in enumerate(markings)
    ]


def fused_markings(
    old: Sequence[Marking], new: Sequence[Marking], decision: Decision
) -> tuple[dict[int, Marking], dict[int, Marking]]:
    """The markings as they are now: by old one all that there were, by new one those without a partner."""
    shift = decision.shift
    by_old = dict(enumerate(shifted_with(old, shift.of_old, True, shift)))
    by_new = dict(enumerate(shifted_with(new, shift.of_new, False, shift)))
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(shift.old, shift.new, strict=True))}
    for pair in decision.pairs:
        both = number.get((pair.old, pair.new))
        moved = by_new.pop(pair.new)
        if both is not None:
            by_old[pair.old] = fused(old[pair.old], new[pair.new], pair.turn, both, shift)
        else:
            by_old[pair.old] = _repainted(old[pair.old], moved, pair.turn)
    return by_old, by_new


def _repainted(old: Marking, new: Marking, turn: int) -> Marking:
    """A marking that was painted elsewhere: where the new map has it, under the old one's id."""
    order = SHIFTS[turn]
    rows = (2 * order[:, None] + np.arange(2)).ravel()
    covariance = new.covariance_m2
    return replace(
        new,
        corners_map=new.corners_map[order],
        covariance_m2=None if covariance is None else covariance[np.ix_(rows, rows)],
        heights_m=old.heights_m,
        id=old.id,
    )


def _relative(own_m2: FloatArray) -> float:
    """Standard deviation of a coordinate of the centre by the marking's own errors."""
    return float(np.sqrt(np.einsum("iaja->", own_m2.reshape(4, 2, 4, 2)) / 32))
