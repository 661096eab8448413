"""Detections of the paint in images that are not rendered, with the statistics of the detector.

The statistics are those of the shipped detector on the rendered port 2: 270 images, 4893 detections, 18029
corners (``python -m tests.benchmarks.survey --statistics``). Nothing stands in the way here, and a marking
that the image's border cuts is not found at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import DIAMOND, LANE_DASH, CameraInfo, FloatArray, HDMap, IntArray, MarkingDetection

RANGE_M = 26.0
"""Distance, m, of the farthest marking that the detector found."""

_CORNER_M = np.array([3.0, 5.0, 7.0, 9.0, 11.0, 13.0, 15.0, 17.0, 19.0, 21.0, 23.0])
"""Distances, m, of the corners by which their sigmas are stated."""

_ALONG_ROW_PX = np.array([0.68, 0.36, 0.30, 0.31, 0.29, 0.26, 0.26, 0.25, 0.26, 0.27, 0.28])
"""Medians of the stated sigma, px, in the image's direction that is known worse: mostly along a row."""

_ACROSS_ROWS_PX = np.array([0.31, 0.19, 0.16, 0.12, 0.10, 0.091, 0.080, 0.070, 0.067, 0.061, 0.058])
"""The same in the direction that is known better."""

_SPREAD = np.array([1.5, 1.05, 0.91, 0.89, 0.85, 0.82, 0.77, 0.70, 0.63, 0.61, 0.58])
"""Standard deviation of the stated sigma's logarithm, from corner to corner."""

_MARKING_M = np.array([3.0, 5.0, 13.0, 15.0, 17.0, 19.0, 21.0, 23.0, 25.0])
"""Distances, m, of the markings by which the share that is found is stated."""

_FOUND = np.array([0.93, 0.99, 0.97, 0.965, 0.92, 0.79, 0.49, 0.37, 0.24])
"""Share of the markings, whole in the image and not hidden, that are found."""

_ERROR_FACTOR = 0.85
"""Errors over their stated sigmas, of the most corners: from the median of the squared distances."""

_TAIL_SHARE, _TAIL_FACTOR = 0.08, 4.0
"""Share of the corners with larger errors, and how much larger: from the 95th and 99th percentiles."""

_FALSE_SHARE = 0.04
"""Detections of what is no marking, of all."""

_FALSE_SIGMA_PX = 0.5  # of the corners of such a detection, chosen
_FALSE_AHEAD_M = (4.0, 20.0)  # distance ahead of the camera of such a detection, chosen
_SCORE = 0.95  # of every detection; the mapping does not weigh it
_BORDER_PX = 4.0  # corners nearer to the image's border are not the marking's own
_NEAR_M = 0.3  # least depth
_MOTION_M = 0.01  # motion of a corner on the ground by which that in the image is told


@dataclass(frozen=True)
class Paint:
    """The corners (J, 4, 2) of markings, m, their kinds, and a tree of their centres.

    ``alike`` (J, 4, 2) are the errors of the corners, along map x and y and in sigmas, that all images share;
    they make for ``correlation`` between any two images.
    """

    corners_map: FloatArray
    kinds: tuple[str, ...]
    tree: cKDTree
    alike: FloatArray
    correlation: float

    @classmethod
    def of(cls, hd_map: HDMap, correlation: float, rng: np.random.Generator) -> Paint:
        """The markings of a map."""
        corners = np.array([marking.corners_map for marking in hd_map.markings]).reshape(-1, 4, 2)
        kinds = tuple(marking.kind for marking in hd_map.markings)
        return cls(
            corners, kinds, cKDTree(corners.mean(axis=1)), rng.standard_normal(corners.shape), correlation
        )


@dataclass(frozen=True)
class Shown:
    """The detections of one image, and the indices (M,) of the markings that it shows whole."""

    markings: tuple[MarkingDetection, ...]
    whole: IntArray


def detect(paint: Paint, info: CameraInfo, cam_from_map: FloatArray, rng: np.random.Generator) -> Shown:
    """The detections in the image of a camera at a true pose (4, 4)."""
    centre_map = camera_centre(cam_from_map)[:2]
    in_range = np.array(sorted(paint.tree.query_ball_point(centre_map, RANGE_M)), dtype=np.intp)
    corners = paint.corners_map[in_range]
    px = _project(info, cam_from_map, corners.reshape(-1, 2)).reshape(-1, 4, 2)
    size = np.array([info.width, info.height])
    with np.errstate(invalid="ignore"):
        whole = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all(axis=(1, 2))
    away_m = np.linalg.norm(corners.mean(axis=1) - centre_map, axis=1)
    is_found = whole & (rng.random(len(in_range)) < np.interp(away_m, _MARKING_M, _FOUND))
    corner_m = np.linalg.norm(corners[is_found] - centre_map, axis=2)
    sigma_px = _stated_px(corner_m, rng)
    px_by_m = _motions_px(info, cam_from_map, corners[is_found])
    alike_px = _on_image(paint.alike[in_range[is_found]], px_by_m, sigma_px)
    detected_px = px[is_found] + _errors_px(sigma_px, alike_px, paint.correlation, rng)
    kinds = [paint.kinds[j] for j in in_range[is_found]]
    # The detector does not know which corner the map counts first.
    first = rng.integers(0, 4, len(kinds))
    markings = [
        _detection(kind, np.roll(corners_px, k, axis=0), np.roll(sigma, k, axis=0))
        for kind, corners_px, sigma, k in zip(kinds, detected_px, sigma_px, first.tolist(), strict=True)
    ]
    for _ in range(rng.poisson(_FALSE_SHARE * len(markings))):
        markings += _false(info, cam_from_map, rng)
    return Shown(tuple(markings), in_range[whole])


def _stated_px(corner_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Stated sigmas (M, 4, 2), px, of u and v of corners at distances (M, 4)."""
    spread = np.exp(np.interp(corner_m, _CORNER_M, _SPREAD) * rng.standard_normal(corner_m.shape))
    along = np.interp(corner_m, _CORNER_M, _ALONG_ROW_PX) * spread
    across = np.interp(corner_m, _CORNER_M, _ACROSS_ROWS_PX) * spread
    return np.stack([along, across], axis=-1)


def _errors_px(
    sigma_px: FloatArray, alike_px: FloatArray, correlation: float, rng: np.random.Generator
) -> FloatArray:
    """Errors (M, 4, 2), px, of corners of stated sigmas; those but the tail are in part ``alike_px``."""
    in_tail = rng.random(sigma_px.shape[:-1])[..., None] < _TAIL_SHARE
    of_image_px = rng.standard_normal(sigma_px.shape) * sigma_px
    most_px = np.sqrt(1 - correlation) * of_image_px + np.sqrt(correlation) * alike_px
    return np.asarray(_ERROR_FACTOR * np.where(in_tail, _TAIL_FACTOR * of_image_px, most_px))


def _motions_px(info: CameraInfo, cam_from_map: FloatArray, corners_map: FloatArray) -> FloatArray:
    """The motions (M, 4, 2, 2) of u and v, px, by those of corners (M, 4, 2) along map x and y, m."""
    steps = _MOTION_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    around = corners_map[:, :, None] + steps
    px = _project(info, cam_from_map, around.reshape(-1, 2)).reshape(around.shape)
    return np.asarray((px[:, :, ::2] - px[:, :, 1::2]).swapaxes(2, 3) / (2 * _MOTION_M))


def _on_image(errors: FloatArray, px_by_m: FloatArray, sigma_px: FloatArray) -> FloatArray:
    """Errors (M, 4, 2) along map x and y, in sigmas of one image, as errors (M, 4, 2) there, px."""
    whitened = px_by_m / sigma_px[..., None]
    share, axes = np.linalg.eigh(whitened.swapaxes(2, 3) @ whitened)  # of the information on the ground
    along = (axes.swapaxes(2, 3) @ errors[..., None]) / np.sqrt(share)[..., None]
    return np.asarray((px_by_m @ axes @ along)[..., 0])


def _detection(kind: str, corners_px: FloatArray, sigma_px: FloatArray) -> MarkingDetection:
    covariance_px = np.diag(np.square(sigma_px).ravel())
    return MarkingDetection(kind, _SCORE, corners_px, covariance_px, np.ones(4, dtype=np.bool_))


def _project(info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray) -> FloatArray:
    """Recorded px (N, 2) of ground points (N, 2); nan where the camera cannot see them."""
    points_cam = points_map @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
    ahead = points_cam[:, 2] > _NEAR_M
    pinhole = points_cam[ahead] @ info.intrinsic.T
    pinhole = pinhole[:, :2] / pinhole[:, 2:]
    # Far outside the image the lens polynomial folds back; only near it are its values meaningful.
    size = np.array([info.width, info.height])
    is_near = ((pinhole > -0.25 * size) & (pinhole < 1.25 * size)).all(axis=1)
    out = np.full((len(points_map), 2), np.nan)
    out[np.flatnonzero(ahead)[is_near]] = distort_points(info, pinhole[is_near])
    return out


def _false(info: CameraInfo, cam_from_map: FloatArray, rng: np.random.Generator) -> list[MarkingDetection]:
    """A quadrilateral on bare ground ahead of the camera, unless the image does not show it whole."""
    ahead = np.linalg.inv(cam_from_map)[:2, 2]
    ahead = ahead / np.linalg.norm(ahead)
    left = np.array([-ahead[1], ahead[0]])
    place = camera_centre(cam_from_map)[:2] + rng.uniform(*_FALSE_AHEAD_M) * ahead
    place = place + rng.uniform(-4.0, 4.0) * left
    length_m = rng.uniform(0.6, 2.0)
    width_m = rng.uniform(0.15, 0.8)
    turn = rng.uniform(-np.pi, np.pi)
    sides = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length_m, width_m)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    px = _project(info, cam_from_map, sides @ rotation + place)
    size = np.array([info.width, info.height])
    if not (np.isfinite(px).all() and ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all()):
        return []
    kind = DIAMOND if rng.random() < 0.5 else LANE_DASH
    return [_detection(kind, px, np.full((4, 2), _FALSE_SIGMA_PX))]
