"""The corner observations of a run, seen from above: from where, how far away, how far off on the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.io.maps.evidence import Residuals
from v2hdm.records import BoolArray, Calibration, FloatArray, IntArray
from v2hdm.report.page.facts import Facts, Route


@dataclass(frozen=True)
class GroundResiduals:
    """K corner observations.

    Attributes:
        cameras: names; ``camera`` (K,) says whose.
        marking: (K,) id, 0 where the candidate was left out.
        corner: (K,) 0 to 3.
        is_point: (K,) whether it says where the corner is, not only on which line.
        taken_s: (K,) when.
        observed_px: (K, 2) pinhole pixels.
        residual_px: (K, 2) projected minus observed.
        distance_sigma: (K,) its length in standard deviations.
        range_m: (K,) from the camera's foot to the corner, as observed.
        ground_m: (K, 2) projected minus observed on the ground, in the map; nan above the horizon.
    """

    cameras: tuple[str, ...]
    camera: IntArray
    marking: IntArray
    corner: IntArray
    is_point: BoolArray
    taken_s: FloatArray
    observed_px: FloatArray
    residual_px: FloatArray
    distance_sigma: FloatArray
    range_m: FloatArray
    ground_m: FloatArray


def ground_residuals(facts: Facts) -> GroundResiduals | None:
    """The residuals of a run that has any, of the cameras whose calibration is known; else None."""
    if facts.residuals is None or facts.route is None or not len(facts.residuals):
        return None
    residuals = facts.residuals
    calibrations = {name: one.calibration for name, one in facts.cameras.items()}
    names = tuple(sorted(set(residuals.camera) & calibrations.keys()))
    if not names:
        return None
    number = {name: n for n, name in enumerate(names)}
    of_image = np.array([number.get(name, -1) for name in residuals.camera])
    rows = np.flatnonzero(of_image[residuals.row_image] >= 0)
    row_image = residuals.row_image[rows]
    cam_from_map = cams_from_map(residuals, facts.route, calibrations)
    observed, off = residuals.observed_px[rows], residuals.residual_px[rows]
    known = np.flatnonzero(of_image >= 0)
    intrinsic = np.array([calibrations[residuals.camera[i]].info.intrinsic for i in known])
    map_from_px, foot_map = np.full((len(of_image), 3, 3), np.nan), np.full((len(of_image), 2), np.nan)
    map_from_px[known] = ground_from_pinhole_px(intrinsic, cam_from_map[known])
    foot_map[known] = camera_centre(cam_from_map[known])[:, :2]
    seen, projected = (
        apply_in_front(map_from_px[row_image], px[:, None])[:, 0] for px in (observed, observed + off)
    )
    return GroundResiduals(
        cameras=names,
        camera=of_image[row_image],
        marking=residuals.marking[rows],
        corner=residuals.corner[rows],
        is_point=residuals.is_point[rows],
        taken_s=residuals.taken_s[row_image],
        observed_px=observed,
        residual_px=off,
        distance_sigma=residuals.distance_sigma[rows],
        range_m=np.linalg.norm(seen - foot_map[row_image], axis=1),
        ground_m=projected - seen,
    )


def cams_from_map(residuals: Residuals, route: Route, calibrations: Mapping[str, Calibration]) -> FloatArray:
    """Where each image (I, 4, 4) was taken from, by the adjusted poses; nan for cameras not calibrated."""
    frame = nearest_pose(route, residuals.taken_s)
    out = np.full((len(residuals.image), 4, 4), np.nan)
    for i, name in enumerate(residuals.camera):
        if name in calibrations:
            out[i] = calibrations[name].cam_from_vehicle @ inverse(route.flat[frame[i]])
    return out


def nearest_pose(route: Route, taken_s: FloatArray) -> IntArray:
    """The index (N,) of the pose nearest in time."""
    after = np.clip(np.searchsorted(route.stamp_s, taken_s), 1, max(len(route.stamp_s) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(route.stamp_s) - 1)
    later = np.abs(route.stamp_s[after] - taken_s) < np.abs(route.stamp_s[before] - taken_s)
    return np.asarray(np.where(later, after, before))
