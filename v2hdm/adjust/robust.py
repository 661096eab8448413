"""Robust losses on the squared whitened residual of an observation."""

from __future__ import annotations

import torch
from torch import Tensor


def loss(name: str, squared: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """The loss rho(s) and its derivative, the weight of iteratively reweighted least squares.

    All agree with rho(s) = s near 0 (Barron, A General and Adaptive Robust Loss Function, CVPR 2019,
    alpha = 2, 1, 0, -2, up to the scale's convention).

    Args:
        name: one of :data:`v2hdm.adjust.problem.LOSSES`.
        squared: squared residuals s, of any shape.
        scale: residual, in standard deviations, from which the loss bends.
    """
    if name == "none":
        return squared, torch.ones_like(squared)
    cut = scale * scale
    if name == "huber":
        norm = squared.clamp(min=cut).sqrt()
        return torch.where(squared <= cut, squared, 2 * scale * norm - cut), scale / norm
    ratio = squared / cut
    if name == "cauchy":
        return cut * torch.log1p(ratio), 1 / (1 + ratio)
    if name == "geman_mcclure":
        return squared / (1 + ratio), (1 + ratio).square().reciprocal()
    raise ValueError(f"unknown loss '{name}'")


def annealed_scale(squared: Tensor, scale: float) -> float:
    """A scale with most residuals in the convex part: while the fit is poor, all look like outliers."""
    return max(scale, 2.0 * float(squared.median().sqrt()))
