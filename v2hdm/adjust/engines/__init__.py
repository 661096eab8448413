"""Engines that evaluate and linearise the model: autograd of kornia, or kernels compiled by numba."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from v2hdm.adjust.arrays import Arrays
    from v2hdm.adjust.engine import Engine


def is_numba(engine: str, device: str) -> bool:
    """Whether an engine by its name is ``numba`` on a device; ``auto`` is, on the CPU."""
    return engine == "numba" or (engine == "auto" and torch.device(device).type == "cpu")


def make_engine(engine: str, arrays: Arrays) -> Engine:
    """The engine by its name over a problem."""
    if is_numba(engine, str(arrays.centre.device)):
        from v2hdm.adjust.engines.numba.engine import NumbaEngine

        return NumbaEngine(arrays)
    from v2hdm.adjust.engines.autograd import TorchEngine

    return TorchEngine(arrays)
