"""Judging a run: the only step that may read ground truth, after everything has been mapped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.io.drive.truth import has_truth, read_truth
from v2hdm.mapping.results import MethodResult
from v2hdm.records import ACCURACIES, BEST, Drive, Truth
from v2hdm.report.metrics import (
    driven_past,
    extrinsic_figures,
    headline,
    map_figures,
    symbols_driven_past,
)

CameraSets = Mapping[str, Mapping[str, MethodResult]]  # by cameras (front, both), then method


class Evaluation(NamedTuple):
    """Figures for ``metrics.json``, and sentences for a reader."""

    metrics: dict[str, Any]
    headlines: list[str]


def evaluate(drive: Drive, methods: CameraSets) -> Evaluation:
    """Compare methods by camera set with the truth, if any."""
    truth = read_truth(drive) if has_truth(drive) else None
    results: dict[str, dict[str, Any]] = {}
    for name, by_method in methods.items():
        expected = driven_past(drive, truth, next(iter(by_method.values())).cameras) if truth else None
        results[name] = {
            method: map_figures(result.hd_map, truth, expected) | _own_figures(result)
            for method, result in by_method.items()
        }
        if truth is not None and truth.map.symbols:
            cameras = next(iter(by_method.values())).cameras
            for method, figures in _areas(drive, truth, by_method, cameras).items():
                results[name][method]["areas"] = figures
    metrics: dict[str, Any] = {"results": results, "extrinsics": _extrinsics(drive, methods, truth)}
    if truth is not None:
        metrics["disturbances"] = truth.disturbances
    headlines = [headline(name, by_method) for name, by_method in results.items()]
    if truth is not None and truth.disturbances:
        headlines.insert(0, _disturbed(truth.disturbances))
    headlines += list(methods.values())[-1][BEST].certainty.values()
    return Evaluation(metrics, headlines)


def _disturbed(disturbances: Mapping[str, float]) -> str:
    """A sentence on the errors that a rendered drive was given: their sigmas, and those that were drawn."""
    parts = []
    for name, sigma in disturbances.items():
        if name.startswith(_DRAWN):
            continue
        words, _, unit = name.rpartition("_")
        drawn = disturbances.get(f"{_DRAWN}{name}")
        of_drawn = "" if drawn is None else f" (drawn {drawn:.2g})"
        parts.append(f"{words.replace('_', ' ')} {sigma:.2g} {unit}{of_drawn}")
    return f"this drive was rendered with errors of one sigma of: {', '.join(parts)}"


_DRAWN = "actual_"  # beginning of the name of a disturbance as it was drawn


def _areas(
    drive: Drive, truth: Truth, by_method: Mapping[str, MethodResult], cameras: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """The figures of words, boxes, crosswalks and double lines, by method."""
    from v2hdm.report.areas import area_figures  # only drives with such a truth load it

    expected = symbols_driven_past(drive, truth, cameras)
    return {method: area_figures(result.hd_map, truth, expected) for method, result in by_method.items()}


def _own_figures(result: MethodResult) -> dict[str, Any]:
    """The figures of a method that need no truth."""
    reasons = Counter(exclusion.reason for exclusion in result.excluded)
    covariances = [marking.covariance_m2 for marking in result.hd_map.markings]
    # The mean variance of a corner's coordinate, by marking.
    variance = [np.trace(covariance) / 8 for covariance in covariances if covariance is not None]
    grades = Counter(result.hd_map.accuracies)
    figures: dict[str, Any] = {
        "excluded": len(result.excluded),
        "excluded_for": dict(reasons.most_common()),
        "median_sigma_m": float(np.sqrt(np.median(variance))) if variance else float("nan"),
    }
    if grades:
        figures["accuracy"] = {grade: grades[grade] for grade in ACCURACIES}
    if result.reprojection_rmse_px is not None:
        figures["reprojection_rmse_px"] = result.reprojection_rmse_px
        figures["initial_reprojection_rmse_px"] = result.initial_reprojection_rmse_px
    if result.suspicions:
        figures["suspicious"] = [asdict(suspicion) | {"p": suspicion.p} for suspicion in result.suspicions]
    if result.diagnostics:
        figures["diagnostics"] = dict(result.diagnostics)
    return figures


def _extrinsics(drive: Drive, methods: CameraSets, truth: Truth | None) -> dict[str, Any]:
    """Per camera the extrinsic found with all cameras together, and under ``alone`` by itself."""
    figures: dict[str, Any] = {}
    for by_method in reversed(list(methods.values())):
        optimised = by_method.get(BEST)
        if optimised is None:
            continue
        for name, calibration in optimised.calibrations.items():
            camera = drive.cameras[name]
            initial = initial_extrinsic(camera)
            true = truth.cam_from_vehicle[name] if truth else None
            extrinsic: dict[str, Any] = extrinsic_figures(calibration.cam_from_vehicle, initial, true)
            extrinsic["certainty"] = optimised.certainty.get(name, "")
            extrinsic |= _clocks(drive, optimised, name)
            if optimised.evidence is not None and name in optimised.evidence.read_out_s:
                read_out = optimised.evidence.read_out_s[name]
                extrinsic |= dict(zip(("read_out_s", "read_out_sigma_s"), read_out, strict=True))
            if calibration.covariance is not None:
                sigma = np.sqrt(np.diag(calibration.covariance))
                extrinsic["translation_sigma_m"] = float(np.linalg.norm(sigma[:3]))
                extrinsic["rotation_sigma_deg"] = float(np.rad2deg(np.linalg.norm(sigma[3:])))
            if name in figures:
                figures[name]["alone"] = extrinsic
            else:
                figures[name] = extrinsic
    return figures


def _clocks(drive: Drive, optimised: MethodResult, camera: str) -> dict[str, Any]:
    """A camera's clock offset and its sigma; of joined drives one a drive, by its name."""
    offsets: dict[str, dict[str, float | None]] = {"clock_offset_s": {}, "clock_sigma_s": {}}
    for session, clocks in zip(drive.sessions, optimised.clocks, strict=True):
        if (clock := clocks.get(camera)) is not None:
            offsets["clock_offset_s"][session.name] = clock.value_s
            offsets["clock_sigma_s"][session.name] = clock.sigma_s if np.isfinite(clock.sigma_s) else None
    if drive.joined:
        return dict(offsets)
    return {key: value for key, by_name in offsets.items() for value in by_name.values()}
