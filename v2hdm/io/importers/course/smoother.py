"""The headings of a whole drive at once, from all of its positions, by Gauss-Newton.

Unknowns of neighbouring epochs alone are in one residual, so that the normal matrix is a band; the few that
all epochs share border it. SciPy's banded Cholesky factor (LAPACK) solves for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError, need
from v2hdm.geometry.planar import length_along
from v2hdm.io.importers.course.directions import Directions
from v2hdm.io.importers.course.recording import Course
from v2hdm.io.importers.course.terms import WIDTH, Epoch, Shared, State, Term, terms_of
from v2hdm.records import FloatArray, IntArray

_MOST_STEPS = 60  # Gauss-Newton takes under ten, a vehicle that stands now and then twenty; chosen
_CONVERGED = 0.1  # decrease of the squared residuals, in sigmas, at which to stop; chosen
_BAND = 2 * WIDTH  # an epoch's unknowns and the next one's
_SHOWN = 300  # epochs at most whose sigma is computed; those between take the line between them
_AT_ONCE = 25  # of these that are solved for together: memory


class Smoothed(NamedTuple):
    """Headings of a drive and what they rest on."""

    heading_rad: FloatArray  # (P,) to the left of x, unwrapped
    sigma_rad: FloatArray  # (P,)
    faded_m: float  # distance over which errors of the heading fade to a third
    speed_m_s: FloatArray  # (P,) negative backward
    shared: FloatArray  # (5,) by Shared
    shared_sigma: FloatArray  # (5,)
    cost: float  # squares of all residuals, in sigmas
    misfit: dict[str, float]  # root mean square of each kind of residual that many epochs have, in sigmas


def smooth(course: Course, directions: Directions, where: str) -> Smoothed:
    """The likeliest headings that begin at the ``directions``; DriveError where none are found."""
    linear = need("scipy.linalg", "map", f"{where}: a heading from the course", DriveError)
    way_m = np.diff(length_along(course.antenna_map))
    way_m = np.where(way_m > 3 * course.sigma_m[1:], way_m, 0.0)  # noise is no way
    state = _begin(course, directions)
    terms = terms_of(course, state, way_m)
    cost = _cost(terms)
    damping = 0.0
    for _ in range(_MOST_STEPS):
        system = _System.of(terms, state, damping, linear)
        moved = state.moved(system.step)
        terms_there = terms_of(course, moved, way_m)
        cost_there = _cost(terms_there)
        if not cost_there <= cost:
            damping = max(10 * damping, 1e-3)
            continue
        gain = cost - cost_there
        state = moved
        terms = terms_there
        cost = cost_there
        damping *= 0.1
        if gain < _CONVERGED:
            break
    else:
        raise DriveError(
            f"{where}: no path of a vehicle fits its positions; check their times, lever_arm_m and the gyro, "
            "or give a heading"
        )
    system = _System.of(terms, state, 0.0, linear)
    sigma_rad, faded_m = system.heading_sigmas(length_along(course.antenna_map))
    shared_sigma = np.sqrt(np.diag(system.shared_covariance))
    misfit = {
        term.name: float(np.sqrt(np.mean(term.residual**2)))
        for term in terms
        if len(term.residual) > len(state.shared)
    }
    return Smoothed(
        state.epochs[:, Epoch.HEADING],
        sigma_rad,
        faded_m,
        state.epochs[:, Epoch.SPEED],
        state.shared,
        shared_sigma,
        cost,
        misfit,
    )


def _cost(terms: list[Term]) -> float:
    return float(sum((term.residual**2).sum() for term in terms))


def _summed(places: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Sums (``count``,) of values by their places, both of any shape."""
    return np.asarray(np.bincount(places.ravel(), values.ravel(), minlength=count), dtype=np.float64)


def _begin(course: Course, directions: Directions) -> State:
    """The state that the directions give."""
    heading_rad = directions.heading_rad
    epochs = np.zeros((len(heading_rad), WIDTH))
    ahead, left = course.lever_arm_m
    epochs[:, Epoch.X] = course.antenna_map[:, 0] - np.cos(heading_rad) * ahead + np.sin(heading_rad) * left
    epochs[:, Epoch.Y] = course.antenna_map[:, 1] - np.sin(heading_rad) * ahead - np.cos(heading_rad) * left
    epochs[:, Epoch.HEADING] = heading_rad
    speed_m_s = np.linalg.norm(np.gradient(course.antenna_map, course.stamp_s, axis=0), axis=1)
    epochs[:, Epoch.SPEED] = directions.forward * speed_m_s
    shared = np.zeros(len(Shared))
    if course.has_gyro:
        turn = np.diff(heading_rad)
        bias = (course.turn_rad - turn) / course.interval_s
        shared[Shared.GYRO_BIAS] = float(np.nanmedian(bias))
    return State(epochs, shared)


@dataclass(frozen=True)
class _System:
    """Normal equations, solved: a band, bordered by the few unknowns that all epochs share."""

    step: FloatArray  # (7 P + 5,) the solution
    shared_covariance: FloatArray  # (5, 5)
    factor: FloatArray  # (14, 7 P) Cholesky factor of the band, as SciPy stores it
    border: FloatArray  # (7 P, 5) the band's inverse times the border
    linear: Any  # scipy.linalg

    @classmethod
    def of(cls, terms: list[Term], state: State, damping: float, linear: Any) -> _System:
        """The system of residuals, its diagonal raised by a share, ``damping``, solved."""
        count = state.epochs.size
        shared = len(state.shared)
        right: FloatArray = np.zeros(count + shared)
        band: FloatArray = np.zeros(_BAND * count)
        border: FloatArray = np.zeros(count * shared)
        corner: FloatArray = np.zeros(shared * shared)
        for term in terms:
            right -= _summed(term.column, term.derivative * term.residual[:, None], len(right))
            rows = term.column[:, :, None]
            columns = term.column[:, None, :]
            products = term.derivative[:, :, None] * term.derivative[:, None, :]
            is_band = (rows >= columns) & (rows < count)
            is_border = (rows < count) & (columns >= count)
            is_corner = (rows >= count) & (columns >= count)
            band += _summed(((rows - columns) * count + columns)[is_band], products[is_band], len(band))
            border += _summed((rows * shared + columns - count)[is_border], products[is_border], len(border))
            places = (rows - count) * shared + columns - count
            corner += _summed(places[is_corner], products[is_corner], len(corner))
        band = band.reshape(_BAND, count)
        border = border.reshape(count, shared)
        corner = corner.reshape(shared, shared)
        band[0] *= 1 + damping
        corner[np.diag_indices(shared)] *= 1 + damping
        factor = linear.cholesky_banded(band, lower=True)
        solved = linear.cho_solve_banded((factor, True), np.column_stack([right[:count], border]))
        shared_covariance = np.linalg.inv(corner - border.T @ solved[:, 1:])
        of_shared = shared_covariance @ (right[count:] - border.T @ solved[:, 0])
        of_epochs = solved[:, 0] - solved[:, 1:] @ of_shared
        step = np.concatenate([of_epochs, of_shared])
        return cls(step, shared_covariance, factor, solved[:, 1:], linear)

    def heading_sigmas(self, along_m: FloatArray) -> tuple[FloatArray, float]:
        """Sigmas (P,) of the headings, rad, and the distance over which their errors fade, m."""
        count = len(along_m)
        shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).astype(int))
        variances = []
        faded = []
        for begin in range(0, len(shown), _AT_ONCE):
            rows = shown[begin : begin + _AT_ONCE]
            unit = np.zeros((WIDTH * count, len(rows)))
            places = WIDTH * rows + Epoch.HEADING
            unit[places, np.arange(len(rows))] = 1.0
            band = self.linear.cho_solve_banded((self.factor, True), unit)[Epoch.HEADING :: WIDTH]
            border = self.border[Epoch.HEADING :: WIDTH] @ self.shared_covariance
            covariance = band + border @ self.border[places].T  # (P, rows)
            variance = covariance[rows, np.arange(len(rows))]
            variances.append(variance)
            sigma_of_all = np.sqrt(np.maximum(variance, 0))
            for place, row in enumerate(rows):
                correlation = covariance[row:, place] / sigma_of_all[place] ** 2
                below = np.flatnonzero(correlation < np.exp(-1))
                end = row + below[0] if len(below) else count - 1
                faded.append(along_m[end] - along_m[row])
        sigma_rad = np.sqrt(np.interp(np.arange(count), shown, np.concatenate(variances)))
        return sigma_rad, float(np.median(faded))
