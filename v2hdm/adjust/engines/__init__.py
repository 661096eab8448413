"""Engines that evaluate and linearise the model: autograd on kornia, or kernels compiled by numba."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from v2hdm.adjust.arrays import Arrays
    from v2hdm.adjust.engine import Engine


def make_engine(engine: str, arrays: Arrays) -> Engine:
    """The engine of this name for a problem; ``auto`` is numba on the CPU, torch elsewhere."""
    if engine == "numba" or (engine == "auto" and arrays.centre.device.type == "cpu"):
        from v2hdm.adjust.engines.numba.engine import NumbaEngine

        return NumbaEngine(arrays)
    from v2hdm.adjust.engines.autograd import TorchEngine

    return TorchEngine(arrays)
