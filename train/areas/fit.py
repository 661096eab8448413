"""The rows of a few classes, fitted to cells of paint: a logistic regression beside classes that stay."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from train.areas.cells import BARE, OTHER, Cells
from v2hdm.errors import ConfigError

# Weights of all cells of a kind together, chosen: paint that is taken for a word by mistake costs a map more
# than a word that is missed.
_WORTH_OF_CLASSES = 0.5  # cells of the fitted classes
_WORTH_OF_OTHER = 0.8  # cells of other labels
_WORTH_OF_BARE = 1.2  # cells of no label

_CHUNK = 65536  # cells that are looked at together, for memory


def fit_rows(
    cells: Cells, classes: int, render_share: float, ridge: float, steps: int, tell: Callable[[float], None]
) -> Tensor:
    """The rows (classes, C + 1) of least loss, their last column the bias.

    The loss of a cell is the cross entropy of the fitted classes and, as one more, of all others together.
    It has one minimum, which does not depend on where the search begins.

    Args:
        cells: of paint.
        classes: how many are fitted.
        render_share: what cells of renders weigh, of 1.
        ridge: what the squared weights are worth beside the loss of all cells.
        steps: of L-BFGS, at most.
        tell: hears the share of the steps that is done.
    """
    rows = torch.zeros((classes, cells.features.shape[1] + 1), requires_grad=True)
    worth = worth_of(cells, classes, render_share)
    answer = torch.where(cells.marks >= 0, cells.marks, classes).long()
    search = torch.optim.LBFGS([rows], max_iter=steps, max_eval=2 * steps, line_search_fn="strong_wolfe")
    looks = 0

    def loss() -> Tensor:
        nonlocal looks
        looks += 1
        tell(looks / (2 * steps))
        search.zero_grad()
        total = ridge * rows[:, :-1].square().sum()
        total.backward()
        columns = (cells.features, cells.others, answer, worth)
        for features, others, right, weight in zip(*(part.split(_CHUNK) for part in columns), strict=True):
            logits = torch.column_stack([features.float() @ rows[:, :-1].T + rows[:, -1], others])
            part = (weight * cross_entropy(logits, right, reduction="none")).sum()
            part.backward()
            total = total + part.detach()
        return total.detach()

    search.step(loss)
    return rows.detach()


def worth_of(cells: Cells, classes: int, render_share: float) -> Tensor:
    """The weight of each cell (N,): all cells of a mark together weigh the same, however many they are."""
    worth = torch.zeros(len(cells.marks))
    shares = dict.fromkeys(range(classes), _WORTH_OF_CLASSES / classes)
    for mark, share in (shares | {OTHER: _WORTH_OF_OTHER, BARE: _WORTH_OF_BARE}).items():
        for is_render, part in ((False, 1 - render_share), (True, render_share)):
            chosen = (cells.marks == mark) & (cells.is_render == is_render)
            worth[chosen] = share * part / max(int(chosen.sum()), 1)
    return worth


def check_shown(cells: Cells, classes: list[str]) -> None:
    """Refuse cells that show nothing of some class.

    Raises:
        ConfigError: names the class.
    """
    for number, name in enumerate(classes):
        if not (cells.marks == number).any():
            raise ConfigError(
                f"classes: no paint of {name} was seen; label photographs of it (data.coco), raise "
                "render_views or leave it out"
            )
