"""One image's detections as one JSON object; docs/detect.md describes it."""

from __future__ import annotations

from typing import Any

import numpy as np

from v2hdm.detection.frames import Frame
from v2hdm.detection.road import Road, RoadLane, RoadMarking
from v2hdm.records import FloatArray

_PX, _PX2, _M = 3, 5, 4


def as_record(frame: Frame, camera: str, road: Road) -> dict[str, Any]:
    """What goes into one line; not-a-number, which JSON lacks, is null."""
    return {
        "source": frame.source,
        "frame": frame.index,
        "stamp_s": None if frame.stamp_s is None else round(frame.stamp_s, 6),
        "camera": camera,
        "markings": [_marking(marking) for marking in road.markings],
        "lanes": [_lane(lane) for lane in road.lanes],
    }


def _marking(marking: RoadMarking) -> dict[str, Any]:
    image = marking.image
    record: dict[str, Any] = {"class": image.kind, "score": round(image.score, 4)}
    if len(image.outline_px):
        record["outline_px"] = _rounded(image.outline_px, _PX)
        if len(marking.outline_vehicle):
            record["outline_vehicle"] = _rounded(marking.outline_vehicle, _M)
        return record
    record["corners_px"] = _rounded(image.corners_px, _PX)
    record["corner_valid"] = image.corner_valid.tolist()
    record["covariance_px"] = _rounded(image.covariance_px, _PX2)
    if len(marking.corners_vehicle):
        record["corners_vehicle"] = _rounded(marking.corners_vehicle, _M)
        record["covariance_m2"] = _significant(marking.covariance_m2)
    return record


def _lane(lane: RoadLane) -> dict[str, Any]:
    image = lane.image
    record: dict[str, Any] = {"class": image.kind, "score": round(image.score, 4)}
    if image.identity is not None:
        record["identity"] = image.identity
    record["points_px"] = _rounded(image.points_px, _PX)
    if len(lane.points_vehicle):
        record["points_vehicle"] = _rounded(lane.points_vehicle, _M)
        record["covariance_m2"] = _significant(lane.covariance_m2)
    return record


def _rounded(values: FloatArray, digits: int) -> list[Any]:
    return _plain(np.round(values, digits))


def _significant(values: FloatArray) -> list[Any]:
    """Four significant digits: a covariance spans many powers of ten."""
    return _plain(np.array([float(f"{value:.4g}") for value in values.ravel()]).reshape(values.shape))


def _plain(values: FloatArray) -> list[Any]:
    finite = np.isfinite(values)
    plain: list[Any] = values.tolist()
    if not finite.all():
        plain = np.where(finite, values.astype(object), np.array(None)).tolist()
    return plain
