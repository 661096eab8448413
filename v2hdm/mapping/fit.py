"""How well observations fit a solved bundle, and its contradicted inputs in the user's words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.adjust import CHANGES, Fault, ScoreTest
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.results import CELLS, WINDOW_OBSERVATIONS, CameraFit, Contradiction
from v2hdm.mapping.stated import name_of
from v2hdm.records import FloatArray, IntArray

MEDIAN_SQUARED = 2 * float(np.log(2))
"""Median of a squared residual in sigmas: chi-square with two degrees of freedom."""

CELL_OBSERVATIONS = 40
"""Observations of a cell from which its median residual counts."""


def contradictions(
    bundle: Bundle, found: Sequence[ScoreTest], frame_s: FloatArray, visits: Sequence[str] = ()
) -> tuple[Contradiction, ...]:
    """``found`` in the bundle's problem, whose frames were taken at ``frame_s`` (J,), in the user's words.

    Several ``visits`` are named.
    """
    names = tuple(bundle.camera_index)
    return tuple(
        Contradiction(
            one.fault,
            names if one.camera < 0 else (names[one.camera],),
            one.axis,
            _about(bundle, one, frame_s, visits),
            one.value,
            one.sigma,
            one.sigmas,
            one.p_value,
            one.gain,
            one.image_share,
        )
        for one in found
    )


def sizes_of(bundle: Bundle, length_m: float) -> list[str]:
    """The classes that have a side or diagonal stated as ``length_m``."""
    stated = bundle.model.sizes.by_class_m
    return [name for name, size in stated.items() if any(abs(one - length_m) < 1e-9 for one in size)]


def length_of(bundle: Bundle, item: int) -> float:
    """The known length, m, that a test's ``item`` is."""
    lengths = bundle.problem.lengths
    return float(np.unique(lengths.length_m)[item]) if lengths is not None else float("nan")


def point_of(bundle: Bundle, item: int) -> str:
    """The name of the surveyed point that a test's ``item`` is."""
    control = bundle.problem.control
    assert control is not None
    return name_of(bundle.model.survey, control.points_map[item])


def camera_fits(bundle: Bundle) -> dict[str, CameraFit]:
    """How well each camera's observations fit ``bundle``, a solve before anything was left out."""
    seen, solution = bundle.problem.observations, bundle.solution
    points, fits = bundle.inliers & ~seen.on_line, {}
    for name, c in bundle.camera_index.items():
        own = seen.camera == c
        fits[name] = CameraFit(
            observations=int(own.sum()),
            variance_factor=_factor(bundle, solution.mahalanobis2[own]),
            rejected_share=float(1 - bundle.inliers[own].mean()),
            bias_px=_cell_bias(seen.pinhole_px[own & points], solution.residual_px[own & points]),
        )
    return fits


def along_route(bundle: Bundle, frame: IntArray, stamp_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variance factors (W,) of windows along the route, and when they begin (W,), s.

    ``frame`` (K,) is that of each observation, ``stamp_s`` (F,) the frames' times.
    """
    order = np.argsort(frame, kind="stable")
    count = max(len(order) // WINDOW_OBSERVATIONS, 1)
    windows = np.array_split(order, count)
    factors = [_factor(bundle, bundle.solution.mahalanobis2[window]) for window in windows]
    return np.array(factors), np.array([stamp_s[frame[window[0]]] for window in windows])


def overall_factor(bundle: Bundle) -> float:
    """How many times as large as stated by the detector the variances of all observations are."""
    return _factor(bundle, bundle.solution.mahalanobis2)


def _factor(bundle: Bundle, mahalanobis2: FloatArray) -> float:
    return bundle.model.variance_factor * float(np.median(mahalanobis2)) / MEDIAN_SQUARED


def _cell_bias(places_px: FloatArray, residual_px: FloatArray) -> float:
    """Longest median residual of the cells that the places (K, 2) span."""
    if not len(places_px):
        return 0.0
    rows, columns = CELLS
    low, span = places_px.min(axis=0), np.maximum(np.ptp(places_px, axis=0), 1.0)
    share = (places_px - low) / span * (1 - 1e-9)
    cell = (share[:, 1] * rows).astype(np.int64) * columns + (share[:, 0] * columns).astype(np.int64)
    biases = [
        float(np.linalg.norm(np.median(residual_px[cell == number], axis=0)))
        for number in np.flatnonzero(np.bincount(cell) >= CELL_OBSERVATIONS)
    ]
    return max(biases, default=0.0)


def _about(bundle: Bundle, test: ScoreTest, frame_s: FloatArray, visits: Sequence[str]) -> str:
    if test.fault in CHANGES:
        return f"from {frame_s[test.item]:.1f} s on"
    if test.fault is Fault.CLOCK and test.item >= 0 and visits:
        return f"in {visits[test.item]}"
    if test.fault is Fault.SIZE:
        length_m = length_of(bundle, test.item)
        return f"{', '.join(sizes_of(bundle, length_m))} {length_m:.2f} m"
    if test.fault is Fault.CONTROL:
        return point_of(bundle, test.item)
    return ""
