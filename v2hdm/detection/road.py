"""The detector for a robot's own loop: images of one calibrated camera in, metres out, as JSON or drawn.

.. code-block:: python

    road = RoadDetector.load("calibration_front.yaml")
    for image_bgr in camera:
        for marking in road.detect(image_bgr).markings:
            print(marking.kind, marking.corners_vehicle, marking.covariance_m2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.detection.camera import GroundPoints, camera_from_calibration
from v2hdm.detection.crosswalks import find_crosswalks
from v2hdm.detection.detector import Detector, Looked
from v2hdm.detection.frames import Frame
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.steps import Steps, last
from v2hdm.detection.stopwatch import lap
from v2hdm.errors import MapFileError
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.records import (
    ARROW,
    BICYCLE,
    BOX,
    CHEVRON,
    CROSSWALK,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_BOUNDARY,
    LANE_DASH,
    LANE_LINE,
    STOP_LINE,
    TEXT,
    Calibration,
    Camera,
    FloatArray,
    LaneDetection,
    MarkingDetection,
)

_LANE_SIGMA_PX = 1.0  # standard deviation of a point of a lane's paint; points of whole lines have their own

_PX_DIGITS = 3  # decimals of px in JSON
_PX2_DIGITS = 5  # decimals of px^2 in JSON
_M_DIGITS = 4  # decimals of m in JSON

# Colours of the classes in a drawing.
_COLOUR_BGR = {
    DIAMOND: (60, 200, 60),
    LANE_DASH: (240, 160, 40),
    LANE_LINE: (40, 160, 255),
    LANE_BOUNDARY: (230, 90, 230),
    ARROW: (60, 230, 230),
    STOP_LINE: (120, 120, 255),
    CROSSWALK_BAR: (230, 230, 90),
    CHEVRON: (160, 220, 160),
    TEXT: (250, 170, 250),
    BOX: (80, 210, 250),
    BICYCLE: (200, 250, 120),
    CROSSWALK: (250, 250, 190),
}
_OTHER_BGR = (200, 200, 200)  # colour of all other classes
_INVALID_BGR = (60, 60, 230)  # colour of corners that are not valid
_SHIFT = 4  # bits after the point of the numbers that OpenCV draws at
_FAR_PX = 30000.0  # largest coordinate that is drawn, px: OpenCV's numbers have 32 bits

_TEXT_SCALE = 0.45  # OpenCV's scale of a text in an image of full width
_LEAST_TEXT_SCALE = 0.35  # scale of a text in the smallest images
_FULL_WIDTH_PX = 1280  # width of an image, px, from which texts grow no more


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
    parts: tuple[int, ...] = ()  # of a crosswalk: its bars, by their place among the markings

    @property
    def kind(self) -> str:
        """The class, one of the detector's catalogue."""
        return self.image.kind


@dataclass(frozen=True)
class RoadLane:
    """One lane's line; on the ground empty where the camera is not calibrated."""

    image: LaneDetection
    points_vehicle: FloatArray  # (N, 2) m, of ``image.points_px``
    covariance_m2: FloatArray  # (N, 2, 2) by the errors of pixels and calibration


@dataclass(frozen=True)
class Road:
    """The markings and lanes of one image.

    ``is_whole`` unless only regions of it were looked at, ``is_second`` if they were before.
    """

    markings: tuple[RoadMarking, ...]
    lanes: tuple[RoadLane, ...]
    is_whole: bool = True
    is_second: bool = False


class RoadDetector:
    """Finds the markings and lanes in the images of one camera; use one per thread.

    ``detector`` may be shared by the cameras of one thread. Without a ``calibration`` there are no metres.
    With ``is_for_localizer`` there are neither metres nor lanes but by their paint.
    """

    def __init__(
        self,
        detector: Detector,
        camera: Camera,
        calibration: Calibration | None = None,
        is_for_localizer: bool = False,
    ):
        self.detector = detector
        self.camera = camera
        self.calibration = calibration
        self.is_for_localizer = is_for_localizer

    @classmethod
    def load(
        cls,
        calibration: str | Path,
        model: str | Path | None = None,
        options: DetectorOptions | None = None,
        linear_response: bool = False,
    ) -> RoadDetector:
        """A detector for the camera of a calibration YAML that ``v2hdm map`` wrote.

        ``model`` is an ONNX file, None the shipped one; ``linear_response`` says that grey values are
        proportional to radiance, not sRGB-coded. Raises MapFileError where the calibration is missing,
        damaged or cannot be right, DetectorError where the model cannot be used.
        """
        return cls.calibrated(Detector.load(model, options), Path(calibration), linear_response)

    @classmethod
    def calibrated(cls, detector: Detector, calibration: Path, linear_response: bool = False) -> RoadDetector:
        """As :meth:`load`, with an existing detector."""
        content = read_calibration(calibration)
        try:
            return cls(detector, camera_from_calibration(content, linear_response), content)
        except MapFileError as error:
            raise MapFileError(f"{calibration}: {error}") from error

    def detect(
        self,
        image_bgr: np.ndarray,
        output: NetworkOutput | None = None,
        regions_px: FloatArray | None = None,
    ) -> Road:
        """Find what an image (H, W, 3) uint8 BGR of the camera's size shows; else raises DetectorError.

        ``output`` is the network's, if it has looked at the image already. Where ``regions_px`` (R, 4) are
        given, of left, top, right and bottom, only markings with corners in these are looked for, for less
        time: regions where a map expects them, as of :meth:`v2hdm.Localizer.regions`.
        """
        if regions_px is not None:
            markings = self.detector.detect_in_regions(image_bgr, self.camera, regions_px)
            return self._road(Looked(markings, (), ()), is_whole=False)
        if output is None:
            return last(self.steps(image_bgr))
        has_boundaries = not self.is_for_localizer
        steps = self.detector.steps_in(output, image_bgr, self.camera, has_boundaries)
        return self._road(last(steps), is_whole=True)

    def steps(self, image_bgr: np.ndarray) -> Steps[Road]:
        """As :meth:`detect` of all of an image, in steps between which something else may be done."""
        has_boundaries = not self.is_for_localizer
        looked = yield from self.detector.steps(image_bgr, self.camera, has_boundaries)
        return self._road(looked, is_whole=True)

    def _road(self, looked: Looked, is_whole: bool) -> Road:
        """The detections on the ground, with the crosswalks that they make."""
        with lap("metres"):
            markings = looked.markings
            camera = self.detector.road_camera(self.camera)
            crosswalks = find_crosswalks(markings, camera, looked.pieces)
            road = self._on_ground((*markings, *(crosswalk for crosswalk, _ in crosswalks)), looked.lanes)
            parts = (*(() for _ in markings), *(parts for _, parts in crosswalks))
            with_parts = zip(road.markings, parts, strict=True)
            with_crosswalks = tuple(replace(marking, parts=of) for marking, of in with_parts)
            return replace(road, markings=with_crosswalks, is_whole=is_whole)

    def _on_ground(self, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection]) -> Road:
        """The detections with their places on the ground, if the camera is calibrated."""
        none = np.empty((0, 2))
        if self.calibration is None or self.is_for_localizer:
            return Road(
                tuple(RoadMarking(marking, none, np.empty((0, 0)), none) for marking in markings),
                tuple(RoadLane(lane, none, np.empty((0, 2, 2))) for lane in lanes),
            )
        shapes_px = [m.outline_px if len(m.outline_px) else m.corners_px for m in markings]
        shapes_px += [lane.points_px for lane in lanes]
        camera = self.detector.road_camera(self.camera)
        ground = camera.footprint(np.concatenate([none, *shapes_px]), self.calibration)
        ends = np.cumsum([0, *map(len, shapes_px)])
        parts = [ground[begin:end] for begin, end in pairwise(ends.tolist())]
        road_markings = tuple(map(_marking, markings, parts))
        return Road(road_markings, tuple(map(_lane, lanes, parts[len(markings) :])))


def _marking(image: MarkingDetection, ground: GroundPoints) -> RoadMarking:
    none = np.empty((0, 2))
    if len(image.outline_px):
        return RoadMarking(image, none, np.empty((0, 0)), ground.points_vehicle)
    return RoadMarking(image, ground.points_vehicle, ground.joint_covariance(image.covariance_px), none)


def _lane(image: LaneDetection, ground: GroundPoints) -> RoadLane:
    sigma_px = _LANE_SIGMA_PX if image.sigma_px is None else image.sigma_px
    return RoadLane(image, ground.points_vehicle, ground.single_covariances(sigma_px))


def as_record(frame: Frame, camera: str, road: Road) -> dict[str, Any]:
    """The content of one JSON line (docs/detect.md); not-a-number, which JSON lacks, is null."""
    record: dict[str, Any] = {
        "source": frame.source,
        "frame": frame.index,
        "stamp_s": None if frame.stamp_s is None else round(frame.stamp_s, 6),
        "camera": camera,
        "markings": [_marking_record(marking) for marking in road.markings],
        "lanes": [_lane_record(lane) for lane in road.lanes],
    }
    if not road.is_whole:
        record["whole"] = False
    if road.is_second:
        record["second"] = True
    return record


def _marking_record(marking: RoadMarking) -> dict[str, Any]:
    image = marking.image
    record: dict[str, Any] = {"class": image.kind, "score": round(image.score, 4)}
    if marking.parts:
        record["parts"] = list(marking.parts)
    if len(image.outline_px):
        record["outline_px"] = _plain(np.round(image.outline_px, _PX_DIGITS))
        record["outline_seen"] = image.outline_seen.tolist()
        if len(marking.outline_vehicle):
            record["outline_vehicle"] = _plain(np.round(marking.outline_vehicle, _M_DIGITS))
        return record
    record["corners_px"] = _plain(np.round(image.corners_px, _PX_DIGITS))
    record["corner_valid"] = image.corner_valid.tolist()
    record["covariance_px"] = _plain(np.round(image.covariance_px, _PX2_DIGITS))
    if len(marking.corners_vehicle):
        record["corners_vehicle"] = _plain(np.round(marking.corners_vehicle, _M_DIGITS))
        record["covariance_m2"] = _significant(marking.covariance_m2)
    return record


def _lane_record(lane: RoadLane) -> dict[str, Any]:
    image = lane.image
    record: dict[str, Any] = {"class": image.kind, "score": round(image.score, 4)}
    if image.identity is not None:
        record["identity"] = image.identity
    record["points_px"] = _plain(np.round(image.points_px, _PX_DIGITS))
    if len(lane.points_vehicle):
        record["points_vehicle"] = _plain(np.round(lane.points_vehicle, _M_DIGITS))
        record["covariance_m2"] = _significant(lane.covariance_m2)
    return record


def _significant(values: FloatArray) -> list[Any]:
    """Four significant digits: a covariance spans many powers of ten."""
    power = 3 - np.floor(np.log10(np.clip(np.abs(values), 1e-18, 1e18)))
    more = 10.0 ** np.maximum(power, 0)
    less = 10.0 ** np.maximum(-power, 0)
    return _plain(np.round(values * more / less) * less / more)


def _plain(values: FloatArray) -> list[Any]:
    finite = np.isfinite(values)
    return list((values if finite.all() else np.where(finite, values, np.array(None))).tolist())


def draw_detections(
    image_bgr: np.ndarray, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection]
) -> np.ndarray:
    """A copy of an image with its detections; red corners are not valid."""
    canvas = image_bgr.copy()
    for lane in lanes:
        colour = _COLOUR_BGR.get(lane.kind, _OTHER_BGR)
        points = _fixed(lane.points_px)
        cv2.polylines(canvas, [points], False, colour, 1, cv2.LINE_AA, _SHIFT)
        for point in points:
            cv2.circle(canvas, point.tolist(), 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
        if lane.identity is not None and len(points):
            _write(canvas, f"{lane.identity:+d}", lane.points_px[0], colour)
    for marking in markings:
        colour = _COLOUR_BGR.get(marking.kind, _OTHER_BGR)
        outlined = len(marking.outline_px) > 0
        shape_px = marking.outline_px if outlined else marking.corners_px
        cv2.polylines(canvas, [_fixed(shape_px)], True, colour, 1, cv2.LINE_AA, _SHIFT)
        for corner, valid in zip(_fixed(marking.corners_px), marking.corner_valid, strict=True):
            if not outlined:
                dot = colour if valid else _INVALID_BGR
                cv2.circle(canvas, corner.tolist(), 3 << _SHIFT, dot, 1, cv2.LINE_AA, _SHIFT)
        _write(canvas, f"{marking.kind} {marking.score:.2f}", shape_px[np.argmax(shape_px[:, 0])], colour)
    return canvas


def _write(canvas: np.ndarray, text: str, at_px: FloatArray, colour: tuple[int, int, int]) -> None:
    """Text to the right of a point, with a shadow so that it shows on paint."""
    scale = max(_LEAST_TEXT_SCALE, _TEXT_SCALE * min(1.0, canvas.shape[1] / _FULL_WIDTH_PX))
    u, v = (int(coordinate) for coordinate in np.clip(np.nan_to_num(at_px), -_FAR_PX, _FAR_PX))
    for shift, tone in ((1, (0, 0, 0)), (0, colour)):
        origin = (u + 6 + shift, v + 4 + shift)
        cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, tone, 1, cv2.LINE_AA)


def _fixed(points_px: FloatArray) -> np.ndarray:
    """Points as OpenCV's fixed-point integers."""
    clipped_px = np.clip(np.nan_to_num(points_px), -_FAR_PX, _FAR_PX)
    return np.asarray(np.round(clipped_px * (1 << _SHIFT)).astype(np.int32))
