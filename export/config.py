"""The settings of an export; `conf/export.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from v2hdm.settings import COUNT, POSITIVE, SEED, SHARE, Within, check_settings


class Precision(Enum):
    """The arithmetic of the exported network."""

    float32 = "float32"
    int8 = "int8"


@dataclass(kw_only=True)
class BoundsConfig:
    """How far an int8 file may be from its network on renders before it is refused.

    The names are those of :class:`export.parity.Parity`, which says what they mean; of ``kinds_agree`` and
    ``lanes_agree`` these are the least, of the others the most.

    Attributes:
        paint_changed: share of the paint that may change.
        outline_px: how far its outline may move.
        outline_bias_px: how far it may move outwards on the whole.
        lane_offset_px: how far lanes may move.
    """

    paint_changed: float = 0.06
    outline_px: float = 0.12
    outline_bias_px: float = 0.05
    kinds_agree: float = 0.97
    lanes_agree: float = 0.95
    lane_offset_px: float = 0.15


@dataclass(kw_only=True)
class Int8Config:
    """How a network becomes int8: on ``frames`` renders that ``seed`` stands for.

    The file is then held against the network on ``parity_frames`` other renders.
    """

    frames: int = 24
    parity_frames: int = 12
    seed: int = 1_618_033
    bounds: BoundsConfig = field(default_factory=BoundsConfig)


@dataclass(kw_only=True)
class ExportConfig:
    """One export, of the averaged weights in ``checkpoint`` to the file ``output``.

    ``checkpoint`` may also be an exported file of float32. ``tolerance`` is how far any logit of a float32
    file may be from the network's before it is refused; an int8 file has bounds of its own.

    Attributes:
        precision: what the network computes with.
        opset: ONNX operator set, 18 to 23.
    """

    checkpoint: str
    output: str
    precision: Precision = Precision.float32
    opset: int = 18
    tolerance: float = 1e-3
    int8: Int8Config = field(default_factory=Int8Config)


_RANGES = {
    "opset": Within(18, 23),
    "tolerance": POSITIVE,
    "int8.frames": COUNT,
    "int8.parity_frames": COUNT,
    "int8.seed": SEED,
    **{f"int8.bounds.{name}": SHARE for name in ("paint_changed", "kinds_agree", "lanes_agree")},
    **{f"int8.bounds.{name}": POSITIVE for name in ("outline_px", "outline_bias_px", "lane_offset_px")},
}


def check_export(config: ExportConfig) -> None:
    """Refuse settings that no export can work with.

    Raises:
        ConfigError: a value is out of range; the message names the key.
    """
    check_settings(config, _RANGES)
