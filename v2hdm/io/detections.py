"""Files of detections: one JSON object for an image, in place of its picture (docs/drive-format.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.planar import signed_area
from v2hdm.records import Drive, FloatArray, ImageDetections, LaneDetection, MarkingDetection
from v2hdm.safe.fields import take_covariance
from v2hdm.safe.texts import take_name
from v2hdm.store.files import check_keys, load_json, take_array, take_mapping, take_number

_MARKING = ("class", "corners_px")
_LANE = ("class", "points_px")
_DIGITS = 6  # significant digits of a standard deviation
_SURELY = 4.0  # sigmas of an area that are never reached by chance
_PIXEL_DIGITS = 8  # of a coordinate: a ten-thousandth of a pixel in the widest image


def write_detections(path: Path, detections: ImageDetections) -> None:
    """Write the markings and lanes of one image; symbols, which have no corners, are left to pictures."""
    markings = [_marking_json(marking) for marking in detections.markings if not len(marking.outline_px)]
    lanes = [_lane_json(lane) for lane in detections.lanes]
    path.write_text(json.dumps({"markings": markings, "lanes": lanes}) + "\n", encoding="utf-8")


def _marking_json(marking: MarkingDetection) -> dict[str, Any]:
    variance = marking.covariance_px.diagonal()
    content = {
        "class": marking.kind,
        "score": marking.score,
        "corners_px": _rounded(marking.corners_px, _PIXEL_DIGITS),
    }
    if np.count_nonzero(marking.covariance_px) == np.count_nonzero(variance):
        content["sigma_px"] = _rounded(np.sqrt(variance).reshape(4, 2), _DIGITS)
    else:
        # Rounded, a covariance with a nearly certain direction would not be positive definite any more.
        content["covariance_px"] = marking.covariance_px.tolist()
    if not marking.corner_valid.all():
        content["known"] = marking.corner_valid.tolist()
    return content


def _lane_json(lane: LaneDetection) -> dict[str, Any]:
    content: dict[str, Any] = {
        "class": lane.kind,
        "score": lane.score,
        "points_px": _rounded(lane.points_px, _PIXEL_DIGITS),
    }
    if lane.identity is not None:
        content["identity"] = lane.identity
    if lane.sigma_px is not None:
        content["sigma_px"] = _rounded(lane.sigma_px, _DIGITS)
    return content


def _rounded(values: np.ndarray, digits: int) -> Any:
    """Nested lists of numbers with so many significant digits."""
    texts = [float(f"{value:.{digits}g}") for value in values.ravel().tolist()]
    return np.array(texts).reshape(values.shape).tolist()


def read_detections(path: Path, image: int) -> ImageDetections:
    """The detections of image number ``image`` of a drive; raises DriveError where the file is damaged."""
    content = load_json(path, DriveError)
    check_keys(content, ("markings",), ("lanes",), str(path), DriveError)
    markings = [
        _marking(entry, f"{path}: markings[{number}]")
        for number, entry in enumerate(_listed(content["markings"], f"{path}: markings"))
    ]
    lanes = [
        _lane(entry, f"{path}: lanes[{number}]")
        for number, entry in enumerate(_listed(content.get("lanes", []), f"{path}: lanes"))
    ]
    return ImageDetections(image, _counter_clockwise(markings), tuple(lanes))


def detections_of(drive: Drive) -> list[ImageDetections]:
    """The detections in all images of a drive that has them in place of pictures; raises DriveError."""
    return [read_detections(image.path, number) for number, image in enumerate(drive.images)]


def _listed(content: object, where: str) -> list[Any]:
    if not isinstance(content, list):
        raise DriveError(f"{where}: expected a list; restore the file, or make it again")
    return content


def _marking(content: object, where: str) -> MarkingDetection:
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, _MARKING, ("sigma_px", "covariance_px", "score", "known"), where, DriveError)
    corner_known = entry.get("known", [True] * 4)
    if not (
        isinstance(corner_known, list)
        and len(corner_known) == 4
        and all(isinstance(flag, bool) for flag in corner_known)
    ):
        raise DriveError(f"{where}, known: expected four times true or false; fix it or leave it out")
    corners_px = take_array(entry["corners_px"], (4, 2), f"{where}, corners_px", DriveError)
    corner_valid = np.array(corner_known, dtype=np.bool_)
    return MarkingDetection(
        kind=take_name(entry["class"], f"{where}, class", DriveError),
        score=_score(entry, where),
        corners_px=corners_px,
        covariance_px=_covariance_px(entry, where),
        corner_valid=corner_valid,
    )


def _counter_clockwise(markings: Sequence[MarkingDetection]) -> tuple[MarkingDetection, ...]:
    """The markings of a file with corners counter-clockwise on the screen: other tools list them clockwise.

    The one whose direction is surest tells that of all: noise turns small ones over.
    """
    whole = [marking for marking in markings if marking.corner_valid.all()]
    if not whole:
        return tuple(markings)
    turns = _turnings(
        np.stack([marking.corners_px for marking in whole]),
        np.stack([marking.covariance_px for marking in whole]),
    )
    if turns[np.abs(turns).argmax()] < _SURELY:
        return tuple(markings)
    return tuple(_reversed(marking) for marking in markings)


def _turnings(corners_px: FloatArray, covariance_px: FloatArray) -> FloatArray:
    """The areas (M,) of markings with corners (M, 4, 2) and their covariances (M, 8, 8), in their sigmas.

    They are positive where corners run clockwise on the screen.
    """
    across = np.roll(corners_px, -1, axis=1) - np.roll(corners_px, 1, axis=1)
    gradient = 0.5 * np.stack([across[:, :, 1], -across[:, :, 0]], axis=2).reshape(-1, 8)
    variance = np.einsum("mi,mij,mj->m", gradient, covariance_px, gradient)
    return np.asarray(signed_area(corners_px) / np.sqrt(np.maximum(variance, 1e-12)))


def _reversed(marking: MarkingDetection) -> MarkingDetection:
    order = [0, 3, 2, 1]
    by_corner = marking.covariance_px.reshape(4, 2, 4, 2)
    return replace(
        marking,
        corners_px=marking.corners_px[order],
        covariance_px=by_corner[order][:, :, order].reshape(8, 8),
        corner_valid=marking.corner_valid[order],
    )


def _score(entry: Mapping[str, Any], where: str) -> float:
    score = take_number(entry.get("score", 1.0), f"{where}, score", DriveError)
    if not 0 <= score <= 1:
        raise DriveError(f"{where}, score: {score:g} is not a probability; give one from 0 to 1")
    return score


def _covariance_px(entry: Mapping[str, Any], where: str) -> FloatArray:
    """The covariance (8, 8) of a marking's corners, or that of their standard deviations."""
    if ("sigma_px" in entry) == ("covariance_px" in entry):
        raise DriveError(f"{where}: give one of sigma_px (4 x 2) and covariance_px (8 x 8)")
    if "covariance_px" in entry:
        return take_covariance(entry["covariance_px"], 8, f"{where}, covariance_px", DriveError)
    sigma_px = take_array(entry["sigma_px"], (4, 2), f"{where}, sigma_px", DriveError)
    if (sigma_px <= 0).any():
        raise DriveError(f"{where}, sigma_px: a standard deviation is not above 0; fix it")
    return np.diag(np.square(sigma_px).ravel())


def _lane(content: object, where: str) -> LaneDetection:
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, _LANE, ("score", "identity", "sigma_px"), where, DriveError)
    points_px = take_array(entry["points_px"], (-1, 2), f"{where}, points_px", DriveError)
    identity = entry.get("identity")
    if identity is not None and (isinstance(identity, bool) or not isinstance(identity, int)):
        raise DriveError(f"{where}, identity: expected a whole number; fix it or leave it out")
    sigma_px = None
    if entry.get("sigma_px") is not None:
        sigma_px = take_array(entry["sigma_px"], (len(points_px),), f"{where}, sigma_px", DriveError)
        if (sigma_px <= 0).any():
            raise DriveError(f"{where}, sigma_px: a standard deviation is not above 0; fix it")
    return LaneDetection(
        kind=take_name(entry["class"], f"{where}, class", DriveError),
        score=_score(entry, where),
        points_px=points_px,
        identity=identity,
        sigma_px=sigma_px,
    )
