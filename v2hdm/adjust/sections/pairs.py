"""Covariances of pairs of corners that are known before they are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.records import BoolArray, FloatArray, IntArray


class Known(NamedTuple):
    """Joint covariances (M, 2 n, 2 n) of M groups of n corners, right where ``is_known`` (M,)."""

    covariances: FloatArray
    is_known: BoolArray


@dataclass(frozen=True)
class PairCovariances:
    """Covariances (P, 2, 2), m^2, of the coordinates of one corner by those of another, of ``count`` corners.

    ``key`` (P,), ascending, is the smaller number of the two times ``count``, plus the larger one.
    """

    count: int
    key: IntArray
    blocks: FloatArray

    @classmethod
    def places(cls, count: int, first: IntArray, second: IntArray) -> IntArray:
        """The numbers (2, P) of the corners of some pairs, once each, the smaller one first."""
        return np.stack(np.divmod(np.unique(_keys(count, first, second)), count))

    @classmethod
    def of(cls, count: int, places: IntArray, blocks: FloatArray) -> PairCovariances:
        """The covariances (P, 2, 2) of pairs at their :meth:`places` (2, P)."""
        return cls(count, _keys(count, *places), blocks)

    def of_groups(self, groups: NDArray[np.int64]) -> Known:
        """Joint covariances of groups (M, n) of corners."""
        count, size = groups.shape
        first, second = np.broadcast_arrays(groups[:, :, None], groups[:, None, :])
        key = _keys(self.count, first, second)
        place = np.searchsorted(self.key, key).clip(max=len(self.key) - 1)
        blocks = self.blocks[place]
        blocks = np.where((first > second)[..., None, None], blocks.swapaxes(-1, -2), blocks)
        covariances = blocks.transpose(0, 1, 3, 2, 4).reshape(count, 2 * size, 2 * size)
        return Known(covariances, (self.key[place] == key).all(axis=(1, 2)))


def _keys(count: int, first: IntArray, second: IntArray) -> IntArray:
    return np.asarray(count * np.minimum(first, second) + np.maximum(first, second))
