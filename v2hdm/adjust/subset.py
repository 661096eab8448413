"""A part of a problem as a problem of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.adjust.problem import ControlPoints, KnownLengths, Observations, Problem
from v2hdm.records import BoolArray, IntArray


def restrict(problem: Problem, keep: BoolArray) -> tuple[Problem, IntArray]:
    """``problem`` with the observations ``keep`` (K,) only, and the corners and frames between them.

    Every camera must keep an observation. Frames are cut off before the first and after the last that
    is used, so that a drift still runs through the others.

    Returns:
        The part, and the corners of ``problem`` that its corners are.
    """
    seen = problem.observations
    corners, corner = np.unique(seen.corner[keep], return_inverse=True)
    frame = seen.frame[keep]
    used = slice(int(frame.min()), int(frame.max()) + 1)
    start, twist, control = problem.corners_start, problem.twist_vehicle, problem.control
    if control is not None:
        left = np.isin(control.corner, corners)
        number = np.searchsorted(corners, control.corner[left])
        control = ControlPoints(number, control.points_map[left], control.sigma_m[left])
    lengths = problem.lengths
    if lengths is not None:
        left = np.isin(lengths.first, corners) & np.isin(lengths.second, corners)
        first, second = (np.searchsorted(corners, ends[left]) for ends in (lengths.first, lengths.second))
        lengths = KnownLengths(first, second, lengths.length_m[left], lengths.sigma_m[left])
    part = replace(
        problem,
        map_from_vehicle=problem.map_from_vehicle[used],
        observations=Observations(
            camera=seen.camera[keep],
            frame=frame - used.start,
            corner=corner.astype(np.int64),
            pinhole_px=seen.pinhole_px[keep],
            covariance_px=seen.covariance_px[keep],
        ),
        corner_count=len(corners),
        corners_start=None if start is None else start[corners],
        twist_vehicle=None if twist is None else twist[used],
        visit=None if problem.visit is None else problem.visit[used],
        control=control,
        lengths=lengths,
    )
    return part, corners
