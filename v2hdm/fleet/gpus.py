"""How the work of a fleet shares its GPUs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from v2hdm.pipeline.config import RunConfig

EYES_A_GPU = 8
"""Actors that detect on one GPU: each takes memory there, and most of an image's time is the CPU's."""

NO_GPU = (
    "device=cuda or detector.device=cuda is set, and none of Ray's machines has a GPU: set them to cpu, or "
    "start Ray where there is one"
)


@dataclass(frozen=True)
class Shares:
    """The shares of a GPU that an actor that detects, and a mapping task, take on Ray's books."""

    eyes: float
    mapping: float

    @classmethod
    def of(cls, configs: Sequence[RunConfig]) -> Shares:
        """A whole GPU for a mapping task, and for so many actors; half where both are on GPUs."""
        detects = any(one.detector.device == "cuda" for one in configs)
        maps = any(one.device == "cuda" for one in configs)
        part = 0.5 if detects and maps else 1.0
        return cls(part / EYES_A_GPU, part)


def wants_gpu(config: RunConfig) -> bool:
    """Whether a run has work for a GPU."""
    return "cuda" in (config.device, config.detector.device)
