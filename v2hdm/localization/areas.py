"""Words, boxes and arrows of a map as places: the middle of what an image shows of one, to a decimetre."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.geometry.planar import centroid
from v2hdm.localization.belief import CAMERA, VEHICLE, Belief, with_markings
from v2hdm.localization.joint import Scene
from v2hdm.localization.observation import Observation, Taken, take
from v2hdm.localization.seeing import Hull, expect_points, ground_points
from v2hdm.records import UNSTATED_SIGMA_M, FloatArray, HDMap, IntArray

# Errors of the middle of a hull, as 60 words on renders show (port 2 with words): 3 cm in the median, a
# letter where one is missed.
_IMAGE_M = 0.15  # standard deviation, m, of a coordinate in an image
_SHAPE_M = 0.05  # standard deviation, m, of a coordinate in all images: a stroke that wear has taken
_RANGE_M = 28.0  # distance, m, of areas that are looked for
_REACH_M = 3.0  # distance, m, of a hull from an area that it may show
_REACH_SIGMAS = 4.0  # in sigmas of the place, beside


class AreaMap:
    """The symbols and areas of a map as places, which are features numbered from ``first`` on.

    ``shared_m2`` is the variance of what all of the map's errors share: a vehicle shifts with it.
    """

    def __init__(self, hd_map: HDMap, shared_m2: float, first: int) -> None:
        symbols = hd_map.symbols
        self.first = first
        self.kinds = np.array([symbol.kind for symbol in symbols], dtype=np.str_)
        middles = [middle_of_hull(symbol.outline_map) for symbol in symbols]
        heights = [0.0 if symbol.heights_m is None else symbol.heights_m.mean() for symbol in symbols]
        self.places_map: FloatArray = np.column_stack([np.array(middles).reshape(-1, 2), heights])
        sigmas_m = [UNSTATED_SIGMA_M if symbol.sigma_m is None else symbol.sigma_m for symbol in symbols]
        self.variance_m2: FloatArray = np.maximum(np.square(sigmas_m) - shared_m2, 0.0) + _SHAPE_M**2

    def __len__(self) -> int:
        return len(self.kinds)

    def near(self, place_map: FloatArray, radius_m: float) -> IntArray:
        """The areas within a distance of a place, counted from 0."""
        distance_m = np.linalg.norm(self.places_map[:, :2] - place_map, axis=1)
        return np.flatnonzero(distance_m < radius_m)


def middle_of_hull(points: FloatArray) -> FloatArray:
    """The middle (2,) of the area of the convex hull of points (N, 2)."""
    origin = points.mean(axis=0)
    hull = cv2.convexHull((points - origin).astype(np.float32)).reshape(-1, 2)
    return np.asarray(origin + centroid(hull.astype(np.float64)))


def with_areas(belief: Belief, scene: Scene, area_map: AreaMap, hulls: Sequence[Hull]) -> Taken:
    """The belief after the hulls of an image, each on the area of its class that it shows."""
    numbers = area_map.near(belief.mean[:2], _RANGE_M)
    if not len(numbers) or not hulls:
        return Taken(belief, ())
    reach_m = _REACH_M + _REACH_SIGMAS * belief.sigma_m
    pose = belief.map_from_vehicle(scene.plane)
    candidates: list[tuple[int, int, FloatArray]] = []
    for detection, hull in enumerate(hulls):
        points_map = ground_points(hull.points_px, pose, scene.plane, scene.calibration)
        if not np.isfinite(points_map).all():
            continue
        middle_map = middle_of_hull(points_map)
        distance_m = np.linalg.norm(area_map.places_map[numbers, :2] - middle_map, axis=1)
        is_alike = (area_map.kinds[numbers] == hull.kind) & (distance_m < reach_m)
        candidates += [(detection, number, middle_map) for number in numbers[is_alike].tolist()]
    features = sorted({area_map.first + number for _, number, _ in candidates})
    unheld = [feature for feature in features if feature not in belief.markings]
    priors = [area_map.variance_m2[feature - area_map.first] * np.eye(2) for feature in unheld]
    held = with_markings(belief, unheld, priors)
    observations = [_observed(held, scene, area_map, *candidate) for candidate in candidates]
    update = take(held, [observation for observation in observations if observation is not None])
    return update if update.observations else Taken(belief, ())


def _observed(
    belief: Belief, scene: Scene, area_map: AreaMap, detection: int, number: int, middle_map: FloatArray
) -> Observation | None:
    """A hull's middle, at ``middle_map`` (2,) by the belief, as a view of an area; None if none is ahead."""
    feature = area_map.first + number
    state = belief.state_of(feature)
    assert state is not None
    place = area_map.places_map[number]
    error_m = belief.mean[state : state + 2]
    height_m = scene.plane.height_m + np.array(scene.plane.slope) @ (middle_map - belief.mean[:2])
    points = np.array([[*(place[:2] + error_m), place[2]], [*middle_map, height_m]])
    expected = expect_points(belief, scene.plane, scene.camera, scene.calibration, points)
    if not np.isfinite(expected.px).all():
        return None
    begin = VEHICLE + CAMERA * scene.camera
    slope = expected.by_states[0, :, :VEHICLE] @ belief.root[:VEHICLE]
    slope += expected.by_states[0, :, VEHICLE:] @ belief.root[begin : begin + CAMERA]
    slope += expected.by_place[0] @ belief.root[state : state + 2]
    noise_px2 = _IMAGE_M**2 * expected.by_place[0] @ expected.by_place[0].T
    residual_px = expected.px[1] - expected.px[0]
    return Observation(detection, number, residual_px, noise_px2, slope, (feature,))
