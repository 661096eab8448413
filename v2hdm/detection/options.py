"""The settings of the detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from v2hdm.doors import check_types
from v2hdm.errors import ConfigError
from v2hdm.safe.texts import shown
from v2hdm.settings import NOT_NEGATIVE, POSITIVE, Within, check_settings

DEVICES = ("cpu", "cuda")


@dataclass(kw_only=True)
class DetectorOptions:
    """Settings of :class:`v2hdm.detection.detector.Detector`."""

    model: Annotated[str | None, "path of the ONNX file; null for the shipped one."] = None
    device: Annotated[
        str, "device of the network, cpu or cuda; the rest of the detector runs on the CPU."
    ] = "cpu"
    threads: Annotated[
        int,
        Within(1, 256),
        "number of threads of one onnxruntime session. Throughput comes from worker processes.",
    ] = 1
    blur_px: Annotated[
        float | None,
        Within(0.2, 3),
        "standard deviation of the image's point spread, including the pixel aperture, px; null measures it "
        "on near markings. Each px of error biases far corners by 0.6 to 1.2 px.",
    ] = None
    max_range_m: Annotated[
        float, POSITIVE, "markings and lane points farther from the camera on the ground are dropped."
    ] = 22.0
    min_score: Annotated[float, Within(0, 1 - 1e-9), "minimum mean class probability of a blob."] = 0.5
    min_confidence: Annotated[
        float,
        Within(0, 1 - 1e-9),
        "minimum probability, given all evidence, that a quadrilateral is a whole marking.",
    ] = 0.7
    mirrored: Annotated[
        bool, "also run the network on the mirror image and average: fewer errors for more time."
    ] = False
    border_px: Annotated[float, NOT_NEGATIVE, "corners closer to the image border are not used."] = 4.0
    lane_step_m: Annotated[float, POSITIVE, "spacing of lane points on the ground."] = 0.5

    @classmethod
    def for_mapping(cls) -> DetectorOptions:
        """Defaults for mapping, which weighs corners by covariance and observes each one many times."""
        return cls(min_confidence=0.3, mirrored=True)

    def __post_init__(self) -> None:
        """Raise ConfigError if a value is out of range."""
        check_types(self, "detector.")
        check_settings(self, "detector.")
        if self.device not in DEVICES:
            raise ConfigError(f"detector.device is {shown(self.device)}: choose {' or '.join(DEVICES)}")
