"""A problem as tensors: 52 bytes an observation, sorted by corner, corners in route order, read in runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

_RUN = 1 << 14  # observations per run: intermediate results stay in the processor's cache
_RUN_ON_DEVICE = 1 << 20  # observations per run on a graphics processor: few launches, and memory for each


@dataclass(frozen=True)
class Lengths:
    """Known distances between the corners ``first`` and ``second`` (M,), and 1 / sigma of each."""

    first: Tensor
    second: Tensor
    length_m: Tensor
    information_root: Tensor


@dataclass(frozen=True)
class Run:
    """Consecutive corners with all their observations: k observations of n corners.

    ``observations`` and ``corners`` are ranges of the problem's, ``corner`` (k,) counts from the run's first;
    ``pair`` (k,), ``measured`` (2, k) and ``root_information`` (3, k) are as in :class:`Arrays`.
    """

    observations: slice
    corners: slice
    pair: Tensor
    corner: Tensor
    measured: Tensor
    root_information: Tensor

    @cached_property
    def corner_count(self) -> int:
        """Number of corners, n."""
        return int(self.corners.stop - self.corners.start)

    def sum_by_corner(self, rows: Tensor) -> Tensor:
        """Sums (n, ...) over each corner's observations of values (k, ...)."""
        return rows.new_zeros(self.corner_count, *rows.shape[1:]).index_add_(0, self.corner, rows)


@dataclass(frozen=True)
class Arrays:
    """The constants of a solve; K observations of N corners from P = C * J (camera, frame) pairs.

    Extrinsic and frame act on an observation through its pair alone. So the large arrays know only pairs and
    corners, and sums over pairs are carried on to extrinsics and frames in small tables (pair = camera * J +
    frame). With rolling shutters a frame has several *moments*, one per observed row, which replace frames
    (M for J) in pairs and in ``clock_twist``.

    Attributes:
        order: (K,) index of each sorted observation in the problem.
        corner_order: (N,) index of each corner in the problem.
        joined: (N,) whether known lengths join a corner to the one before; joined ones are contiguous.
        pair: (K,) index of the (camera, frame) pair.
        corner: (K,) index of the corner, ascending.
        measured: (2, K) the observation at depth 1.
        root_information: (3, K) a, b, c of the whitened residual (a dx, b dx + c dy), dx at depth 1.
        has_lines: whether some observations belong to lines.
        vehicle_from_map: (J, 4, 4) as recorded.
        session: (J,) session of each frame.
        states: column of the frame tangent of each state. An error with a drift beside its white part
            has two states on one column.
        centre, centre_information_root: (C, 3) prior on the camera centres, and 1 / sigma.
        ground_plane, ground_root: (C, 4) plane of the ground in the cameras, and (C, 3, 4) root information.
        state_transition: (J, S, S) prediction of a frame's states from the frame before.
        state_information_root: (J, S) 1 / sigma of the innovations.
        clock_twist: (J, 6, Q) the vehicle's motion per clock offset; Q is the number of sessions, or 0
            without offsets, plus one, the last, for an estimated read-out time.
        clock_information_root: (Q,) 1 / sigma of each.
        control, control_root: surveyed positions (N, 2) of the corners and a, b, c (N, 3) as in
            ``root_information``, 0 without survey.
        lengths: known distances between corners.
        frame_of_moment: (M,) frame of each moment, None if frames are moments.
        read_out: (C, M, 6) the vehicle's motion since the frame's stamp for the stated read-out times.
    """

    order: Tensor
    corner_order: Tensor
    joined: Tensor
    pair: Tensor
    corner: Tensor
    measured: Tensor
    root_information: Tensor
    has_lines: bool
    vehicle_from_map: Tensor
    session: Tensor
    states: tuple[int, ...]
    centre: Tensor
    centre_information_root: Tensor
    ground_plane: Tensor
    ground_root: Tensor
    state_transition: Tensor
    state_information_root: Tensor
    clock_twist: Tensor
    clock_information_root: Tensor
    control: Tensor
    control_root: Tensor
    lengths: Lengths
    frame_of_moment: Tensor | None = None
    read_out: Tensor | None = None

    @cached_property
    def frame_count(self) -> int:
        """Number of frames, J."""
        return self.vehicle_from_map.shape[0]

    @cached_property
    def camera_count(self) -> int:
        """Number of cameras, C."""
        return self.centre.shape[0]

    @cached_property
    def corner_count(self) -> int:
        """Number of corners, N."""
        return self.corner_order.shape[0]

    @cached_property
    def camera_unknowns(self) -> int:
        """Unknowns of a camera, 6 + Q: its extrinsic and, if estimated, clock offsets and read-out time."""
        return 6 + self.clock_twist.shape[-1]

    @property
    def moves(self) -> bool:
        """Whether images may have been taken at other times than their stamps."""
        return self.clock_twist.shape[-1] > 0 or self.read_out is not None

    @cached_property
    def pair_count(self) -> int:
        """Number of pairs, P."""
        return self.camera_count * self.moment_count

    @cached_property
    def moment_count(self) -> int:
        """Number of moments, M; J if frames are moments."""
        return self.clock_twist.shape[0]

    def camera_of(self, pair: Tensor) -> Tensor:
        """Cameras of pairs."""
        return pair // self.moment_count

    def frame_of(self, pair: Tensor) -> Tensor:
        """Frames of pairs."""
        moment = pair % self.moment_count
        return moment if self.frame_of_moment is None else self.frame_of_moment[moment.long()]

    def at_moments(self, by_frame: Tensor, axis: int = 0) -> Tensor:
        """Values (..., J, ...) of frames, repeated for their moments (..., M, ...)."""
        moments = self.frame_of_moment
        return by_frame if moments is None else by_frame.index_select(axis, moments)

    def over_moments(self, by_moment: Tensor) -> Tensor:
        """Sums (J, ...) over each frame's moments of values (M, ...)."""
        if self.frame_of_moment is None:
            return by_moment
        out = by_moment.new_zeros(self.frame_count, *by_moment.shape[1:])
        return out.index_add_(0, self.frame_of_moment, by_moment)

    def no_clock(self) -> Tensor:
        """Clock offsets (C, Q) of zero."""
        return self.centre.new_zeros(self.camera_count, self.clock_twist.shape[-1])

    @cached_property
    def units(self) -> Tensor:
        """First corners of units, which may begin a run, and the end."""
        if not bool(self.joined.any()):
            return torch.arange(self.corner_count + 1, device=self.joined.device)
        end = self.joined.new_full((1,), self.corner_count, dtype=torch.int64)
        return torch.cat([(~self.joined).nonzero()[:, 0], end])

    @cached_property
    def begin(self) -> Tensor:
        """First observation (N + 1,) of each corner, and the end."""
        if len(self.corner) > _RUN:
            changes = (self.corner[1:] != self.corner[:-1]).nonzero()[:, 0] + 1
            if len(changes) == self.corner_count - 1:  # each is observed: ten times as fast as searching
                ends = changes.new_tensor([0, len(self.corner)])
                return torch.cat([ends[:1], changes, ends[1:]])
        corners = torch.arange(self.corner_count + 1, dtype=self.corner.dtype, device=self.corner.device)
        return torch.searchsorted(self.corner, corners)

    def bounds(self, size: int) -> list[tuple[int, int]]:
        """(observation, corner) at the start of runs of about ``size`` observations, and the end."""
        count = self.corner.shape[0]
        if count <= size:
            return [(0, 0), (count, self.corner_count)]
        begins = self.begin[self.units]
        multiples = torch.arange(0, count + size, size, device=begins.device)
        chosen = torch.unique(torch.searchsorted(begins, multiples.clamp(max=count)))
        return list(zip(begins[chosen].tolist(), self.units[chosen].tolist(), strict=True))

    @cached_property
    def run_bounds(self) -> list[tuple[int, int]]:
        """(observation, corner) at the start of each run, and the end."""
        return self.bounds(_RUN if self.measured.device.type == "cpu" else _RUN_ON_DEVICE)

    def runs(self, size: int | None = None) -> Iterator[Run]:
        """The whole problem in runs; joined corners are never separated."""
        for (begin, first), (end, last) in pairwise(self.run_bounds if size is None else self.bounds(size)):
            yield self.run(slice(begin, end), slice(first, last))

    def run(self, observations: slice, corners: slice) -> Run:
        """The run of these observations, which are all of these corners'."""
        return Run(
            observations,
            corners,
            self.pair[observations].long(),
            self.corner[observations].long() - corners.start,
            self.measured[:, observations],
            self.root_information[:, observations],
        )

    def gather(self, corners: Tensor) -> Run:
        """A run of corners (n,), ascending, counted from 0."""
        end = self.begin[corners + 1]
        count = end - self.begin[corners]
        corner = torch.repeat_interleave(count)
        rows = torch.arange(len(corner), device=corner.device) + (end - count.cumsum(0))[corner]
        return Run(
            slice(0, len(rows)),
            slice(0, len(corners)),
            self.pair[rows].long(),
            corner,
            self.measured[:, rows],
            self.root_information[:, rows],
        )

    def whole(self) -> Run:
        """The whole problem as one run."""
        return self.run(slice(0, len(self.corner)), slice(0, self.corner_count))

    def by_moment(self) -> ByMoment:
        """The problem whose frames are the moments of its observations."""
        # Without a sort of the observations, which are many.
        is_observed = torch.zeros(self.moment_count, dtype=torch.bool, device=self.pair.device)
        moment = self.pair % self.moment_count
        is_observed[moment.long()] = True
        moments = is_observed.nonzero()[:, 0]
        number = is_observed.cumsum(0) - 1
        frames = self.frame_of(moments)
        arrays = replace(
            self,
            pair=(self.camera_of(self.pair) * len(moments) + number[moment.long()]).to(self.pair.dtype),
            vehicle_from_map=self.vehicle_from_map[frames],
            session=self.session[frames],
            state_transition=self.state_transition[frames],
            state_information_root=self.state_information_root[frames],
            clock_twist=self.clock_twist[moments],
            frame_of_moment=None,
            read_out=None if self.read_out is None else self.read_out[:, moments],
        )
        return ByMoment(arrays, frames)

    def take(self, keep: Tensor) -> tuple[Arrays, Tensor]:
        """The problem of observations ``keep``, a mask (K,) or ascending indices, and of their corners.

        Known lengths need both corners. Returns the corners' indices here as well.
        """
        # Ascending, and so without a sort.
        corners, corner = torch.unique_consecutive(self.corner[keep], return_inverse=True)
        corners = corners.long()
        rank = torch.full_like(self.corner_order, -1)
        rank[corners] = torch.arange(len(corners), device=rank.device)
        first = rank[self.lengths.first]
        second = rank[self.lengths.second]
        have_both = (first >= 0) & (second >= 0)
        unit = (~self.joined).cumsum(0)[corners]
        part = replace(
            self,
            order=self.order[keep],
            corner_order=self.corner_order[corners],
            joined=torch.cat([torch.zeros_like(self.joined[:1]), unit[1:] == unit[:-1]]),
            pair=self.pair[keep],
            corner=corner.to(self.corner.dtype),
            measured=self.measured[:, keep],
            root_information=self.root_information[:, keep],
            control=self.control[corners],
            control_root=self.control_root[corners],
            lengths=Lengths(
                first[have_both],
                second[have_both],
                self.lengths.length_m[have_both],
                self.lengths.information_root[have_both],
            ),
        )
        return part, corners


class ByMoment(NamedTuple):
    """A problem whose m frames are moments of another."""

    arrays: Arrays
    frames: Tensor  # (m,) the other's
