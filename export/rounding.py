"""Weights rounded so that what they compute, rather than they themselves, changes least.

Neighbouring pixels are so much alike that errors of weights which add up matter, and errors which cancel do
not. So the weights of an output are rounded one after another, and those that are still to be rounded make
up for each error as well as they can on the inputs seen, at last the bias (Frantar et al., "GPTQ", ICLR
2023, after Hassibi and Stork, "Optimal Brain Surgeon", 1993).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from export.graph import Convolution, FloatTensor

_DAMPING = 1e-2
"""Share of the inputs' mean square that is added to each: a channel that no image has shown yet may come."""

Moments = NDArray[np.float64]


def input_moments(conv: Convolution, tensor: FloatTensor, rows: slice = slice(None)) -> Moments:
    """Sums of products of what meets the weights of a convolution, and of 1, which meets its bias.

    Args:
        conv: A convolution.
        tensor: What it reads, (1, C, H, W).
        rows: Which rows of its output are to count.

    Returns:
        (G, K + 1, K + 1) with K weights per output; G is C for a depthwise convolution, else 1.
    """
    channels = tensor.shape[1]
    top, left = conv.padding
    padded = np.pad(tensor[0], ((0, 0), (top, top), (left, left)))
    spans = [(n - 1) * d + 1 for n, d in zip(conv.kernel, conv.dilation, strict=True)]
    windows = np.lib.stride_tricks.sliding_window_view(padded, spans, axis=(1, 2))
    windows = windows[:, :: conv.stride[0], :: conv.stride[1], :: conv.dilation[0], :: conv.dilation[1]]
    windows = windows[:, rows].transpose(0, 3, 4, 1, 2)
    groups = channels if conv.depthwise else 1
    columns = windows.reshape(groups, windows[0, :, :, 0, 0].size * channels // groups, -1)
    columns = np.concatenate([columns, np.ones_like(columns[:, :1])], axis=1)
    return np.asarray(columns @ columns.transpose(0, 2, 1), dtype=np.float64)


class Rounded(NamedTuple):
    """The weights of a convolution, rounded."""

    whole: NDArray[np.int8]  # (N, C, h, w)
    scale: FloatTensor  # (N,) that makes them weights
    bias: FloatTensor  # (N,) that goes with them


def round_weights(weight: FloatTensor, bias: FloatTensor, moments: Moments, highest: int) -> Rounded:
    """Round the weights (N, C, h, w) and bias (N,) of a convolution to integers from -highest to highest."""
    flat = weight.reshape(len(weight), -1).astype(np.float64)
    scale = np.maximum(np.abs(flat).max(axis=1), 1e-12) / highest
    unrounded = np.column_stack([flat, bias.astype(np.float64)])
    whole = np.zeros(flat.shape)
    for outputs, moment in zip(np.array_split(np.arange(len(flat)), len(moments)), moments, strict=True):
        whole[outputs], unrounded[outputs] = _round_in_turn(
            unrounded[outputs], scale[outputs, None], moment, highest
        )
    new_bias = unrounded[:, -1]
    return Rounded(
        whole=whole.reshape(weight.shape).astype(np.int8),
        scale=scale.astype(np.float32),
        bias=new_bias.astype(np.float32),
    )


def _round_in_turn(
    unrounded: NDArray[np.float64], scale: NDArray[np.float64], moment: Moments, highest: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Round all columns but the last, of which there is no need; those of the strongest inputs first."""
    count = unrounded.shape[1] - 1
    power = np.diag(moment)[:count]
    order = np.append(np.argsort(-power, kind="stable"), count)
    damped = moment[np.ix_(order, order)]
    damped[np.arange(count), np.arange(count)] += _DAMPING * max(power.mean(), 1e-12)
    upper = np.linalg.cholesky(np.linalg.inv(damped)).T
    unrounded, whole = unrounded[:, order], np.zeros((len(unrounded), count))
    for k in range(count):
        whole[:, k] = np.clip(np.round(unrounded[:, k] / scale[:, 0]), -highest, highest)
        error = (unrounded[:, k] - whole[:, k] * scale[:, 0]) / upper[k, k]
        unrounded[:, k:] -= error[:, None] * upper[k, k:]
    back = np.argsort(order)
    return whole[:, back[:-1]], unrounded[:, back]
