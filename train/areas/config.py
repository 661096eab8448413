"""The settings of ``python -m train.areas``; `conf/train_areas.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from train.config import DataConfig
from v2hdm.records import BOX, TEXT
from v2hdm.settings import ANY_NUMBER, COUNT, MOST_PROCESSES, NOT_NEGATIVE, SEED, SHARE, Within

_LOWERED = {TEXT: -0.2, BOX: -0.75}
"""The change of the shipped classes' log odds. Source: the 130 validation photographs of ROAD MARK."""

_RIDGE = 1e-3
"""For text and box. Source: in these photographs 1e-5 saw words at 14 places without a label, 1e-3 at 10."""


@dataclass(kw_only=True)
class AreasConfig:
    """One fit of the rows of a few classes."""

    output: Annotated[str, "folder that best.pt is written to."] = "runs/areas"
    start: Annotated[str, "the network, a checkpoint or an exported file; all else of it stays."] = (
        "models/marking_net.onnx"
    )
    classes: Annotated[list[str], "the classes that are fitted; those that start knows are fitted anew."] = (
        field(default_factory=lambda: [TEXT, BOX])
    )
    log_odds: Annotated[
        dict[str, float],
        ANY_NUMBER,
        "by class: what is added to its log odds after the fit. Choose it on photographs for validation.",
    ] = field(default_factory=lambda: dict(_LOWERED))
    seed: Annotated[int, SEED, "of the renders and of the changes of photographs."] = 1
    threads: Annotated[int, Within(1, MOST_PROCESSES), "of torch."] = 1
    sky: Annotated[float, SHARE, "share of a photograph's height, from its top, that shows no ground."] = 0.35
    render_views: Annotated[int, NOT_NEGATIVE, "views of renders that are shown beside the photographs."] = (
        1176
    )
    render_share: Annotated[float, SHARE, "what all cells of renders weigh of all cells."] = 0.3
    ridge: Annotated[float, NOT_NEGATIVE, "what is added to the loss for each squared weight."] = _RIDGE
    steps: Annotated[int, COUNT, "the fit ends after so many steps of L-BFGS, or when it has converged."] = (
        100
    )
    scored_images: Annotated[int, COUNT, "validation renders that the result is scored on."] = 64
    data: DataConfig = field(default_factory=DataConfig)
