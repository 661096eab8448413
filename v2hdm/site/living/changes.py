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
from typing import NamedTuple

import numpy as np

from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig
from v2hdm.errors import MappingError
from v2hdm.geometry.planar import SHIFTS
from v2hdm.records import (
    UNSTATED_DRIFT_OVER_M,
    BoolArray,
    Change,
    Changes,
    Fate,
    FloatArray,
    HDMap,
    IntArray,
    Marking,
)
from v2hdm.site.living.fates import Decision, Pair, Watched, decide
from v2hdm.site.living.looks import Looks, Observer, find_rates, with_paint
from v2hdm.site.living.map_errors import SHIFT, Errors, Shift, updated_lanes, updated_symbols


def fused(old: Marking, new: Marking, turn: int, pair: int, shift: Shift) -> Marking:
    """A marking in both maps, with the old one's id and order of corners, and the sightings of both."""
    of_old = shift.of_old.own_m2[shift.old[pair]]
    of_new = shift.of_new.own_m2[shift.new[pair]]
    order = SHIFTS[turn]
    rows = _coordinates(order)
    information = [np.linalg.inv(of_old), np.linalg.inv(of_new[np.ix_(rows, rows)])]
    own_m2 = np.linalg.inv(information[0] + information[1])
    shared, spread = shift.of_both(pair)
    corners_of_maps = [old.corners_map.ravel(), new.corners_map[order].ravel()]
    parts = [
        own_m2 @ inverse_m2 @ (stated_corners - SHIFT @ shared_part)
        for inverse_m2, stated_corners, shared_part in zip(
            information, corners_of_maps, shared.reshape(2, 2), strict=True
        )
    ]
    gain = np.concatenate([own_m2 @ inverse_m2 @ SHIFT for inverse_m2 in information], axis=1)
    covariance = own_m2 + gain @ spread @ gain.T
    return replace(
        old,
        corners_map=(parts[0] + parts[1]).reshape(4, 2),
        sightings=old.sightings + new.sightings,
        covariance_m2=(covariance + covariance.T) / 2,
        # Standard deviation of a coordinate of the centre from the marking's own errors.
        relative_sigma_m=float(np.sqrt(np.einsum("iaja->", own_m2.reshape(4, 2, 4, 2)) / 32)),
    )


def _coordinates(order: IntArray) -> IntArray:
    """Rows (8,) of the stacked corners in an ``order`` (4,)."""
    return (2 * order[:, None] + np.arange(2)).ravel()


def shifted_with(markings: Sequence[Marking], errors: Errors, of_old: bool, shift: Shift) -> list[Marking]:
    """Markings in one map alone, corrected by the estimated common error of their surroundings."""
    estimate_at = shift.of_old_at if of_old else shift.of_new_at
    mean, spread = estimate_at(errors.centres_map, errors.shared_m2)
    covariance = errors.own_m2 + SHIFT @ spread @ SHIFT.T
    return [
        replace(marking, corners_map=marking.corners_map - mean[k], covariance_m2=covariance[k])
        for k, marking in enumerate(markings)
    ]


class Fused(NamedTuple):
    """The markings of an updated map."""

    by_old: dict[int, Marking]  # by number of the old marking
    by_new: dict[int, Marking]  # those without an old one, by number of the new marking


def fused_markings(old: Sequence[Marking], new: Sequence[Marking], decision: Decision) -> Fused:
    """The updated markings from both maps."""
    shift = decision.shift
    by_old = dict(enumerate(shifted_with(old, shift.of_old, True, shift)))
    by_new = dict(enumerate(shifted_with(new, shift.of_new, False, shift)))
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(shift.old, shift.new, strict=True))}
    for pair in decision.pairs:
        pair_of_shift = number.get((pair.old, pair.new))
        moved = by_new.pop(pair.new)
        if pair_of_shift is not None:
            by_old[pair.old] = fused(old[pair.old], new[pair.new], pair.turn, pair_of_shift, shift)
        else:
            # Repainted elsewhere: at the new map's position, under the old id.
            order = SHIFTS[pair.turn]
            rows = _coordinates(order)
            covariance = moved.covariance_m2
            by_old[pair.old] = replace(
                moved,
                corners_map=moved.corners_map[order],
                covariance_m2=None if covariance is None else covariance[np.ix_(rows, rows)],
                heights_m=old[pair.old].heights_m,
                id=old[pair.old].id,
            )
    return Fused(by_old, by_new)


_LIKELY = 0.5  # probability at which a marking is reported as moved, gone or new
_LEAST_PAIRED = 0.3  # least fraction of inspected markings that a drive of the same site finds again
_LOOKED = 3  # least number of easy views of a place that is counted as inspected


@dataclass(frozen=True)
class Base:
    """An earlier map with ids, and the poses of its drives."""

    hd_map: HDMap
    poses: FloatArray  # (F, 4, 4) of its images, (0, 4, 4) if unknown
    left_out: tuple[tuple[str, FloatArray, int], ...] = ()  # class, position (2,), sightings of candidates


class Update(NamedTuple):
    """A map updated by a drive, and where the M markings of the drive's own map are in it."""

    hd_map: HDMap
    changes: Changes
    ids: IntArray  # (M,) ids of the drive's markings, 0 for none
    corners: IntArray  # (M, 4) positions of their corners in the updated map's order


def update_map(
    base: Base, drive_map: HDMap, observer: Observer, mapped: BoolArray, drift_over_m: float
) -> Update:
    """Update the ``base`` map with ``drive_map``, the new drive's own map in the same frame.

    ``mapped`` (S,) are sightings of ``drive_map``, ``drift_over_m`` is the correlation length of the poses'
    error. Raises MappingError if the drive finds too little of the map again.
    """
    old = base.hd_map.markings
    new = drive_map.markings
    of_old = Errors.of(old, base.hd_map.drift_over_m or UNSTATED_DRIFT_OVER_M)
    of_new = Errors.of(new, drift_over_m)
    rates = find_rates(observer, new)
    now = observer.looks(old, ~mapped)
    before = _looks_of(base, new, observer)
    usual = float(np.mean(list(rates.values())))
    watched_now = now.watched(np.array([rates.get(marking.kind, usual) for marking in old]))
    watched_before = Watched.never(len(new))
    if len(base.poses):
        watched_before = before.watched(np.array([rates[marking.kind] for marking in new]))
    decision = decide(old, new, of_old, of_new, with_paint(watched_now, observer, old, new), watched_before)
    _check_site(decision, now, len(old))
    by_old, by_new = fused_markings(old, new, decision)
    # Ids that no feature of the map has, or ever had.
    used_ids = [
        feature.id or 0 for features in (old, base.hd_map.lanes, base.hd_map.symbols) for feature in features
    ]
    next_id = itertools.count(1 + max([base.hd_map.largest_id, *used_ids])).__next__
    fresh = {k: replace(marking, id=next_id()) for k, marking in by_new.items()}
    gone = {k for k, probability in decision.gone.items() if probability > _LIKELY}
    updated = replace(
        base.hd_map,
        markings=(*(marking for k, marking in by_old.items() if k not in gone), *fresh.values()),
        lanes=updated_lanes(base.hd_map.lanes, drive_map.lanes, decision.shift, next_id),
        symbols=updated_symbols(base.hd_map.symbols, drive_map.symbols, decision.shift, next_id),
        drift_over_m=max(of_old.over_m, of_new.over_m),
        largest_id=next_id() - 1,
    )
    number_of = np.zeros(len(new), dtype=np.int64)
    corner_of = np.tile(np.arange(4), (len(new), 1))
    for k, marking in fresh.items():
        number_of[k] = marking.id or 0
    for pair in decision.pairs:
        number_of[pair.new] = by_old[pair.old].id or 0
        corner_of[pair.new] = np.argsort(SHIFTS[pair.turn])
    same = sum(pair.moved <= _LIKELY for pair in decision.pairs)
    shift_m = decision.shift.off_map.mean(axis=0) if len(decision.shift.old) else np.zeros(2)
    changes = _changes(decision, old, by_old, fresh, now, before)
    return Update(updated, Changes(tuple(changes), same, shift_m), number_of, corner_of)


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
    corners = np.array([marking.corners_map for marking in places]).reshape(-1, 4, 2)
    place_of_view = replace(observer, views=views, rig=rig).easy_views(corners)[0]
    detections = np.zeros(len(places), dtype=np.int64)
    for k, marking in enumerate(places):
        diagonals_m = np.linalg.norm(marking.corners_map[2:] - marking.corners_map[:2], axis=1)
        for kind, position, sightings in base.left_out:
            off_m = np.linalg.norm(marking.corners_map.mean(axis=0) - position)
            if marking.kind == kind and off_m < diagonals_m.max() / 2:
                detections[k] = max(detections[k], sightings)
    near_views = np.bincount(place_of_view, minlength=len(places))
    return Looks(np.maximum(near_views, detections), detections)


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
    changes = [
        _move(pair, old[pair.old], by_old[pair.old], decision.shift, now)
        for pair in decision.pairs
        if pair.moved > _LIKELY
    ]
    for k, gone in decision.gone.items():
        corners = by_old[k].corners_map
        is_gone = gone > _LIKELY
        changes.append(
            Change(
                id=old[k].id or 0,
                kind=old[k].kind,
                fate=Fate.VANISHED if is_gone else Fate.NOT_SEEN,
                before=corners,
                after=None if is_gone else corners,
                shift_m=None,
                shift_sigma_m=None,
                probability=max(gone, 1 - gone),
                views=int(now.views[k]),
                views_showing=int(now.detections[k]),
                sightings=old[k].sightings,
            )
        )
    for k, marking in fresh.items():
        new = decision.fresh[k]
        changes.append(
            Change(
                id=marking.id or 0,
                kind=marking.kind,
                fate=Fate.NEW if new > _LIKELY else Fate.FIRST_SEEN,
                before=None,
                after=marking.corners_map,
                shift_m=None,
                shift_sigma_m=None,
                probability=max(new, 1 - new),
                views=int(before.views[k]),
                views_showing=int(before.detections[k]),
                sightings=marking.sightings,
            )
        )
    return changes


def _move(pair: Pair, old: Marking, after: Marking, shift: Shift, now: Looks) -> Change:
    """The change of a marking that was repainted elsewhere, from ``old`` to ``after``."""
    k = pair.old
    mean, spread = shift.of_old_at(shift.of_old.centres_map[[k]], shift.of_old.shared_m2[[k]])
    own_m2 = shift.of_old.own_m2[k] + shift.of_new.own_m2[pair.new]
    corners_before = old.corners_map - mean[0]
    return Change(
        id=old.id or 0,
        kind=old.kind,
        fate=Fate.MOVED,
        before=corners_before,
        after=after.corners_map,
        shift_m=after.corners_map.mean(axis=0) - corners_before.mean(axis=0),
        shift_sigma_m=np.sqrt(np.diag(own_m2.reshape(4, 2, 4, 2).mean(axis=(0, 2)) + spread[0])),
        probability=pair.moved,
        views=int(now.views[k]),
        views_showing=int(now.detections[k]),
        sightings=after.sightings,
    )
