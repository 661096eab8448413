"""Update of an earlier map by a new drive: ids persist, changes are listed with their evidence.

Corners in both maps are re-estimated from both. Given the errors common to markings
(:mod:`v2hdm.site.living.map_errors`), each is the mean of two under their own errors; the common ones follow
from the differences of all. So one map's drift counts once, however many markings it moved, and what one map
alone has moves with its surroundings.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig
from v2hdm.errors import MappingError
from v2hdm.geometry.planar import SHIFTS
from v2hdm.records import BoolArray, Change, Changes, Fate, FloatArray, HDMap, IntArray, Marking
from v2hdm.site.living.fates import Decision, Watched, decide
from v2hdm.site.living.looks import Looks, Observer, find_rates, with_paint
from v2hdm.site.living.map_errors import SHIFT, Errors, Shift, updated_lanes, updated_symbols


def fused(old: Marking, new: Marking, turn: int, pair: int, shift: Shift) -> Marking:
    """A marking in both maps, with the old one's id and order of corners, and the sightings of both."""
    of_old = shift.of_old.own_m2[shift.old[pair]]
    of_new = shift.of_new.own_m2[shift.new[pair]]
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
        # Standard deviation of a coordinate of the centre from the marking's own errors.
        relative_sigma_m=float(np.sqrt(np.einsum("iaja->", own.reshape(4, 2, 4, 2)) / 32)),
    )


def shifted_with(markings: Sequence[Marking], errors: Errors, of_old: bool, shift: Shift) -> list[Marking]:
    """Markings in one map alone, corrected by the estimated common error of their surroundings."""
    at = shift.of_old_at if of_old else shift.of_new_at
    mean, spread = at(errors.centres_map, errors.shared_m2)
    covariance = errors.own_m2 + SHIFT @ spread @ SHIFT.T
    return [
        replace(one, corners_map=one.corners_map - mean[k], covariance_m2=covariance[k])
        for k, one in enumerate(markings)
    ]


def fused_markings(
    old: Sequence[Marking], new: Sequence[Marking], decision: Decision
) -> tuple[dict[int, Marking], dict[int, Marking]]:
    """The updated markings, by old one and, for those without a partner, by new one."""
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
            # Repainted elsewhere: at the new map's position, under the old id.
            order = SHIFTS[pair.turn]
            rows = (2 * order[:, None] + np.arange(2)).ravel()
            covariance = moved.covariance_m2
            by_old[pair.old] = replace(
                moved,
                corners_map=moved.corners_map[order],
                covariance_m2=None if covariance is None else covariance[np.ix_(rows, rows)],
                heights_m=old[pair.old].heights_m,
                id=old[pair.old].id,
            )
    return by_old, by_new


_DRIFT_OVER_M = 30.0  # correlation length of markings' common error, m, if the map does not state it
_LIKELY = 0.5  # probability at which a marking is reported as moved, gone or new
_LEAST_PAIRED = 0.3  # least fraction of inspected markings that a drive of the same site finds again
_LOOKED = 3  # easy views of a place that count as an inspection for that fraction


@dataclass(frozen=True)
class Base:
    """An earlier map with ids, and the poses of its drives."""

    hd_map: HDMap
    poses: FloatArray  # (F, 4, 4) of its images, (0, 4, 4) if unknown
    left_out: tuple[tuple[str, FloatArray, int], ...] = ()  # class, position (2,), sightings of candidates


def update_map(
    base: Base, made: HDMap, observer: Observer, mapped: BoolArray, drift_over_m: float
) -> tuple[HDMap, Changes, IntArray, IntArray]:
    """Update the ``base`` map with ``made``, the new drive's own map in the same frame.

    Returns the map, the changes, the ids in it of the M markings of ``made`` (M,), 0 for none, and their
    corners' positions (M, 4) in its order. ``mapped`` (S,) are sightings of ``made``, ``drift_over_m`` is the
    correlation length of the poses' error. Raises MappingError if the drive finds too little of the map
    again.
    """
    old = base.hd_map.markings
    new = made.markings
    of_old = Errors.of(old, base.hd_map.drift_over_m or _DRIFT_OVER_M)
    of_new = Errors.of(new, drift_over_m)
    rates = find_rates(observer, new)
    now = observer.looks(old, ~mapped)
    before = _looks_of(base, new, observer)
    usual = float(np.mean(list(rates.values())))
    decision = decide(
        old,
        new,
        of_old,
        of_new,
        with_paint(now.watched(np.array([rates.get(one.kind, usual) for one in old])), observer, old, new),
        before.watched(np.array([rates[one.kind] for one in new]))
        if len(base.poses)
        else Watched.never(len(new)),
    )
    _check_site(decision, now, len(old))
    by_old, by_new = fused_markings(old, new, decision)
    # Ids that no feature of the map has, or ever had.
    known = [one.id or 0 for some in (old, base.hd_map.lanes, base.hd_map.symbols) for one in some]
    number = itertools.count(1 + max([base.hd_map.largest_id, *known])).__next__
    fresh = {k: replace(one, id=number()) for k, one in by_new.items()}
    gone = {k for k, probability in decision.gone.items() if probability > _LIKELY}
    updated = replace(
        base.hd_map,
        markings=(*(one for k, one in by_old.items() if k not in gone), *fresh.values()),
        lanes=updated_lanes(base.hd_map.lanes, made.lanes, decision.shift, number),
        symbols=updated_symbols(base.hd_map.symbols, made.symbols, decision.shift, number),
        drift_over_m=max(of_old.over_m, of_new.over_m),
        largest_id=number() - 1,
    )
    number_of = np.zeros(len(new), dtype=np.int64)
    corner_of = np.tile(np.arange(4), (len(new), 1))
    for k, one in fresh.items():
        number_of[k] = one.id or 0
    for pair in decision.pairs:
        number_of[pair.new] = by_old[pair.old].id or 0
        corner_of[pair.new] = np.argsort(SHIFTS[pair.turn])
    same = sum(pair.moved <= _LIKELY for pair in decision.pairs)
    shift_m = decision.shift.off_map.mean(axis=0) if len(decision.shift.old) else np.zeros(2)
    changes = _changes(decision, old, by_old, fresh, now, before)
    return updated, Changes(tuple(changes), same, shift_m), number_of, corner_of


def _looks_of(base: Base, places: Sequence[Marking], observer: Observer) -> Looks:
    """Looks of the earlier drive at ``places``, assuming the new drive's cameras at its poses."""
    poses = base.poses
    count = len(observer.cameras)
    views = Views(
        image=np.arange(count * len(poses)),
        camera=np.repeat(np.arange(count), len(poses)),
        frame=np.tile(np.arange(len(poses)), count),
    )
    rig = Rig(observer.rig.intrinsic, observer.rig.cam_from_vehicle, poses)
    corners = np.array([one.corners_map for one in places]).reshape(-1, 4, 2)
    seen = replace(observer, views=views, rig=rig).easy_views(corners)[0]
    found = np.zeros(len(places), dtype=np.int64)
    for k, one in enumerate(places):
        diagonals_m = np.linalg.norm(one.corners_map[2:] - one.corners_map[:2], axis=1)
        for kind, place, sightings in base.left_out:
            off_m = np.linalg.norm(one.corners_map.mean(axis=0) - place)
            if one.kind == kind and off_m < diagonals_m.max() / 2:
                found[k] = max(found[k], sightings)
    return Looks(np.maximum(np.bincount(seen, minlength=len(places)), found), found)


def _check_site(decision: Decision, now: Looks, count: int) -> None:
    """Reject a map of which the drive finds nearly nothing where it looked."""
    paired = np.zeros(count, dtype=bool)
    paired[[pair.old for pair in decision.pairs if pair.moved <= _LIKELY]] = True
    looked = (now.views >= _LOOKED) | paired
    if paired.sum() < _LEAST_PAIRED * looked.sum() or not looked.any():
        raise MappingError(
            f"map.base: this drive finds {paired.sum()} of {looked.sum()} markings again that it should have "
            "seen; is the map of this site and in this frame? Map the drive without it to check"
        )


def _changes(
    decision: Decision,
    old: Sequence[Marking],
    by_old: Mapping[int, Marking],
    fresh: Mapping[int, Marking],
    now: Looks,
    before: Looks,
) -> list[Change]:
    """Moved, missing and new markings, from the looks at old and new places."""
    shift = decision.shift
    out = []
    for pair in decision.pairs:
        if pair.moved <= _LIKELY:
            continue
        k = pair.old
        after = by_old[pair.old]
        mean, spread = shift.of_old_at(shift.of_old.centres_map[[k]], shift.of_old.shared_m2[[k]])
        own = shift.of_old.own_m2[k] + shift.of_new.own_m2[pair.new]
        sigma = np.sqrt(np.diag(own.reshape(4, 2, 4, 2).mean(axis=(0, 2)) + spread[0]))
        placed = old[k].corners_map - mean[0]
        moved = after.corners_map.mean(axis=0) - placed.mean(axis=0)
        numbers = pair.moved, int(now.views[k]), int(now.found[k]), after.sightings
        course = placed, after.corners_map, moved, sigma, *numbers
        out.append(Change(old[k].id or 0, old[k].kind, Fate.MOVED, *course))
    for k, gone in decision.gone.items():
        fate = Fate.VANISHED if gone > _LIKELY else Fate.NOT_SEEN
        corners = by_old[k].corners_map
        numbers = max(gone, 1 - gone), int(now.views[k]), int(now.found[k]), old[k].sightings
        left = None if gone > _LIKELY else corners
        out.append(Change(old[k].id or 0, old[k].kind, fate, corners, left, None, None, *numbers))
    for k, one in fresh.items():
        new = decision.fresh[k]
        fate = Fate.NEW if new > _LIKELY else Fate.FIRST_SEEN
        numbers = max(new, 1 - new), int(before.views[k]), int(before.found[k]), one.sightings
        out.append(Change(one.id or 0, one.kind, fate, None, one.corners_map, None, None, *numbers))
    return out
