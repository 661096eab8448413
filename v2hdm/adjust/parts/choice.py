"""In one piece, or in parts where that takes clearly fewer multiplications.

In one piece corners are eliminated first, which couples all frames that saw one: where many visits drive the
same way, tiles of all of them fill up, and cost grows with the cube of their number. In parts shared corners
come last: a part carries a column of all its frames for each that it saw, and the head factorises them all.
So parts pay where few corners are shared, or many visits share them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from v2hdm.adjust.layout import make_arrays, state_components
from v2hdm.adjust.parts.solve import solve_in_parts
from v2hdm.adjust.parts.split import is_shared
from v2hdm.adjust.parts.team import Local, Team
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.reduced import make_plan
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import solve

_log = logging.getLogger(__name__)

_CLEARLY_LESS = 0.5
"""Share of the multiplications from which parts pay; they are not all that takes time."""

_WORTH_WORKERS = 2e9
"""Multiplications of a whitening in parts below which this process is done before others have started."""


def adjust(problem: Problem, options: SolveOptions, how: str, team: Callable[[int], Team]) -> Solution:
    """Solve in one piece or in parts.

    Args:
        problem: what was seen.
        options: how to solve.
        how: ``together``; ``parts``, where there are any; or ``auto``, which looks at the problem alone, so
            that a map does not depend on who made it.
        team: those who adjust so many parts; under ``auto`` small ones are left to this process.

    Raises:
        AdjustError: as :func:`v2hdm.adjust.solve`.
    """
    visits = len(np.unique(problem.visit_of_frame[problem.observations.frame]))
    if how == "together" or visits < 2 or not _can_be_parted(problem, options):
        return solve(problem, options)
    if how == "auto":
        parts, together = cost_in_parts(problem, options), cost_together(problem, options)
        _log.debug("multiplications of a whitening: %.1e in parts, %.1e together", parts, together)
        if parts > _CLEARLY_LESS * together:
            return solve(problem, options)
        if parts < _WORTH_WORKERS:
            return solve_in_parts(problem, options, Local())
    return solve_in_parts(problem, options, team(visits))


def _can_be_parted(problem: Problem, options: SolveOptions) -> bool:
    near = not options.coarse and problem.camera_prior is None
    return near and options.solver == "lbfgs" and options.device == "cpu"


def cost_in_parts(problem: Problem, options: SolveOptions) -> float:
    """Multiplications of a whitening in parts, those of all parts and of the head."""
    seen, visit = problem.observations, problem.visit_of_frame
    states = len(state_components(problem.pose_sigmas, tuple(options.pose_states))[0])
    cameras, shared = 6 * len(problem.intrinsic), is_shared(problem)
    count = (cameras + 2.0 * np.count_nonzero(shared)) ** 3 / 6
    for own in np.unique(visit[seen.frame]):
        corners = np.unique(seen.corner[visit[seen.frame] == own])
        columns = cameras + 2.0 * np.count_nonzero(shared[corners])
        count += np.count_nonzero(visit == own) * states * columns**2
    return float(count)


def cost_together(problem: Problem, options: SolveOptions) -> float:
    """Multiplications of a whitening in one piece."""
    arrays = make_arrays(problem, tuple(options.pose_states), "cpu", options.clock_offset)
    plan = make_plan(arrays)
    size = plan.frames_per_tile * len(arrays.states)
    tiles = np.array([len(below) for below in plan.pattern.below], dtype=float)
    heights = tiles * size + arrays.camera_count * arrays.camera_unknowns
    return float(np.sum(size**3 / 6 + heights * size**2 / 2 + heights**2 * size / 2))
