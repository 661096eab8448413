"""The minimiser on objectives that are no number somewhere."""

import math

import pytest
import torch

from v2hdm.adjust.lbfgs import minimise

CENTRE = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
CURVATURE = torch.tensor([1.0, 30.0, 900.0], dtype=torch.float64)


def bowl(whitened: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    off = whitened - CENTRE
    return 0.5 * (CURVATURE * off * off).sum(), CURVATURE * off


@pytest.mark.parametrize("wrong", ["cost", "gradient", "both"])
@pytest.mark.parametrize("first_wrong", range(1, 12))
def test_where_the_objective_is_no_number_the_point_before_it_stands(wrong: str, first_wrong: int) -> None:
    calls = 0

    def objective(whitened: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nonlocal calls
        calls += 1
        cost, gradient = bowl(whitened)
        if calls >= first_wrong:
            # A small gradient passes for the end of a line search, which then has no bracket to speak of.
            cost = cost * math.nan if wrong != "gradient" else cost
            gradient = gradient * (1e-3 if wrong == "cost" else math.nan)
        return cost, gradient

    start_cost, start_gradient = bowl(torch.zeros(3, dtype=torch.float64))
    found = minimise(objective, start_cost, start_gradient, 1e-12, 30)
    cost, gradient = bowl(found.whitened)
    assert float(found.cost) <= float(start_cost)
    torch.testing.assert_close(found.cost, cost)
    torch.testing.assert_close(found.gradient, gradient)
