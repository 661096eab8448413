"""A problem cut into parts along its frames, and what the parts share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.layout import StatePrior, make_arrays, shifted, state_prior
from v2hdm.adjust.problem import ControlPoints, KnownLengths, Observations, Problem, SolveOptions
from v2hdm.records import BoolArray, FloatArray, IntArray


class Link(NamedTuple):
    """A frame whose states are predicted from those of a frame of another part; both are border frames."""

    before: int  # number of the frame before in the whole
    frame: int  # number of the frame in the whole
    transition: FloatArray  # (S, S) from the frame before
    root: FloatArray  # (S,) inverse sigma of the innovation
    root_alone: FloatArray  # (S,) inverse sigma of the states, which the frame's own part assumes


@dataclass(frozen=True)
class Part:
    """The frames of one part with all that they saw, as a problem of its own.

    Numbers in the whole: ``cameras`` (C,), ``frames`` (F,), ``corners`` (N,). ``is_start`` (F,) are frames
    whose states no frame before here predicts. ``border_frames`` and ``border_corners`` are indices here,
    ascending: of frames that a :class:`Link` couples to another part, and corners that other parts saw, too.
    """

    problem: Problem
    cameras: IntArray
    frames: IntArray
    corners: IntArray
    is_start: BoolArray
    border_frames: IntArray
    border_corners: IntArray

    def arrays(self, options: SolveOptions, origin_map: FloatArray) -> Arrays:
        """The part laid out about an origin (2,) that all parts share, its chains of states cut."""
        states = tuple(options.pose_states)
        nearby = shifted(self.problem, -origin_map)
        arrays = make_arrays(nearby, states, options.device, options.clock_offset, options.read_out)
        prior = _cut(nearby, states, self.is_start)
        return replace(
            arrays,
            state_transition=arrays.state_transition.new_tensor(prior.transition),
            state_information_root=arrays.state_information_root.new_tensor(prior.information_root),
        )


def _cut(problem: Problem, states: tuple[str, ...], is_start: BoolArray) -> StatePrior:
    """The prior of the frames' states where chains end before each start."""
    chain = np.cumsum(is_start) - 1
    sigmas = problem.pose_sigmas
    of_chain = [sigmas[session] for session in problem.session_of_frame[is_start].tolist()]
    # Those of all sessions, whether here or not, decide which states there are.
    return state_prior(replace(problem, session=chain, pose_sigma=(*of_chain, *sigmas)), states)


class Chains(NamedTuple):
    """How the states of J frames follow each other from part to part."""

    is_start: BoolArray  # (J,) frames whose states no frame before in their part predicts
    in_border: BoolArray  # (J,) frames that a link has
    links: tuple[Link, ...]


def chains_of(problem: Problem, part_of_frame: IntArray, states: tuple[str, ...]) -> Chains:
    """The chains of a problem's frames, of which only poses, sessions and their sigmas count."""
    session = problem.session_of_frame
    follows = np.concatenate([[False], session[1:] == session[:-1]])
    is_start = ~follows | np.concatenate([[True], part_of_frame[1:] != part_of_frame[:-1]])
    linked = np.flatnonzero(is_start & follows) if states else np.zeros(0, dtype=np.int64)
    in_border = np.zeros(len(session), dtype=np.bool_)
    in_border[linked] = in_border[linked - 1] = True
    return Chains(is_start, in_border, tuple(_link(problem, frame, states) for frame in linked.tolist()))


def cut(problem: Problem, part_of_frame: IntArray, states: tuple[str, ...]) -> tuple[list[Part], list[Link]]:
    """The parts of a problem by the part (J,) of each frame, numbered from 0, and their links.

    A surveyed corner, and a known length, is a matter of the first part that saw all its corners.
    """
    count = int(part_of_frame.max(initial=-1)) + 1
    chains = chains_of(problem, part_of_frame, states)
    observations = problem.observations
    part = part_of_frame[observations.frame]
    saw = np.zeros((count, problem.corner_count), dtype=np.bool_)
    saw[part, observations.corner] = True
    saw = _with_joined(problem.lengths, saw)
    shared = saw.sum(axis=0) > 1
    first_part = saw.argmax(axis=0)
    parts = []
    for number in range(count):
        frames = np.flatnonzero(part_of_frame == number)
        corners = np.flatnonzero(saw[number])
        is_first = first_part[corners] == number
        local, cameras = _local(problem, np.flatnonzero(part == number), frames, corners, is_first)
        parts.append(
            Part(
                problem=local,
                cameras=cameras,
                frames=frames,
                corners=corners,
                is_start=chains.is_start[frames],
                border_frames=np.flatnonzero(chains.in_border[frames]),
                border_corners=np.flatnonzero(shared[corners]),
            )
        )
    return parts, list(chains.links)


def whole_of(parts: Sequence[Part], bare: Problem, corners: IntArray) -> Problem:
    """The problem that was cut into parts, without surveyed corners and known lengths.

    ``bare`` has its cameras and frames; ``corners`` (N,) are those of all parts, which say where it starts.
    """
    cam_from_vehicle = bare.cam_from_vehicle.copy()
    poses_start = bare.map_from_vehicle.copy()
    corners_start = np.full((len(corners), 2), np.nan)
    twists = None if bare.twist_vehicle is None else bare.twist_vehicle.copy()
    columns = []
    for part in parts:
        problem = part.problem
        cam_from_vehicle[part.cameras] = problem.cam_from_vehicle
        if problem.poses_start is not None:
            poses_start[part.frames] = problem.poses_start
        if problem.corners_start is not None:
            corners_start[np.searchsorted(corners, part.corners)] = problem.corners_start
        if twists is not None:
            twists[part.frames] = problem.twist_vehicle
        observations = replace(
            problem.observations,
            camera=part.cameras[problem.observations.camera],
            frame=part.frames[problem.observations.frame],
            corner=np.searchsorted(corners, part.corners)[problem.observations.corner],
        )
        columns.append(vars(observations))
    stated = [name for name, column in columns[0].items() if column is not None]
    joined = {name: np.concatenate([of_part[name] for of_part in columns]) for name in stated}
    return replace(
        bare,
        observations=Observations(**joined),
        corner_count=len(corners),
        cam_from_vehicle=cam_from_vehicle,
        poses_start=poses_start,
        corners_start=None if np.isnan(corners_start).any() else corners_start,
        twist_vehicle=twists,
    )


def _with_joined(lengths: KnownLengths | None, saw: BoolArray) -> BoolArray:
    """Whether parts know corners (P, N): those that they saw, and all that known lengths join to these."""
    if lengths is None:
        return saw
    joined = saw
    while True:
        ends = joined[:, lengths.first] | joined[:, lengths.second]
        grown = joined.copy()
        for part in range(len(saw)):
            grown[part, lengths.first[ends[part]]] = True
            grown[part, lengths.second[ends[part]]] = True
        if (grown == joined).all():
            return joined
        joined = grown


def _link(problem: Problem, frame: int, states: tuple[str, ...]) -> Link:
    """The link from the frame before."""
    rows = slice(frame - 1, frame + 1)
    sigma = problem.pose_sigmas[int(problem.session_of_frame[frame])]
    sigmas = (sigma, *problem.pose_sigmas)  # all of them decide which states there are
    pair = replace(
        problem,
        map_from_vehicle=problem.map_from_vehicle[rows],
        session=np.zeros(2, dtype=np.int64),
        pose_sigma=sigmas,
    )
    prior = state_prior(pair, states)
    return Link(frame - 1, frame, prior.transition[1], prior.information_root[1], prior.information_root[0])


def _local(
    problem: Problem, rows: IntArray, frames: IntArray, corners: IntArray, is_first: BoolArray
) -> tuple[Problem, IntArray]:
    """The problem of some rows of the observations, and its cameras' numbers in the whole."""
    observations = problem.observations.take(rows)
    cameras, camera = np.unique(observations.camera, return_inverse=True)
    frame = np.searchsorted(frames, observations.frame)
    corner = np.searchsorted(corners, observations.corner)
    of_cameras = ("intrinsic", "cam_from_vehicle", "centre_vehicle", "centre_sigma_m", "read_out_s")
    of_frames = ("map_from_vehicle", "poses_start", "twist_vehicle", "session")
    numbers = dict.fromkeys(of_cameras, cameras) | dict.fromkeys(of_frames, frames)
    numbers["corners_start"] = corners
    changes = {
        name: getattr(problem, name)[at] for name, at in numbers.items() if getattr(problem, name) is not None
    }
    ground = None if problem.ground is None else problem.ground.take(cameras)
    local = replace(
        problem,
        ground=ground,
        observations=replace(observations, camera=camera, frame=frame, corner=corner),
        corner_count=len(corners),
        pose_sigma=problem.pose_sigmas,
        control=_control(problem.control, corners, is_first),
        lengths=_lengths(problem.lengths, corners, is_first),
        **changes,
    )
    return local, cameras


def _control(control: ControlPoints | None, corners: IntArray, is_first: BoolArray) -> ControlPoints | None:
    if control is None or not len(corners):
        return None
    place = np.minimum(np.searchsorted(corners, control.corner), len(corners) - 1)
    rows = np.flatnonzero((corners[place] == control.corner) & is_first[place])
    return control.take(rows, place[rows]) if len(rows) else None


def _lengths(lengths: KnownLengths | None, corners: IntArray, is_first: BoolArray) -> KnownLengths | None:
    if lengths is None or not len(corners):
        return None
    last = len(corners) - 1
    first = np.minimum(np.searchsorted(corners, lengths.first), last)
    second = np.minimum(np.searchsorted(corners, lengths.second), last)
    rows = (corners[first] == lengths.first) & (corners[second] == lengths.second) & is_first[first]
    if not rows.any():
        return None
    return KnownLengths(first[rows], second[rows], lengths.length_m[rows], lengths.sigma_m[rows])
