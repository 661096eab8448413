"""Each camera alone against all together: markings that several saw, and the mountings."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from scipy.spatial import KDTree

from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.results.mountings import centre_sigma_m, mounting_sigmas
from v2hdm.verdict.verdict import Finding

SAME_M = 1.0
"""Centres of one marking in the maps of two cameras lie closer than this."""

LEAST_SHARED = 8
"""Markings that two maps must share for their offset to be told."""

OFFSET_LIMIT_SIGMAS = 5.0
"""Offset of two cameras' maps in the sigmas of their centres and markings: clean drives stay below 3."""

LEAST_OFFSET_M = 0.03
"""An offset of less than this is no finding, however sure it is: corners are good to two centimetres."""

MOUNTING_LIMIT_SIGMAS = 5.0
"""A mounting by one camera alone against that by all, in the sigmas of the former: clean drives stay below
2."""


def check_agreement(results: Mapping[str, MethodResult], drive: Drive) -> list[Finding]:
    """Single cameras against one another and against all of them.

    Args:
        results: the optimised results by camera set; the last one is that of all cameras.
        drive: for the driving direction.
    """
    together = list(results.values())[-1]
    alone = {name: one for name, one in results.items() if len(one.cameras) == 1}
    findings = [
        finding
        for (first, a), (second, b) in combinations(alone.items(), 2)
        if (finding := _offset(first, a, second, b, drive)) is not None
    ]
    for name, one in alone.items():
        if one.calibrations[name].covariance is None or together.calibrations[name].covariance is None:
            continue
        sigmas = mounting_sigmas(one.calibrations[name], together.calibrations[name])
        findings.append(
            judge(
                "alone and together",
                name,
                sigmas,
                MOUNTING_LIMIT_SIGMAS,
                "sigmas",
                fine="mapped alone and with the others, it has the same mounting",
                wrong=f"mapped alone its mounting is {sigmas:.0f} sigmas from the one that it has with "
                f"the others: "
                "cameras do not agree; check its clock, its survey and camera_info",
            )
        )
    return findings


def _offset(first: str, a: MethodResult, second: str, b: MethodResult, drive: Drive) -> Finding | None:
    """How far two cameras' maps are apart in the driving direction and across."""
    apart = shared_offsets(a, b, drive)
    if len(apart) < LEAST_SHARED:
        return None
    middle = np.median(apart, axis=0)
    spread = 1.4826 * np.median(np.abs(apart - middle), axis=0) / np.sqrt(len(apart))
    sigma = np.hypot(centre_sigma_m(a.calibrations[first])[:2], centre_sigma_m(b.calibrations[second])[:2])
    sigmas = np.where(np.abs(middle) > LEAST_OFFSET_M, np.abs(middle) / np.hypot(sigma, spread), 0.0)
    axis = int(np.argmax(sigmas))
    where = (("behind", "ahead of"), ("right of", "left of"))[axis][int(middle[axis] > 0)]
    cause = (
        "their clocks or the forward survey of a centre disagree",
        "a heading or a lateral survey disagrees",
    )
    return judge(
        "cameras apart",
        f"{first}, {second}",
        float(sigmas[axis]),
        OFFSET_LIMIT_SIGMAS,
        "sigmas",
        fine=f"{len(apart)} markings that both saw lie in one place",
        wrong=f"{second} maps {len(apart)} markings {100 * abs(middle[axis]):.0f} cm {where} where {first} "
        f"does: {cause[axis]}; synchronise and measure anew",
    )


def shared_offsets(a: MethodResult, b: MethodResult, drive: Drive) -> FloatArray:
    """Offsets (N, 2), forward and left, of the markings of ``b`` from those of ``a`` that they are.

    A marking is that of the other map that is nearest to it, of its class, both ways.
    """
    if not a.hd_map.markings or not b.hd_map.markings:
        return np.empty((0, 2))
    places = [np.array([one.corners_map.mean(axis=0) for one in r.hd_map.markings]) for r in (a, b)]
    trees = [KDTree(one) for one in places]
    there_m, there = trees[1].query(places[0])
    _, back = trees[0].query(places[1])
    pairs = [
        (i, int(j))
        for i, j in enumerate(there)
        if back[j] == i and there_m[i] < SAME_M and a.hd_map.markings[i].kind == b.hd_map.markings[j].kind
    ]
    if not pairs:
        return np.empty((0, 2))
    first, second = np.array(pairs).T
    apart = places[1][second] - places[0][first]
    poses = np.stack([image.map_from_vehicle for image in drive.images])
    _, nearest = KDTree(poses[:, :2, 3]).query(places[0][first])
    forward = poses[nearest, :2, 0]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    return np.stack([(apart * forward).sum(1), (apart * left).sum(1)], axis=1)
