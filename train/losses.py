"""The loss of a training: one term per output of the network."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import (
    binary_cross_entropy_with_logits,
    cross_entropy,
    interpolate,
    max_pool2d,
    smooth_l1_loss,
)

from models import Prediction
from train.config import LossConfig
from train.targets import IGNORE, Targets

_BARE_WORTH = 0.1
"""The weight of a cell that is taken for paint and bare: as much as one of a marking of 100 cells. Chosen."""


def total_loss(prediction: Prediction, targets: Targets, config: LossConfig) -> Tensor:
    """The weighted sum of the terms, a scalar."""
    cells = targets.paint_weight * rare_paint(targets.kinds, targets.kind_weight)
    worth = interpolate(cells[:, None], scale_factor=2.0, mode="nearest")[:, 0]
    loss = paint_loss(prediction.paint[:, 0], targets.paint, worth, config.paint_weight, config.dice)
    loss = loss + config.kinds * kind_loss(prediction.kinds, targets.kinds, targets.kind_weight)
    if config.lanes:
        loss = loss + config.lanes * lane_loss(prediction.lanes, targets, config.lane_weight)
    return loss


def paint_loss(
    logits: Tensor, labels: Tensor, worth: Tensor, positive_weight: float, dice_weight: float
) -> Tensor:
    """Binary cross entropy plus soft Dice of paint; logits, labels and worth (B, H, W).

    Args:
        logits: Log odds of paint.
        labels: 0, 1 or :data:`IGNORE`.
        worth: What each element weighs in the cross entropy.
        positive_weight: What an element of paint weighs, one of background weighing 1.
        dice_weight: 0 leaves the Dice term out.
    """
    loss = _balanced_cross_entropy(logits, labels, positive_weight, worth)
    return loss + dice_weight * dice_loss(logits, labels) if dice_weight else loss


def dice_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """One minus the soft Dice overlap of a batch's paint.

    Milletari et al., "V-Net", 2016, eq. for D with squared denominators.
    """
    is_labelled = labels != IGNORE
    probability = logits.sigmoid() * is_labelled
    target = (labels == 1).to(probability.dtype)
    return 1 - (2 * (probability * target).sum() + 1) / (probability.square().sum() + target.sum() + 1)


def kind_loss(logits: Tensor, labels: Tensor, weight: Tensor) -> Tensor:
    """Cross entropy of the paint's class: logits (B, K, H, W), labels (B, H, W); no paint carries no loss.

    Cells weigh ``weight`` (B, H, W), and the more the rarer their class is: by the root of how many times its
    cells' weights go into those of all classes. Arrows are few, lines are many.
    """
    is_labelled = labels != IGNORE
    if not is_labelled.any():
        return logits.sum() * 0
    cells = labels[is_labelled].long()
    weight = weight[is_labelled]
    weight = weight * _rarity(cells, weight, logits.shape[1]).clamp(max=6.0)[cells]
    loss = cross_entropy(logits.movedim(1, -1)[is_labelled], cells, reduction="none")
    return (weight * loss).sum() / weight.sum()


def kept_loss(logits: Tensor, before: Tensor, paint: Tensor, targets: Targets) -> Tensor:
    """How far the classes of paint have moved from those before, where no label says otherwise.

    It is the mean Kullback-Leibler divergence from the earlier network's classes (Li and Hoiem, "Learning
    without Forgetting", ECCV 2016) over the cells that the network takes for paint and that are bare by the
    labels, or of the class that it gave them before.

    Args:
        logits: Of the classes, (B, K, H, W).
        before: The same of the earlier network.
        paint: Log odds of paint, (B, 1, 2H, 2W).
        targets: The answers; paint of a class that nobody knows carries no loss.
    """
    is_seen = max_pool2d(paint, 2)[:, 0] > 0
    is_bare = max_pool2d(targets.paint.float()[:, None], 2)[:, 0] == 0
    agrees = targets.kinds == before.argmax(dim=1)
    is_kept = is_seen & (agrees | (is_bare & (targets.kinds == IGNORE)))
    if not is_kept.any():
        return logits.sum() * 0
    log_share = logits.movedim(1, -1)[is_kept].log_softmax(-1)
    log_share_before = before.movedim(1, -1)[is_kept].log_softmax(-1)
    divergence = (log_share_before.exp() * (log_share_before - log_share)).sum(-1)
    worth = torch.where(agrees, targets.kind_weight, _BARE_WORTH)[is_kept]
    return (worth * divergence).sum() / worth.sum()


def rare_paint(kinds: Tensor, weight: Tensor) -> Tensor:
    """Weights of the paint in and around each cell (B, H, W) by its class: 1 for the commonest, 4 at most.

    Stop lines are seldom, and of the thinnest paint: their class alone would be learnt, not their paint.
    Around them too, so that no edge is learnt outside of the true one.
    """
    is_labelled = kinds != IGNORE
    if not is_labelled.any():
        return torch.ones_like(weight)
    cells = kinds[is_labelled].long()
    rarity = _rarity(cells, weight[is_labelled], int(cells.max()) + 1)
    worth = torch.ones_like(weight)
    worth[is_labelled] = (rarity / rarity[cells].min()).clamp(max=4.0)[cells]
    return max_pool2d(worth[:, None], 5, 1, 2)[:, 0]


def _rarity(cells: Tensor, weight: Tensor, classes: int) -> Tensor:
    """The root of how many times the weight (N,) of each class's cells (N,) goes into that of all."""
    total = torch.zeros(classes, dtype=weight.dtype, device=weight.device).index_add(0, cells, weight)
    return (total.sum() / total.clamp(min=1e-6)).sqrt()


def lane_loss(logits: Tensor, targets: Targets, positive_weight: float) -> Tensor:
    """Whether a lane's line crosses, and where: logits (B, 2, H, W) as in :class:`models.Prediction`."""
    loss = _balanced_cross_entropy(logits[:, 0], targets.lane_there, positive_weight)
    crossed = targets.lane_there == 1
    if not crossed.any():
        return loss
    return loss + smooth_l1_loss(logits[:, 1][crossed], targets.lane_offset[crossed], beta=0.1)


def _balanced_cross_entropy(
    logits: Tensor, labels: Tensor, positive_weight: float, worth: Tensor | float = 1.0
) -> Tensor:
    """Mean binary cross entropy of the elements that are known, positive ones weighing more."""
    is_labelled = labels != IGNORE
    target = (labels == 1).to(logits.dtype)
    weight = is_labelled * worth * (1 + (positive_weight - 1) * target)
    total = binary_cross_entropy_with_logits(logits, target, weight, reduction="sum")
    return total / weight.sum().clamp(min=1)
