"""Errors of a map and a calibration against ground truth, for ``metrics.json``.

Only this package and the pipeline's evaluation read ground truth. Lengths are metres in the map frame unless
named otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.geometry.planar import inside_convex, length_along, points_along
from v2hdm.geometry.rigid import camera_centre, ground_in_vehicle
from v2hdm.records import (
    BEST,
    DIAMOND,
    TWO_SIDED_95,
    BoolArray,
    Drive,
    FloatArray,
    HDMap,
    IntArray,
    Lane,
    Marking,
    Truth,
)
from v2hdm.site.accuracy import well_known

MATCH_GATE_M = 2.0  # a mapped marking farther from every true one of its class is false
MIN_SIGHTINGS = 3  # images with the whole marking in the region of interest that count as driven past
FULLY_VISIBLE = 0.99  # visible fraction of an unoccluded marking


@dataclass(frozen=True)
class MarkingMetrics:
    """Mapped markings of one class, or all, against the true ones; nan without matches."""

    markings: int
    false_markings: int  # without a true counterpart
    expected: int  # true ones driven past within the region of interest
    recall: float  # mapped fraction of these
    corner_rmse_m: float
    corner_bias_m: float  # length of the corners' mean error vector
    well_known_rmse_m: float  # of the corners, but of markings of accuracy C while these are the fewer


def driven_past(drive: Drive, truth: Truth, cameras: Sequence[str]) -> BoolArray:
    """True markings (J,) that the cameras saw whole in their ROI in :data:`MIN_SIGHTINGS` images."""
    outlines = [(marking.corners_map, marking.heights_m) for marking in truth.map.markings]
    return _seen_whole(drive, truth, cameras, outlines, truth.visibility) >= MIN_SIGHTINGS


def symbols_driven_past(
    drive: Drive, truth: Truth, cameras: Sequence[str], least_sightings: int = MIN_SIGHTINGS
) -> BoolArray:
    """The true symbols (S,) with four corners that :func:`driven_past` would count as passed.

    ``least_sightings`` is the number of images that it asks for.
    """
    outlines = [(symbol.outline_map, symbol.heights_m) for symbol in truth.map.symbols]
    if truth.symbol_visibility is None or any(len(outline) != 4 for outline, _ in outlines):
        return np.zeros(len(outlines), dtype=np.bool_)
    return _seen_whole(drive, truth, cameras, outlines, truth.symbol_visibility) >= least_sightings


def _seen_whole(
    drive: Drive, truth: Truth, cameras: Sequence[str],
    outlines: Sequence[tuple[FloatArray, FloatArray | None]], visibility: FloatArray,
) -> IntArray:  # fmt: skip
    """The number (J,) of images in which the cameras saw outlines with heights whole, in their ROI."""
    corners = np.zeros((len(outlines), 4, 3))
    for j, (corners_map, heights_m) in enumerate(outlines):
        corners[j, :, :2] = corners_map
        corners[j, :, 2] = 0.0 if heights_m is None else heights_m
    sightings = np.zeros(len(corners), dtype=int)
    for i, image in enumerate(drive.images):
        if image.camera not in cameras:
            continue
        candidates = np.flatnonzero(visibility[i] >= FULLY_VISIBLE)
        corners_vehicle = ground_in_vehicle(truth.map_from_vehicle[i], corners[candidates])
        inside = inside_convex(drive.cameras[image.camera].roi_vehicle, corners_vehicle).all(axis=1)
        sightings[candidates[inside]] += 1
    return sightings


def marking_metrics(
    hd_map: HDMap, truth: Truth, expected: BoolArray, kind: str | None = None
) -> MarkingMetrics:
    """Compare markings of ``kind``, all if None, with the truth; see :class:`MarkingMetrics`."""
    mapped = [m for m in hd_map.markings if kind is None or m.kind == kind]
    true_index = [j for j, m in enumerate(truth.map.markings) if kind is None or m.kind == kind]
    true = [truth.map.markings[j] for j in true_index]
    is_expected = expected[true_index]
    rows, columns = match_markings(mapped, true)
    is_mapped = np.zeros(len(true), dtype=bool)
    is_mapped[columns] = True
    errors = corner_errors([mapped[r] for r in rows], [true[c] for c in columns])
    well_known_ids = {id(marking) for marking in well_known([mapped[r] for r in rows])}
    is_well_known = np.repeat([id(mapped[r]) in well_known_ids for r in rows], 4).astype(bool)
    return MarkingMetrics(
        markings=len(mapped),
        false_markings=len(mapped) - len(rows),
        expected=int(is_expected.sum()),
        recall=float(is_mapped[is_expected].mean()) if is_expected.any() else float("nan"),
        corner_rmse_m=rms(errors),
        corner_bias_m=float(np.linalg.norm(errors.mean(axis=0))) if len(errors) else float("nan"),
        well_known_rmse_m=rms(errors[is_well_known]),
    )


def match_markings(
    mapped: Sequence[Marking], true: Sequence[Marking], gate_m: float = MATCH_GATE_M
) -> tuple[list[int], list[int]]:
    """One-to-one pairs (indices into both) within a class, of least total centre distance."""
    from scipy.optimize import linear_sum_assignment  # slow to load, and `view` compares nothing

    if not mapped or not true:
        return [], []
    centres = np.array([m.corners_map.mean(axis=0) for m in mapped])
    true_centres = np.array([m.corners_map.mean(axis=0) for m in true])
    distance = np.linalg.norm(centres[:, None] - true_centres[None], axis=2)
    kinds_differ = np.array([m.kind for m in mapped])[:, None] != np.array([m.kind for m in true])[None]
    # A constant cost beyond the gate, so that distant pairs never separate a near one.
    cost = np.where(kinds_differ | (distance > gate_m), gate_m * 1e3, distance)
    rows, columns = linear_sum_assignment(cost)
    keep = cost[rows, columns] <= gate_m
    return rows[keep].tolist(), columns[keep].tolist()


def corner_errors(mapped: Sequence[Marking], true: Sequence[Marking]) -> FloatArray:
    """Error vectors (4 M, 2) of paired markings, over the best of the four cyclic corner orders."""
    errors = _errors_by_order(mapped, true)
    return np.asarray(errors[np.arange(len(errors)), _nearest(errors)].reshape(-1, 2))


def height_figures(mapped: Sequence[Marking], true: Sequence[Marking]) -> dict[str, float]:
    """RMSE, m, of paired corners' heights, and the fraction within 1.96 sigmas, where known."""
    errors_m = []
    inside = []
    for marking, counterpart, shift in zip(mapped, true, first_corners(mapped, true), strict=True):
        if marking.heights_m is None or counterpart.heights_m is None:
            continue
        errors_m.append(marking.heights_m - np.roll(counterpart.heights_m, -shift))
        if marking.heights_sigma_m is not None:
            inside.append(np.abs(errors_m[-1]) < TWO_SIDED_95 * marking.heights_sigma_m)
    figures = {"height_rmse_m": float(np.sqrt(np.mean(np.square(errors_m))))} if errors_m else {}
    return figures | ({"heights_inside_95": float(np.mean(inside))} if inside else {})


def first_corners(mapped: Sequence[Marking], true: Sequence[Marking]) -> list[int]:
    """The steps to roll each mapped marking's corners by so that they come nearest to the true ones."""
    return [int(steps) for steps in _nearest(_errors_by_order(mapped, true))]


def _errors_by_order(mapped: Sequence[Marking], true: Sequence[Marking]) -> FloatArray:
    """Error vectors (M, 4, 4, 2) of the corners of M pairs, by the steps that the mapped ones are rolled."""
    corners, true_corners = (
        np.array([marking.corners_map for marking in markings]).reshape(-1, 4, 2)
        for markings in (mapped, true)
    )
    rolled = np.stack([np.roll(corners, steps, axis=1) for steps in range(4)], axis=1)
    return np.asarray(rolled - true_corners[:, None])


def _nearest(errors: FloatArray) -> IntArray:
    """The steps (M,) of the smallest of errors (M, 4, 4, 2)."""
    return np.asarray((errors.reshape(-1, 4, 8) ** 2).sum(axis=2).argmin(axis=1))


def extrinsic_metrics(cam_from_vehicle: FloatArray, true_cam_from_vehicle: FloatArray) -> dict[str, float]:
    """Angle (deg) between two camera orientations (4, 4), and distance (m) of their centres."""
    from scipy.spatial.transform import Rotation  # slow to load, and `view` compares nothing

    turn = Rotation.from_matrix(cam_from_vehicle[:3, :3] @ true_cam_from_vehicle[:3, :3].T)
    shift_m = camera_centre(cam_from_vehicle) - camera_centre(true_cam_from_vehicle)
    angle_deg = np.rad2deg(turn.magnitude())
    distance_m = np.linalg.norm(shift_m)
    return {"rotation_error_deg": float(angle_deg), "translation_error_m": float(distance_m)}


def rms(errors: FloatArray) -> float:
    """RMS norm of vectors (N, 2), nan for none."""
    return float(np.sqrt((errors**2).sum(axis=1).mean())) if len(errors) else float("nan")


SAMPLE_STEP_M = 0.1  # sampling interval of polylines for comparison
LATERAL_GATE_M = 0.3  # largest distance of a mapped from a true lane


@dataclass(frozen=True)
class LaneMetrics:
    """Mapped lane lines against the true ones, near within :data:`LATERAL_GATE_M`."""

    lanes: int
    length_m: float
    mean_lateral_error_m: float  # of mapped length near a true line
    rms_lateral_error_m: float
    inside_95: float  # fraction of vertices there within 1.96 of their sigmas; nan without sigmas
    mapped_fraction: float  # of the visible true length, with a mapped line near
    false_length_m: float  # mapped without a true line near


def lane_metrics(lanes: Sequence[Lane], truth: Truth) -> LaneMetrics:
    """Compare mapped lanes with the truth; see :class:`LaneMetrics`."""
    lanes = [line for lane in lanes for line in lane.painted]
    true_all = _stack(resample(line.points_map) for lane in truth.map.lanes for line in lane.painted)
    true_visible = _stack(
        resample(piece)
        for lane, visible in zip(truth.map.lanes, truth.lane_visible, strict=True)
        for line in lane.painted
        for piece in runs(line.points_map, visible)
    )
    mapped = _stack(resample(lane.points_map) for lane in lanes)
    mapped_m = len(mapped) * SAMPLE_STEP_M
    none = float("nan")
    if not len(mapped) or not len(true_all):
        return LaneMetrics(len(lanes), mapped_m, none, none, none, 0.0, mapped_m)
    lateral = distance_to_points(mapped, true_all)
    is_near = lateral <= LATERAL_GATE_M
    stated = [(lane.points_map, lane.sigma_m) for lane in lanes if lane.sigma_m is not None]
    off_m = distance_to_points(_stack(points for points, _ in stated), true_all)
    sigmas = off_m / np.concatenate([np.zeros(0), *(sigma_m for _, sigma_m in stated)])
    sigmas = sigmas[off_m <= LATERAL_GATE_M]
    covered = distance_to_points(true_visible, mapped) <= LATERAL_GATE_M
    return LaneMetrics(
        lanes=len(lanes),
        length_m=mapped_m,
        mean_lateral_error_m=float(lateral[is_near].mean()) if is_near.any() else none,
        rms_lateral_error_m=float(np.sqrt((lateral[is_near] ** 2).mean())) if is_near.any() else none,
        inside_95=float((sigmas <= TWO_SIDED_95).mean()) if len(sigmas) else none,
        mapped_fraction=float(covered.mean()) if len(covered) else none,
        false_length_m=float((~is_near).sum() * SAMPLE_STEP_M),
    )


def resample(points: FloatArray, step_m: float = SAMPLE_STEP_M) -> FloatArray:
    """Points (M, 2) every ``step_m`` along a polyline (N, 2), its first point included."""
    if len(points) < 2:
        return points
    return points_along(points, np.arange(0.0, length_along(points)[-1] + 1e-9, step_m))


def distance_to_points(points: FloatArray, line: FloatArray) -> FloatArray:
    """Distance (N,) of points to a densely sampled line, perpendicular between the two nearest samples."""
    from scipy.spatial import cKDTree  # slow to load, and `view` compares nothing

    if not len(points):
        return np.empty(0)
    if len(line) < 2:
        return np.asarray(np.linalg.norm(points - line[0], axis=1))
    distance, nearest = cKDTree(line).query(points, k=2)
    first = line[nearest[:, 0]]
    second = line[nearest[:, 1]]
    span = second - first
    length2 = np.maximum((span**2).sum(axis=1), 1e-18)
    share = np.clip(((points - first) * span).sum(axis=1) / length2, 0.0, 1.0)
    # Samples more than a step apart belong to different lines and are not joined.
    joined = np.sqrt(length2) <= 1.5 * SAMPLE_STEP_M
    lateral = np.linalg.norm(points - (first + share[:, None] * span), axis=1)
    return np.asarray(np.where(joined, lateral, distance[:, 0]))


def runs(points: FloatArray, keep: BoolArray) -> list[FloatArray]:
    """Maximal runs of a polyline's vertices in ``keep``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(int), [0]])))
    return [points[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def _stack(pieces: Iterable[FloatArray]) -> FloatArray:
    arrays = [piece for piece in pieces if len(piece)]
    return np.concatenate(arrays) if arrays else np.empty((0, 2))


_MAIN_REASONS = 3  # number of reasons for exclusion in a headline


def map_figures(hd_map: HDMap, truth: Truth | None, expected: BoolArray | None) -> dict[str, Any]:
    """Figures of one map: counts, and errors if there is ground truth.

    They are of all classes, except ``recall`` and ``expected``: of diamonds, the site's landmarks, where it
    has any. ``by_class`` has every figure of each class.
    """
    figures: dict[str, Any] = {"markings": len(hd_map.markings)}
    if truth is not None and expected is not None:
        figures |= asdict(marking_metrics(hd_map, truth, expected))
        rows, columns = match_markings(hd_map.markings, truth.map.markings)
        figures |= height_figures(
            [hd_map.markings[row] for row in rows], [truth.map.markings[column] for column in columns]
        )
        shown = dict.fromkeys(m.kind for m in (*truth.map.markings, *hd_map.markings))
        kinds = dict.fromkeys((*CORNERED_CLASSES, *shown))
        by_class = {kind: asdict(marking_metrics(hd_map, truth, expected, kind)) for kind in kinds}
        if by_class[DIAMOND]["expected"]:
            figures |= {name: by_class[DIAMOND][name] for name in ("expected", "recall")}
        figures["by_class"] = by_class
    if truth is not None:
        figures["lanes"] = asdict(lane_metrics(hd_map.lanes, truth))
    else:
        length = float(sum(length_along(lane.points_map)[-1] for lane in hd_map.lanes))
        figures["lanes"] = {"lanes": len(hd_map.lanes), "length_m": length}
    return figures


def extrinsic_figures(estimate: FloatArray, initial: FloatArray, true: FloatArray | None) -> dict[str, float]:
    """Change of an extrinsic (4, 4) from its start and, if known, its error.

    Rotations are about the vehicle's axes, deg: yaw to the left, pitch nose down, roll to the right.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and `view` compares nothing

    turn_vehicle = estimate[:3, :3].T @ initial[:3, :3]
    yaw, pitch, roll = Rotation.from_matrix(turn_vehicle).as_euler("ZYX", degrees=True)
    shift_m = camera_centre(estimate) - camera_centre(initial)
    figures = {"yaw_change_deg": yaw, "pitch_change_deg": pitch, "roll_change_deg": roll}
    figures |= {f"{axis}_change_m": float(value) for axis, value in zip("xyz", shift_m, strict=True)}
    if true is not None:
        figures |= extrinsic_metrics(estimate, true)
    return figures


def headline(cameras: str, results: Mapping[str, Mapping[str, Any]]) -> str:
    """One sentence on the result of one camera set."""
    best = results.get(BEST, {})
    start = next((results[m] for m in ("ENI", "CNI") if m in results), {})
    if "corner_rmse_m" not in best or "corner_rmse_m" not in start:
        return f"{cameras}: {_own_words(best)}"
    heights = f", heights {100 * best['height_rmse_m']:.1f} cm" if "height_rmse_m" in best else ""
    return (
        f"{cameras}: corners {100 * start['corner_rmse_m']:.1f} cm off before, "
        f"{100 * best['corner_rmse_m']:.1f} cm after the optimisation{heights}"
    )


def _own_words(figures: Mapping[str, Any]) -> str:
    """Size and accuracy of a map, and the main reasons for exclusion."""
    words = f"{figures.get('markings', 0)} markings"
    if np.isfinite(figures.get("median_sigma_m", np.nan)):
        words += f" (sigma of a corner {100 * figures['median_sigma_m']:.1f} cm)"
    lanes = figures.get("lanes", {}).get("lanes", 0)
    words += f", {lanes} lane line{'s' * (lanes != 1)}"
    reasons = list(figures.get("excluded_for", {}).items())[:_MAIN_REASONS]
    if reasons:
        listed = "; ".join(f"{reason} ({count})" for reason, count in reasons)
        words += f"; {figures['excluded']} candidates left out, most often: {listed}"
    return words
