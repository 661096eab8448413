"""The detector for a robot's own loop: images of one calibrated camera in, metres out.

.. code-block:: python

    road = RoadDetector.load("calibration_front.yaml")
    for image_bgr in camera:
        for marking in road.detect(image_bgr).markings:
            print(marking.kind, marking.corners_vehicle, marking.covariance_m2)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.detection.detector import Detector
from v2hdm.detection.footprint import Footprint
from v2hdm.detection.mounting import camera_from_calibration
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.stopwatch import lap
from v2hdm.errors import MapFileError
from v2hdm.hdmap import read_calibration
from v2hdm.records import Camera, FloatArray, LaneDetection, MarkingDetection

LANE_SIGMA_PX = 1.0
"""What a point of a lane's line is taken to err by, since the detector gives it no covariance of its own."""


@dataclass(frozen=True)
class RoadMarking:
    """One marking: where it is in the image and on the ground (vehicle frame, m).

    ``corners_vehicle`` (4, 2) belong to ``image.corners_px``, whose order they share; ``covariance_m2``
    (8, 8) is that of the stacked corners and holds the errors of pixels and calibration. ``outline_vehicle``
    (N, 2) is the polygon of those without corners. All are empty where the camera is not calibrated.
    """

    image: MarkingDetection
    corners_vehicle: FloatArray
    covariance_m2: FloatArray
    outline_vehicle: FloatArray

    @property
    def kind(self) -> str:
        """The class, one of :data:`v2hdm.records.PAINT_CLASSES`."""
        return self.image.kind


@dataclass(frozen=True)
class RoadLane:
    """One lane's line: ``points_vehicle`` (N, 2) belong to ``image.points_px``.

    ``covariance_m2`` (N, 2, 2) holds the errors of pixels and calibration, point by point. Both are empty
    where the camera is not calibrated.
    """

    image: LaneDetection
    points_vehicle: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True)
class Road:
    """What one image shows."""

    markings: tuple[RoadMarking, ...]
    lanes: tuple[RoadLane, ...]


class RoadDetector:
    """Finds the markings and lanes in the images of one camera; use one per thread.

    Args:
        detector: may be shared by the cameras of one thread.
        camera: the camera.
        footprint: how its pixels lie on the ground; without one there are no metres.
    """

    def __init__(self, detector: Detector, camera: Camera, footprint: Footprint | None = None):
        self.detector = detector
        self.camera = camera
        self.footprint = footprint

    @classmethod
    def load(
        cls,
        calibration: str | Path,
        model: str | Path | None = None,
        options: DetectorOptions | None = None,
        linear_response: bool = False,
    ) -> RoadDetector:
        """A detector for the camera of a calibration YAML that ``python -m v2hdm.map`` wrote.

        Args:
            calibration: the YAML file.
            model: ONNX file; None takes the one that is shipped.
            options: settings of the detector.
            linear_response: the camera's grey values are proportional to radiance, not sRGB-coded.

        Raises:
            MapFileError: the calibration is missing, damaged or cannot be right.
            DetectorError: the model cannot be used.
        """
        return cls.calibrated(Detector.load(model, options), Path(calibration), linear_response)

    @classmethod
    def calibrated(cls, detector: Detector, calibration: Path, linear_response: bool = False) -> RoadDetector:
        """As :meth:`load`, for a detector that is there already."""
        content = read_calibration(calibration)
        try:
            camera = camera_from_calibration(content, linear_response)
        except MapFileError as error:
            raise MapFileError(f"{calibration}: {error}") from error
        return cls(detector, camera, Footprint(detector.view(camera), content))

    def detect(self, image_bgr: np.ndarray) -> Road:
        """Find what one image (H, W, 3) uint8 BGR shows.

        Raises:
            DetectorError: the image is not of that form or not of the camera's size.
        """
        markings, lanes = self.detector.detect(image_bgr, self.camera)
        with lap("metres"):
            return Road(
                tuple(self._on_ground(marking) for marking in markings),
                tuple(self._line_on_ground(lane) for lane in lanes),
            )

    def _on_ground(self, marking: MarkingDetection) -> RoadMarking:
        none = np.empty((0, 2))
        if self.footprint is None:
            return RoadMarking(marking, none, np.empty((0, 0)), none)
        if len(marking.outline_px):
            outline, _ = self.footprint.points(marking.outline_px, 0.0)
            return RoadMarking(marking, none, np.empty((0, 0)), outline)
        corners, covariance = self.footprint.polygon(marking.corners_px, marking.covariance_px)
        return RoadMarking(marking, corners, covariance, none)

    def _line_on_ground(self, lane: LaneDetection) -> RoadLane:
        if self.footprint is None:
            return RoadLane(lane, np.empty((0, 2)), np.empty((0, 2, 2)))
        return RoadLane(lane, *self.footprint.points(lane.points_px, LANE_SIGMA_PX))
