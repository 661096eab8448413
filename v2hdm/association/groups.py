"""Which sightings belong together, where the groups lie, and groups that turn out to be one marking.

Tracks break at occlusions and shadows, and each lap and each camera makes its own. Under an extrinsic that
can be trusted they coincide in the map, up to their covariances. A dash that runs through the image from
border to border is two lines, which look alike wherever the vehicle is: such sightings are attached last, to
the one marking of the map that they fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.association.ground import Located
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import direction_covariance, project_ground
from v2hdm.geometry.planar import SHIFTS, align, diameters
from v2hdm.records import BoolArray, FloatArray, IntArray

_Scalar = TypeVar("_Scalar", bound=np.generic)

_LEAST_DEPTH_M = 1.0
"""Depth, m, from which a corner on a line may be projected: nearer, the line leaves the image steeply."""

LEAST_TOLERANCE_M = 0.05  # how far corners of one shape may deviate, m, however small the marking is

_CORNER_FLOOR_M = 0.001  # floor of a corner's sigma where groups are fused, m
_HUBER_SIGMAS = 2.0  # residual in sigmas from which a sighting's weight in its group falls

_OPEN_END_M = 10.0  # sigma, m, of where along its side a corner is that is no point: markings may be so long


@dataclass(frozen=True)
class Association:
    """Groups of sightings: tracks of one camera, or markings of the map."""

    group: IntArray  # (S,) from 0, -1 for sightings that belong to none
    shift: IntArray  # (S,) corner c of the group is corner (c + shift) mod 4 of the sighting
    count: int  # of groups

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
    """Where G groups lie; corners of which nothing is known are nan."""

    corners_map: FloatArray  # (G, 4, 2) m
    covariance_m2: FloatArray  # (G, 4, 2, 2), large along a line that a corner is known to lie on
    seen: IntArray  # (G, 4) sightings that show a corner as a point

    @property
    def valid(self) -> BoolArray:
        """Which corners (G, 4) were seen as points."""
        return np.asarray(self.seen > 0)


def known_elsewhere(association: Association, point: BoolArray, informs: BoolArray) -> BoolArray:
    """Corners (S, 4) that a sighting knows only across their side, and others of its group as points.

    Images that other paint, a shadow or the border cut alike are wrong alike: as soon as another image shows
    the corner, only its line counts. ``point`` and ``informs`` (S, 4) are in the sightings' own order.
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
    noise = located.covariance_m2
    noise = noise + direction_covariance(located.ray_map, located.height_m[:, None], jitter_rad)
    on_line = known_elsewhere(association, located.valid, located.informs)
    noise[on_line] = line_only(noise[on_line], _OPEN_END_M)
    covariance = association.in_group_order(noise) + _CORNER_FLOOR_M**2 * np.eye(2)
    information = np.linalg.inv(np.where(informs[..., None, None], covariance, np.eye(2)))
    corner = np.where(informs, association.group[:, None] * 4 + np.arange(4), association.count * 4)
    points = np.where(informs[..., None], corners, 0.0)
    size = association.count * 4 + 1
    weight = informs.astype(float)
    for _ in range(3):
        total, vector = np.zeros((size, 2, 2)), np.zeros((size, 2))
        weighted = information * weight[..., None, None]
        np.add.at(total, corner, weighted)
        np.add.at(vector, corner, (weighted @ points[..., None])[..., 0])
        solvable = np.linalg.det(total) > 0
        spread = np.linalg.inv(np.where(solvable[:, None, None], total, np.eye(2)))
        mean = (spread @ vector[..., None])[..., 0]
        miss = points - mean[corner]
        distance = np.sqrt(np.maximum(np.einsum("sci,scij,scj->sc", miss, information, miss), 1e-12))
        weight = informs * np.minimum(1.0, _HUBER_SIGMAS / distance)
    seen = np.bincount(corner[point], minlength=size)[:-1]
    mean[~solvable] = np.nan
    covariance_m2 = spread[:-1].reshape(-1, 4, 2, 2)
    return FusedGroups(mean[:-1].reshape(-1, 4, 2), covariance_m2, seen.reshape(-1, 4).astype(np.int64))


def in_view(
    association: Association, located: Located, sightings: Sightings, rig: Rig, jitter_rad: float
) -> BoolArray:
    """Which corners (S, 4) the adjustment may use: points, and those on lines in front of the camera.

    A dash that passes under the vehicle is cut by the image's border, and its corner behind the camera has no
    projection.
    """
    fused = fuse_groups(association, located, jitter_rad)
    cam_from_map = rig.cam_from_map(sightings.camera, sightings.frame)
    group = np.maximum(association.group, 0)
    corners = fused.corners_map[group] if association.count else np.full(located.corners_map.shape, np.nan)
    _, depth_m = project_ground(rig.intrinsic[sightings.camera], cam_from_map, corners)
    order = association.corner_order()
    in_front = np.zeros_like(located.valid)
    with np.errstate(invalid="ignore"):
        np.put_along_axis(in_front, order, depth_m > _LEAST_DEPTH_M, axis=1)
    return np.asarray(located.valid | (located.informs & in_front))


def merge_groups(
    association: Association,
    sightings: Sightings,
    fused: FusedGroups,
    *,
    floor_m: float,
    gate_sigmas: float,
    max_distance_m: float,
    shape_tolerance: float,
) -> Association:
    """Merge groups of one class and shape that coincide in the map, nearest pairs first.

    Two groups with a sighting in the same image are two markings and are never merged. Groups coincide within
    ``gate_sigmas`` and ``max_distance_m``, where ``floor_m`` is added to each position's sigma for what
    shifts whole groups (extrinsic, RTK drift); ``shape_tolerance`` is the largest deviation of a corner as a
    fraction of the marking's diameter.
    """
    usable = np.flatnonzero(fused.valid.sum(axis=1) >= 2)
    centre = np.nanmean(fused.corners_map[usable], axis=1)
    # Of a drive of a few images the extrinsic is hardly known, and rays may meet the ground nowhere.
    somewhere = np.isfinite(centre).all(axis=1)
    usable, centre = usable[somewhere], centre[somewhere]
    if not len(usable):
        return association
    kind = group_kinds(association, sightings)
    size_m = diameters(fused.corners_map, fused.valid)
    # Centres over different valid corners differ by up to half a diameter.
    reach_m = max_distance_m + 0.5 * float(np.max(size_m[usable]))
    a, b = usable[cKDTree(centre).query_pairs(reach_m, output_type="ndarray")].T
    found = align(fused.corners_map[a], fused.valid[a], fused.corners_map[b], fused.valid[b])
    covariance = _mean_covariance(fused, a) + _mean_covariance(fused, b) + 2 * floor_m**2 * np.eye(2)
    solved = np.linalg.solve(covariance, found.offset[..., None])[..., 0]
    distance = np.sqrt(np.sum(found.offset * solved, axis=-1))
    tolerance_m = np.maximum(shape_tolerance * np.maximum(size_m[a], size_m[b]), LEAST_TOLERANCE_M)
    accepted = (kind[a] == kind[b]) & (distance <= gate_sigmas) & (found.deformation_m <= tolerance_m)
    accepted &= np.linalg.norm(found.offset, axis=-1) <= max_distance_m
    root = np.arange(association.count)
    # Corner c of the root is corner (c + turn) mod 4 of the group.
    turn = np.zeros(association.count, dtype=np.int64)
    images: list[set[int]] = [set() for _ in root]
    for group, image in zip(association.group.tolist(), sightings.image.tolist(), strict=True):
        if group >= 0:
            images[group].add(image)
    pairs = zip(*(of[accepted] for of in (distance, a, b, found.shift)), strict=True)
    for _, a, b, s in sorted(pairs, key=lambda pair: float(pair[0])):
        root_a, root_b = root[a], root[b]
        if root_a == root_b or not images[root_a].isdisjoint(images[root_b]):
            continue
        members = root == root_b
        turn[members] = (turn[members] + turn[a] + s - turn[b]) % 4
        root[members] = root_a
        images[root_a] |= images[root_b]
    kept, number = np.unique(root, return_inverse=True)
    grouped = association.group >= 0
    shift = (association.shift + np.where(grouped, turn[association.group], 0)) % 4
    return Association(np.where(grouped, number[association.group], -1), shift, len(kept))


def group_kinds(association: Association, sightings: Sightings) -> IntArray:
    """The most frequent class (G,) among each group's sightings."""
    votes = np.zeros((association.count, int(sightings.kind.max(initial=0)) + 1), dtype=np.int64)
    grouped = association.group >= 0
    np.add.at(votes, (association.group[grouped], sightings.kind[grouped]), 1)
    return np.asarray(votes.argmax(axis=1))


def _mean_covariance(fused: FusedGroups, groups: IntArray) -> FloatArray:
    """Mean covariance (P, 2, 2) of the seen corners of ``groups``."""
    valid = fused.valid[groups][..., None, None]
    covariance = np.where(valid, fused.covariance_m2[groups], 0.0)
    return np.asarray(covariance.sum(axis=1) / np.maximum(valid.sum(axis=1), 1))


_REACH_M = 4.0  # how far, m, a sighting's middle may be from its marking's centre: dashes are up to 6 m long

_MOST_SQUARED = 16.0
"""Squared distance, in sigmas, up to which a sighting fits: four corners on lines have as many freedoms."""

_CLEARER_BY = 9.0  # how much worse any other marking, or order of corners, must fit, in squared sigmas


def attach(
    association: Association,
    sightings: Sightings,
    located: Located,
    rig: Rig,
    fused: FusedGroups,
    jitter_rad: float,
) -> Association:
    """Give each sighting without a group to the one that alone fits it; an image shows a group once.

    Of the groups only those of four known corners in ``fused`` are looked at; the recorded attitude is off by
    ``jitter_rad``.
    """
    rows = np.flatnonzero((association.group < 0) & (located.informs.sum(axis=1) >= 2))
    whole = np.flatnonzero(fused.valid.all(axis=1))
    if not len(rows) or not len(whole):
        return association
    row, near = near_pairs(located, rows, fused.corners_map[whole].mean(axis=1), _REACH_M)
    group = whole[near]
    alike = group_kinds(association, sightings)[group] == sightings.kind[row]
    row, group = row[alike], group[alike]
    squared = squared_distances(sightings, located, rig, row, fused.corners_map[group], jitter_rad)
    out_group, out_shift = association.group.copy(), association.shift.copy()
    shown = set(zip(association.group.tolist(), sightings.image.tolist(), strict=True))
    for one in np.unique(row):
        own = np.flatnonzero(row == one)
        order = np.argsort(squared[own], axis=None)
        pair, shift = divmod(int(order[0]), 4)
        best, second = squared[own].ravel()[order[:2]]
        place = (int(group[own[pair]]), int(sightings.image[one]))
        if best <= _MOST_SQUARED and second >= best + _CLEARER_BY and place not in shown:
            out_group[one], out_shift[one] = place[0], shift
            shown.add(place)
    return Association(out_group, out_shift, association.count)


def near_pairs(
    located: Located, rows: IntArray, centres_map: FloatArray, reach_m: float
) -> tuple[IntArray, IntArray]:
    """Pairs (P,), (P,) of sightings, out of ``rows``, and places (G, 2) within reach of their middles."""
    informs = located.informs[rows][..., None]
    middle = np.where(informs, located.corners_map[rows], 0.0).sum(axis=1) / informs.sum(axis=1)
    near = cKDTree(centres_map).query_ball_point(middle, reach_m)
    row = np.repeat(rows, [len(places) for places in near])
    return row, np.concatenate([np.asarray(places, dtype=np.int64) for places in near])


def squared_distances(
    sightings: Sightings,
    located: Located,
    rig: Rig,
    row: IntArray,
    corners_map: FloatArray,
    jitter_rad: float,
) -> FloatArray:
    """Squared distances (P, 4), in sigmas, of sightings ``row`` (P,) from markings (P, 4, 2), by shift."""
    camera = sightings.camera[row]
    # By the pose at which the row of each seen corner was read, where shutters roll.
    seen = camera[:, None], sightings.frame[row][:, None], sightings.row_share[row]
    cam_from_map = rig.cam_from_map(*np.broadcast_arrays(*seen))
    expected, depth_m = project_ground(rig.intrinsic[camera][:, None], cam_from_map, corners_map[:, None])
    expected, depth_m = expected[:, SHIFTS, np.arange(4)], depth_m[:, SHIFTS, np.arange(4)]
    jitter_px = rig.intrinsic[camera, 0, 0] * jitter_rad
    noise = sightings.covariance_px[row] + jitter_px[:, None, None, None] ** 2 * np.eye(2)
    used = located.informs[row]
    information = np.linalg.inv(np.where(used[..., None, None], noise, np.eye(2)))[:, SHIFTS]
    off = np.where(used[..., None], sightings.corners_pinhole_px[row], 0.0)[:, SHIFTS] - expected
    each = np.einsum("psci,pscij,pscj->psc", off, information, off)
    each = np.where(depth_m > 0, each, np.inf)
    return np.asarray(np.where(used[:, SHIFTS], each, 0.0).sum(axis=2))
