"""The classifier of quadrilaterals, a small network: the second stage of the detector.

:class:`models.MarkingNet` separates paint from ground, pixel by pixel. Whether a piece of paint is a whole
marking of a class shows in its shape and in the image about it. The classifier gets both: the quadrilateral
rectified (:mod:`v2hdm.detection.evidence`) and what was measured of it
(:data:`v2hdm.detection.evidence.FEATURES`), as the second stage of Faster R-CNN gets features of its
region (Ren et al., NeurIPS 2015).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_CELLS = 2
"""Rows and columns that convolutions end in: means over parts of a view that overlap in its middle."""


_SIDES = 4  # sides of a quadrilateral
_LOG_SIGMA = (-4.0, 4.0)
"""Limits of the logarithm of a side's error, px."""


class Judge(nn.Module):
    """Log odds that quadrilaterals are whole markings of their classes, and how far their sides may be off.

    What convolutions see in the views is weighed with the evidence, for each shape a little otherwise.

    Args:
        channels: of the views, which have 20 rows and columns.
        features: of the evidence.
        shapes: the classes are classified by.
        width: channels of the first convolution.
        dropout: share of what is hidden in training.
        hidden: units between the convolutions and the answer.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(
        self,
        channels: int,
        features: int,
        shapes: int,
        width: int,
        dropout: float,
        hidden: int = 48,
    ):
        super().__init__()
        self.shapes = shapes
        self.see = nn.Sequential(
            nn.Conv2d(channels, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, 3 * width // 2, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(3 * width // 2, 2 * width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(2 * width, 2 * width, 3, padding=1),
            nn.ReLU(),
            nn.AvgPool2d(3, stride=2),
            nn.Flatten(),
        )
        inputs = features + shapes
        self.weigh = nn.Sequential(
            nn.Linear(2 * width * _CELLS**2 + inputs, hidden),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, shapes),
        )
        self.doubt = nn.Sequential(
            nn.Linear(2 * width * _CELLS**2 + inputs, hidden), nn.ReLU(), nn.Linear(hidden, _SIDES)
        )
        self.hide = nn.Dropout(dropout)
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("deviation", torch.ones(features))

    def forward(self, views: Tensor, evidence: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds (M,), and log of how far each side may be off (M, 4), px.

        Args:
            views: (M, C, S, S); sides are those at the top, right, bottom and left of a view.
            evidence: (M, F).
            shape: (M, K), one-hot.
        """
        measured = torch.cat([(evidence - self.mean) / self.deviation, shape], dim=1)
        all_inputs = torch.cat([self.hide(self.see(views)), measured], dim=1)
        return (self.weigh(all_inputs) * shape).sum(dim=1), self.doubt(all_inputs).clamp(*_LOG_SIGMA)
