"""How good a network is on labelled images: intersection over union by class, lane crossings found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d

from models import Prediction
from models.marking_net import KIND_STRIDE, PAINT_STRIDE
from train.targets import IGNORE, Targets
from v2hdm.catalogue import PAINT_CLASSES


@dataclass(frozen=True)
class Score:
    """Intersection over union of every paint class (cells of 4 px) and of paint as such (cells of 2 px).

    ``lane_recall`` and ``lane_precision`` count crossings of row anchors, right if at most one cell off.
    """

    iou: dict[str, float]
    paint_iou: float
    lane_recall: float
    lane_precision: float

    @property
    def mean_iou(self) -> float:
        """Mean over the paint classes that the images show."""
        return float(np.mean(list(self.iou.values()))) if self.iou else 0.0

    def figures(self) -> dict[str, float]:
        """All of it by name."""
        lanes = {"lane_recall": self.lane_recall, "lane_precision": self.lane_precision}
        iou = {f"{name}_iou": value for name, value in self.iou.items()}
        return {"mean_iou": self.mean_iou, "paint_iou": self.paint_iou} | iou | lanes

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:.3f}" for name, value in self.figures().items())


class Tally:
    """Counts over images, added up one by one, of the ``classes`` of a network."""

    def __init__(self, classes: Sequence[str] = PAINT_CLASSES) -> None:
        self._classes = classes
        self._kinds: NDArray[np.int64] = np.zeros((1 + len(classes),) * 2, dtype=np.int64)
        self._paint: NDArray[np.int64] = np.zeros((2, 2), dtype=np.int64)
        self._lanes: NDArray[np.int64] = np.zeros(4, dtype=np.int64)

    def add(self, prediction: Prediction, targets: Targets) -> None:
        """Count a batch, except for what its targets ignore."""
        is_labelled = targets.paint != IGNORE
        _count(self._paint, targets.paint[is_labelled], prediction.paint[:, 0][is_labelled] > 0)
        self._add_kinds(prediction, targets)
        self._add_lanes(prediction.lanes[:, 0] > 0, targets.lane_there)

    def score(self) -> Score:
        """The scores so far; a class that was never shown is left out."""
        hits = np.diag(self._kinds)
        union = self._kinds.sum(axis=0) + self._kinds.sum(axis=1) - hits
        shown = self._kinds.sum(axis=1) > 0
        iou = {name: float(hits[c] / union[c]) for c, name in enumerate(self._classes, start=1) if shown[c]}
        paint = self._paint
        met, true, right, reported = (int(count) for count in self._lanes)
        return Score(
            iou,
            float(paint[1, 1] / max(paint.sum() - paint[0, 0], 1)),
            met / max(true, 1),
            right / max(reported, 1),
        )

    def _add_kinds(self, prediction: Prediction, targets: Targets) -> None:
        """Cells where paint is likelier than not take the class that is likeliest there."""
        scale = KIND_STRIDE // PAINT_STRIDE
        painted = torch.nn.functional.avg_pool2d(prediction.paint.sigmoid(), scale)[:, 0] > 0.5
        guess = torch.where(painted, prediction.kinds.argmax(dim=1) + 1, 0)
        truth_paint = targets.paint.to(torch.float32)[:, None]
        empty = max_pool2d(truth_paint, scale)[:, 0] == 0
        truth = torch.where(targets.kinds == IGNORE, 0, targets.kinds.long() + 1)
        counts = (targets.kinds != IGNORE) | empty
        _count(self._kinds, truth[counts], guess[counts])

    def _add_lanes(self, reported: Tensor, truth: Tensor) -> None:
        true = truth == 1
        possible = truth != 0
        self._lanes += np.array(
            [
                (true & _widened(reported)).sum().item(),
                true.sum().item(),
                (reported & _widened(possible)).sum().item(),
                reported.sum().item(),
            ]
        )


def _widened(cells: Tensor) -> Tensor:
    """Cells (B, H, W) and their neighbours along the row."""
    return max_pool2d(cells.to(torch.float32)[:, None], (1, 3), 1, (0, 1))[:, 0] > 0


def _count(table: NDArray[np.int64], truth: Tensor, guess: Tensor) -> None:
    size = len(table)
    pairs = truth.long() * size + guess.long()
    table += torch.bincount(pairs.flatten(), minlength=size**2).view(size, size).cpu().numpy()
