"""Features of cells of paint in a network, and the classes that these cells show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from models import MarkingNet
from models.marking_net import KIND_STRIDE, PAINT_STRIDE
from train.growth import CLASS_LAYERS

OTHER = -1
"""Marks a cell that is labelled as another class than those that are fitted."""

BARE = -2
"""Marks a cell that has no label."""

OPEN = -3
"""Marks a cell of which nothing is known."""

Marks = NDArray[np.int8]

_LEAST_LOG_ODDS = -1.0
"""Log odds of paint from which a cell is shown: some paint is seen only in part. Chosen."""

_MOST_OF_OTHERS = 900
"""Cells of a view that show none of the classes, at most; more are drawn by lot. Chosen, for memory."""


class View(NamedTuple):
    """An image (H, W, 3) uint8 BGR, and the mark (H/4, W/4) of each of its cells.

    A mark is the place of a class among those that are fitted, or one of the constants above.
    """

    image: NDArray[np.uint8]
    marks: Marks


class Cells(NamedTuple):
    """Cells of paint: features (N, C) float16, marks (N,) int8, and whether each is of a render (N,).

    ``others`` (N,) float32 is the log of the summed odds of all classes that are not fitted.
    """

    features: Tensor
    others: Tensor
    marks: Tensor
    is_render: Tensor

    @classmethod
    def joined(cls, parts: Sequence[Cells]) -> Cells:
        """All cells of some parts, at least one."""
        return cls(*(torch.cat(column) for column in zip(*parts, strict=True)))


class CellReader:
    """A network in eval mode that tells what its layers of classes read.

    Args:
        net: the network.
        places: of the fitted classes among its channels.
        rng: draws the cells of other classes.
    """

    def __init__(self, net: MarkingNet, places: Sequence[int], rng: np.random.Generator) -> None:
        self._net = net
        self._places = list(places)
        self._rng = rng
        self._planes: dict[str, Tensor] = {}
        modules = dict(net.named_modules())
        self._layers = [name for name in CLASS_LAYERS if name in modules]
        for name in self._layers:
            modules[name].register_forward_pre_hook(self._keeper(name))

    def _keeper(self, name: str) -> Callable[[nn.Module, tuple[Tensor, ...]], None]:
        def keep(_layer: nn.Module, inputs: tuple[Tensor, ...]) -> None:
            self._planes[name] = inputs[0]

        return keep

    @torch.inference_mode()
    def read(self, view: View, is_render: bool) -> Cells:
        """The cells of a view that show paint."""
        prediction = self._net(torch.from_numpy(view.image)[None])
        paint = max_pool2d(prediction.paint, KIND_STRIDE // PAINT_STRIDE)[0, 0].numpy()
        row, column = np.nonzero((paint > _LEAST_LOG_ODDS) & (view.marks != OPEN))
        chosen = self._chosen(view.marks[row, column])
        row = row[chosen]
        column = column[chosen]
        features = [_at_cells(self._planes[name][0], row, column, len(paint)) for name in self._layers]
        logits = prediction.kinds[0][:, row, column]
        logits[self._places] = -torch.inf
        return Cells(
            torch.cat(features).T.half(),
            logits.logsumexp(dim=0),
            torch.from_numpy(view.marks[row, column]),
            torch.full((len(row),), is_render),
        )

    def _chosen(self, marks: Marks) -> NDArray[np.intp]:
        """Indices of the cells to keep: all of the fitted classes, and so many others at most."""
        others = np.flatnonzero(marks < 0)
        if len(others) > _MOST_OF_OTHERS:
            others = self._rng.choice(others, _MOST_OF_OTHERS, replace=False)
        return np.concatenate([np.flatnonzero(marks >= 0), others])


def _at_cells(plane: Tensor, row: NDArray[np.intp], column: NDArray[np.intp], rows: int) -> Tensor:
    """The values (C, N) of a plane (C, h, w) at cells of a plane of ``rows`` rows, perhaps a finer one."""
    scale = rows // plane.shape[1]
    return plane[:, row // scale, column // scale]
