"""Groups of sightings that turn out to be one marking become one group.

Tracks break at occlusions and shadows, and each lap and each camera makes its own. Under an
extrinsic that can be trusted they coincide in the map, up to their covariances.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.quadrilateral import align, diameters
from v2hdm.mapping.association.groups import Association, FusedGroups
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.records import FloatArray, IntArray


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

    Two groups with a sighting in the same image are two markings and are never merged.

    Args:
        association: The groups to merge.
        sightings: The table that they index.
        fused: Where the groups lie.
        floor_m: Sigma added to each position for what shifts whole groups: extrinsic, RTK drift.
        gate_sigmas: Largest distance of two groups in sigmas.
        max_distance_m: Largest distance of two groups in metres.
        shape_tolerance: Largest deviation of a corner as a fraction of the marking's diameter.
    """
    if not association.count:
        return association
    pairs, shifts, distance = _coinciding_pairs(
        association, sightings, fused, floor_m, gate_sigmas, max_distance_m, shape_tolerance
    )
    root = np.arange(association.count)
    # Corner c of the root is corner (c + turn) mod 4 of the group.
    turn = np.zeros(association.count, dtype=np.int64)
    images = _images_of_groups(association, sightings)
    for p in np.argsort(distance, kind="stable"):
        (a, b), s = pairs[p], shifts[p]
        root_a, root_b = root[a], root[b]
        if root_a == root_b or not images[root_a].isdisjoint(images[root_b]):
            continue
        members = root == root_b
        turn[members] = (turn[members] + turn[a] + s - turn[b]) % 4
        root[members] = root_a
        images[root_a] |= images[root_b]
    kept, number = np.unique(root, return_inverse=True)
    grouped = association.group >= 0
    safe = np.where(grouped, association.group, 0)
    return Association(
        group=np.where(grouped, number[safe], -1),
        shift=(association.shift + np.where(grouped, turn[safe], 0)) % 4,
        count=len(kept),
    )


def group_kinds(association: Association, sightings: Sightings) -> IntArray:
    """The most frequent class (G,) among each group's sightings."""
    votes = np.zeros((association.count, int(sightings.kind.max(initial=0)) + 1), dtype=np.int64)
    grouped = association.group >= 0
    np.add.at(votes, (association.group[grouped], sightings.kind[grouped]), 1)
    return np.asarray(votes.argmax(axis=1))


def _coinciding_pairs(
    association: Association,
    sightings: Sightings,
    fused: FusedGroups,
    floor_m: float,
    gate_sigmas: float,
    max_distance_m: float,
    shape_tolerance: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs (P, 2) of groups that may be one marking, their shifts (P,) and distances (P,) in sigmas."""
    usable = np.flatnonzero(fused.valid.sum(axis=1) >= 2)
    centre = np.nanmean(fused.corners_map[usable], axis=1)
    # Of a drive of a few images the extrinsic is hardly known, and rays may meet the ground nowhere.
    somewhere = np.isfinite(centre).all(axis=1)
    usable, centre = usable[somewhere], centre[somewhere]
    kind = group_kinds(association, sightings)
    size_m = diameters(fused.corners_map, fused.valid)
    # Centres over different valid corners differ by up to half a diameter.
    reach_m = max_distance_m + 0.5 * float(np.max(size_m[usable], initial=0.0))
    pairs = usable[cKDTree(centre).query_pairs(reach_m, output_type="ndarray")] if len(usable) else _NO_PAIRS
    a, b = pairs[:, 0], pairs[:, 1]
    found = align(fused.corners_map[a], fused.valid[a], fused.corners_map[b], fused.valid[b])
    covariance = _mean_covariance(fused, a) + _mean_covariance(fused, b) + 2 * floor_m**2 * np.eye(2)
    solved = np.linalg.solve(covariance, found.offset[..., None])[..., 0]
    distance = np.sqrt(np.sum(found.offset * solved, axis=-1))
    tolerance_m = np.maximum(shape_tolerance * np.maximum(size_m[a], size_m[b]), 0.05)
    accepted = (
        (kind[a] == kind[b])
        & (distance <= gate_sigmas)
        & (np.linalg.norm(found.offset, axis=-1) <= max_distance_m)
        & (found.deformation_m <= tolerance_m)
    )
    return pairs[accepted], found.shift[accepted], distance[accepted]


_NO_PAIRS: IntArray = np.zeros((0, 2), dtype=np.int64)


def _mean_covariance(fused: FusedGroups, groups: IntArray) -> FloatArray:
    """Mean covariance (P, 2, 2) of the seen corners of ``groups``."""
    valid = fused.valid[groups][..., None, None]
    covariance = np.where(valid, fused.covariance_m2[groups], 0.0)
    return np.asarray(covariance.sum(axis=1) / np.maximum(valid.sum(axis=1), 1))


def _images_of_groups(association: Association, sightings: Sightings) -> list[set[int]]:
    images: list[set[int]] = [set() for _ in range(association.count)]
    for group, image in zip(association.group.tolist(), sightings.image.tolist(), strict=True):
        if group >= 0:
            images[group].add(image)
    return images
