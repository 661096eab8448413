"""Which sightings belong together, and where the groups lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from v2hdm.geometry.ipm import project_ground
from v2hdm.mapping.sightings.location import Located
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.records import BoolArray, FloatArray, IntArray

_Scalar = TypeVar("_Scalar", bound=np.generic)

_LEAST_DEPTH_M = 1.0
"""Depth, m, from which a corner on a line may be projected: nearer, the line leaves the image steeply."""

OPEN_END_M = 10.0
"""Sigma, m, of where along its side a corner lies that is no point: markings are up to so long."""


@dataclass(frozen=True)
class Association:
    """Groups of sightings: tracks of one camera, or markings of the map.

    ``group`` (S,) numbers groups from 0, -1 for sightings that belong to none; ``shift`` (S,) turns
    a sighting's corners into its group's order: corner c of the group is corner (c + shift) mod 4
    of the sighting. ``count`` is the number of groups.
    """

    group: IntArray
    shift: IntArray
    count: int

    def corner_order(self) -> IntArray:
        """Which of each sighting's corners is corner c of its group (S, 4)."""
        return np.asarray((np.arange(4) + self.shift[:, None]) % 4)

    def in_group_order(self, per_corner: NDArray[_Scalar]) -> NDArray[_Scalar]:
        """Reorder the second axis of ``per_corner`` (S, 4, ...) into the order of the groups."""
        return per_corner[np.arange(len(per_corner))[:, None], self.corner_order()]


def keep_rows(association: Association, rows: BoolArray) -> Association:
    """The association restricted to the sightings marked in ``rows`` (S,), groups renumbered."""
    kept = rows & (association.group >= 0)
    numbers, group = np.unique(association.group[kept], return_inverse=True)
    full = np.full(len(association.group), -1, dtype=np.int64)
    full[kept] = group
    return Association(full, association.shift, len(numbers))


def same_groups(a: Association, b: Association) -> bool:
    """Whether ``a`` and ``b`` divide the sightings that both of them group in the same way."""
    common = (a.group >= 0) & (b.group >= 0)
    pairs = len(np.unique(np.stack([a.group[common], b.group[common]]), axis=1).T)
    return pairs == len(np.unique(a.group[common])) == len(np.unique(b.group[common]))


@dataclass(frozen=True)
class FusedGroups:
    """Where G groups lie: ``corners_map`` (G, 4, 2) m with ``covariance_m2`` (G, 4, 2, 2).

    ``seen`` (G, 4) counts the sightings that show a corner as a point. A corner without any may still lie on
    a known line, and says so by its covariance; if nothing is known of it, it is nan.
    """

    corners_map: FloatArray
    covariance_m2: FloatArray
    seen: IntArray

    @property
    def valid(self) -> BoolArray:
        """Which corners (G, 4) were seen as points."""
        return np.asarray(self.seen > 0)


def known_elsewhere(association: Association, point: BoolArray, informs: BoolArray) -> BoolArray:
    """Corners (S, 4) that a sighting knows only across their side, and others of its group as points.

    Where other paint, a shadow or the image's border cuts a marking, its corner is somewhere on the line of
    the side, no nearer than the cut. Images that are cut alike are wrong alike, so that their mean is no
    better than one of them: as soon as another image shows the corner, only the line counts.

    Args:
        association: the groups.
        point: corners (S, 4), in the sightings' own order, that are points.
        informs: those that say anything.
    """
    grouped = (association.group >= 0)[:, None]
    number = 4 * association.group[:, None] + np.arange(4)
    points = association.in_group_order(point) & grouped
    has_point = np.zeros(4 * association.count + 1, dtype=np.bool_)
    has_point[number[points]] = True
    out = np.zeros_like(point)
    known = grouped & has_point[np.where(grouped, number, -1)]
    np.put_along_axis(out, association.corner_order(), known, axis=1)
    return np.asarray(out & informs & ~point)


def line_only(covariance: FloatArray, sigma: float) -> FloatArray:
    """Covariances (..., 2, 2) whose longer axis is made at least ``sigma`` long."""
    value, vector = np.linalg.eigh(covariance)
    value[..., 1] = np.maximum(value[..., 1], sigma**2)
    return np.asarray((vector * value[..., None, :]) @ np.swapaxes(vector, -1, -2))


def fuse_groups(association: Association, located: Located, jitter_rad: float) -> FusedGroups:
    """Information-weighted mean of each group's corners, with Huber weights from its own median.

    A sighting's covariance is that of its pixels plus what ``jitter_rad`` of viewing direction
    makes of it at its range, so that one far sighting cannot ruin the mean of near ones.
    """
    corners = association.in_group_order(located.corners_map)
    grouped = (association.group >= 0)[:, None]
    informs = association.in_group_order(located.informs) & grouped
    point = association.in_group_order(located.valid) & grouped
    noise = located.covariance_m2 + located.direction_covariance_m2(jitter_rad)
    on_line = known_elsewhere(association, located.valid, located.informs)
    noise[on_line] = line_only(noise[on_line], OPEN_END_M)
    covariance = association.in_group_order(noise) + 1e-6 * np.eye(2)
    information = np.linalg.inv(np.where(informs[..., None, None], covariance, np.eye(2)))
    corner = np.where(informs, association.group[:, None] * 4 + np.arange(4), association.count * 4)
    points = np.where(informs[..., None], corners, 0.0)
    size = association.count * 4 + 1
    weight = informs.astype(float)
    for _ in range(3):
        total = np.zeros((size, 2, 2))
        vector = np.zeros((size, 2))
        weighted = information * weight[..., None, None]
        np.add.at(total, corner, weighted)
        np.add.at(vector, corner, (weighted @ points[..., None])[..., 0])
        solvable = np.linalg.det(total) > 0
        spread = np.linalg.inv(np.where(solvable[:, None, None], total, np.eye(2)))
        mean = (spread @ vector[..., None])[..., 0]
        miss = points - mean[corner]
        distance = np.sqrt(np.maximum(np.einsum("sci,scij,scj->sc", miss, information, miss), 1e-12))
        weight = informs * np.minimum(1.0, 2.0 / distance)
    seen = np.bincount(corner[point], minlength=size)[:-1]
    mean[~solvable] = np.nan
    return FusedGroups(
        corners_map=mean[:-1].reshape(-1, 4, 2),
        covariance_m2=spread[:-1].reshape(-1, 4, 2, 2),
        seen=seen.reshape(-1, 4).astype(np.int64),
    )


def in_view(
    association: Association, located: Located, sightings: Sightings, rig: Rig, jitter_rad: float
) -> BoolArray:
    """Which corners (S, 4) the adjustment may use: points, and those on lines that the camera can see.

    A dash that passes under the vehicle is cut by the image's border; its side is a line of the image, but
    where its corner lies behind the camera the line cannot be had by projecting the corner.
    """
    fused = fuse_groups(association, located, jitter_rad)
    cam_from_map = rig.cam_from_vehicle[sightings.camera] @ np.linalg.inv(
        rig.map_from_vehicle[sightings.frame]
    )
    group = np.maximum(association.group, 0)
    corners = fused.corners_map[group] if association.count else np.full(located.corners_map.shape, np.nan)
    _, depth_m = project_ground(rig.intrinsic[sightings.camera], cam_from_map, corners)
    order = association.corner_order()
    in_front = np.zeros_like(located.valid)
    with np.errstate(invalid="ignore"):
        np.put_along_axis(in_front, order, depth_m > _LEAST_DEPTH_M, axis=1)
    return np.asarray(located.valid | (located.informs & in_front))
