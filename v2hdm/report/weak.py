"""Where a map or a drive is weak, and where and how to drive again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import ACCURACIES, SIGMAS_95, FloatArray, HDMap, IntArray, Marking, Symbol
from v2hdm.report.coverage import ENOUGH_VIEWS, Coverage
from v2hdm.site.accuracy import corner_radii_m, radius_95_m

_TOGETHER_M = 12.0  # markings nearer than this to each other are driven past at once; chosen
_NEAR_M = 8.0  # pass a marking within this: twice the lateral distance of a lane's far edge; chosen
_FEW_IMAGES = 10  # images beyond which more of the same drive improve little, as drift is shared; chosen
_SHARED = 0.5  # radius of a centre beside neighbours over that in the frame, below which most is shared
_UNEVEN = 2.0  # radius of the worst corner over that of the best, above which an end is in doubt; chosen
MOST_PLACES = 10  # that are listed: more are a drive of their own

BESIDE_M = 4.0  # reach of ground on either side of the route that a drive should cover: a lane's width
_STEP_M = 1.0  # distance along the route of the places that are looked at
_THIN_SHARE = 0.5  # share of ground beside the route that must be covered; chosen
_LEAST_STRETCH_M = 3.0  # a shorter one is a single late image
_ENDS_M = 12.0  # at its ends a drive sees less than between them: a camera's reach


class Place(NamedTuple):
    """Markings that lie together and are known less well than the goal asks."""

    centre_map: FloatArray  # (2,) m
    markings: int
    radius_m: float  # the largest 95 % radius of their corners
    says: str  # how to drive past them again


def weak_places(hd_map: HDMap, coverage: Coverage | None, route_map: FloatArray) -> tuple[Place, ...]:
    """The places of markings below accuracy A, most markings first; ``route_map`` (N, 2) was driven."""
    mapped: list[Marking | Symbol] = [*hd_map.markings, *hd_map.symbols]
    features = [
        feature
        for feature in mapped
        if feature.accuracy in ACCURACIES[1:] and feature.covariance_m2 is not None
    ]
    if not features:
        return ()
    centres = np.array([_outline(feature).mean(axis=0) for feature in features])
    number = np.ones(1, dtype=np.int64)
    if len(features) > 1:
        number = fcluster(linkage(centres, method="single"), _TOGETHER_M, criterion="distance")
    places = []
    for cluster in np.unique(number):
        rows = np.flatnonzero(number == cluster)
        together = [features[row] for row in rows]
        radius_m = max(float(corner_radii_m(_covariance(feature)).max()) for feature in together)
        says = _advice(together, centres[rows], coverage, route_map)
        places.append(Place(centres[rows].mean(axis=0), len(rows), radius_m, says))
    return tuple(sorted(places, key=lambda place: (-place.markings, -place.radius_m)))


def _outline(feature: Marking | Symbol) -> FloatArray:
    return feature.corners_map if isinstance(feature, Marking) else feature.outline_map


def _covariance(feature: Marking | Symbol) -> FloatArray:
    assert feature.covariance_m2 is not None
    return feature.covariance_m2


def _advice(
    features: Sequence[Marking | Symbol],
    centres_map: FloatArray,
    coverage: Coverage | None,
    route_map: FloatArray,
) -> str:
    """Advice for a further drive, the most effective first; at most two sentences."""
    advice = []
    if len(route_map) > 1:
        away_m, nearest = cKDTree(route_map).query(centres_map)
        if (distance_m := float(np.median(away_m))) > _NEAR_M:
            side = _side(route_map, np.atleast_1d(nearest), centres_map)
            advice.append(f"Pass within {_NEAR_M:.0f} m: the drive passed {distance_m:.0f} m away, {side}.")
    images = float(np.median([feature.sightings for feature in features]))
    if images < _FEW_IMAGES:
        advice.append(f"Drive past slowly, or record more images: {images:.0f} show each marking.")
    if _is_one_sided(coverage, centres_map):
        advice.append("Pass once more in the opposite direction: all images look the same way.")
    if float(np.median([_unevenness(feature) for feature in features])) > _UNEVEN:
        advice.append("Pass on the other side, or when nothing stands there: an end was not seen clearly.")
    elif _is_shared(features):
        advice.append("Survey a control point here, or drive on another day: the positions drift together.")
    if not advice:
        advice.append("Drive past once more, on the other side if there is room.")
    return " ".join(advice[:2])


def _unevenness(feature: Marking | Symbol) -> float:
    """How many times less well the worst corner is known than the best."""
    radii_m = corner_radii_m(_covariance(feature))
    return float(radii_m.max() / max(float(radii_m.min()), 1e-6))


def _is_shared(features: Sequence[Marking | Symbol]) -> bool:
    """Whether most of the error of the markings' centres is common to them and their neighbours."""
    shares = []
    for feature in features:
        if not isinstance(feature, Marking) or feature.relative_sigma_m is None:
            continue
        corners = len(feature.corners_map)
        mean = np.tile(np.eye(2), corners) / corners
        centre_m = float(radius_95_m(mean @ _covariance(feature) @ mean.T))
        shares.append(SIGMAS_95 * feature.relative_sigma_m / max(centre_m, 1e-6))
    return bool(shares) and float(np.median(shares)) < _SHARED


def _is_one_sided(coverage: Coverage | None, centres_map: FloatArray) -> bool:
    """Whether the images that show places (N, 2) look at them from one side alone."""
    if coverage is None or not coverage.views.size:
        return False
    return int(np.median(coverage.sectors[coverage.cells_of(centres_map)])) <= 1


def _side(route_map: FloatArray, nearest: IntArray, centres_map: FloatArray) -> str:
    """On which side of the route markings lie, by the nearest of its points."""
    ahead = np.gradient(route_map, axis=0)[nearest]
    off = centres_map - route_map[nearest]
    left = float(np.median(ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]))
    return "with them on its left" if left > 0 else "with them on its right"


class Stretch(NamedTuple):
    """A stretch of a route beside which ground was seen too seldom."""

    from_m: float  # along the route
    to_m: float
    covered: float  # share of the ground beside it that enough images show

    @property
    def says(self) -> str:
        """Where to drive again, and how."""
        return (
            f"from {self.from_m:.0f} m to {self.to_m:.0f} m along the route, {100 * self.covered:.0f} % of "
            f"the ground within {BESIDE_M:.0f} m is seen in {ENOUGH_VIEWS} images or more: drive there "
            "again, slower or with more images per second"
        )


def thin_stretches(coverage: Coverage, route_map: FloatArray) -> tuple[Stretch, ...]:
    """Stretches of the route (N, 2) beside which less than half of the ground is seen often enough."""
    way_m = length_along(route_map) if len(route_map) > 1 else np.zeros(1)
    at_m = np.arange(_ENDS_M, way_m[-1] - _ENDS_M, _STEP_M)
    if len(at_m) < 2 or not coverage.views.size:
        return ()
    points_map = points_along(route_map, at_m)
    ahead = np.gradient(points_map, axis=0)
    length = np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / length
    offsets_m = np.arange(-BESIDE_M, BESIDE_M + coverage.cell_m / 2, coverage.cell_m)
    beside_map = points_map[:, None] + offsets_m[None, :, None] * left[:, None]
    row, column = coverage.cells_of(beside_map.reshape(-1, 2))
    is_covered = (coverage.views[row, column] >= ENOUGH_VIEWS).reshape(len(at_m), -1)
    share = is_covered.mean(axis=1)
    is_thin = np.concatenate([[False], share < _THIN_SHARE, [False]])
    edges = np.flatnonzero(np.diff(is_thin.astype(int)))
    return tuple(
        Stretch(float(at_m[first]), float(at_m[last - 1]), float(share[first:last].mean()))
        for first, last in zip(edges[::2], edges[1::2], strict=True)
        if at_m[last - 1] - at_m[first] >= _LEAST_STRETCH_M
    )
