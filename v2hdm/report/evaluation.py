"""One run's figures, as they stand in ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import DIAMOND, BoolArray, FloatArray, HdMap, Truth
from v2hdm.report.dashes import dash_spacing
from v2hdm.report.lane_metrics import lane_metrics
from v2hdm.report.metrics import extrinsic_metrics, marking_metrics

_MAIN_REASONS = 3
"""Reasons of exclusion that a headline names."""


def map_figures(hd_map: HdMap, truth: Truth | None, expected: BoolArray | None) -> dict[str, Any]:
    """Figures of one map: against the truth where there is one, counts and dash spacing always.

    Counts and errors are of markings of all classes; ``recall`` and ``expected`` are those of the
    diamonds, the site's landmarks, where it has any. ``by_class`` holds every figure of each class.
    """
    figures: dict[str, Any] = {"markings": len(hd_map.markings)}
    if truth is not None and expected is not None:
        figures |= asdict(marking_metrics(hd_map, truth, expected))
        shown = dict.fromkeys(m.kind for m in (*truth.map.markings, *hd_map.markings))
        kinds = dict.fromkeys((*CORNERED_CLASSES, *shown))
        by_class = {kind: asdict(marking_metrics(hd_map, truth, expected, kind)) for kind in kinds}
        if by_class[DIAMOND]["expected"]:
            figures |= {name: by_class[DIAMOND][name] for name in ("expected", "recall")}
        figures["by_class"] = by_class
    figures["lanes"] = _lane_figures(hd_map, truth)
    figures["dash_spacing"] = asdict(dash_spacing(hd_map))
    return figures


def extrinsic_figures(estimate: FloatArray, initial: FloatArray, true: FloatArray | None) -> dict[str, float]:
    """How far an extrinsic (4 x 4) moved from its start and, where known, how far it is from truth.

    The turns are those of the camera about the vehicle's axes (deg): yaw to the left, pitch nose
    down, roll to the right.
    """
    turn_vehicle = estimate[:3, :3].T @ initial[:3, :3]
    yaw, pitch, roll = Rotation.from_matrix(turn_vehicle).as_euler("ZYX", degrees=True)
    centres = [camera_centre(t) for t in (estimate, initial)]
    shift_m = centres[0] - centres[1]
    figures = {"yaw_change_deg": yaw, "pitch_change_deg": pitch, "roll_change_deg": roll}
    figures |= {f"{axis}_change_m": float(value) for axis, value in zip("xyz", shift_m, strict=True)}
    if true is not None:
        figures |= asdict(extrinsic_metrics(estimate, true))
    return figures


def growth_figures(maps: Sequence[HdMap], truth: Truth) -> list[tuple[int, float]]:
    """Number of markings and corner RMSE (m) of each of a sequence of growing maps."""
    nothing = np.zeros(len(truth.map.markings), dtype=bool)
    found = [(len(m.markings), marking_metrics(m, truth, nothing).corner_rmse_m) for m in maps]
    return [(count, rmse) for count, rmse in found if np.isfinite(rmse)]


def headline(cameras: str, results: Mapping[str, Mapping[str, Any]]) -> str:
    """What one camera set reached, in one sentence."""
    best = results.get("Opt", {})
    start = next((results[m] for m in ("ENI", "CNI") if m in results), {})
    if "corner_rmse_m" not in best or "corner_rmse_m" not in start:
        return f"{cameras}: {_own_words(best)}"
    return (
        f"{cameras}: corners {100 * start['corner_rmse_m']:.1f} cm off before, "
        f"{100 * best['corner_rmse_m']:.1f} cm after the optimisation"
    )


def _own_words(figures: Mapping[str, Any]) -> str:
    """The size of a map, its accuracy, and the main reasons why candidates are not in it."""
    words = f"{figures.get('markings', 0)} markings"
    if np.isfinite(figures.get("median_sigma_m", np.nan)):
        words += f" (sigma of a corner {100 * figures['median_sigma_m']:.1f} cm)"
    words += f", {figures.get('lanes', {}).get('lanes', 0)} lane lines"
    reasons = list(figures.get("excluded_for", {}).items())[:_MAIN_REASONS]
    if reasons:
        told = ", ".join(f"{count} {reason}" for reason, count in reasons)
        words += f"; {figures['excluded']} candidates left out, most often: {told}"
    return words


def _lane_figures(hd_map: HdMap, truth: Truth | None) -> dict[str, Any]:
    if truth is not None:
        return asdict(lane_metrics(hd_map.lanes, truth))
    return {
        "lanes": len(hd_map.lanes),
        "length_m": float(
            sum(np.linalg.norm(np.diff(lane.points_map, axis=0), axis=1).sum() for lane in hd_map.lanes)
        ),
    }
