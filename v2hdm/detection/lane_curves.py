"""Lines of lanes as curves in the image: what a circular arc on flat ground looks like.

Below the horizon such an arc is u = a + b v + c / v, u along the horizon and v the distance below it, in
pinhole px: the image of a straight line (a, b) and, to second order, of its curvature (c); see A. Guiducci,
"Parametric model of the perspective projection of a road with applications to lane keeping and 3D road
reconstruction", CVIU 73 (1999). It is linear in a, b and c: what points say of it adds up, and whether two
groups of points are one line has a closed answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.detection.view import CameraView
from v2hdm.records import FloatArray

_LEAST_BELOW_PX = 4.0
"""Nearer to the horizon than this nothing is known of the ground."""

_UNIT_PX = 100.0
"""Unit of v within the basis, which keeps a, b and c of a size."""

_PROBE_PX = 50.0

_DIRECTION_SIGMA_RAD = 0.5
_BESIDE_SIGMA_M = 8.0
_CURVATURE_SIGMA = 0.008
"""Lines before they are seen: their direction about the camera's, how far to the side they pass, 1/m."""

_KEPT_PRIOR = np.array([0.04, 0.04, 1.0])


class Horizon:
    """Pinhole pixels of one camera in axes along and below its horizon.

    ``prior_information`` (3, 3) and ``centre_px`` (the mean of a; that of b and c is nought) describe lines
    before they are seen. ``px_per_m`` is how many px along the horizon a metre of ground is wide at one px
    below it; it grows in proportion.
    """

    def __init__(self, view: CameraView):
        row = view.vehicle_from_pinhole_px[2]
        lowest = np.array([[(view.info.width - 1) / 2, view.info.height - 1.0]])
        sign = np.sign(float(row[:2] @ lowest[0] + row[2]))
        sign = sign if np.isfinite(view.ground(lowest)).all() else -sign
        size = max(float(np.linalg.norm(row[:2])), 1e-12)
        self._down = sign * row[:2] / size
        self._along = np.array([self._down[1], -self._down[0]])
        self._shift = float(sign * row[2] / size)
        intrinsic = view.info.intrinsic
        self.centre_px = float(self.coordinates(intrinsic[None, :2, 2])[0][0])
        beside = self.pinhole_px(self.centre_px + np.array([-0.5, 0.5]), np.full(2, _PROBE_PX))
        ground = view.ground(beside)
        probe_px_per_m = 1.0 / max(float(np.linalg.norm(ground[1] - ground[0])), 1e-9)
        self.px_per_m = probe_px_per_m / _PROBE_PX
        range_m = float(view.range_m(ground.mean(axis=0)))
        sigma = np.array(
            [
                _DIRECTION_SIGMA_RAD * float(intrinsic[0, 0]),
                _BESIDE_SIGMA_M * self.px_per_m * _UNIT_PX,
                0.5 * _CURVATURE_SIGMA * range_m**2 * probe_px_per_m * _PROBE_PX / _UNIT_PX,
            ]
        )
        self.prior_information = np.diag(sigma**-2.0)

    def coordinates(self, pinhole_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position along (N,) and below (N,) the horizon, px, of pinhole pixels (N, 2)."""
        return pinhole_px @ self._along, pinhole_px @ self._down + self._shift

    def pinhole_px(self, along: FloatArray, below: FloatArray) -> FloatArray:
        """The pinhole pixels (N, 2) of :meth:`coordinates`."""
        return np.asarray(along[:, None] * self._along + (below - self._shift)[:, None] * self._down)


@dataclass(frozen=True)
class Evidence:
    """What N groups of points say of their lines, each summed up.

    ``information`` (N, 3, 3), ``moment`` (N, 3) and ``square`` (N,) are the weighted sums of the outer
    products of the basis, of basis times u, and of u squared. That of the same line adds.
    """

    information: FloatArray
    moment: FloatArray
    square: FloatArray

    @classmethod
    def of(cls, phi: FloatArray, u: FloatArray, sigma: FloatArray, ends: Sequence[int]) -> Evidence:
        """Groups of points, one after the other.

        Args:
            phi: :func:`basis` of the points (M, 3).
            u: Their place along the horizon from its ``centre_px``, px (M,).
            sigma: Standard deviations of that (M,).
            ends: Where in these arrays each group ends, N indices; none is empty.
        """
        weighted = phi * (sigma**-2.0)[:, None]
        terms = np.column_stack(
            [(phi[:, :, None] * weighted[:, None, :]).reshape(-1, 9), weighted * u[:, None], (u / sigma) ** 2]
        )
        sums = np.add.reduceat(terms, [0, *ends[:-1]], axis=0)
        return cls(sums[:, :9].reshape(-1, 3, 3), sums[:, 9:12], sums[:, 12])

    def __getitem__(self, index: np.ndarray | slice) -> Evidence:
        return Evidence(self.information[index], self.moment[index], self.square[index])

    def __add__(self, other: Evidence) -> Evidence:
        return Evidence(
            self.information + other.information, self.moment + other.moment, self.square + other.square
        )

    def log_evidence(self, horizon: Horizon) -> FloatArray:
        """Log probability (N,) of each group as one line, up to a constant per point."""
        posterior = self.information + horizon.prior_information
        answer = np.linalg.solve(posterior, self.moment[..., None])[..., 0]
        misfit = self.square - np.einsum("ni,ni->n", self.moment, answer)
        prior = float(np.log(np.diag(horizon.prior_information)).sum())
        return np.asarray(-0.5 * (misfit + np.linalg.slogdet(posterior)[1] - prior))

    def curve(self, horizon: Horizon) -> Curve:
        """The line that the first group's points suggest.

        Where lines tend to be says what is one line, not where that one is: of the prior only the curvature's
        is kept, and what makes the answer finite.
        """
        covariance = np.linalg.inv(self.information[0] + horizon.prior_information * _KEPT_PRIOR)
        return Curve(covariance @ self.moment[0] + np.array([horizon.centre_px, 0.0, 0.0]), covariance)


@dataclass(frozen=True)
class Curve:
    """A line: ``parameters`` (3,) a, b, c and their ``covariance`` (3, 3)."""

    parameters: FloatArray
    covariance: FloatArray

    def along(self, phi: FloatArray) -> FloatArray:
        """Where the line is along the horizon (N,), px, where the :func:`basis` is ``phi`` (N, 3)."""
        return np.asarray(phi @ self.parameters)

    def sigma(self, phi: FloatArray) -> FloatArray:
        """Standard deviation (N,) of :meth:`along`, px."""
        return np.asarray(np.sqrt(((phi @ self.covariance) * phi).sum(axis=1)))


def middle_of(first: Curve, second: Curve) -> Curve:
    """The curve half way between two."""
    return Curve((first.parameters + second.parameters) / 2, (first.covariance + second.covariance) / 2)


def basis(below: FloatArray) -> FloatArray:
    """What (a, b, c) are multiplied by (N, 3) at distances (N,) below the horizon, px."""
    v = np.maximum(below, _LEAST_BELOW_PX) / _UNIT_PX
    phi = np.ones((len(v), 3))
    phi[:, 1], phi[:, 2] = v, 1.0 / v
    return phi
