"""The summaries of all parts joined: one sparse solve for their borders, with its covariances."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from v2hdm.adjust.model import by_ground_planes, ground_planes
from v2hdm.adjust.problem import GroundPlanes, Problem, SolveOptions
from v2hdm.adjust.sections.blocks import BlockCholesky, BlockMatrix, BlockPattern
from v2hdm.adjust.sections.parts import Link, Part
from v2hdm.adjust.sections.summary import Summary
from v2hdm.records import FloatArray, IntArray


class Labels(NamedTuple):
    """The border of a part, in its order: numbers of cameras, frames and corners in the whole."""

    cameras: IntArray
    frames: IntArray
    corners: IntArray


class Shared(NamedTuple):
    """The value of all borders: extrinsics (C, 4, 4), clocks (C, Q), states (B, S), corners (M, 2)."""

    cam_from_vehicle: FloatArray
    clock_s: FloatArray
    frame_state: FloatArray
    corners_map: FloatArray


class _Place(NamedTuple):
    """Where the border of a part lies among the blocks."""

    block: IntArray  # (n,)
    row: IntArray  # (n,) within its block


class Joined(NamedTuple):
    """A solve for all borders: the ``step`` by block, twice its decrease of the cost, and the factor."""

    step: list[FloatArray]
    decrease: float
    factor: BlockCholesky


@dataclass(frozen=True)
class Net:
    """The borders of all parts: frames (B,) and corners (M,) of the whole, and their places in blocks.

    ``unknowns`` are a camera's, ``states`` a frame's. Block 0 are the cameras; any other the frames and
    corners that the same parts know.
    """

    problem: Problem
    options: SolveOptions
    labels: tuple[Labels, ...]
    links: tuple[Link, ...]
    frames: IntArray
    corners: IntArray
    unknowns: int
    states: int
    pattern: BlockPattern
    frame_place: tuple[IntArray, IntArray]  # (B,) block and first row
    corner_place: tuple[IntArray, IntArray]  # (M,) block and first row

    @classmethod
    def of(
        cls,
        problem: Problem,
        options: SolveOptions,
        labels: Sequence[Labels],
        links: Sequence[Link],
        unknowns: int,
        states: int,
    ) -> Net:
        """The net of parts of which ``labels`` are the borders; ``problem`` names cameras and priors."""
        frames = np.unique(np.concatenate([label.frames for label in labels]))
        corners = np.unique(np.concatenate([label.corners for label in labels]))
        of_frame: list[set[int]] = [set() for _ in frames]
        of_corner: list[set[int]] = [set() for _ in corners]
        for part, label in enumerate(labels):
            for at in np.searchsorted(frames, label.frames).tolist():
                of_frame[at].add(part)
            for at in np.searchsorted(corners, label.corners).tolist():
                of_corner[at].add(part)
        # A link couples both its frames to all that the parts of either know.
        for link in links:
            ends = np.searchsorted(frames, [link.before, link.frame]).tolist()
            parts_of_ends = of_frame[ends[0]] | of_frame[ends[1]]
            of_frame[ends[0]] = of_frame[ends[1]] = parts_of_ends
        keys = sorted({frozenset(parts) for parts in (*of_frame, *of_corner)}, key=sorted)
        block_of = {key: number + 1 for number, key in enumerate(keys)}
        sizes = [unknowns * len(problem.intrinsic)] + [0] * len(keys)
        frame_place = _placed([block_of[frozenset(parts)] for parts in of_frame], states, sizes)
        corner_place = _placed([block_of[frozenset(parts)] for parts in of_corner], 2, sizes)
        cliques = [[0, *(block_of[key] for key in keys if part in key)] for part in range(len(labels))]
        pattern = BlockPattern.of(sizes, cliques, last=0)
        return cls(
            problem=problem,
            options=options,
            labels=tuple(labels),
            links=tuple(links),
            frames=frames,
            corners=corners,
            unknowns=unknowns,
            states=states,
            pattern=pattern,
            frame_place=frame_place,
            corner_place=corner_place,
        )

    def join(self, told: Iterable[Summary], shared: Shared) -> Joined:
        """The step of all borders to the optimum of the whole, as the parts tell of their borders."""
        matrix = BlockMatrix.zeros(self.pattern)
        gradient = [np.zeros(size) for size in self.pattern.sizes]
        for label, part in zip(self.labels, told, strict=True):
            place = self._place(label)
            _add(matrix, gradient, place, part.information, part.slope)
        self._priors_once(matrix, gradient, shared)
        for link in self.links:
            self._add_link(matrix, gradient, link, shared)
        factor = matrix.factorise()
        step = factor.solve([-part for part in gradient])
        decrease = -sum(float(of_block @ part) for of_block, part in zip(step, gradient, strict=True))
        return Joined(step, decrease, factor)

    def covariances(self, factor: BlockCholesky) -> Iterator[FloatArray]:
        """The joint covariance (n, n) of each part's border, one after the other."""
        blocks = factor.inverse()
        for label in self.labels:
            place = self._place(label)
            covariance = np.zeros((len(place.block), len(place.block)))
            numbers = np.unique(place.block).tolist()
            for first in numbers:
                rows = np.flatnonzero(place.block == first)
                for second in numbers:
                    columns = np.flatnonzero(place.block == second)
                    block = blocks.get((first, second))
                    whole = blocks[second, first].T if block is None else block
                    covariance[np.ix_(rows, columns)] = whole[np.ix_(place.row[rows], place.row[columns])]
            yield covariance

    def steps(self, factor: BlockCholesky, slopes: Sequence[FloatArray]) -> list[FloatArray]:
        """Steps (b, n) of each part's border to the optimum under n errors, as the parts' ``slopes`` tell."""
        errors = slopes[0].shape[1]
        gradient = [np.zeros((size, errors)) for size in self.pattern.sizes]
        for label, of_part in zip(self.labels, slopes, strict=True):
            place = self._place(label)
            for number in np.unique(place.block).tolist():
                rows = np.flatnonzero(place.block == number)
                gradient[number][place.row[rows]] += of_part[rows]
        step = factor.solve([-of_block for of_block in gradient])
        return [self._of_border(step, label) for label in self.labels]

    def _of_border(self, step: Sequence[FloatArray], label: Labels) -> FloatArray:
        """The rows (b, ...) of a step by block that are of a part's border."""
        place = self._place(label)
        out = np.zeros((len(place.block), *step[0].shape[1:]))
        for number in np.unique(place.block).tolist():
            rows = np.flatnonzero(place.block == number)
            out[rows] = step[number][place.row[rows]]
        return out

    def _place(self, label: Labels) -> _Place:
        cameras = (label.cameras[:, None] * self.unknowns + np.arange(self.unknowns)).ravel()
        frames = np.searchsorted(self.frames, label.frames)
        corners = np.searchsorted(self.corners, label.corners)
        of_frames = _rows(self.frame_place, frames, self.states)
        of_corners = _rows(self.corner_place, corners, 2)
        return _Place(
            np.concatenate([np.zeros(len(cameras), dtype=np.int64), of_frames.block, of_corners.block]),
            np.concatenate([cameras, of_frames.row, of_corners.row]),
        )

    def _priors_once(self, matrix: BlockMatrix, gradient: list[FloatArray], shared: Shared) -> None:
        """Take the cameras' priors out that all parts but one have too many."""
        count = np.zeros(len(self.problem.intrinsic), dtype=np.int64)
        for label in self.labels:
            count[label.cameras] += 1
        clocks = self.unknowns - 6
        sigma_s = np.full(clocks, self.problem.clock_sigma_s)
        if self.options.read_out:
            sigma_s[-1] = self.problem.read_out_sigma_s
        for camera in np.flatnonzero(count > 1).tolist():
            information = np.zeros((self.unknowns, self.unknowns))
            slope = np.zeros(self.unknowns)
            if self.problem.centre_vehicle is not None and self.problem.centre_sigma_m is not None:
                rotation = shared.cam_from_vehicle[camera, :3, :3]
                centre = -rotation.T @ shared.cam_from_vehicle[camera, :3, 3]
                of_axes = 1 / self.problem.centre_sigma_m[camera] ** 2
                information[:3, :3] = (rotation * of_axes) @ rotation.T
                slope[:3] = -rotation @ (of_axes * (centre - self.problem.centre_vehicle[camera]))
            if self.problem.ground is not None:
                by_ground, off = _of_ground(self.problem.ground, shared.cam_from_vehicle, camera)
                information[:6, :6] += by_ground.T @ by_ground
                slope[:6] += by_ground.T @ off
            information[6:, 6:] = np.diag(1 / sigma_s**2)
            slope[6:] = shared.clock_s[camera] / sigma_s**2
            rows = camera * self.unknowns + np.arange(self.unknowns)
            place = _Place(np.zeros(self.unknowns, dtype=np.int64), rows)
            more = 1.0 - count[camera]
            _add(matrix, gradient, place, more * information, more * slope)

    def _add_link(self, matrix: BlockMatrix, gradient: list[FloatArray], link: Link, shared: Shared) -> None:
        """Predict a frame's states from those before, in place of the prior that its part gave them."""
        before, frame = np.searchsorted(self.frames, [link.before, link.frame]).tolist()
        first = _rows(self.frame_place, np.array([before]), self.states)
        second = _rows(self.frame_place, np.array([frame]), self.states)
        place = _Place(np.concatenate([first.block, second.block]), np.concatenate([first.row, second.row]))
        by_both = link.root[:, None] * np.hstack([-link.transition, np.eye(self.states)])
        residual = by_both @ np.concatenate([shared.frame_state[before], shared.frame_state[frame]])
        alone = np.square(link.root_alone)
        information = by_both.T @ by_both
        slope = by_both.T @ residual
        information[self.states :, self.states :] -= np.diag(alone)
        slope[self.states :] -= alone * shared.frame_state[frame]
        _add(matrix, gradient, place, information, slope)


def _of_ground(
    ground: GroundPlanes, cam_from_vehicle: FloatArray, camera: int
) -> tuple[FloatArray, FloatArray]:
    """Whitened deviation (3,) of a camera from its plane of the ground, after its derivatives (3, 6)."""
    extrinsic = torch.as_tensor(cam_from_vehicle[camera : camera + 1])
    off = ground_planes(extrinsic)[0].numpy() - ground.plane_cam[camera]
    root = ground.root_information[camera]
    return root @ by_ground_planes(extrinsic)[0].numpy(), root @ off


def labels_of(part: Part, corner_order: IntArray, corners: IntArray) -> Labels:
    """The labels of a part's border, whose ``corners`` (m,) are numbers in the order of its arrays."""
    return Labels(part.cameras, part.frames[part.border_frames], part.corners[corner_order[corners]])


def _placed(block: Sequence[int], width: int, sizes: list[int]) -> tuple[IntArray, IntArray]:
    """Block and first row of each item of so many rows; ``sizes`` of the blocks grow."""
    row = np.zeros(len(block), dtype=np.int64)
    for item, number in enumerate(block):
        row[item] = sizes[number]
        sizes[number] += width
    return np.array(block, dtype=np.int64), row


def _rows(place: tuple[IntArray, IntArray], items: IntArray, width: int) -> _Place:
    block, first = place
    rows = (first[items][:, None] + np.arange(width)).ravel()
    return _Place(np.repeat(block[items], width), rows)


def _add(
    matrix: BlockMatrix,
    gradient: list[FloatArray],
    place: _Place,
    information: FloatArray,
    slope: FloatArray,
) -> None:
    """Add to matrix and gradient the part of them at a place."""
    numbers = np.unique(place.block).tolist()
    index = {number: np.flatnonzero(place.block == number) for number in numbers}
    for first in numbers:
        gradient[first][place.row[index[first]]] += slope[index[first]]
        for second in numbers:
            if (first, second) in matrix.blocks:
                at = np.ix_(place.row[index[first]], place.row[index[second]])
                matrix.blocks[first, second][at] += information[np.ix_(index[first], index[second])]
