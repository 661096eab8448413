"""The pitch of a camera of which little is known, from the lines that its images show.

Lines painted along a road are parallel on the ground and meet on the horizon of the image. A line of the
image is u = p + q v in pinhole px, v down from the principal point. It passes through the vanishing point
(x, y) if p + q y = x, so that two lines of different slopes give both. Where the road bends its lines turn
together, which moves x alone. One vanishing point does not show the roll of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.records import FloatArray, LaneDetection

_GUESS_SIGMA_RAD = np.deg2rad(6.0)  # standard deviation of a guess of the pitch
_PARALLEL_SIGMA_RAD = 0.015
"""Standard deviation of the directions of one road's lines; 0.012 rad in lanes/curves, whose camera is
known."""

_POINT_SIGMA_PX = 1.0  # least standard deviation of a line beside its own points, px
_MOST_SIGMA_RAD = np.deg2rad(0.6)
"""A pitch of a larger standard deviation is not returned: of 80 up to 1 degree, ten were off by more than
that."""

_OUTLIER_SIGMAS = 2.0  # scale of Cauchy's loss: kerbs, arrows and letters point elsewhere
_STEPS = 20
_VOTES = 3
_AGREE_RAD = np.deg2rad(1.0)
"""A stream has the pitch that this number of images in a row gives within this range."""


@dataclass(frozen=True)
class Pitch:
    """How far a camera's axis points below the horizon, rad, and the standard deviation of that."""

    pitch_rad: float
    sigma_rad: float


def estimate_pitch(lanes: Sequence[LaneDetection], camera: RoadCamera) -> Pitch | None:
    """The pitch of a camera, from the lines of its images; None where they do not show it.

    ``camera`` is as guessed; only its intrinsics and, weakly, its pitch are used.
    """
    lines = [line for lane in lanes if (line := _straight(lane, camera)) is not None]
    focal_px = float(camera.info.intrinsic[1, 1])
    guess_px = -focal_px * np.tan(guessed_pitch_rad(camera))
    if len(lines) < 2:
        return None
    place, slope, covariance = (np.array(column) for column in zip(*lines, strict=True))
    x, y = float(np.median(place + slope * guess_px)), guess_px
    for _ in range(_STEPS):
        design = np.column_stack([np.ones(len(lines)), -slope])
        gradient = np.array([1.0, y])
        model_px = _PARALLEL_SIGMA_RAD * focal_px * np.hypot(1, slope)
        variance = gradient @ covariance @ gradient + model_px**2
        weight = 1 / (1 + (place + slope * y - x) ** 2 / (variance * _OUTLIER_SIGMAS**2))
        rows = design * (weight / variance)[:, None]
        information = design.T @ rows + np.diag([0.0, (focal_px * _GUESS_SIGMA_RAD) ** -2])
        moment = rows.T @ place + [0.0, guess_px * (focal_px * _GUESS_SIGMA_RAD) ** -2]
        x, y = np.linalg.solve(information, moment).tolist()
    sigma_rad = float(np.sqrt(np.linalg.inv(information)[1, 1])) / focal_px
    return Pitch(float(np.arctan2(-y, focal_px)), sigma_rad) if sigma_rad < _MOST_SIGMA_RAD else None


@dataclass
class PitchVote:
    """Collects the pitch of each image of a stream that shows one, until several agree."""

    _found: list[float] = field(default_factory=list)
    _settled: bool = False

    def add(self, lanes: Sequence[LaneDetection], camera: RoadCamera) -> float | None:
        """The pitch, rad, with the first image at which the last ones agree; None before and after that."""
        found = None if self._settled else estimate_pitch(lanes, camera)
        if found is None:
            return None
        self._found.append(found.pitch_rad)
        last = self._found[-_VOTES:]
        self._settled = len(last) == _VOTES and float(np.ptp(last)) < _AGREE_RAD
        return float(np.mean(last)) if self._settled else None


def guessed_pitch_rad(camera: RoadCamera) -> float:
    """How far a camera's axis points below the horizon by its IPM, rad."""
    ahead = camera.pinhole_px_from_vehicle[:, 0]
    direction = np.linalg.solve(camera.info.intrinsic, ahead)
    return float(np.arctan2(-direction[1] * np.sign(direction[2]), abs(direction[2])))


def _straight(lane: LaneDetection, camera: RoadCamera) -> tuple[float, float, FloatArray] | None:
    """A line's place on the principal point's row, its slope, and their covariance (2, 2); None if flat."""
    points = camera.undistort(lane.points_px) - camera.info.intrinsic[:2, 2]
    u, v = points.T
    down = v - v.mean()
    spread = float(down @ down)
    if len(points) < 3 or spread < 1.0:
        return None
    slope = float(down @ u) / spread
    rest = u - u.mean() - slope * down
    variance = max(float(rest @ rest) / len(points), _POINT_SIGMA_PX**2) * np.hypot(1, slope) ** 2
    variance_of_slope = variance * len(points) / spread
    # Neighbours err together: the scatter is taken as that of the mean, not of one point.
    from_mean = np.array([[1.0, -v.mean()], [0.0, 1.0]])
    covariance = from_mean @ np.diag([variance, variance_of_slope]) @ from_mean.T
    return float(u.mean() - slope * v.mean()), slope, covariance
