"""How far a map and a calibration are from the truth.

Only this package and the pipeline's evaluation step read ground truth. All lengths are metres in
the map frame unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import camera_centre, ground_in_vehicle
from v2hdm.records import BoolArray, Drive, FloatArray, HdMap, Marking, Truth

MATCH_GATE_M = 2.0
"""A mapped marking farther than this from every true one of its class is false."""

MIN_SIGHTINGS = 3
"""A marking was driven past when this many images show all of it inside the region of interest."""

FULLY_VISIBLE = 0.99
"""Visible fraction from which a marking counts as unoccluded."""


@dataclass(frozen=True)
class MarkingMetrics:
    """Mapped markings of one class, or of all, against the true ones.

    ``markings`` counts the mapped ones, ``false_markings`` those without a true counterpart,
    ``expected`` the true ones driven past within the region of interest and ``recall`` their mapped
    share. ``corner_rmse_m`` is the root mean square distance of corners, ``corner_bias_m`` the
    length of their mean error vector; both are nan where nothing matched.
    """

    markings: int
    false_markings: int
    expected: int
    recall: float
    corner_rmse_m: float
    corner_bias_m: float


@dataclass(frozen=True)
class ExtrinsicMetrics:
    """Angle between two camera orientations and distance of the camera centres."""

    rotation_error_deg: float
    translation_error_m: float


def driven_past(drive: Drive, truth: Truth, cameras: Sequence[str]) -> BoolArray:
    """Which true markings (J,) the cameras saw whole inside their region of interest.

    Whole means: all corners inside the camera's ROI at the true pose, at least
    :data:`FULLY_VISIBLE` of the area unoccluded, in at least :data:`MIN_SIGHTINGS` images.
    """
    corners_map = np.array([marking.corners_map for marking in truth.map.markings]).reshape(-1, 4, 2)
    sightings = np.zeros(len(corners_map), dtype=int)
    for i, image in enumerate(drive.images):
        if image.camera not in cameras:
            continue
        candidates = np.flatnonzero(truth.visibility[i] >= FULLY_VISIBLE)
        if candidates.size == 0:
            continue
        corners_vehicle = ground_in_vehicle(truth.map_from_vehicle[i], corners_map[candidates])
        inside = inside_convex(drive.cameras[image.camera].roi_vehicle, corners_vehicle).all(axis=1)
        sightings[candidates[inside]] += 1
    return sightings >= MIN_SIGHTINGS


def marking_metrics(
    hd_map: HdMap, truth: Truth, expected: BoolArray, kind: str | None = None
) -> MarkingMetrics:
    """Compare the markings of ``kind`` (all where None) with the truth; see :class:`MarkingMetrics`."""
    mapped = [m for m in hd_map.markings if kind is None or m.kind == kind]
    true_index = [j for j, m in enumerate(truth.map.markings) if kind is None or m.kind == kind]
    true = [truth.map.markings[j] for j in true_index]
    wanted = expected[true_index]
    rows, columns = match_markings(mapped, true)
    found = np.zeros(len(true), dtype=bool)
    found[columns] = True
    errors = corner_errors([mapped[r] for r in rows], [true[c] for c in columns])
    return MarkingMetrics(
        markings=len(mapped),
        false_markings=len(mapped) - len(rows),
        expected=int(wanted.sum()),
        recall=float(found[wanted].mean()) if wanted.any() else float("nan"),
        corner_rmse_m=_rms(errors),
        corner_bias_m=float(np.linalg.norm(errors.mean(axis=0))) if len(errors) else float("nan"),
    )


def match_markings(
    mapped: Sequence[Marking], true: Sequence[Marking], gate_m: float = MATCH_GATE_M
) -> tuple[list[int], list[int]]:
    """One-to-one pairs (indices into both) of the same class, by least total centre distance."""
    if not mapped or not true:
        return [], []
    centres = np.array([m.corners_map.mean(axis=0) for m in mapped])
    true_centres = np.array([m.corners_map.mean(axis=0) for m in true])
    distance = np.linalg.norm(centres[:, None] - true_centres[None], axis=2)
    kinds_differ = np.array([m.kind for m in mapped])[:, None] != np.array([m.kind for m in true])[None]
    # Beyond the gate all pairs cost the same, so that they never push a near pair apart.
    cost = np.where(kinds_differ | (distance > gate_m), gate_m * 1e3, distance)
    rows, columns = linear_sum_assignment(cost)
    keep = cost[rows, columns] <= gate_m
    return rows[keep].tolist(), columns[keep].tolist()


def corner_errors(mapped: Sequence[Marking], true: Sequence[Marking]) -> FloatArray:
    """Error vectors (4 M, 2) of paired markings, over the best of the four cyclic corner orders."""
    errors = []
    for estimate, reference in zip(mapped, true, strict=True):
        shifted = [np.roll(estimate.corners_map, s, axis=0) - reference.corners_map for s in range(4)]
        errors.append(min(shifted, key=lambda e: float((e**2).sum())))
    return np.concatenate(errors) if errors else np.empty((0, 2))


def extrinsic_metrics(cam_from_vehicle: FloatArray, true_cam_from_vehicle: FloatArray) -> ExtrinsicMetrics:
    """Compare two extrinsics (4 x 4 each)."""
    difference = cam_from_vehicle[:3, :3] @ true_cam_from_vehicle[:3, :3].T
    centres = [camera_centre(t) for t in (cam_from_vehicle, true_cam_from_vehicle)]
    return ExtrinsicMetrics(
        rotation_error_deg=float(np.rad2deg(Rotation.from_matrix(difference).magnitude())),
        translation_error_m=float(np.linalg.norm(centres[0] - centres[1])),
    )


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean())) if len(errors) else float("nan")
