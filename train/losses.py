"""What the training minimises: weighted cross entropy plus soft Dice."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

IGNORE = 255
"""Label of pixels that carry no loss: those that an edge of paint halves."""


def segmentation_loss(logits: Tensor, labels: Tensor, class_weights: Tensor, dice_weight: float) -> Tensor:
    """Cross entropy plus ``dice_weight`` times the soft Dice loss, a scalar.

    Args:
        logits: (B, C, H, W) float.
        labels: (B, H, W) int64, class index or :data:`IGNORE`.
        class_weights: (C,) weights of the cross entropy.
        dice_weight: 0 leaves the Dice term out.
    """
    loss = cross_entropy(logits, labels, weight=class_weights, ignore_index=IGNORE)
    return loss + dice_weight * dice_loss(logits, labels) if dice_weight else loss


def dice_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """One minus the soft Dice overlap, averaged over the paint classes that the batch shows.

    Milletari et al., "V-Net", 2016, eq. for D with squared denominators. Background is left out, and so
    are absent classes: their overlap is 0 however good the prediction is.
    """
    known = (labels != IGNORE).unsqueeze(1)
    probability = logits.softmax(dim=1) * known
    classes = torch.arange(logits.shape[1], device=logits.device).view(1, -1, 1, 1)
    target = (labels.unsqueeze(1) == classes).to(probability.dtype)
    overlap = (probability * target).sum(dim=(0, 2, 3))[1:]
    size = (probability.square() + target).sum(dim=(0, 2, 3))[1:]
    present = (target.sum(dim=(0, 2, 3))[1:] > 0).to(probability.dtype)
    return (present * (1 - (2 * overlap + 1) / (size + 1))).sum() / present.sum().clamp(min=1)
