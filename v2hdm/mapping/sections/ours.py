"""The candidates that belong to a section, of all that its images show."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.conclusion import FinalSolve
from v2hdm.records import BoolArray, IntArray
from v2hdm.site.relative import FARTHEST_M

_MOVED_M = 3.0
"""Longest way of a candidate's centre, m, when its class places an unseen corner; chosen."""


class Pairs(NamedTuple):
    """Pairs of corners (P,) by their indices in a solution."""

    first: IntArray
    second: IntArray


def near_corners(bundle: Bundle, is_ours: BoolArray) -> Pairs:
    """The corners of groups ``is_ours`` (G,) with those of their own and of neighbours.

    Whoever states a marking's place beside its neighbours asks for these. Two of the neighbours may be twice
    as far apart as each is from the marking.
    """
    groups = np.flatnonzero(is_ours & (bundle.corner_index >= 0).any(axis=1))
    centres_map = np.nanmean(bundle.corners_map[groups], axis=1)
    near = cKDTree(centres_map).query_pairs(2 * FARTHEST_M + _MOVED_M, output_type="ndarray")
    alone = np.repeat(np.arange(len(groups)), 2).reshape(-1, 2)
    corners = bundle.corner_index[groups][np.concatenate([alone, near])]
    first, second = np.broadcast_arrays(corners[:, 0, :, None], corners[:, 1, None, :])
    is_solved = (first >= 0) & (second >= 0)
    return Pairs(first[is_solved], second[is_solved])


def of_ours(final: FinalSolve, is_ours: BoolArray) -> FinalSolve:
    """A final solve in which the groups that are not ``is_ours`` (G,) have no sighting and no corner."""
    bundle = final.bundle
    association = bundle.association
    is_other = (association.group >= 0) & ~is_ours[association.group]
    return replace(
        final,
        bundle=replace(
            bundle,
            association=replace(association, group=np.where(is_other, -1, association.group)),
            corner_index=np.where(is_ours[:, None], bundle.corner_index, -1),
        ),
    )
