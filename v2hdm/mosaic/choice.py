"""Which images of a tile are blended: the fewest that leave its pixels as all of them would have them.

An image counts with the square of its density, so with the sixth power of its distance: of thirty that show a
place, a few have all but a twentieth of the weight. They are chosen by the weights at nodes of the tile,
before any image is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.mosaic.warp import Views
from v2hdm.records import BoolArray, IntArray

LEFT_OUT = 0.05
"""Largest share of the weight of a place that images left out may have: its colour moves by so much of their
difference from the others, half a grey value where they differ by ten; chosen."""
_FAINTER = 1 / 255
"""Largest opacity that a place may lose by images left out: one step of alpha, so that the same ground is
shown."""


class Candidate(NamedTuple):
    """An image that shows tiles (T, 2) of (column, row), and how much it counts at the nodes of each."""

    shot: int  # its number
    tiles: np.ndarray
    weight: np.ndarray  # (T, nodes)
    opacity: np.ndarray  # (T, nodes)


def chosen(candidates: Sequence[Candidate]) -> Views:
    """The images that are blended, and the tiles of each."""
    counts = [len(candidate.tiles) for candidate in candidates]
    tiles = np.concatenate([candidate.tiles for candidate in candidates])
    weight = np.concatenate([candidate.weight for candidate in candidates])
    opacity = np.concatenate([candidate.opacity for candidate in candidates])
    _, tile_of, views_of_tile = np.unique(tiles, axis=0, return_inverse=True, return_counts=True)
    is_blended: BoolArray = np.zeros(len(tiles), dtype=np.bool_)
    by_tile = np.argsort(tile_of.ravel(), kind="stable")
    for rows in np.split(by_tile, np.cumsum(views_of_tile)[:-1]):
        is_blended[rows[_needed(weight[rows], opacity[rows])]] = True
    flags = np.split(is_blended, np.cumsum(counts)[:-1])
    return [
        (candidate.shot, candidate.tiles[is_needed])
        for candidate, is_needed in zip(candidates, flags, strict=True)
        if is_needed.any()
    ]


def _needed(weight: np.ndarray, opacity: np.ndarray) -> IntArray:
    """The images of one tile, by weights and opacities (N, nodes), whose share is large enough together."""
    total = weight.sum(axis=0)
    is_shown = total > 0
    if not is_shown.any():
        return np.empty(0, dtype=np.int64)
    share = weight[:, is_shown] / total[is_shown]
    order = np.argsort(-share.max(axis=1), kind="stable")
    share_up_to = np.cumsum(share[order], axis=0)
    opacity_up_to = np.cumsum(opacity[order], axis=0)
    has_weight = (share_up_to >= 1 - LEFT_OUT).all(axis=1)
    has_opacity = (opacity_up_to >= opacity_up_to[-1].clip(max=1) - _FAINTER).all(axis=1)
    is_enough = has_weight & has_opacity
    is_enough[-1] = True  # all of them are, whatever their shares are rounded to
    return order[: int(np.argmax(is_enough)) + 1]
