"""A recorded attitude relative to the road instead of gravity, from the trajectory alone.

The mapper's ground is the plane z = 0. A street has grade, cross-fall and slow undulation, and GNSS
height drifts by decimetres within a minute; none of it concerns the markings' plan. What does is
the vehicle's attitude relative to the road beneath and before it: pitch by acceleration and
suspension moves a ground point at 15 m by about 2.4 m per degree at a car's camera height of 1.65 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.records import FloatArray


@dataclass(frozen=True)
class RoadAttitude:
    """Attitude relative to the road: ``roll_rad`` and ``pitch_rad`` (P,), both without their mean.

    ``mount_pitch_rad`` is that mean of the pitch (positive: sensor nose down): how the sensor's axes
    sit on a vehicle that follows the road. The mean roll is the road's cross-fall or the sensor's
    mount, which no trajectory tells apart; it is taken for cross-fall.
    """

    roll_rad: FloatArray
    pitch_rad: FloatArray
    mount_pitch_rad: float


def attitude_to_road(
    position_enu: FloatArray, roll_rad: FloatArray, pitch_rad: FloatArray, smoothing_m: float
) -> RoadAttitude:
    """Split recorded attitude (P,) into the road's and what the vehicle does upon it.

    The road's grade and cross-fall are local straight-line fits, weighted by a Gaussian of
    ``smoothing_m`` along the path: to the height the grade, to the roll the cross-fall.

    Args:
        position_enu: (P, 3) m.
        roll_rad: against gravity, positive left side up.
        pitch_rad: against gravity, positive nose down.
        smoothing_m: standard deviation of the Gaussian; far longer than a wheelbase.
    """
    steps = np.linalg.norm(np.diff(position_enu[:, :2], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    _, grade = _local_line(path_m, position_enu[:, 2], smoothing_m)
    cross_fall_rad, _ = _local_line(path_m, roll_rad, smoothing_m)
    pitch = pitch_rad + np.arctan(grade)
    roll = roll_rad - cross_fall_rad
    return RoadAttitude(roll - roll.mean(), pitch - pitch.mean(), float(pitch.mean()))


def _local_line(at: FloatArray, values: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Value and slope (P,) of the line fitted to ``values`` around each of ``at``; Gaussian weights.

    Where nearly all weight lies at one place (a vehicle that stands), the slope is zero.
    """
    value, slope = np.empty_like(values), np.empty_like(values)
    for k, here in enumerate(at):
        offset = at - here
        weight = np.exp(-0.5 * (offset / width) ** 2)
        weight /= weight.sum()
        mean_offset, mean_value = weight @ offset, weight @ values
        variance = weight @ (offset - mean_offset) ** 2
        covariance = weight @ ((offset - mean_offset) * (values - mean_value))
        slope[k] = covariance / variance if variance > (0.05 * width) ** 2 else 0.0
        value[k] = mean_value - slope[k] * mean_offset
    return value, slope
