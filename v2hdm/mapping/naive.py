"""The naive methods of the paper: markings back-projected by an IPM, then averaged.

CNI and ENI take a calibrated and an estimated IPM, ONI that of the joint optimisation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from v2hdm.association.ground import ground_points
from v2hdm.association.groups import Association, FusedGroups, group_kinds, keep_rows, merge_groups
from v2hdm.association.sightings import camera_of
from v2hdm.association.tracks import LEAST_SIGHTINGS
from v2hdm.geometry.ipm import extrinsic_from_ipm, facing_ipm, flat_motion, ipm_from_extrinsic
from v2hdm.geometry.planar import inside_convex, is_convex
from v2hdm.lanes.points import ImageGround, ground_by_ipm
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Calibration, Exclusion, FloatArray, HDMap, Marking

NAIVE_IPMS: Mapping[str, str] = {"CNI": "calibrated", "ENI": "estimated"}
"""Name of the IPM that each naive method uses."""


def run_stated(inputs: Inputs, progress: Callable[[str], None]) -> dict[str, MethodResult]:
    """Naive maps under the IPMs that were stated, by method; of those that every camera has."""
    results = {}
    for name, known_as in NAIVE_IPMS.items():
        ipms = {camera: camera_of(inputs.drive, camera).ipm for camera in inputs.cameras}
        if all(known_as in ipm for ipm in ipms.values()):
            progress(name)
            results[name] = run_naive(name, inputs, {camera: ipm[known_as] for camera, ipm in ipms.items()})
    return results


def run_optimised(inputs: Inputs, calibrations: Mapping[str, Calibration]) -> MethodResult:
    """ONI: the naive map under the IPMs of optimised extrinsics."""
    in_order = [(camera, calibrations[camera]) for camera in inputs.cameras]
    ipm = {camera: ipm_from_extrinsic(at.info, at.cam_from_vehicle) for camera, at in in_order}
    return replace(run_naive("ONI", inputs, ipm), calibrations=calibrations)


def run_naive(name: str, inputs: Inputs, ipm: Mapping[str, FloatArray]) -> MethodResult:
    """The naive strategy under one IPM per camera, such as that of a known extrinsic."""
    drive = inputs.drive
    sightings = inputs.sightings
    extrinsic = {c: extrinsic_from_ipm(drive.cameras[c].info, matrix) for c, matrix in ipm.items()}
    ground = ground_by_ipm(drive, ipm, extrinsic, inputs.optimiser.initial_rig)
    markings, excluded = _naive_markings(inputs, ipm, ground)
    lanes = inputs.find_lanes(ground)
    return MethodResult(
        name=name,
        cameras=sightings.cameras,
        hd_map=HDMap(tuple(markings), lanes, drive.origin),
        excluded=tuple(excluded),
    )


_NAIVE_MERGE_M = 1.0  # largest distance of two tracks of one marking in the naive methods
_NAIVE_SHAPE_TOLERANCE = 0.5  # largest deviation of the corners of two such tracks over a marking's diameter


def _naive_markings(
    inputs: Inputs, ipm: Mapping[str, FloatArray], ground: ImageGround
) -> tuple[list[Marking], list[Exclusion]]:
    """The paper's baseline: back-projection by an IPM within its region of interest, then averaging.

    Recorded poses are taken as exact. Tracks merge if their averages are within a metre: where IPMs disagree
    by more, a marking is mapped twice, as is inherent to the method.
    """
    sightings = inputs.sightings
    cameras = [inputs.drive.cameras[name] for name in sightings.cameras]
    rois = [camera.roi_vehicle for camera in cameras]
    forward = [facing_ipm(ipm[c.info.name], c.roi_vehicle.mean(axis=0)) for c in cameras]
    homographies = np.stack(forward)[sightings.camera]
    corners_vehicle = ground_points(homographies, sightings.corners_pinhole_px)
    to_map = flat_motion(sightings.map_from_vehicle[sightings.frame]) @ homographies
    corners_map = ground_points(to_map, sightings.corners_pinhole_px)
    corners_map = ground.at_rows(corners_map, sightings.image[:, None], sightings.row_share)
    usable = (inputs.tracks.group >= 0) & sightings.valid.all(axis=1)
    for c, roi in enumerate(rois):
        of_camera = sightings.camera == c
        usable[of_camera] &= inside_convex(roi, corners_vehicle[of_camera]).all(axis=1)
    tracks = keep_rows(inputs.tracks, usable)
    association = merge_groups(
        tracks,
        sightings,
        _average(tracks, corners_map),
        floor_m=_NAIVE_MERGE_M,
        gate_sigmas=np.inf,
        max_distance_m=_NAIVE_MERGE_M,
        shape_tolerance=_NAIVE_SHAPE_TOLERANCE,
    )
    average = _average(association, corners_map)
    markings: list[Marking] = []
    excluded: list[Exclusion] = []
    groups = zip(
        group_kinds(association, sightings),
        average.corners_map,
        is_convex(average.corners_map),
        average.point_sightings[:, 0].tolist(),
        strict=True,
    )
    for kind, corners, convex, count in groups:
        name = sightings.kinds[kind]
        if count >= LEAST_SIGHTINGS and convex:
            markings.append(Marking(name, corners, count))
        else:
            reason = "not a convex quadrilateral" if count >= LEAST_SIGHTINGS else "too few sightings"
            excluded.append(Exclusion(name, corners.mean(axis=0), count, reason))
    return markings, excluded


def _average(association: Association, corners_map: FloatArray) -> FusedGroups:
    """Mean of each group's corners, without covariance."""
    rows = np.flatnonzero(association.group >= 0)
    corners = association.in_group_order(corners_map)[rows]
    sightings = np.bincount(association.group[rows], minlength=association.count)
    total = np.zeros((association.count, 4, 2))
    np.add.at(total, association.group[rows], corners)
    return FusedGroups(
        corners_map=total / np.maximum(sightings, 1)[:, None, None],
        covariance_m2=np.zeros((association.count, 4, 2, 2)),
        point_sightings=np.repeat(sightings[:, None], 4, axis=1),
    )
