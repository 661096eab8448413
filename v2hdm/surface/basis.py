"""The functions that add up to the ground's height: grade, slopes of the cross-section, a bicubic spline."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from v2hdm.records import FloatArray, IntArray

KNOTS_M = (1.75, 3.5, 5.25)
"""Offsets from the path at which the slope may change: every half lane of 3.5 m. A crown follows a lane line;
one elsewhere is smoothed by 2 cm at most."""

GRADES = 2  # number of parameters of the grade, along map x and y
HINGES = 1 + 2 * len(KNOTS_M)  # number of slopes of the cross-section: at the path, at knots left and right
SHAPE = GRADES + HINGES  # number of parameters before the spline's

SIDE_M = 12.5  # farther beside the path the ground continues at this height, m, except for the grade
ALONG_M = 6.0  # knot spacing of the spline along the path, m: a third of a camera's range
_ACROSS_M = 5.0  # knot spacing of the spline across the path, m: a lane with margins
ACROSS = int(2 * SIDE_M / _ACROSS_M) + 3  # number of functions of the spline across
MOST_ALONG = 120  # largest number of knots along the route; longer routes have wider spacing


def hinges(left_m: FloatArray) -> FloatArray:
    """Heights (K, B) at left offsets (K,) per unit of each slope of the cross-section."""
    left_m = np.clip(left_m, -SIDE_M, SIDE_M)
    sides = [np.maximum(side * left_m - knot, 0.0) for side in (1.0, -1.0) for knot in KNOTS_M]
    return -np.column_stack([np.abs(left_m), *sides])


class Knots(NamedTuple):
    """Uniform knots of cubic B-splines."""

    first_m: float
    step_m: float
    functions: int  # number of functions


ACROSS_KNOTS = Knots(-SIDE_M, _ACROSS_M, ACROSS)  # knots of the spline across the path


def cubic(at_m: FloatArray, knots: Knots) -> tuple[IntArray, FloatArray]:
    """Indices and values (K, 4) of the four functions that cover ``at_m`` (K,)."""
    first, step, count = knots
    within = np.clip(at_m, first, first + (count - 3 - 1e-9) * step)
    design = BSpline.design_matrix(within, first + step * np.arange(-3.0, count + 1), 3)
    return design.indices.reshape(-1, 4).astype(np.int64), design.data.reshape(-1, 4)
