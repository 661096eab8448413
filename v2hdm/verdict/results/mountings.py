"""Two estimates of one camera's mounting, compared."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import inverse, log
from v2hdm.records import Calibration, FloatArray

_LEAST_VARIANCE = np.array([1e-8] * 3 + [1e-10] * 3)
"""Added to a covariance's diagonal (m^2, rad^2): a tenth of a millimetre, a thousandth of a degree."""


def mounting_sigmas(one: Calibration, other: Calibration, of_both: bool = False) -> float:
    """Distance of two mountings: root of the mean squared deviation of their six parameters, in sigmas.

    ``one`` knows less; where ``other`` rests on the same data, its covariance must not be added.

    Args:
        one: its covariance is what the deviation is measured by.
        other: the other one.
        of_both: whether they are independent, so that both covariances count.
    """
    assert one.covariance is not None
    covariance = one.covariance + np.diag(_LEAST_VARIANCE)
    if of_both and other.covariance is not None:
        covariance = covariance + other.covariance
    off = mounting_difference(one, other)
    return float(np.sqrt(off @ np.linalg.solve(covariance, off) / len(off)))


def mounting_difference(one: Calibration, other: Calibration) -> FloatArray:
    """The left tangent (6,) from ``other`` to ``one``: translation m, rotation rad."""
    return log(one.cam_from_vehicle @ inverse(other.cam_from_vehicle))


def centre_sigma_m(calibration: Calibration) -> FloatArray:
    """Standard deviations (3,) of a camera's centre along the vehicle's axes; 0 without a covariance."""
    if calibration.covariance is None:
        return np.zeros(3)
    rotation = calibration.cam_from_vehicle[:3, :3]
    return np.sqrt(np.diagonal(rotation.T @ calibration.covariance[:3, :3] @ rotation))
