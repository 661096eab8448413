"""The naive strategy: back-project by an IPM inside its region of interest, and average.

It is the paper's baseline: no optimisation, recorded poses taken at their word, a marking's corners
the plain mean of its repeated sightings.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from v2hdm.association.ground import ground_points
from v2hdm.association.groups import Association, FusedGroups, group_kinds, keep_rows, merge_groups
from v2hdm.association.options import LEAST_SIGHTINGS
from v2hdm.association.sightings import Sightings
from v2hdm.geometry.ipm import facing_ipm, flat_motion
from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.quadrilateral import is_convex
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import BoolArray, Camera, FloatArray, Marking
from v2hdm.site.candidates import Exclusion


def naive_markings(
    sightings: Sightings,
    tracks: Association,
    cameras: Mapping[str, Camera],
    ipm: Mapping[str, FloatArray],
    options: MappingOptions,
) -> tuple[list[Marking], list[Exclusion]]:
    """Map ``tracks`` by one IPM ``vehicle_from_pinhole_px`` per camera; returns exclusions, too.

    Only sightings with four valid corners inside the region of interest count. Tracks merge where their
    averages lie within ``naive_merge_m``: two cameras whose IPMs disagree by more yield two markings where
    there is one, which is the method's own failure.
    """
    corners_map = ipm_corners(sightings, cameras, ipm)
    usable = (tracks.group >= 0) & _inside_roi(sightings, cameras, corners_map[1])
    tracks = keep_rows(tracks, usable)
    association = merge_groups(
        tracks,
        sightings,
        _average(tracks, corners_map[0]),
        floor_m=options.association.naive_merge_m,
        gate_sigmas=np.inf,
        max_distance_m=options.association.naive_merge_m,
        shape_tolerance=2 * options.association.shape_tolerance,
    )
    return _accept(association, sightings, _average(association, corners_map[0]))


def ipm_corners(
    sightings: Sightings, cameras: Mapping[str, Camera], ipm: Mapping[str, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Corners (S, 4, 2) in the map and in the vehicle frame by an IPM per camera and recorded poses.

    Corners that the IPM puts above the horizon are nan.
    """
    forward = np.stack(
        [facing_ipm(ipm[name], cameras[name].roi_vehicle.mean(axis=0)) for name in sightings.cameras]
    )
    homographies = forward[sightings.camera]
    corners_vehicle = ground_points(homographies, sightings.corners_pinhole_px)
    to_map = flat_motion(sightings.map_from_vehicle[sightings.frame]) @ homographies
    return ground_points(to_map, sightings.corners_pinhole_px), corners_vehicle


def _inside_roi(
    sightings: Sightings, cameras: Mapping[str, Camera], corners_vehicle: FloatArray
) -> BoolArray:
    """Which sightings (S,) have four valid corners inside their camera's region of interest."""
    inside = np.zeros(len(sightings), dtype=bool)
    for c, name in enumerate(sightings.cameras):
        own = sightings.camera == c
        inside[own] = inside_convex(cameras[name].roi_vehicle, corners_vehicle[own]).all(axis=1)
    return inside & sightings.valid.all(axis=1)


def _average(association: Association, corners_map: FloatArray) -> FusedGroups:
    """Plain mean of each group's corners; the strategy knows of no covariance."""
    rows = np.flatnonzero(association.group >= 0)
    corners = association.in_group_order(corners_map)[rows]
    seen = np.bincount(association.group[rows], minlength=association.count)
    total = np.zeros((association.count, 4, 2))
    np.add.at(total, association.group[rows], corners)
    return FusedGroups(
        corners_map=total / np.maximum(seen, 1)[:, None, None],
        covariance_m2=np.zeros((association.count, 4, 2, 2)),
        seen=np.repeat(seen[:, None], 4, axis=1),
    )


def _accept(
    association: Association, sightings: Sightings, average: FusedGroups
) -> tuple[list[Marking], list[Exclusion]]:
    markings: list[Marking] = []
    excluded: list[Exclusion] = []
    convex = is_convex(average.corners_map)
    kinds = group_kinds(association, sightings)
    for group in range(association.count):
        kind = sightings.kinds[kinds[group]]
        corners = average.corners_map[group]
        count = int(average.seen[group, 0])
        if count < LEAST_SIGHTINGS:
            excluded.append(Exclusion(kind, corners.mean(axis=0), count, "too few sightings"))
        elif not convex[group]:
            excluded.append(Exclusion(kind, corners.mean(axis=0), count, "not a convex quadrilateral"))
        else:
            markings.append(Marking(kind, corners, count))
    return markings, excluded
