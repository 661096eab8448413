"""How much further the answers of different stretches of a drive lie apart than their noise explains."""

from __future__ import annotations

import numpy as np

from v2hdm.ground.adjust import Adjusted, Observations, adjust
from v2hdm.ground.beliefs import Beliefs

_STRETCHES = 8
"""Enough to tell a spread, few enough that each has several pairs."""

_TOLD = [0, 1, 2, 5]
"""Roll, pitch, yaw and height: what is left is mostly the survey's word."""


def scatter(observations: Observations, beliefs: Beliefs, solved: Adjusted) -> float:
    """The factor, at least 1, by which the variances of ``solved`` are too small.

    A road is no plane, poses err otherwise than stated, and neighbouring matches share their errors. All that
    makes stretches disagree. Each is left out in turn (Efron and Stein, The jackknife estimate of variance,
    1981); the variance of the answers, over the one that they should have, is averaged over the angles and
    the height.
    """
    pairs = np.unique(observations.pair)
    place = {int(pair): float(observations.first[observations.pair == pair][0]) for pair in pairs}
    ordered = sorted(place, key=lambda pair: place[pair])
    stretches = [part for part in np.array_split(np.array(ordered), _STRETCHES) if len(part)]
    free = "clock_s" if len(solved.covariance) > 6 else None
    answers = []
    for part in stretches:
        rest = observations.only(~np.isin(observations.pair, part))
        used, believed, _ = beliefs.about(rest)
        mount = adjust(used, believed, solved.mount, free).mount
        turn = mount.vehicle_from_cam_rotation @ solved.mount.vehicle_from_cam_rotation.T
        small = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        answers.append([*(np.array(small) / 2), *(mount.centre_vehicle - solved.mount.centre_vehicle)])
    count = len(stretches)
    if count < 2:
        return 1.0
    spread = (count - 1) * np.var(np.array(answers), axis=0)
    return max(1.0, float(np.mean(spread[_TOLD] / np.diag(solved.covariance)[_TOLD])))
