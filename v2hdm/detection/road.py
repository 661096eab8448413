"""The detector for a robot's own loop: images of one calibrated camera in, metres out.

.. code-block:: python

    road = RoadDetector.load("calibration_front.yaml")
    for image_bgr in camera:
        for marking in road.detect(image_bgr).markings:
            print(marking.kind, marking.corners_vehicle, marking.covariance_m2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from v2hdm.detection.camera.footprint import Footprint, GroundPoints
from v2hdm.detection.camera.mounting import camera_from_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.stopwatch import lap
from v2hdm.errors import MapFileError
from v2hdm.io.maps import read_calibration
from v2hdm.records import Camera, FloatArray, LaneDetection, MarkingDetection

LANE_SIGMA_PX = 1.0
"""What a point of a lane's paint is taken to err by; those of whole lines have a sigma of their own."""


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
        """The class, one of the detector's catalogue."""
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
        """A detector for the camera of a calibration YAML that ``v2hdm map`` wrote.

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
            return self._on_ground(markings, lanes)

    def _on_ground(self, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection]) -> Road:
        none = np.empty((0, 2))
        if self.footprint is None:
            return Road(
                tuple(RoadMarking(marking, none, np.empty((0, 0)), none) for marking in markings),
                tuple(RoadLane(lane, none, np.empty((0, 2, 2))) for lane in lanes),
            )
        shapes_px = [m.outline_px if len(m.outline_px) else m.corners_px for m in markings]
        shapes_px += [lane.points_px for lane in lanes]
        ground = self.footprint.of(np.concatenate([none, *shapes_px]))
        ends = np.cumsum([0, *map(len, shapes_px)])
        parts = [ground[begin:end] for begin, end in pairwise(ends.tolist())]
        return Road(tuple(map(_marking, markings, parts)), tuple(map(_lane, lanes, parts[len(markings) :])))


def _marking(image: MarkingDetection, ground: GroundPoints) -> RoadMarking:
    none = np.empty((0, 2))
    if len(image.outline_px):
        return RoadMarking(image, none, np.empty((0, 0)), ground.points_vehicle)
    return RoadMarking(image, ground.points_vehicle, ground.joint_covariance(image.covariance_px), none)


def _lane(image: LaneDetection, ground: GroundPoints) -> RoadLane:
    sigma_px = LANE_SIGMA_PX if image.sigma_px is None else image.sigma_px
    return RoadLane(image, ground.points_vehicle, ground.single_covariances(sigma_px))
