"""From blobs of lane paint to their centre lines as rows of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.markings.blobs import Blob
from v2hdm.geometry.ipm import apply_homography
from v2hdm.records import FloatArray, LaneDetection

_CAP_WIDTH_RATIO = 0.7
_MIN_POINTS = 2
_ROWS_MIN_ASPECT = 0.35


@dataclass(frozen=True)
class LanePaint:
    """A blob that is lane paint of class ``kind``."""

    blob: Blob
    kind: str
    score: float


def trace_lanes(
    paints: Sequence[LanePaint], view: CameraView, step_m: float, max_range_m: float
) -> list[LaneDetection]:
    """The centre lines of one image's lane paint, a point every ``step_m`` on the ground, near to far.

    A blob is cut by image rows (by columns where it lies flat); each cut's two edge points are
    taken to the ground by the camera's initial IPM and averaged there, so perspective does not pull
    the centre. Cuts through the slanted ends, narrower than the rest, are left out. A blob of two
    lines that touch gives one row of points for each branch.
    """
    branches = [(paint, edges) for paint in paints for edges in _branches(paint.blob)]
    if not branches:
        return []
    edges_px = np.concatenate([edges for _, edges in branches])
    edges_vehicle = view.ground(view.undistort(edges_px.reshape(-1, 2))).reshape(-1, 2, 2)
    ends = np.cumsum([len(edges) for _, edges in branches])[:-1]
    traced = [
        (paint, points)
        for (paint, _), edges in zip(branches, np.split(edges_vehicle, ends), strict=True)
        if len(points := _resample(_centre(edges), view, step_m, max_range_m)) >= _MIN_POINTS
    ]
    if not traced:
        return []
    points_vehicle = np.concatenate([points for _, points in traced])
    points_px = view.distort(apply_homography(view.pinhole_px_from_vehicle, points_vehicle))
    ends = np.cumsum([len(points) for _, points in traced])[:-1]
    return [
        LaneDetection(paint.kind, paint.score, points)
        for (paint, _), points in zip(traced, np.split(points_px, ends), strict=True)
    ]


def _branches(blob: Blob) -> list[FloatArray]:
    """The two edges (n, 2, 2), recorded px, of each branch of a blob, cut by cut."""
    height, width = blob.level.shape
    by_rows = height >= _ROWS_MIN_ASPECT * width
    order = [1, 0] if by_rows else [0, 1]
    return [
        blob.origin_px + blob.stride * np.stack([chain[:, [0, 1]], chain[:, [0, 2]]], axis=1)[..., order]
        for chain in _chains(_cuts(blob.level if by_rows else blob.level.T))
    ]


def _cuts(level: np.ndarray) -> FloatArray:
    """Runs (R, 3) of row, start and end column of where a field (h, w) is positive, in order."""
    i, j = np.nonzero((level[:, :-1] > 0) != (level[:, 1:] > 0))
    crossing = j + level[i, j] / (level[i, j] - level[i, j + 1])
    return np.column_stack([i[::2], crossing[::2], crossing[1::2]]).astype(np.float64)


def _chains(runs: FloatArray) -> list[FloatArray]:
    """Runs linked from row to row where they overlap (n, 3), each chain one branch of the blob."""
    if len(runs) < _MIN_POINTS:
        return []
    above, below = runs[:-1], runs[1:]
    linked = (below[:, 0] == above[:, 0] + 1) & (above[:, 1] < below[:, 2]) & (below[:, 1] < above[:, 2])
    if linked.all():
        return [runs]
    breaks = np.flatnonzero(np.diff(runs[:, 0])) + 1
    return _branching_chains(np.split(runs, breaks))


def _branching_chains(cuts: list[FloatArray]) -> list[FloatArray]:
    """The chains of a blob some rows of which hold several runs; ``cuts`` has the runs row by row."""
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
                open_chains[match].append(run)
                following.append(open_chains[match])
        closed += [chain for c, chain in enumerate(open_chains) if c not in taken]
        open_chains = following
    return [np.array(chain) for chain in closed + open_chains if len(chain) >= _MIN_POINTS]


def _centre(edges_vehicle: FloatArray) -> FloatArray:
    """Centres (n, 2) of cuts between two edge points on the ground (n, 2, 2), caps left out."""
    width_m = np.linalg.norm(edges_vehicle[:, 1] - edges_vehicle[:, 0], axis=1)
    finite = np.isfinite(width_m)
    if not finite.any():
        return np.empty((0, 2))
    typical_m = float(np.median(width_m[finite]))
    whole = finite & (width_m > _CAP_WIDTH_RATIO * typical_m) & (width_m < typical_m / _CAP_WIDTH_RATIO)
    return np.asarray(edges_vehicle.mean(axis=1)[whole])


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
