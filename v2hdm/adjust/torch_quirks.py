"""Ways around torch's internals, all in one place; a test notices when torch changes."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import torch


@cache
def bare_step() -> Callable[[torch.optim.LBFGS, Callable[[], float]], Any]:
    """LBFGS' step without the profiler's hooks around it, which take as long as the step."""
    step: Callable[[torch.optim.LBFGS, Callable[[], float]], Any] = inspect.unwrap(torch.optim.LBFGS.step)
    return step


@cache
def leave_compiler_out() -> None:
    """Keep torch from importing its compiler, 1 to 2.5 s, for the methods of the first optimiser."""
    if "torch._dynamo" in sys.modules:
        return
    for name in dir(torch.optim.Optimizer):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None:
            with suppress(AttributeError, TypeError):
                method.__dynamo_disable = method
