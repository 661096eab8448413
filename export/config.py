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


_KINDS_AGREE_AND_LANES_AGREE = (
    "The names are those of Parity, which says what they mean; of kinds_agree and lanes_agree these are "
    "the least, of the others the most."
)


@dataclass(kw_only=True)
class BoundsConfig:
    """How far an int8 file may be from its network on renders before it is refused.

    The names are those of :class:`export.parity.Parity`.
    """

    paint_changed: Annotated[float, SHARE, "share of the paint that may change."] = 0.06
    outline_px: Annotated[float, POSITIVE, "how far its outline may move."] = 0.12
    outline_bias_px: Annotated[float, POSITIVE, "how far it may move outwards on the whole."] = 0.05
    kinds_agree: Annotated[float, SHARE, _KINDS_AGREE_AND_LANES_AGREE] = 0.97
    lanes_agree: Annotated[float, SHARE, _KINDS_AGREE_AND_LANES_AGREE] = 0.95
    lane_offset_px: Annotated[float, POSITIVE, "how far lanes may move."] = 0.15


_FRAMES_AND_SEED = "How a network becomes int8: on frames renders that seed stands for."


@dataclass(kw_only=True)
class Int8Config:
    """How a network becomes int8, on renders."""

    frames: Annotated[int, COUNT, _FRAMES_AND_SEED] = 24
    parity_frames: Annotated[
        int, COUNT, "The file is then held against the network on parity_frames other renders."
    ] = 12
    seed: Annotated[int, SEED, _FRAMES_AND_SEED] = 1_618_033
    bounds: BoundsConfig = field(default_factory=BoundsConfig)


@dataclass(kw_only=True)
class ExportConfig:
    """One export, of the averaged weights in ``checkpoint`` to the file ``output``."""

    checkpoint: Annotated[
        str,
        "One export, of the averaged weights in checkpoint to the file output. checkpoint may also be an "
        "exported file of float32.",
    ]
    output: Annotated[str, "One export, of the averaged weights in checkpoint to the file output."]
    precision: Annotated[Precision, "what the network computes with."] = Precision.float32
    opset: Annotated[int, Within(18, 23), "ONNX operator set, 18 to 23."] = 18
    tolerance: Annotated[
        float,
        POSITIVE,
        "how far any logit of a float32 file may be from the network's before it is refused; an int8 file "
        "has bounds of its own.",
    ] = 1e-3
    int8: Int8Config = field(default_factory=Int8Config)


def check_export(config: ExportConfig) -> None:
    """Refuse settings that no export can work with.

    Raises:
        ConfigError: a value is out of range; the message names the key.
    """
    check_settings(config)
