"""From a blob of lane paint to its centre line as a row of points."""

from __future__ import annotations

import numpy as np

from v2hdm.detection.blobs import Blob
from v2hdm.detection.ground import apply_homography
from v2hdm.detection.view import CameraView
from v2hdm.records import FloatArray, LaneDetection

_MAX_WIDTH_M = 0.7
_CAP_WIDTH_RATIO = 0.7
_MIN_POINTS = 2
_ROWS_MIN_ASPECT = 0.35


def trace_lanes(
    blob: Blob, kind: str, score: float, view: CameraView, step_m: float, max_range_m: float
) -> list[LaneDetection]:
    """The centre lines of one blob, a point every ``step_m`` on the ground, near to far.

    The blob is cut by image rows (by columns where it lies flat); each cut's two edge points are
    taken to the ground by the camera's initial IPM and averaged there, so perspective does not pull
    the centre. Cuts through the slanted ends, narrower than the rest, are left out. A blob of two
    lines that touch gives one row of points for each branch.
    """
    height, width = blob.level.shape
    by_rows = height >= _ROWS_MIN_ASPECT * width
    order = [1, 0] if by_rows else [0, 1]
    lanes = []
    for chain in _chains(_cuts(blob.level if by_rows else blob.level.T)):
        first, second = chain[:, [0, 1]][:, order], chain[:, [0, 2]][:, order]
        centre_vehicle = _centre_on_ground(blob, view, first, second)
        points_vehicle = _resample(centre_vehicle, view, step_m, max_range_m)
        if len(points_vehicle) >= _MIN_POINTS:
            points_pinhole_px = apply_homography(view.pinhole_px_from_vehicle, points_vehicle)
            lanes.append(LaneDetection(kind, score, view.distort(points_pinhole_px)))
    return lanes


def _cuts(level: np.ndarray) -> list[FloatArray]:
    """Per row of a field (h, w): runs (R, 3) of row, start and end column of where it is positive."""
    i, j = np.nonzero((level[:, :-1] > 0) != (level[:, 1:] > 0))
    crossing = j + level[i, j] / (level[i, j] - level[i, j + 1])
    runs = np.column_stack([i[::2], crossing[::2], crossing[1::2]]).astype(np.float64)
    breaks = np.flatnonzero(np.diff(runs[:, 0])) + 1
    return np.split(runs, breaks)


def _chains(cuts: list[FloatArray]) -> list[FloatArray]:
    """Runs (n, 3) linked from row to row where they overlap, each chain one branch of the blob."""
    open_chains: list[list[FloatArray]] = []
    closed: list[list[FloatArray]] = []
    for runs in cuts:
        following: list[list[FloatArray]] = []
        taken = set()
        for run in runs:
            match = next(
                (
                    c
                    for c, chain in enumerate(open_chains)
                    if c not in taken and chain[-1][1] < run[2] and run[1] < chain[-1][2]
                ),
                None,
            )
            if match is None:
                following.append([run])
            else:
                taken.add(match)
                following.append([*open_chains[match], run])
        closed += [chain for c, chain in enumerate(open_chains) if c not in taken]
        open_chains = following
    return [np.array(chain) for chain in closed + open_chains if len(chain) >= _MIN_POINTS]


def _centre_on_ground(blob: Blob, view: CameraView, first: FloatArray, second: FloatArray) -> FloatArray:
    """Centres (n, 2) on the ground, vehicle frame, of cuts between two edge points given in blob cells."""
    cells = np.concatenate([first, second])
    edge_vehicle = view.ground(view.undistort(blob.origin_px + blob.stride * cells)).reshape(2, -1, 2)
    width_m = np.linalg.norm(edge_vehicle[1] - edge_vehicle[0], axis=1)
    finite = np.isfinite(width_m)
    if not finite.any():
        return np.empty((0, 2))
    typical_m = float(np.median(width_m[finite]))
    whole = finite & (width_m > _CAP_WIDTH_RATIO * typical_m) & (width_m < typical_m / _CAP_WIDTH_RATIO)
    return np.asarray(edge_vehicle.mean(axis=0)[whole])


def _resample(centre_vehicle: FloatArray, view: CameraView, step_m: float, max_range_m: float) -> FloatArray:
    """Means of the points within each ``step_m`` along the line, from near to far."""
    range_m = view.range_m(centre_vehicle)
    centre_vehicle, range_m = centre_vehicle[range_m <= max_range_m], range_m[range_m <= max_range_m]
    if len(centre_vehicle) < _MIN_POINTS:
        return np.empty((0, 2))
    if range_m[0] > range_m[-1]:
        centre_vehicle = centre_vehicle[::-1]
    gap_m = np.linalg.norm(np.diff(centre_vehicle, axis=0), axis=1)
    bins = np.floor(np.concatenate([[0.0], np.cumsum(gap_m)]) / step_m)
    starts = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(np.append(starts, len(bins)))
    return np.asarray(np.add.reduceat(centre_vehicle, starts, axis=0) / counts[:, None])
