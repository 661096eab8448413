"""Results that all sections share once each is mapped: the noise of poses, the names of markings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.adjust import Drift, PoseSigma
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.optimise import larger_noise
from v2hdm.mapping.results import SolveEvidence
from v2hdm.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Alone:
    """A section solved by itself, as the others need to know it.

    ``sighting`` (R,) names its sightings, over the whole drive, ``group`` and ``shift`` (R,) their markings;
    ``own_sightings`` (G,) counts a group's sightings in the section's own images. ``variance_factor`` is that
    of the observations which its solve assumes, as the joint one does. ``busiest`` is the most
    observations of a stretch of frames on which pose models are compared.
    """

    sighting: IntArray
    group: IntArray
    shift: IntArray
    own_sightings: IntArray
    estimated_sigma: tuple[PoseSigma, ...]
    stated_sigma: tuple[PoseSigma, ...]
    variance_factor: float
    observations: int
    own_frames: int
    busiest: int
    evidence: SolveEvidence


@dataclass(frozen=True)
class Names:
    """Names over the drive of a section's G groups.

    ``marking`` (G,) is the marking's, ``turned`` (G,) by how many corners its first is behind the group's,
    ``is_shared`` (G,) whether other sections have it, too, ``sightings`` (G,) counts those in the section's
    images, ``is_ours`` (G,) says whether it belongs to the section, as :func:`with_owners` has it.
    """

    marking: IntArray
    turned: IntArray
    is_shared: BoolArray
    sightings: IntArray
    is_ours: BoolArray

    def corners(self, bundle: Bundle) -> IntArray:
        """The corner (K,), over the drive, of each observation of a section's bundle."""
        turned = bundle.corner + self.turned[bundle.group]
        return np.asarray(4 * self.marking[bundle.group] + turned % 4)


class Pooled(NamedTuple):
    """The noise of all sections together."""

    pose_sigma: tuple[PoseSigma, ...]  # the larger of stated and estimated, by session
    variance_factor: float


def pooled_noise(sections: Sequence[Alone]) -> Pooled:
    """The noise that all sections together show, weighted by their frames and observations."""
    frames = np.array([section.own_frames for section in sections], dtype=np.float64)
    stated = sections[0].stated_sigma
    estimated = [
        _mean_sigma([section.estimated_sigma[session] for section in sections], frames)
        for session in range(len(stated))
    ]
    weight = np.array([section.observations for section in sections], dtype=np.float64)
    factors = np.array([section.variance_factor for section in sections])
    return Pooled(
        pose_sigma=tuple(map(larger_noise, stated, estimated)),
        variance_factor=float(np.exp(np.average(np.log(factors), weights=weight))),
    )


def _mean_sigma(sigmas: Sequence[PoseSigma], weight: FloatArray) -> PoseSigma:
    """The sigmas whose squares are the weighted means of others' squares."""

    def root_mean_square(values: Sequence[float]) -> float:
        return float(np.sqrt(np.average(np.square(values), weights=weight)))

    def mean_drift(drifts: Sequence[Drift]) -> Drift:
        over_m = float(np.exp(np.average(np.log([drift.over_m for drift in drifts]), weights=weight)))
        return Drift(root_mean_square([drift.sigma for drift in drifts]), over_m)

    return PoseSigma(
        position_m=root_mean_square([sigma.position_m for sigma in sigmas]),
        heading_rad=root_mean_square([sigma.heading_rad for sigma in sigmas]),
        roll_pitch_rad=root_mean_square([sigma.roll_pitch_rad for sigma in sigmas]),
        height_m=root_mean_square([sigma.height_m for sigma in sigmas]),
        position_drift=mean_drift([sigma.position_drift for sigma in sigmas]),
        heading_drift=mean_drift([sigma.heading_drift for sigma in sigmas]),
        roll_pitch_drift=mean_drift([sigma.roll_pitch_drift for sigma in sigmas]),
        heading_slip=max(sigma.heading_slip for sigma in sigmas),
    )


def named(sections: Sequence[Alone]) -> list[Names]:
    """The names of all sections' groups, which belong to none yet."""
    markings = _named_markings(sections)
    count = Counter(name for names in markings for name in names.marking.tolist())
    return [
        Names(
            marking=names.marking,
            turned=names.turned,
            is_shared=np.array([count[name] > 1 for name in names.marking.tolist()], dtype=np.bool_),
            sightings=section.own_sightings,
            is_ours=np.zeros(len(names.marking), dtype=np.bool_),
        )
        for names, section in zip(markings, sections, strict=True)
    ]


def with_owners(sections: Sequence[Names], corners: Sequence[IntArray]) -> list[Names]:
    """The names, with the section that each marking belongs to.

    It is the section whose own images determine most of its corners, of several that with most sightings.
    ``corners`` are by section those, over the drive, that its images determine: others are in no covariance
    of the section.
    """
    best: dict[int, tuple[int, int, int]] = {}
    claims = []
    for number, (names, determined) in enumerate(zip(sections, corners, strict=True)):
        marking, count = np.unique(np.unique(determined) // 4, return_counts=True)
        corners_of = dict(zip(marking.tolist(), count.tolist(), strict=True))
        pairs = zip(names.marking.tolist(), names.sightings.tolist(), strict=True)
        claims.append([(name, (corners_of.get(name, 0), count_in, -number)) for name, count_in in pairs])
        for name, claim in claims[-1]:
            best[name] = max(best.get(name, claim), claim)
    return [
        replace(names, is_ours=np.array([best[name] == claim for name, claim in of_section], dtype=np.bool_))
        for names, of_section in zip(sections, claims, strict=True)
    ]


class _Turned(NamedTuple):
    marking: IntArray  # (G,)
    turned: IntArray  # (G,)


def _named_markings(sections: Sequence[Alone]) -> list[_Turned]:
    """Names over the drive of each section's groups, and by how many corners these are turned.

    Groups of two sections are one marking if they have sightings in common; of several such pairs those with
    the most count, and no marking has two groups of one section.
    """
    first = np.cumsum([0, *(len(section.own_sightings) for section in sections)])
    key = np.concatenate([section.sighting for section in sections])
    group = np.concatenate(
        [section.group + begin for section, begin in zip(sections, first[:-1], strict=True)]
    )
    shift = np.concatenate([section.shift for section in sections])
    section_of = np.repeat(np.arange(len(sections)), np.diff(first))
    order = np.argsort(key, kind="stable")
    key, group, shift = key[order], group[order], shift[order]
    pairs = [np.zeros((0, 3), dtype=np.int64)]
    for step in range(1, len(sections)):
        same = np.flatnonzero(key[step:] == key[:-step]) if len(key) > step else np.zeros(0, dtype=np.int64)
        if not len(same):
            break
        other = same + step
        # Corner c of group a is the sighting's c + shift: that of group b is c + shift_a - shift_b.
        pairs.append(np.stack([group[same], group[other], (shift[same] - shift[other]) % 4], axis=1))
    rows, counts = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    name = np.arange(first[-1])
    turn = np.zeros(first[-1], dtype=np.int64)  # corner c of the group is corner c + turn of the marking
    members: dict[int, list[int]] = {}
    for a, b, by in rows[np.argsort(-counts, kind="stable")].tolist():
        of_a = members.get(int(name[a]), [a])
        of_b = members.get(int(name[b]), [b])
        if name[a] == name[b] or {*section_of[of_a]} & {*section_of[of_b]}:
            continue
        # c of a is c + by of b; the marking's corner is c + turn[a] by a, c + by + turn[b] by b.
        extra = (turn[a] - by - turn[b]) % 4
        for member in of_b:
            turn[member] = (turn[member] + extra) % 4
            name[member] = name[a]
        members[int(name[a])] = [*of_a, *of_b]
    return [
        _Turned(marking, turned)
        for marking, turned in zip(np.split(name, first[1:-1]), np.split(turn, first[1:-1]), strict=True)
    ]
