"""What else a table of points could mean: columns exchanged, axes reversed, another unit, another image size.

Each reading is a hypothesis with a prior; the mounting that it leads to counts by how well it explains the
points and by where cameras sit on vehicles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from v2hdm.calibration.angles import mounting_angles
from v2hdm.calibration.fit import Fit, fit_mountings
from v2hdm.calibration.likelihood import Noise, Seen
from v2hdm.calibration.points import SurveyedPoints
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo, FloatArray

_MISREAD = 0.01
"""Prior probability of each way to write the table wrongly."""

_SURE = np.log(1e3)
"""Log odds from which a reading is told as the cause."""

_ROLL_RAD = np.radians(15.0)
"""Standard deviation of the roll of cameras on vehicles."""

_BESIDE_M = 1.5
"""Standard deviation of their place to the left."""

_UNUSUAL = 8.0
"""Log odds at most against an unusual mounting: some cameras hang on their side or head."""

_HEIGHT_M, _LOG_HEIGHT = 2.0, 0.7
"""Median height of cameras on vehicles, m, and the standard deviation of its logarithm."""

_SCALES = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)
"""Usual ratios of the sizes of one camera's images."""

_STARTS, _ROUNDS = 1, 6
"""Enough to tell a reading that explains the points from one that does not."""

UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}
"""Units other than metres, in m."""


@dataclass(frozen=True)
class Misreading:
    """A way in which the table explains itself better: what is wrong with it, and the fit without that."""

    cause: str
    fit: Fit


def misreading(
    points: SurveyedPoints, info: CameraInfo, noise: Noise, given: Fit | None
) -> Misreading | None:
    """The reading under which the points make sense, if they make none as they are.

    Args:
        points: the table.
        info: the camera.
        noise: as stated.
        given: the fit to the table as it is; None where there is none.
    """
    best: Misreading | None = None
    highest = -np.inf
    for cause, points_px, points_vehicle in _readings(points, info):
        seen = Seen.of(points.read_as(points_px, points_vehicle), info, noise)
        for fit in fit_mountings(seen, _STARTS, _ROUNDS):
            score = _score(fit)
            if score > highest:
                best, highest = Misreading(cause, fit), score
    as_given = -np.inf if given is None else _score(given)
    return best if best is not None and highest + np.log(_MISREAD) - as_given > _SURE else None


def unit_of(fit: Fit) -> str | None:
    """The unit of the ground points where it is not the metre, by the height that the camera comes out at."""
    height = camera_centre(fit.cam_from_vehicle)[2]

    def log_odds(metres: float, prior: float) -> float:
        return float(-0.5 * (np.log(height * metres / _HEIGHT_M) / _LOG_HEIGHT) ** 2 + np.log(prior))

    scores = {unit: log_odds(metres, _MISREAD) for unit, metres in UNITS.items()}
    best = max(scores, key=lambda unit: scores[unit])
    return best if scores[best] > log_odds(1.0, 1.0) else None


def _score(fit: Fit) -> float:
    """Log posterior, with how usual the mounting is."""
    roll = mounting_angles(fit.cam_from_vehicle)[0]
    beside = camera_centre(fit.cam_from_vehicle)[1]
    unusual = 0.5 * ((roll / _ROLL_RAD) ** 2 + (beside / _BESIDE_M) ** 2)
    return fit.log_posterior - min(float(unusual), _UNUSUAL)


def _readings(points: SurveyedPoints, info: CameraInfo) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Causes, and the pixels and places without them."""
    px, ground = points.points_px, points.points_vehicle
    mirrored = "y is counted to the right, or x backward; write y positive to the left, x forward"
    yield mirrored, px, ground * [1.0, -1.0]
    yield "x and y are exchanged; x is forward, y to the left", px, ground[:, ::-1].copy()
    swapped = px[:, ::-1].copy()
    yield "u and v are exchanged; u counts columns to the right, v rows down", swapped, ground
    upward = np.column_stack([px[:, 0], info.height - 1 - px[:, 1]])
    yield "v is counted upward from the image's lower edge; count it down from the upper one", upward, ground
    for scale in _SCALES:
        yield (
            f"the pixels are of an image {1 / scale:.3g} times as large as that of the intrinsics; give both "
            "for one size",
            (px + 0.5) * scale - 0.5,
            ground,
        )
