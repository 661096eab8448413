"""The settings of the detector."""

from __future__ import annotations

from dataclasses import dataclass

from v2hdm.errors import ConfigError
from v2hdm.safe.texts import shown
from v2hdm.settings import NOT_NEGATIVE, POSITIVE, Within, check_settings

DEVICES = ("cpu", "cuda")

_RANGES = (
    dict.fromkeys(("max_range_m", "lane_step_m"), POSITIVE)
    | dict.fromkeys(("min_score", "min_confidence"), Within(0, 1 - 1e-9))
    # More threads take the machine's memory before they do any work.
    | {"border_px": NOT_NEGATIVE, "blur_px": Within(0.2, 3), "threads": Within(1, 256)}
)


@dataclass(kw_only=True)
class DetectorOptions:
    """Settings of :class:`v2hdm.detection.detector.Detector`.

    Attributes:
        model: path of the ONNX file; None for the shipped one.
        device: device of the network, ``cpu`` or ``cuda``; the rest of the detector runs on the CPU.
        threads: number of threads of one onnxruntime session. Throughput comes from worker processes.
        blur_px: standard deviation of the image's point spread, including the pixel aperture, px; None
            measures it on near markings. Each px of error biases far corners by 0.6 to 1.2 px.
        max_range_m: markings and lane points farther from the camera on the ground are dropped.
        min_score: minimum mean class probability of a blob.
        min_confidence: minimum probability, given all evidence, that a quadrilateral is a whole marking.
        mirrored: also run the network on the mirror image and average: fewer errors for more time.
        border_px: corners closer to the image border are not used.
        lane_step_m: spacing of lane points on the ground.
    """

    model: str | None = None
    device: str = "cpu"
    threads: int = 1
    blur_px: float | None = None
    max_range_m: float = 22.0
    min_score: float = 0.5
    min_confidence: float = 0.7
    mirrored: bool = False
    border_px: float = 4.0
    lane_step_m: float = 0.5

    @classmethod
    def for_mapping(cls) -> DetectorOptions:
        """Defaults for mapping, which weighs corners by covariance and observes each one many times."""
        return cls(min_confidence=0.3, mirrored=True)

    def __post_init__(self) -> None:
        """Raise ConfigError if a value is out of range."""
        check_settings(self, _RANGES, "detector.")
        if self.device not in DEVICES:
            raise ConfigError(f"detector.device is {shown(self.device)}: choose {' or '.join(DEVICES)}")
