"""Which unknowns each visit has for itself, and which several visits share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from v2hdm.adjust.problem import ControlPoints, KnownLengths, Observations, Problem
from v2hdm.records import BoolArray, IntArray


@dataclass(frozen=True)
class Part:
    """One visit of a problem, as a problem of its own without what is said of shared unknowns.

    Attributes:
        problem: its frames, its observations and the corners that it saw.
        visit: its number.
        frames: which of the whole problem's frames it has.
        corners: (n,) which of the whole problem's corners its are, ascending.
        shared: (n,) each one's number among the shared corners, -1 where it is this part's own.
        pose_states: that frames are given.
        clock_offset: whether its clock offsets are estimated.
    """

    problem: Problem
    visit: int
    frames: slice
    corners: IntArray
    shared: IntArray
    pose_states: tuple[str, ...]
    clock_offset: bool


def split(problem: Problem, pose_states: tuple[str, ...], clock_offset: bool) -> tuple[list[Part], IntArray]:
    """The visits of a problem as parts, and its corners (M,) that they share, ascending.

    Corners that known lengths join to a shared one are shared, too.
    """
    shared = np.flatnonzero(is_shared(problem))
    number = np.full(problem.corner_count, -1, dtype=np.int64)
    number[shared] = np.arange(len(shared))
    visit = problem.visit_of_frame
    bounds = np.searchsorted(visit, np.arange(problem.visit_count + 1))
    of_observation = visit[problem.observations.frame]
    parts = []
    for own in np.unique(of_observation):
        frames = slice(int(bounds[own]), int(bounds[own + 1]))
        chosen = _visit(problem, int(own), frames, of_observation == own, number)
        parts.append(Part(*chosen[:1], int(own), frames, *chosen[1:], pose_states, clock_offset))
    return parts, shared


def is_shared(problem: Problem) -> BoolArray:
    """Which corners (N,) several visits have a say in."""
    count, seen = problem.corner_count, problem.observations
    visit = problem.visit_of_frame[seen.frame]
    first = np.full(count, problem.visit_count)
    last = np.full(count, -1)
    np.minimum.at(first, seen.corner, visit)
    np.maximum.at(last, seen.corner, visit)
    lengths = problem.lengths
    if lengths is not None and len(lengths.first):
        ends = (lengths.first, lengths.second)
        edges = coo_matrix((np.ones(len(lengths.first)), ends), shape=(count, count))
        units, unit = connected_components(edges, directed=False)
        first_of, last_of = np.full(units, problem.visit_count), np.full(units, -1)
        np.minimum.at(first_of, unit, first)
        np.maximum.at(last_of, unit, last)
        first, last = first_of[unit], last_of[unit]
    return np.asarray(first < last)


def _visit(
    problem: Problem, visit: int, frames: slice, mine: BoolArray, number: IntArray
) -> tuple[Problem, IntArray, IntArray]:
    seen = problem.observations
    corners, corner = np.unique(seen.corner[mine], return_inverse=True)
    shared = number[corners]
    place = np.full(problem.corner_count, -1, dtype=np.int64)
    place[corners[shared < 0]] = np.flatnonzero(shared < 0)
    twist, start = problem.twist_vehicle, problem.corners_start
    part = replace(
        problem,
        map_from_vehicle=problem.map_from_vehicle[frames],
        observations=Observations(
            camera=seen.camera[mine],
            frame=seen.frame[mine] - frames.start,
            corner=corner.astype(np.int64),
            pinhole_px=seen.pinhole_px[mine],
            covariance_px=seen.covariance_px[mine],
        ),
        corner_count=len(corners),
        centre_vehicle=None,
        centre_sigma_m=None,
        camera_prior=None,
        corners_start=None if start is None else start[corners],
        twist_vehicle=None if twist is None else twist[frames],
        # All visits have the same columns of states, so that each is told of the noise of all.
        visit=np.full(frames.stop - frames.start, visit),
        pose_sigma=problem.pose_sigmas,
        control=_control(problem.control, place),
        lengths=_lengths(problem.lengths, place),
    )
    return part, corners, shared


def _control(control: ControlPoints | None, place: IntArray) -> ControlPoints | None:
    if control is None:
        return None
    kept = place[control.corner] >= 0
    return ControlPoints(place[control.corner[kept]], control.points_map[kept], control.sigma_m[kept])


def _lengths(lengths: KnownLengths | None, place: IntArray) -> KnownLengths | None:
    if lengths is None:
        return None
    kept = place[lengths.first] >= 0
    first, second = place[lengths.first[kept]], place[lengths.second[kept]]
    return KnownLengths(first, second, lengths.length_m[kept], lengths.sigma_m[kept])


def said_of_shared(problem: Problem, shared: IntArray) -> tuple[ControlPoints | None, KnownLengths | None]:
    """What a survey and known lengths say of the ``shared`` corners (M,), by their numbers there."""
    place = np.full(problem.corner_count, -1, dtype=np.int64)
    place[shared] = np.arange(len(shared))
    return _control(problem.control, place), _lengths(problem.lengths, place)
