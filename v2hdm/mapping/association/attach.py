"""Sightings that show no two corners as points: whose they are, once it is known where markings lie.

A dash that runs through the image from border to border is two lines. Such lines look alike wherever the
vehicle is, so that they cannot be linked from image to image; but of the markings of the map they fit one.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.quadrilateral import SHIFTS
from v2hdm.mapping.association.groups import Association, FusedGroups
from v2hdm.mapping.association.merge import group_kinds
from v2hdm.mapping.sightings.location import Located
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.records import FloatArray, IntArray

_REACH_M = 4.0
"""How far, m, the middle of a sighting may be from the centre of its marking: dashes are up to 6 m long."""

_MOST_SQUARED = 16.0
"""Squared distance, in sigmas, up to which a sighting fits: four corners on lines have as many freedoms."""

_CLEARER_BY = 9.0
"""How much worse any other marking, or order of corners, must fit, in squared sigmas."""


def attach(
    association: Association,
    sightings: Sightings,
    located: Located,
    rig: Rig,
    fused: FusedGroups,
    jitter_rad: float,
) -> Association:
    """Give each sighting without a group to the one that alone fits it; an image shows a group once.

    Args:
        association: The groups.
        sightings: The table that they index.
        located: Where the sightings lie under ``rig``.
        rig: Extrinsics and poses.
        fused: Where the groups lie; only those of four known corners are looked at.
        jitter_rad: How far the recorded attitude is off.
    """
    rows = np.flatnonzero((association.group < 0) & (located.informs.sum(axis=1) >= 2))
    whole = np.flatnonzero(fused.valid.all(axis=1))
    if not len(rows) or not len(whole):
        return association
    informs = located.informs[rows][..., None]
    middle = np.where(informs, located.corners_map[rows], 0.0).sum(axis=1) / informs.sum(axis=1)
    near = cKDTree(fused.corners_map[whole].mean(axis=1)).query_ball_point(middle, _REACH_M)
    row = np.repeat(rows, [len(groups) for groups in near])
    group = whole[np.concatenate([np.asarray(groups, dtype=np.int64) for groups in near])]
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
    cam_from_map = rig.cam_from_vehicle[camera] @ np.linalg.inv(rig.map_from_vehicle[sightings.frame[row]])
    expected, depth_m = project_ground(rig.intrinsic[camera], cam_from_map, corners_map)
    jitter_px = rig.intrinsic[camera, 0, 0] * jitter_rad
    noise = sightings.covariance_px[row] + jitter_px[:, None, None, None] ** 2 * np.eye(2)
    used = located.informs[row]
    information = np.linalg.inv(np.where(used[..., None, None], noise, np.eye(2)))[:, SHIFTS]
    off = np.where(used[..., None], sightings.corners_pinhole_px[row], 0.0)[:, SHIFTS] - expected[:, None]
    each = np.einsum("psci,pscij,pscj->psc", off, information, off)
    each = np.where(depth_m[:, None] > 0, each, np.inf)
    return np.asarray(np.where(used[:, SHIFTS], each, 0.0).sum(axis=2))
