"""The settings of an export; `conf/export.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

from v2hdm.settings import COUNT, POSITIVE, SEED, SHARE, Within, check_settings


class Precision(Enum):
    """The arithmetic of the exported network."""

    float32 = "float32"
    int8 = "int8"


@dataclass(kw_only=True)
class BoundsConfig:
    """How far an int8 file may be from its network on renders before it is refused.

    The names are those of :class:`export.parity.Parity`.
    """

    paint_changed: Annotated[float, SHARE, "largest share of the paint that may change."] = 0.06
    outline_px: Annotated[float, POSITIVE, "largest median shift of the paint's outline, px."] = 0.12
    outline_bias_px: Annotated[float, POSITIVE, "largest mean growth of the paint on all sides, px."] = 0.05
    kinds_agree: Annotated[float, SHARE, "least share of painted elements that keep their class."] = 0.97
    lanes_agree: Annotated[float, SHARE, "least Dice coefficient of the cells that lanes cross."] = 0.95
    lane_offset_px: Annotated[float, POSITIVE, "largest median shift of lanes, px."] = 0.15


@dataclass(kw_only=True)
class Int8Config:
    """How a network becomes int8, on renders."""

    frames: Annotated[int, COUNT, "number of renders on which a network becomes int8."] = 24
    parity_frames: Annotated[
        int, COUNT, "number of other renders on which the file is compared with the network."
    ] = 12
    seed: Annotated[int, SEED, "seed of these renders."] = 1_618_033
    bounds: BoundsConfig = field(default_factory=BoundsConfig)


@dataclass(kw_only=True)
class ExportConfig:
    """One export, of the averaged weights in ``checkpoint`` to the file ``output``."""

    checkpoint: Annotated[
        str,
        "a checkpoint, whose averaged weights are exported, or an exported float32 file.",
    ]
    output: Annotated[str, "the ONNX file to write."]
    precision: Annotated[Precision, "arithmetic of the exported network, float32 or int8."] = (
        Precision.float32
    )
    opset: Annotated[int, Within(18, 23), "ONNX operator set, 18 to 23."] = 18
    tolerance: Annotated[
        float,
        POSITIVE,
        "largest difference of any logit of a float32 file from the network's; int8 files have "
        "their own bounds.",
    ] = 1e-3
    int8: Int8Config = field(default_factory=Int8Config)


def check_export(config: ExportConfig) -> None:
    """Refuse settings that no export can work with.

    Raises:
        ConfigError: a value is out of range; the message names the key.
    """
    check_settings(config)
