"""Errors of clocks that a drive in parts shows (:mod:`v2hdm.faults.clock_errors`), of no part by itself.

In a part alone a late clock looks like another mounting, which parts have in common: only all of them tell.
So each part states how an error pulls at its border (:mod:`v2hdm.adjust.sections`), the join answers how the
border follows, and each part then has its share of the columns net of all that the whole estimates. Noise
that is drawn from the model is carried along, as errors that are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from v2hdm.adjust.problem import Problem
from v2hdm.adjust.sections.joined import JoinedCovariance
from v2hdm.adjust.solution import Solution
from v2hdm.faults.clock_errors import ClockEvidence, errors_of_clocks
from v2hdm.faults.jacobians import Whitened
from v2hdm.faults.score_tests import Segments
from v2hdm.faults.sensitivity import Follow, Rows, Sensitivity
from v2hdm.records import BoolArray, FloatArray, IntArray, PoseNoise

_DRAWS = 16  # draws of the model's noise, as many as of a drive in one piece

# Priors that every part has of the same cameras.
_OF_CAMERAS = ("camera_centre", "ground_planes", "clock_offsets")


@dataclass(frozen=True)
class Along:
    """Where the J frames of part ``number`` are in the whole drive.

    ``stretch`` is the segment of the route, of ``stretch_count`` in all, ``rising`` the share of a drift at
    each; ``is_linked`` marks the first frames that a frame of another part predicts.
    """

    number: int
    stretch: IntArray
    stretch_count: int
    rising: FloatArray
    is_linked: BoolArray


class PartSegments(NamedTuple):
    """The share of a part in what G segments, and priors of none, tell of n errors of clocks."""

    score: FloatArray  # (n, G + 1)
    products: FloatArray  # (n, n, G + 1) of the errors' columns
    drawn: FloatArray  # (n, D, G + 1)
    alone: FloatArray  # (n,) information with all else known


def slopes_of(
    problem: Problem, solution: Solution, noises: Sequence[PoseNoise], along: Along
) -> FloatArray | None:
    """Slopes (b, n + D) of a part's border under n errors of clocks and D draws of its noise.

    None where the clocks are stated to be right, or nothing moves.
    """
    errors = list(errors_of_clocks(problem, noises, along.rising))
    if not errors or problem.twist_vehicle is None:
        return None
    solved = _at(solution, along)
    columns = [error.hypothesis(problem).column(solved) for error in errors]
    whitened = solved.whiten_columns([*columns, *_drawn(solved, along)])
    return _covariance(solution).slopes(whitened.reduced, whitened.corners)


def follow_of(solution: Solution, steps: FloatArray) -> Follow:
    """How a part follows errors under which its border makes ``steps`` (b, n)."""
    covariance = _covariance(solution)

    def follow(columns: Whitened) -> Whitened:
        return Whitened(*covariance.followed(columns.reduced, columns.corners, steps))

    return follow


def segments_of(
    problem: Problem, solution: Solution, noises: Sequence[PoseNoise], along: Along, steps: FloatArray
) -> PartSegments:
    """The share of a part whose border makes ``steps`` (b, n + D) under the errors of :func:`slopes_of`."""
    solved = _at(solution, along)
    errors = errors_of_clocks(problem, noises, along.rising)
    columns = [error.hypothesis(problem).column(solved) for error in errors]
    count = len(columns)
    net = solved.efficient_columns([*columns, *_drawn(solved, along)], follow_of(solution, steps))
    net[:, ~_is_counted(solved, along)] = 0.0
    of_errors = net[:count]
    others = np.column_stack([-solved.flat(solved.residuals), net.T])
    products = np.moveaxis(solved.by_stretch(of_errors, others), 1, 2)
    return PartSegments(
        score=products[:, 0],
        products=products[:, 1 : 1 + count],
        drawn=products[:, 1 + count :],
        alone=np.array([sum(float(row.square().sum()) for row in column.values()) for column in columns]),
    )


def evidence_of(parts: Sequence[PartSegments]) -> ClockEvidence:
    """The evidence of all parts: the less, the larger their noise is than the stated one."""
    score = np.sum([part.score for part in parts], axis=0)
    products = np.sum([part.products for part in parts], axis=0)
    drawn = np.sum([part.drawn for part in parts], axis=0)
    alone = np.sum([part.alone for part in parts], axis=0)
    multiple = np.array(
        [
            Segments(score[k], products[k, k], drawn[k], float(alone[k])).noise_multiple
            for k in range(len(score))
        ]
    )
    information = products.sum(axis=2) / np.sqrt(np.outer(multiple, multiple))
    return ClockEvidence(information, score.sum(axis=1) / multiple)


def _covariance(solution: Solution) -> JoinedCovariance:
    covariance = solution.covariance
    assert isinstance(covariance, JoinedCovariance)
    return covariance


def _at(solution: Solution, along: Along) -> Sensitivity:
    solved = Sensitivity.at(solution.covariance.whitening)
    stretch = torch.as_tensor(along.stretch, device=solved.stretch.device)
    return replace(solved, stretch=stretch, stretch_count=along.stretch_count)


def _drawn(solved: Sensitivity, along: Along) -> list[Rows]:
    """Draws of the model's noise, of all rows that are counted in this part."""
    generator = np.random.default_rng(along.number)
    is_counted = _is_counted(solved, along)
    flat = generator.standard_normal((_DRAWS, len(is_counted))) * is_counted
    return [solved.rows_of(numbers) for numbers in flat]


def _is_counted(solved: Sensitivity, along: Along) -> BoolArray:
    """Whether each residual (R,) belongs to the drive: no border condition, and no other part counts it.

    The first states after a border are predicted from another part, which this part's rows do not know.
    """
    by_kind = {name: torch.ones_like(row) for name, row in solved.residuals.items()}
    by_kind["control_points"][:] = 0.0
    by_kind["frame_states"][torch.as_tensor(along.is_linked)] = 0.0
    if along.number:
        for name in _OF_CAMERAS:
            by_kind[name][:] = 0.0
    return solved.flat(by_kind) > 0
