"""A person's corrections of candidates: they override the images, except on the position of other corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from v2hdm.geometry.planar import clip_convex, signed_area
from v2hdm.io.maps.corrections import ACCEPTED, ADDED, REJECTED, Correction, Heard
from v2hdm.records import Exclusion, FloatArray, HDMap, IntArray, Marking
from v2hdm.site.candidates import Candidates

_SAME_M = 0.4  # largest distance, m, between a candidate's centre and the one that a person corrected
_SURE = float(
    np.log(999.0)
)  # log odds of a marking, or against it, from which the images contradict a person
_CONTRADICTS = float(chdtri(2, 1e-3))  # squared distance, in sigmas, that one of 1000 right corners exceeds
_LEAST_PAINT = 0.5  # share of a marking that is painted at least: a worn one, chosen
_ADDED = "added"  # what the map follows of a marking that a person added
MAX_OVERLAP = 0.2  # overlap of outlines, relative to the smaller, from which they are one paint


@dataclass(frozen=True)
class Stated:
    """Corrections by candidate: ``rejected`` with reasons, ``confirmed`` with the correction."""

    rejected: dict[int, str]
    confirmed: dict[int, Correction]
    rejections: tuple[tuple[int, Correction], ...] = ()  # each with a candidate that it is of

    @classmethod
    def of(cls, corrections: Sequence[Correction], corners_map: FloatArray, kinds: Sequence[str]) -> Stated:
        """Corrections of the nearest candidates (G, 4, 2), own class first; rejections are of all there."""
        rejected: dict[int, str] = {}
        confirmed: dict[int, Correction] = {}
        rejections: list[tuple[int, Correction]] = []
        for correction in of_paint(corrections):
            same = _same(correction, corners_map)
            if correction.says == REJECTED:
                rejections += [(group, correction) for group in same.tolist()]
                rejected |= dict.fromkeys(same.tolist(), reason_of(correction))
            elif len(same):
                middle = np.mean(correction.outline_map, axis=0)
                away_m = np.linalg.norm(corners_map[same].mean(axis=1) - middle, axis=1)
                away_m = away_m + [0.0 if kinds[group] == correction.kind else _SAME_M for group in same]
                confirmed[int(same[np.argmin(away_m)])] = correction
        rejected = {group: why for group, why in rejected.items() if group not in confirmed}
        return cls(rejected, confirmed, tuple(pair for pair in rejections if pair[0] in rejected))

    def placed(self, candidates: Candidates, uncorrected: Candidates) -> Candidates:
        """The candidates with the corners that a person moved.

        The other corners of the ``uncorrected`` ones give the map's shift since the correction. A corner
        placed beside others of its marking has their common error and its own sigma: a shift of the whole map
        does not reduce its weight, nor do many corrections make the map more precise.
        """
        corners = candidates.corners_map.copy()
        covariance = candidates.covariance_m2.copy()
        for group, correction in self.confirmed.items():
            if not correction.moved:
                continue
            before = np.array(correction.outline_map)
            turns = [np.roll(np.arange(4), -k) for k in range(4)]
            now = uncorrected.corners_map[group]
            turn = min(turns, key=lambda order: float(np.sum((now[order] - before) ** 2)))
            moved = [int(turn[number - 1]) for number in correction.moved]
            others = [int(k) for k in turn if k not in moved and candidates.known[group, k]] or turn.tolist()
            numbers = [turn.tolist().index(k) for k in others]
            shift = (now[others] - before[numbers]).mean(axis=0)
            mixing = np.eye(4)
            for place, corner in zip(correction.moved.values(), moved, strict=True):
                corners[group, corner] = np.array(place) + shift
                mixing[corner] = np.isin(np.arange(4), others) / len(others)
            by_axis = np.kron(mixing, np.eye(2))
            covariance[group] = by_axis @ covariance[group] @ by_axis.T
            for corner in moved:
                rows = slice(2 * corner, 2 * corner + 2)
                covariance[group][rows, rows] += correction.sigma_m**2 * np.eye(2)
        return Candidates(corners, covariance)


def heard_of(
    stated: Stated, reasons: Sequence[str | None], log_odds: FloatArray, images: IntArray, shown: Candidates
) -> tuple[Heard, ...]:
    """The corrections of candidates (G,) that the map follows, beside what the images alone say.

    By the images ``reasons`` (G,) speak against them, or None, their ``log_odds`` (G,) are of being markings,
    ``images`` (G,) show them, and their corners are those ``shown``.
    """
    heard: dict[str, Heard] = {}
    for group, correction in stated.rejections:
        is_sure = reasons[group] is None and log_odds[group] > _SURE
        against = f"{images[group]} images show it" if is_sure else ""
        if against or correction.place not in heard:
            heard[correction.place] = Heard(correction.place, "rejected", against)
    for group, correction in stated.confirmed.items():
        says = []
        against = ""
        reason = reasons[group]
        if correction.new_kind:
            says.append(f"of class {correction.new_kind}")
        if correction.moved:
            off_m, is_off = _moved_off(stated, group, shown)
            corners = ", ".join(map(str, sorted(correction.moved)))
            says.append(f"corner {corners} moved")
            if is_off:
                against = f"the images show the paint {100 * off_m:.1f} cm from there"
        if not against and reason is not None and log_odds[group] < -_SURE:
            against = f"by the images it is left out: {reason}"
        if correction.says == ADDED:
            says.append(_ADDED)
        heard[correction.place] = Heard(correction.place, ", ".join(says) or "accepted", against)
    return tuple(heard.values())


def _moved_off(stated: Stated, group: int, shown: Candidates) -> tuple[float, bool]:
    """The largest distance, m, of a moved corner from where the images show it, and if they exclude it."""
    correction = stated.confirmed[group]
    placed = stated.placed(shown, shown)
    off_m = placed.corners_map[group] - shown.corners_map[group]
    moved = np.flatnonzero(np.any(off_m != 0.0, axis=1))
    others = np.setdiff1d(np.arange(4), moved) if len(moved) < 4 else np.arange(4)
    is_off = False
    for corner in moved.tolist():
        # Beside the other corners: what all share is no difference.
        beside = np.kron(np.eye(4)[corner] - np.isin(np.arange(4), others) / len(others), np.eye(2))
        covariance_m2 = beside @ shown.covariance_m2[group] @ beside.T + correction.sigma_m**2 * np.eye(2)
        squared = float(off_m[corner] @ np.linalg.solve(covariance_m2, off_m[corner]))
        is_off = is_off or squared > _CONTRADICTS
    return float(np.linalg.norm(off_m, axis=1).max()), is_off


def added_markings(
    corrections: Sequence[Correction], markings: Sequence[Marking]
) -> tuple[tuple[Marking, ...], tuple[Heard, ...]]:
    """The markings that a person added where none of ``markings`` is, and that the map follows them.

    Their corners have the person's sigma, and the error that the corners of the nearest marking share.
    """
    corners = np.array([marking.corners_map for marking in markings]).reshape(-1, 4, 2)
    added = []
    heard = []
    for correction in of_paint(corrections):
        if correction.says != ADDED or len(_same(correction, corners)):
            continue
        outline = np.array(correction.outline_map)
        away_m = np.linalg.norm(corners.mean(axis=1) - outline.mean(axis=0), axis=1)
        nearest = markings[int(np.argmin(away_m))]
        added.append(_added_marking(correction, outline, nearest))
        heard.append(Heard(correction.place, _ADDED))
    return tuple(added), tuple(heard)


def _added_marking(correction: Correction, outline: FloatArray, nearest: Marking) -> Marking:
    shared_m2 = np.zeros((2, 2))
    if nearest.covariance_m2 is not None:
        shared_m2 = nearest.covariance_m2.reshape(4, 2, 4, 2).mean(axis=(0, 2))
    covariance_m2 = np.tile(shared_m2, (4, 4)) + correction.sigma_m**2 * np.eye(8)
    relative_sigma_m = nearest.relative_sigma_m
    if relative_sigma_m is not None:
        # The middle of four corners has half the sigma of each.
        relative_sigma_m = float(np.hypot(relative_sigma_m, correction.sigma_m / 2))
    return Marking(correction.kind, outline, 0, covariance_m2, relative_sigma_m)


def with_paint_of_added(
    heard: Sequence[Heard], corrections: Sequence[Correction], markings: Sequence[Marking]
) -> tuple[Heard, ...]:
    """The corrections that the map follows; paint that a person added has the images' evidence with it."""
    corners = np.array([marking.corners_map for marking in markings]).reshape(-1, 4, 2)
    against_of_place = {}
    for correction in of_paint(corrections):
        if correction.says != ADDED:
            continue
        for group in _same(correction, corners):
            marking = markings[group]
            if not marking.sightings:
                against_of_place[correction.place] = _against_paint(marking)
    return tuple(replace(entry, against=against_of_place.get(entry.place, entry.against)) for entry in heard)


def _against_paint(marking: Marking) -> str:
    """How the images contradict that a marking is painted; empty where they do not."""
    if marking.paint is None:
        return "no two images show its place whole from near"
    if marking.paint.share + marking.paint.sigma < _LEAST_PAINT:
        return f"the images show paint on {100 * marking.paint.share:.0f} % of it"
    return ""


def of_paint(corrections: Sequence[Correction]) -> list[Correction]:
    """The corrections of markings, symbols and candidates, without those of lane lines."""
    return [correction for correction in corrections if not correction.is_line]


def reason_of(correction: Correction) -> str:
    """The reason for a marking that a person rejected."""
    return "rejected by a person" + (f": {correction.reason}" if correction.reason else "")


def _same(correction: Correction, corners_map: FloatArray) -> IntArray:
    """The candidates on the paint that a person corrected."""
    outline = np.array(correction.outline_map)
    away_m = np.linalg.norm(corners_map.mean(axis=1) - outline.mean(axis=0), axis=1)
    if len(outline) != 4:
        return np.flatnonzero(away_m < _SAME_M)
    reach_m = float(np.ptp(outline, axis=0).max()) + _SAME_M
    in_reach = np.flatnonzero(away_m < reach_m)
    return in_reach[[overlap(corners_map[group], outline) > MAX_OVERLAP for group in in_reach]]


def is_confirmed(outline_map: FloatArray, corrections: Sequence[Correction]) -> bool:
    """Whether a person accepted or corrected the marking or symbol with that outline (N, 2)."""
    confirmed = [correction for correction in of_paint(corrections) if correction.says != REJECTED]
    if len(outline_map) == 4:
        return any(len(_same(correction, outline_map[None])) for correction in confirmed)
    middle = outline_map.mean(axis=0)
    away_m = [np.linalg.norm(np.mean(correction.outline_map, axis=0) - middle) for correction in confirmed]
    return bool(min(away_m, default=np.inf) < _SAME_M)


def overlap(a: FloatArray, b: FloatArray) -> float:
    """Common area of two convex quadrilaterals, relative to the smaller."""
    common = abs(float(signed_area(clip_convex(a, b))))
    return common / max(float(min(signed_area(a), signed_area(b))), 1e-9)


def with_symbols_corrected(
    hd_map: HDMap, corrections: Sequence[Correction]
) -> tuple[HDMap, tuple[Exclusion, ...]]:
    """The map with a person's corrections to its symbols, and the rejected symbols."""
    kept_symbols = []
    exclusions = []
    for symbol in hd_map.symbols:
        middle = symbol.outline_map.mean(axis=0)
        for correction in of_paint(corrections):
            if len(correction.outline_map) < 5 and symbol.kind != correction.kind:
                continue
            if np.linalg.norm(np.mean(correction.outline_map, axis=0) - middle) < _SAME_M:
                if correction.says == REJECTED:
                    exclusions.append(Exclusion(symbol.kind, middle, symbol.sightings, reason_of(correction)))
                    break
                symbol = replace(symbol, kind=correction.new_kind or symbol.kind)
        else:
            kept_symbols.append(symbol)
    return replace(hd_map, symbols=tuple(kept_symbols)), tuple(exclusions)


def unmet(corrections: Sequence[Correction], hd_map: HDMap) -> list[str]:
    """Corrections that found nothing at their position in a finished map."""
    corners = np.array([marking.corners_map for marking in hd_map.markings]).reshape(-1, 4, 2)
    missing = []
    for correction in of_paint(corrections):
        same = _same(correction, corners)
        kinds = {hd_map.markings[k].kind for k in same}
        middle = np.mean(correction.outline_map, axis=0)
        kinds |= {
            symbol.kind
            for symbol in hd_map.symbols
            if np.linalg.norm(symbol.outline_map.mean(axis=0) - middle) < _SAME_M
        }
        names_a_class = correction.says != ACCEPTED or bool(correction.new_kind)
        is_present = (correction.new_kind or correction.kind) in kinds if names_a_class else bool(kinds)
        if is_present == (correction.says == REJECTED):
            missing.append(correction.place)
    return missing
