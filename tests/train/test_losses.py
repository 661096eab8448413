"""The loss and the score on cases that can be worked out by hand."""

import pytest
import torch

from models import Prediction
from train.config import LossConfig
from train.losses import dice_loss, kind_loss, lane_loss, paint_loss, total_loss
from train.metrics import Tally
from train.targets import IGNORE, Targets
from v2hdm.catalogue import PAINT_CLASSES

KINDS = len(PAINT_CLASSES)


def sure(labels: torch.Tensor) -> torch.Tensor:
    """Log odds that are all but certain of 0 or 1."""
    return 40.0 * (labels == 1).float() - 20.0


def sure_kinds(labels: torch.Tensor) -> torch.Tensor:
    """Logits (B, K, H, W) that are all but certain of the given classes."""
    known = torch.where(labels == IGNORE, 0, labels).long()
    return 30.0 * torch.nn.functional.one_hot(known, KINDS).permute(0, 3, 1, 2).float()


def example() -> tuple[Prediction, Targets]:
    """A picture of 8 x 16 px with paint, its class and a lane's line, and the perfect prediction of it."""
    paint = torch.zeros((1, 4, 8), dtype=torch.uint8)
    paint[0, :2, :4] = 1
    kinds = torch.full((1, 2, 4), IGNORE, dtype=torch.uint8)
    kinds[0, 0, :2] = 3
    there = torch.tensor([[[0, 1]]], dtype=torch.uint8)
    offset = torch.tensor([[[0.0, 0.25]]])
    prediction = Prediction(
        sure(paint)[:, None], sure_kinds(kinds), torch.stack([sure(there), offset], dim=1)
    )
    worth = torch.ones(kinds.shape)
    return prediction, Targets(paint, worth, kinds, worth, there, offset)


def test_certain_and_right_costs_nothing() -> None:
    prediction, targets = example()
    assert float(total_loss(prediction, targets, LossConfig())) < 1e-3


@pytest.mark.parametrize("wrong", ["paint", "kinds", "lanes"])
def test_each_output_that_is_wrong_costs(wrong: str) -> None:
    prediction, targets = example()
    prediction = prediction._replace(**{wrong: getattr(prediction, wrong).flip(-1)})
    assert float(total_loss(prediction, targets, LossConfig())) > 1


def test_certain_and_wrong_costs_the_whole_dice_loss() -> None:
    labels = torch.full((1, 40, 40), 1)
    assert float(dice_loss(sure(torch.zeros_like(labels)), labels)) > 0.99


def test_dice_of_a_picture_without_paint_is_zero() -> None:
    labels = torch.zeros((1, 4, 4), dtype=torch.uint8)
    assert float(dice_loss(sure(labels), labels)) == pytest.approx(0, abs=1e-6)


def test_ignored_elements_get_no_gradient() -> None:
    labels = torch.tensor([[[0, 1, IGNORE, 1]]], dtype=torch.uint8)
    logits = torch.randn(1, 1, 4, requires_grad=True)
    worth = torch.tensor([[[1.0, 1.0, 1.0, 3.0]]])
    paint_loss(logits, labels, worth, 2.0, 0.0).backward()
    assert logits.grad is not None
    assert float(logits.grad[..., 2].abs().max()) == 0
    pull = logits.grad[0, 0] / (logits[0, 0].sigmoid() - labels[0, 0]).detach()
    assert float(pull[1]) > 0
    assert float(pull[3] / pull[1]) == pytest.approx(3, rel=1e-4), "an element is not worth what it should be"


def test_a_batch_without_paint_or_lanes_has_a_finite_loss() -> None:
    kinds = torch.full((1, 2, 2), IGNORE, dtype=torch.uint8)
    assert float(kind_loss(torch.randn(1, KINDS, 2, 2), kinds, torch.ones(1, 2, 2))) == 0
    none = torch.zeros((1, 2, 2), dtype=torch.uint8)
    nothing = torch.zeros(1, 2, 2)
    targets = Targets(none, nothing, kinds, nothing, none, nothing)
    assert torch.isfinite(lane_loss(torch.randn(1, 2, 2, 2), targets, 3.0))


def test_cells_of_no_weight_leave_the_loss_of_kinds_as_it_is() -> None:
    labels = torch.tensor([[[0, 1, 1, IGNORE]]], dtype=torch.uint8)
    logits = torch.randn(1, KINDS, 1, 4)
    without = torch.tensor([[[1.0, 1.0, 0.0, 0.0]]])
    half = kind_loss(logits, labels, without)
    wrong = logits.clone()
    wrong[..., 2] += 5 * torch.randn(KINDS)[None, :, None]
    assert torch.equal(half, kind_loss(wrong, labels, without))
    whole = kind_loss(logits, labels, torch.ones(1, 1, 4))
    first, second, third = (-logits[0, :, 0, k].log_softmax(0)[label] for k, label in enumerate((0, 1, 1)))
    rare, common = 3**0.5, 1.5**0.5
    expected = (rare * first + common * (second + third)) / (rare + 2 * common)
    assert float(whole) == pytest.approx(float(expected), rel=1e-5)


def test_the_score_counts_by_hand() -> None:
    prediction, targets = example()
    kinds = targets.kinds.clone()
    kinds[0, 0, 1] = 5
    tally = Tally()
    tally.add(prediction, targets._replace(kinds=kinds))
    score = tally.score()
    assert score.iou == {"arrow": 1 / 2, "crosswalk_bar": 0.0}
    assert score.mean_iou == 1 / 4
    assert (score.paint_iou, score.lane_recall, score.lane_precision) == (1.0, 1.0, 1.0)


def test_a_crossing_two_cells_off_is_neither_found_nor_right() -> None:
    there = torch.zeros((1, 1, 8), dtype=torch.uint8)
    there[..., 2] = 1
    for found, right in ((3, 1.0), (4, 0.0)):
        given = torch.zeros((1, 1, 8), dtype=torch.uint8)
        given[..., found] = 1
        paint = torch.zeros((1, 4, 32), dtype=torch.uint8)
        kinds = torch.full((1, 2, 16), IGNORE, dtype=torch.uint8)
        nothing = torch.zeros(kinds.shape)
        tally = Tally()
        tally.add(
            Prediction(
                sure(paint)[:, None], sure_kinds(kinds), torch.stack([sure(given), sure(given)], dim=1)
            ),
            Targets(paint, nothing, kinds, nothing, there, torch.zeros((1, 1, 8))),
        )
        assert (tally.score().lane_recall, tally.score().lane_precision) == (right, right)
