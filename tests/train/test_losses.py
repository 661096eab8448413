"""The loss on cases that can be worked out by hand."""

import torch

from train.losses import IGNORE, dice_loss, segmentation_loss
from train.metrics import Confusion

WEIGHTS = torch.ones(5)


def sure_logits(labels: torch.Tensor) -> torch.Tensor:
    """Logits that are all but certain of the given classes."""
    return 30.0 * torch.nn.functional.one_hot(labels, 5).permute(0, 3, 1, 2).float()


def test_certain_and_right_costs_nothing() -> None:
    labels = torch.tensor([[[0, 1, 1], [0, 2, 4]]])
    assert float(segmentation_loss(sure_logits(labels), labels, WEIGHTS, 1.0)) < 1e-4


def test_certain_and_wrong_costs_the_whole_dice_loss_of_a_class() -> None:
    labels = torch.full((1, 40, 40), 1)
    assert float(dice_loss(sure_logits(torch.full_like(labels, 2)), labels)) > 0.99


def test_ignored_pixels_get_no_gradient() -> None:
    labels = torch.tensor([[[0, 1, IGNORE, 2]]])
    logits = torch.randn(1, 5, 1, 4, requires_grad=True)
    segmentation_loss(logits, labels, WEIGHTS, 1.0).backward()
    assert logits.grad is not None
    assert float(logits.grad[..., 2].abs().max()) == 0
    assert float(logits.grad[..., 1].abs().max()) > 0


def test_dice_of_a_picture_without_paint_is_zero() -> None:
    labels = torch.zeros((1, 4, 4), dtype=torch.int64)
    assert float(dice_loss(sure_logits(labels), labels)) == 0


def test_intersection_over_union_counts_by_hand() -> None:
    labels = torch.tensor([[[1, 1, 0, 0, IGNORE, 2]]])
    predicted = torch.tensor([[[1, 0, 1, 0, 1, 1]]])
    confusion = Confusion()
    confusion.add(sure_logits(predicted), labels)
    score = confusion.score()
    assert score.iou == {"diamond": 1 / 4, "lane_dash": 0.0}
    assert score.mean_iou == 1 / 8
    assert score.paint_iou == 2 / 4
