"""How far single sightings are off: on the ground by their range, in the image by their place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from v2hdm.association.sightings import Sightings, collect_sightings
from v2hdm.errors import MappingError
from v2hdm.geometry.ipm import (
    apply_in_front,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray, ImageDetections, Marking, Truth
from v2hdm.report.metrics import match_markings

SAME_SHARE = 0.5
"""A sighting is of the marking whose image lies within this share of its own diameter of it."""

CELLS = (8, 5)
"""Cells of a field of residuals, across and down the image."""

RANGE_STEP_M = 1.0
"""Width of a bin of ranges."""

_FARTHEST_M = 22.0
_FEWEST = 20
"""Corners below which neither a cell nor a bin has figures."""


@dataclass(frozen=True)
class _Sighted:
    """Corners (4,) of sightings that were recognised in the map: one entry per sighting.

    ``row`` indexes the sightings, ``marking`` the map, ``shift`` says which corner of the marking is the
    sighting's first: corner ``k`` is the marking's ``(k + shift) % 4``.
    """

    row: list[int]
    marking: list[int]
    shift: list[int]


def residuals(
    drive: Drive,
    detections: Sequence[ImageDetections],
    methods: Mapping[str, MethodResult],
    truth: Truth,
) -> dict[str, Any]:
    """By camera ``field`` and ``range`` of a camera set's results, as plain content.

    Args:
        drive: as it was described, with its first IPMs.
        detections: what was found in its images.
        methods: of one camera set; ``Opt`` is among them.
        truth: of the drive.

    Returns:
        ``field`` holds for ``before`` and ``after`` the median residual (px) of detected corners against the
        optimised map, by cell of the image: before under the first IPM and the recorded poses, after under
        the optimised extrinsic and the adjusted poses. ``range`` holds by method quartiles of the distance
        (m) between corners of single sightings, laid on the ground, and the true ones.
    """
    best = methods["Opt"]
    out: dict[str, Any] = {}
    for name in best.cameras:
        try:
            sightings = collect_sightings(drive, detections, (name,))
        except MappingError:
            continue  # a camera that saw nothing has no residuals
        seen = _recognised(drive, sightings, name, best)
        out[name] = {
            "field": _field(drive, sightings, name, best, seen),
            "range": _by_range(drive, sightings, name, methods, truth, seen),
        }
    return out


def _adjusted(drive: Drive, image: int, best: MethodResult) -> FloatArray:
    one = drive.images[image]
    return one.map_from_vehicle if best.poses is None else best.poses.of_image(one)


def _recognised(drive: Drive, sightings: Sightings, name: str, best: MethodResult) -> _Sighted:
    """Which sightings are of which marking of the map, by where the optimised calibration sees it."""
    calibration, markings = best.calibrations[name], best.hd_map.markings
    seen = _Sighted([], [], [])
    if not markings:
        return seen
    corners = np.array([marking.corners_map for marking in markings])
    kinds = np.array([marking.kind for marking in markings])
    for image in np.unique(sightings.image):
        cam_from_map = calibration.cam_from_vehicle @ inverse(_adjusted(drive, int(image), best))
        places, depth = project_ground(
            calibration.info.intrinsic, cam_from_map, corners.reshape(-1, 2)
        )  # fmt: skip
        places, ahead = places.reshape(-1, 4, 2), (depth.reshape(-1, 4) > 0).all(axis=1)
        centres = places.mean(axis=1)
        for row in np.flatnonzero(sightings.image == image):
            corners_px = sightings.corners_pinhole_px[row]
            if not sightings.valid[row].all():
                continue
            alike = np.flatnonzero(ahead & (kinds == sightings.kinds[sightings.kind[row]]))
            if not len(alike):
                continue
            distance = np.linalg.norm(centres[alike] - corners_px.mean(axis=0), axis=1)
            marking = int(alike[distance.argmin()])
            if distance.min() > SAME_SHARE * np.linalg.norm(np.ptp(corners_px, axis=0)):
                continue
            off = [((np.roll(places[marking], -s, axis=0) - corners_px) ** 2).sum() for s in range(4)]
            seen.row.append(int(row))
            seen.marking.append(marking)
            seen.shift.append(int(np.argmin(off)))
    return seen


def _turned(markings: Sequence[Marking], seen: _Sighted) -> FloatArray:
    """Corners (N, 4, 2) of the recognised markings, in the order of their sightings' corners."""
    corners = [
        np.roll(markings[m].corners_map, -s, axis=0) for m, s in zip(seen.marking, seen.shift, strict=True)
    ]
    return np.array(corners).reshape(-1, 4, 2)


def _field(
    drive: Drive, sightings: Sightings, name: str, best: MethodResult, seen: _Sighted
) -> dict[str, Any]:
    camera = drive.cameras[name]
    rows = np.array(seen.row, dtype=np.int64)
    corners_map, observed = _turned(best.hd_map.markings, seen), sightings.corners_pinhole_px[rows]
    first = np.linalg.inv(facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0)))
    found = best.calibrations[name]
    images = [int(image) for image in sightings.image[rows]]
    before = [first @ flat_motion(inverse(drive.images[image].map_from_vehicle)) for image in images]
    after = [
        pinhole_px_from_ground(
            camera.info.intrinsic, found.cam_from_vehicle @ inverse(_adjusted(drive, image, best))
        )
        for image in images
    ]
    size = (camera.info.width, camera.info.height)
    return {
        "size_px": size,
        "before": _cells(observed, _projected(before, corners_map), size),
        "after": _cells(observed, _projected(after, corners_map), size),
    }


def _projected(homographies: Sequence[FloatArray], corners_map: FloatArray) -> FloatArray:
    if not len(corners_map):
        return np.empty((0, 4, 2))
    return apply_in_front(np.array(homographies), corners_map)


def _cells(observed_px: FloatArray, projected_px: FloatArray, size: tuple[int, int]) -> dict[str, Any]:
    """Median residual (detected minus projected) by cell, None where there are too few; median length of all.

    A median, for single corners are off by many pixels: cut by shadows, or of another marking.
    """
    place, residual = observed_px.reshape(-1, 2), (observed_px - projected_px).reshape(-1, 2)
    keep = np.isfinite(residual).all(axis=1) & (place >= 0).all(axis=1) & (place < size).all(axis=1)
    place, residual = place[keep], residual[keep]
    cell = (place * CELLS / size).astype(np.int64)
    number = cell[:, 1] * CELLS[0] + cell[:, 0]
    median: list[list[float] | None] = []
    for index in range(CELLS[0] * CELLS[1]):
        own = number == index
        median.append(np.median(residual[own], axis=0).tolist() if own.sum() >= _FEWEST else None)
    length = float(np.median(np.linalg.norm(residual, axis=1))) if len(residual) else None
    return {"median_px": median, "length_px": length, "corners": len(residual)}


def _by_range(
    drive: Drive,
    sightings: Sightings,
    name: str,
    methods: Mapping[str, MethodResult],
    truth: Truth,
    seen: _Sighted,
) -> dict[str, Any]:
    """Quartiles of the distance (m) of single sightings' corners to the true ones, by method."""
    camera, best = drive.cameras[name], methods["Opt"]
    mapped, true = match_markings(best.hd_map.markings, truth.map.markings)
    true_of = dict(zip(mapped, true, strict=True))
    known = [n for n, marking in enumerate(seen.marking) if marking in true_of]
    rows = np.array([seen.row[n] for n in known], dtype=np.int64)
    if not len(rows):
        return {}
    turned = _turned(best.hd_map.markings, seen)[known]
    corners = np.array([truth.map.markings[true_of[seen.marking[n]]].corners_map for n in known])
    corners = np.array([_alike(one, other) for one, other in zip(corners, turned, strict=True)])
    images = [int(image) for image in sightings.image[rows]]
    recorded = flat_motion(np.array([drive.images[image].map_from_vehicle for image in images]))
    vehicle_from_map = inverse(np.array([_adjusted(drive, image, best) for image in images]))
    found, intrinsic = best.calibrations[name].cam_from_vehicle, camera.info.intrinsic
    side = camera.roi_vehicle.mean(axis=0)
    grounds = {
        "ONI": recorded @ ground_from_pinhole_px(intrinsic, found),
        "Opt": ground_from_pinhole_px(intrinsic, found @ vehicle_from_map),
    }
    for method, ipm in {"CNI": "calibrated", "ENI": "estimated"}.items():
        if method in methods and ipm in camera.ipm:
            grounds[method] = recorded @ facing_ipm(camera.ipm[ipm], side)
    true_pose = truth.map_from_vehicle[images]
    camera_map = (true_pose @ np.append(camera_centre(truth.cam_from_vehicle[name]), 1.0))[:, :2]
    range_m = np.linalg.norm(corners - camera_map[:, None], axis=2).ravel()
    pinhole = sightings.corners_pinhole_px[rows]
    out = {}
    for method in ("CNI", "ENI", "Opt", "ONI"):
        if method in grounds:
            error = np.linalg.norm(apply_in_front(grounds[method], pinhole) - corners, axis=2).ravel()
            out[method] = _quartiles(range_m, error)
    return out


def _alike(corners: FloatArray, other: FloatArray) -> FloatArray:
    """Corners (4, 2) of a quadrilateral, begun where they lie nearest to those of another."""
    turned = [np.roll(corners, shift, axis=0) for shift in range(4)]
    return min(turned, key=lambda one: float(((one - other) ** 2).sum()))


def _quartiles(range_m: FloatArray, error_m: FloatArray) -> list[list[float]]:
    """Middle of the bin (m), quartiles of the error (m), corners; for bins that hold enough."""
    out = []
    for low in np.arange(0.0, _FARTHEST_M, RANGE_STEP_M):
        own = (range_m >= low) & (range_m < low + RANGE_STEP_M) & np.isfinite(error_m)
        if own.sum() >= _FEWEST:
            quartiles = np.percentile(error_m[own], [25, 50, 75])
            out.append([float(low + RANGE_STEP_M / 2), *map(float, quartiles), float(own.sum())])
    return out
