"""Groups of sightings: their positions, and merging and attaching under a trusted extrinsic.

Tracks break at occlusions and shadows, and every lap and camera starts new ones; those of one marking
coincide in the map, up to their covariances. A dash that crosses the whole image is two parallel lines, which
look alike along it: such sightings are attached last, to the one marking that fits them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from v2hdm.association.ground import Located
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import direction_covariance, project_ground
from v2hdm.geometry.planar import SHIFTS, align, diameters, inverse_2x2
from v2hdm.records import BoolArray, FloatArray, IntArray

_Scalar = TypeVar("_Scalar", bound=np.generic)

_LEAST_DEPTH_M = 1.0
"""Least depth, m, of a corner on a line to be projected: nearer, the line leaves the image steeply."""

GATE_SIGMAS = 4.0  # size of a gate, in sigmas of the distance between two positions of one marking
MAX_GATE_M = 1.5  # largest size of a gate, m
SHAPE_TOLERANCE = 0.25  # corner deviation of sightings of one shape, as a fraction of the marking's diameter
LEAST_TOLERANCE_M = 0.05  # least tolerance, m, of corners of one shape, for small markings

_CORNER_FLOOR_M = 0.001  # floor of a corner's standard deviation in fusion, m
_HUBER_SIGMAS = 2.0  # residual in sigmas beyond which a sighting is down-weighted in its group
_OPEN_END_M = 10.0  # standard deviation, m, along its side, of a corner on a line: a marking's length


@dataclass(frozen=True)
class Association:
    """Groups of sightings: tracks of one camera, or markings of the map."""

    group: IntArray  # (S,) from 0, -1 for sightings that belong to none
    shift: IntArray  # (S,) corner c of the group is the sighting's (c + shift) mod 4
    count: int  # number of groups

    def corner_order(self) -> IntArray:
        """Index (S, 4) of the sighting's corner that is corner c of its group."""
        return np.asarray((np.arange(4) + self.shift[:, None]) % 4)

    def in_group_order(self, per_corner: NDArray[_Scalar]) -> NDArray[_Scalar]:
        """Reorder the second axis of ``per_corner`` (S, 4, ...) into the order of the groups."""
        return per_corner[np.arange(len(per_corner))[:, None], self.corner_order()]


def keep_rows(association: Association, rows: BoolArray) -> Association:
    """The association restricted to ``rows`` (S,), groups renumbered."""
    is_in_group = rows & (association.group >= 0)
    numbers, group = np.unique(association.group[is_in_group], return_inverse=True)
    full = np.full(len(association.group), -1, dtype=np.int64)
    full[is_in_group] = group
    return Association(full, association.shift, len(numbers))


def same_groups(a: Association, b: Association) -> bool:
    """Whether ``a`` and ``b`` group the same sightings, and in the same way."""
    is_grouped = a.group >= 0
    if not np.array_equal(is_grouped, b.group >= 0):
        return False
    pairs = len(np.unique(np.stack([a.group[is_grouped], b.group[is_grouped]]), axis=1).T)
    return pairs == len(np.unique(a.group[is_grouped])) == len(np.unique(b.group[is_grouped]))


@dataclass(frozen=True)
class FusedGroups:
    """Positions of G groups; unknown corners are nan."""

    corners_map: FloatArray  # (G, 4, 2) m
    covariance_m2: FloatArray  # (G, 4, 2, 2), large along the line of a corner that is no point
    point_sightings: IntArray  # (G, 4) number of sightings that show the corner as a point

    @property
    def valid(self) -> BoolArray:
        """Corners (G, 4) seen as points."""
        return np.asarray(self.point_sightings > 0)


def known_elsewhere(association: Association, point: BoolArray, informs: BoolArray) -> BoolArray:
    """Corners (S, 4) that a sighting has on a line only, while others of its group have them as points.

    Images cut alike by other paint, a shadow or the border share one error: once another image shows the
    corner, only its line counts. ``point`` and ``informs`` (S, 4) are in the sightings' own order.
    """
    grouped = (association.group >= 0)[:, None]
    number = 4 * association.group[:, None] + np.arange(4)
    points = association.in_group_order(point) & grouped
    has_point = np.zeros(4 * association.count + 1, dtype=np.bool_)
    has_point[number[points]] = True
    is_elsewhere = np.zeros_like(point)
    has_point_elsewhere = grouped & has_point[np.where(grouped, number, -1)]
    np.put_along_axis(is_elsewhere, association.corner_order(), has_point_elsewhere, axis=1)
    return np.asarray(is_elsewhere & informs & ~point)


def line_only(covariance: FloatArray, sigma: float) -> FloatArray:
    """Covariances (..., 2, 2) with the standard deviation of the longer axis raised to at least ``sigma``."""
    value, vector = np.linalg.eigh(covariance)
    value[..., 1] = np.maximum(value[..., 1], sigma**2)
    return np.asarray((vector * value[..., None, :]) @ np.swapaxes(vector, -1, -2))


def fuse_groups(association: Association, located: Located, jitter_rad: float) -> FusedGroups:
    """Information-weighted mean of each group's corners, Huber-reweighted about itself.

    Covariances add ``jitter_rad`` of viewing direction to the pixel noise, so that one far sighting cannot
    spoil the mean of near ones.
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
    information = inverse_2x2(np.where(informs[..., None, None], covariance, np.eye(2)))
    corner = np.where(informs, association.group[:, None] * 4 + np.arange(4), association.count * 4)
    points = np.where(informs[..., None], corners, 0.0)
    size = association.count * 4 + 1
    sums = csr_array((np.ones(corner.size), (corner.ravel(), np.arange(corner.size))), (size, corner.size))
    pulls = information @ points[..., None]
    summands = np.concatenate([information.reshape(-1, 4), pulls.reshape(-1, 2)], axis=1)
    weight = informs.astype(float)
    for _ in range(3):
        by_corner = sums @ (summands * weight.reshape(-1, 1))
        total = by_corner[:, :4].reshape(-1, 2, 2)
        solvable = np.linalg.det(total) > 0
        spread = inverse_2x2(np.where(solvable[:, None, None], total, np.eye(2)))
        mean = (spread @ by_corner[:, 4:, None])[..., 0]
        miss = points - mean[corner]
        squared = (information @ miss[..., None])[..., 0] * miss
        distance = np.sqrt(np.maximum(squared.sum(axis=-1), 1e-12))
        weight = informs * np.minimum(1.0, _HUBER_SIGMAS / distance)
    point_sightings = np.bincount(corner[point], minlength=size)[:-1]
    mean[~solvable] = np.nan
    return FusedGroups(
        corners_map=mean[:-1].reshape(-1, 4, 2),
        covariance_m2=spread[:-1].reshape(-1, 4, 2, 2),
        point_sightings=point_sightings.reshape(-1, 4).astype(np.int64),
    )


def in_view(
    association: Association, located: Located, sightings: Sightings, rig: Rig, jitter_rad: float
) -> BoolArray:
    """Corners (S, 4) that the adjustment may use: points, and those on lines in front of the camera.

    A dash that passes under the vehicle is cut by the image border; its corner behind the camera has no
    projection.
    """
    fused = fuse_groups(association, located, jitter_rad)
    cam_from_map = rig.cam_from_map(sightings.camera, sightings.frame)
    group = np.maximum(association.group, 0)
    corners = np.full(located.corners_map.shape, np.nan)
    if association.count:
        corners = fused.corners_map[group]
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
    gate_sigmas: float = GATE_SIGMAS,
    max_distance_m: float = MAX_GATE_M,
    shape_tolerance: float = SHAPE_TOLERANCE,
) -> Association:
    """Merge groups of one class and shape that coincide in the map, nearest pairs first.

    Groups with sightings in one image are different markings. Others coincide within ``gate_sigmas`` and
    ``max_distance_m``; ``floor_m`` is added to each position's sigma for shifts of whole groups (extrinsic,
    RTK drift). ``shape_tolerance`` is the largest deviation of a corner as a fraction of the marking's
    diameter.
    """
    usable = np.flatnonzero(fused.valid.sum(axis=1) >= 2)
    centre = np.nanmean(fused.corners_map[usable], axis=1)
    # In a drive of a few images the extrinsic is poorly known, and rays may miss the ground.
    on_ground = np.isfinite(centre).all(axis=1)
    usable = usable[on_ground]
    centre = centre[on_ground]
    if not len(usable):
        return association
    kind = group_kinds(association, sightings)
    size_m = diameters(fused.corners_map, fused.valid)
    # Centres of different valid corners differ by up to half a diameter.
    reach_m = max_distance_m + 0.5 * float(np.max(size_m[usable]))
    a, b = usable[cKDTree(centre).query_pairs(reach_m, output_type="ndarray")].T
    aligned = align(fused.corners_map[a], fused.valid[a], fused.corners_map[b], fused.valid[b])
    covariance = _mean_covariance(fused, a) + _mean_covariance(fused, b) + 2 * floor_m**2 * np.eye(2)
    solved = np.linalg.solve(covariance, aligned.offset[..., None])[..., 0]
    distance = np.sqrt(np.sum(aligned.offset * solved, axis=-1))
    tolerance_m = np.maximum(shape_tolerance * np.maximum(size_m[a], size_m[b]), LEAST_TOLERANCE_M)
    accepted = (kind[a] == kind[b]) & (distance <= gate_sigmas) & (aligned.deformation_m <= tolerance_m)
    accepted &= np.linalg.norm(aligned.offset, axis=-1) <= max_distance_m
    root = np.arange(association.count)
    # Corner c of the root is corner (c + turn) mod 4 of the group.
    turn = np.zeros(association.count, dtype=np.int64)
    images: list[set[int]] = [set() for _ in root]
    for group, image in zip(association.group.tolist(), sightings.image.tolist(), strict=True):
        if group >= 0:
            images[group].add(image)
    pairs = np.flatnonzero(accepted)
    for pair in pairs[np.argsort(distance[pairs], kind="stable")]:
        root_a = root[a[pair]]
        root_b = root[b[pair]]
        if root_a == root_b or not images[root_a].isdisjoint(images[root_b]):
            continue
        members = root == root_b
        turn[members] = (turn[members] + turn[a[pair]] + aligned.shift[pair] - turn[b[pair]]) % 4
        root[members] = root_a
        images[root_a] |= images[root_b]
    roots, number = np.unique(root, return_inverse=True)
    grouped = association.group >= 0
    shift = (association.shift + np.where(grouped, turn[association.group], 0)) % 4
    return Association(np.where(grouped, number[association.group], -1), shift, len(roots))


def group_kinds(association: Association, sightings: Sightings) -> IntArray:
    """The most frequent class (G,) among each group's sightings."""
    votes = np.zeros((association.count, int(sightings.kind.max(initial=0)) + 1), dtype=np.int64)
    grouped = association.group >= 0
    np.add.at(votes, (association.group[grouped], sightings.kind[grouped]), 1)
    return np.asarray(votes.argmax(axis=1))


def _mean_covariance(fused: FusedGroups, groups: IntArray) -> FloatArray:
    """Mean covariance (P, 2, 2) of the corners of ``groups`` that are points."""
    valid = fused.valid[groups][..., None, None]
    covariance = np.where(valid, fused.covariance_m2[groups], 0.0)
    return np.asarray(covariance.sum(axis=1) / np.maximum(valid.sum(axis=1), 1))


_REACH_M = 4.0  # largest distance, m, from a sighting's centre to its marking's: dashes are up to 6 m long

_MOST_SQUARED = 16.0
"""Largest squared Mahalanobis distance of a match: four corners on lines have four degrees of freedom."""

CLEARER_BY = 9.0
"""Least margin in squared distance to any other marking or corner order: odds of ninety to one."""


def attach(
    association: Association,
    sightings: Sightings,
    located: Located,
    rig: Rig,
    fused: FusedGroups,
    jitter_rad: float,
) -> Association:
    """Attach each ungrouped sighting to the only marking that fits; an image shows a marking once.

    Candidates are groups with four known corners in ``fused``; ``jitter_rad`` is the attitude's noise.
    """
    rows = np.flatnonzero((association.group < 0) & (located.informs.sum(axis=1) >= 2))
    whole = np.flatnonzero(fused.valid.all(axis=1))
    if not len(rows) or not len(whole):
        return association
    row, index = near_pairs(located, rows, fused.corners_map[whole].mean(axis=1), _REACH_M)
    group = whole[index]
    alike = group_kinds(association, sightings)[group] == sightings.kind[row]
    row = row[alike]
    group = group[alike]
    squared = squared_distances(sightings, located, rig, row, fused.corners_map[group], jitter_rad)
    out_group = association.group.copy()
    out_shift = association.shift.copy()
    shown = set(zip(association.group.tolist(), sightings.image.tolist(), strict=True))
    # Pairs are in the order of their sightings.
    in_reach, first_pair = np.unique(row, return_index=True)
    pairs = np.split(np.arange(len(row)), first_pair[1:])
    for sighting, pairs_of_sighting in zip(in_reach.tolist(), pairs, strict=True):
        order = np.argsort(squared[pairs_of_sighting], axis=None)
        pair, shift = divmod(int(order[0]), 4)
        best, second = squared[pairs_of_sighting].ravel()[order[:2]]
        place_in_image = (int(group[pairs_of_sighting[pair]]), int(sightings.image[sighting]))
        if best <= _MOST_SQUARED and second >= best + CLEARER_BY and place_in_image not in shown:
            out_group[sighting] = place_in_image[0]
            out_shift[sighting] = shift
            shown.add(place_in_image)
    return Association(out_group, out_shift, association.count)


def near_pairs(
    located: Located, rows: IntArray, centres_map: FloatArray, reach_m: float
) -> tuple[IntArray, IntArray]:
    """Pairs (P,), (P,) of sightings, out of ``rows``, and centres (G, 2) within ``reach_m``."""
    informs = located.informs[rows][..., None]
    middle = np.where(informs, located.corners_map[rows], 0.0).sum(axis=1) / informs.sum(axis=1)
    places_in_reach = cKDTree(centres_map).query_ball_point(middle, reach_m)
    row = np.repeat(rows, [len(places) for places in places_in_reach])
    return row, np.concatenate([np.asarray(places, dtype=np.int64) for places in places_in_reach])


def squared_distances(
    sightings: Sightings,
    located: Located,
    rig: Rig,
    row: IntArray,
    corners_map: FloatArray,
    jitter_rad: float,
) -> FloatArray:
    """Squared Mahalanobis distances (P, 4) of sightings ``row`` (P,) from markings (P, 4, 2), by shift."""
    camera = sightings.camera[row]
    # A rolling shutter reads each corner's row at a pose of its own.
    row_share = sightings.row_share[row]
    camera_of_corner = np.broadcast_to(camera[:, None], row_share.shape)
    frame_of_corner = np.broadcast_to(sightings.frame[row][:, None], row_share.shape)
    cam_from_map = rig.cam_from_map(camera_of_corner, frame_of_corner, row_share)
    expected, depth_m = project_ground(rig.intrinsic[camera][:, None], cam_from_map, corners_map[:, None])
    expected = expected[:, SHIFTS, np.arange(4)]
    depth_m = depth_m[:, SHIFTS, np.arange(4)]
    jitter_px = rig.intrinsic[camera, 0, 0] * jitter_rad
    noise = sightings.covariance_px[row] + jitter_px[:, None, None, None] ** 2 * np.eye(2)
    used = located.informs[row]
    information = np.linalg.inv(np.where(used[..., None, None], noise, np.eye(2)))[:, SHIFTS]
    off = np.where(used[..., None], sightings.corners_pinhole_px[row], 0.0)[:, SHIFTS] - expected
    squared = np.einsum("psci,pscij,pscj->psc", off, information, off)
    squared = np.where(depth_m > 0, squared, np.inf)
    return np.asarray(np.where(used[:, SHIFTS], squared, 0.0).sum(axis=2))
