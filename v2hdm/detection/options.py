"""The settings of the detector."""

from __future__ import annotations

from dataclasses import dataclass

from v2hdm.errors import ConfigError
from v2hdm.io.safe.texts import shown
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
        model: path of the ONNX file; None takes the one that is shipped.
        device: what the network runs on, ``cpu`` or ``cuda``; the rest of the detector runs on the CPU.
        threads: threads of one onnxruntime session. Throughput comes from worker processes.
        blur_px: standard deviation of the image's point spread, pixel aperture included, in px;
            None measures it on the near markings. It decides the far corners' bias: 0.6 to 1.2 px
            per px of error.
        max_range_m: markings and lane points farther from the camera on the ground are dropped.
        min_score: least mean class probability of a blob.
        min_confidence: least probability, by all evidence, that a quadrilateral is a whole marking.
        mirrored: ask the network of the mirror image, too, and take the mean: fewer errors for more time.
        border_px: corners nearer to the image border are no points.
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
        """Defaults of the mapping, which weighs corners by their covariance and sees each many times."""
        return cls(min_confidence=0.3, mirrored=True)

    def __post_init__(self) -> None:
        """Raise ConfigError where a value is out of range."""
        check_settings(self, _RANGES, "detector.")
        if self.device not in DEVICES:
            raise ConfigError(f"detector.device is {shown(self.device)}: choose {' or '.join(DEVICES)}")
