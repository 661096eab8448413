"""How good a network is on labelled images: intersection over union by class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from train.losses import IGNORE
from v2hdm.records import PAINT_CLASSES


@dataclass(frozen=True)
class Score:
    """Intersection over union of every paint class, of paint as a whole, and the mean over classes."""

    iou: dict[str, float]
    paint_iou: float

    @property
    def mean_iou(self) -> float:
        """Mean over the paint classes that the images show."""
        return float(np.mean(list(self.iou.values()))) if self.iou else 0.0


class Confusion:
    """Counts of pixels by (true class, predicted class), added up image by image."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros((1 + len(PAINT_CLASSES),) * 2, dtype=np.int64)

    def add(self, logits: Tensor, labels: Tensor) -> None:
        """Count the pixels of logits (B, C, H, W) against labels (B, H, W), except ignored ones."""
        classes = len(self.counts)
        known = labels != IGNORE
        pairs = labels[known] * classes + logits.argmax(dim=1)[known]
        self.counts += torch.bincount(pairs, minlength=classes**2).view(classes, classes).cpu().numpy()

    def score(self) -> Score:
        """The scores so far; a class that was never shown is left out."""
        hits = np.diag(self.counts)
        union = self.counts.sum(axis=0) + self.counts.sum(axis=1) - hits
        shown = self.counts.sum(axis=1) > 0
        iou = {name: float(hits[c] / union[c]) for c, name in enumerate(PAINT_CLASSES, start=1) if shown[c]}
        paint = self.counts[1:, 1:].sum()
        return Score(iou, float(paint / max(self.counts.sum() - self.counts[0, 0], 1)))
