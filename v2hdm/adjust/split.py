"""The likeliest states of frames whose poses are known: how much of an error is white, and how much drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import bsr_array
from scipy.sparse.linalg import splu

from v2hdm.records import FloatArray


def likeliest_states(
    deviation: FloatArray, axes: Sequence[int], transition: FloatArray, root: FloatArray
) -> FloatArray:
    """The states (J, S) that sum up to the ``deviation`` (J, 6) of each frame's tangent.

    Each state acts on one of the ``axes`` (S,). ``transition`` (J, S, S) predicts a frame's states from those
    of the frame before, ``root`` (J, S) are inverse sigmas of the innovations. A smoother: all frames tell.
    """
    frames, count = root.shape
    first = np.array([axes.index(axis) for axis in axes], dtype=np.int64)
    is_free = first < np.arange(count)
    free = np.flatnonzero(is_free)
    states = np.where(is_free, 0.0, deviation[:, list(axes)])
    if not len(free) or not frames:
        return states
    # What a free state gains the first of its axis loses.
    basis = np.zeros((count, len(free)))
    basis[free, np.arange(len(free))] = 1.0
    basis[first[free], np.arange(len(free))] = -1.0
    here = root[:, :, None] * basis
    before = -root[1:, :, None] * (transition[1:] @ basis)
    blocks = np.concatenate([here[:1], np.stack([before, here[1:]], axis=1).reshape(-1, *basis.shape)])
    columns = np.concatenate([[0], np.column_stack([np.arange(frames - 1), np.arange(1, frames)]).ravel()])
    begins = np.concatenate([[0], 2 * np.arange(frames) + 1])
    size = frames * count, frames * len(free)
    innovations = bsr_array((blocks, columns, begins), shape=size).tocsc()
    residual = root * states
    residual[1:] -= root[1:] * (transition[1:] @ states[:-1, :, None])[..., 0]
    normal = (innovations.T @ innovations).tocsc()
    moved = splu(normal, permc_spec="NATURAL").solve(-(innovations.T @ residual.ravel()))
    return np.asarray(states + moved.reshape(frames, -1) @ basis.T)
