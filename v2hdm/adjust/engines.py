"""The engine of a solve by name: torch's, or its heir by compiled kernels."""

from __future__ import annotations

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.kernels import NAMES, are_compiled


def make_engine(engine: str, arrays: Arrays) -> TorchEngine:
    """The engine of this name for a problem; ``auto`` is ``native`` on the CPU if kernels are compiled."""
    is_on_cpu = arrays.centre.device.type == "cpu"
    if engine in NAMES or (engine == "auto" and is_on_cpu and are_compiled()):
        from v2hdm.adjust.kernels.engine import KernelEngine

        return KernelEngine(arrays)
    return TorchEngine(arrays)
