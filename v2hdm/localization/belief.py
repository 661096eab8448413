"""The belief of a localiser on vehicle, cameras and markings in view, as a square-root filter.

The states are the vehicle's (:data:`VEHICLE`), for each camera the tangent (6) of its mounting's error
(:class:`~v2hdm.records.Calibration`), and for each feature that was seen lately its place's error (2), m:
what a map and a calibration are wrong by does not average out over the images. The covariance is
``root @ root.T``; updates work on the whitened state, where the information is never less than one, so that
rounding cannot make it indefinite (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977,
chapter V).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.rigid import make_transform, rotation_from_angles
from v2hdm.localization.motion import ACCELERATION_M_S2, TURN_ACCELERATION_RAD_S2, MotionNoise, Piece
from v2hdm.records import HEAVE_SIGMA_M, FloatArray, IntArray

X, Y, HEADING, SCALE, BIAS, HEIGHT, ROLL, PITCH, SLOW_ROLL, SLOW_PITCH, LATE = range(11)
"""The vehicle's states: place, m, heading, rad, log of true over stated speed, bias of the yaw rate, rad/s,
above the ground of the map height, m, roll and pitch, rad, in a part that changes fast and one that lasts,
and how much later than the images the odometry is stamped, s."""

_PROTECTION_SIGMAS = 3.717  # radius, in sigmas, that one error in a thousand in a plane exceeds

VEHICLE = 11  # number of the vehicle's states
CAMERA = 6  # number of a camera's

# Roll and pitch of a body on its springs, for vehicles of 1 to 6 mrad:
_FAST_RAD = 0.003  # standard deviation, rad, of what a road shakes
_FAST_S = 0.25  # time, s, over which that fades
_SLOW_RAD = 0.003  # standard deviation, rad, of what a bend, a brake or a load holds
_SLOW_S = 4.0  # time, s, over which that fades
_HEAVE_S = 0.5  # time, s, over which a heave fades
_ACCELERATES_S = 1.0  # time, s, for which an acceleration lasts: a brake, or the turn of a steering wheel
_CREEP_M = 1e-5  # change of a mounting's place within a second, m (one sigma)
CREEP_RAD = 1.7e-5
"""Change of a mounting's angles within a second, rad (one sigma): 0.06 deg within an hour."""
TURNING_RAD = 3.5e-4
"""The same of a mounting that is turning slowly: 0.15 deg within a minute."""

_SPRINGS = (
    (HEIGHT, HEAVE_SIGMA_M, _HEAVE_S),
    (ROLL, _FAST_RAD, _FAST_S),
    (PITCH, _FAST_RAD, _FAST_S),
    (SLOW_ROLL, _SLOW_RAD, _SLOW_S),
    (SLOW_PITCH, _SLOW_RAD, _SLOW_S),
)


@dataclass(frozen=True)
class Plane:
    """The map's ground about a place: height, m, and slopes by x and y there."""

    height_m: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Belief:
    """Mean (n,) and root of the states at a time.

    The root has shape (n, n), or (n, m) with m > n as :func:`foresee` leaves it. ``markings`` are the
    numbers, in order, of the map's features whose errors are states: of markings, and behind the last of
    these of stretches of lines and of areas.
    """

    stamp_s: float
    mean: FloatArray
    root: FloatArray
    cameras: int
    markings: tuple[int, ...] = ()

    @property
    def first_marking(self) -> int:
        """The number of the first state of a marking."""
        return VEHICLE + CAMERA * self.cameras

    def state_of(self, marking: int) -> int | None:
        """The first of a marking's two states."""
        if marking not in self.markings:
            return None
        return self.first_marking + 2 * self.markings.index(marking)

    def states_of(self, markings: IntArray) -> IntArray:
        """The first of the two states of markings (M,), -1 for one without."""
        is_same = markings[:, None] == np.array(self.markings, dtype=np.int64)
        place = is_same @ np.arange(1, len(self.markings) + 1)
        return np.where(place > 0, self.first_marking + 2 * (place - 1), -1)

    def covariance(self, states: Sequence[int]) -> FloatArray:
        """The covariance of some states."""
        rows = self.root[list(states)]
        return np.asarray(rows @ rows.T)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the place, both directions together."""
        return float(np.linalg.norm(self.root[:2]))

    def map_from_vehicle(self, plane: Plane) -> FloatArray:
        """The pose (4, 4) over the map's ground."""
        vehicle = self.mean[:VEHICLE].tolist()
        cos = math.cos(vehicle[HEADING])
        sin = math.sin(vehicle[HEADING])
        along = plane.slope[0] * cos + plane.slope[1] * sin
        left = plane.slope[1] * cos - plane.slope[0] * sin
        roll = math.atan(left) + vehicle[ROLL] + vehicle[SLOW_ROLL]
        pitch = -math.atan(along) + vehicle[PITCH] + vehicle[SLOW_PITCH]
        rotation = rotation_from_angles(roll, pitch, vehicle[HEADING])
        place = np.array([vehicle[X], vehicle[Y], plane.height_m + vehicle[HEIGHT]])
        return make_transform(rotation, place)


def start(
    stamp_s: float,
    pose: FloatArray,
    sigma: FloatArray,
    mountings: Sequence[FloatArray],
    noise: MotionNoise,
) -> Belief:
    """The belief at a pose (3,) of x, y and heading with standard deviations (3,).

    ``mountings`` are the covariances (6, 6) of the cameras' calibrations.
    """
    vehicle = [*sigma, noise.scale, noise.bias_rad_s, *(spring[1] for spring in _SPRINGS), noise.late_s]
    count = VEHICLE + CAMERA * len(mountings)
    root = np.zeros((count, count))
    root[range(VEHICLE), range(VEHICLE)] = vehicle
    for camera, covariance in enumerate(mountings):
        begin = VEHICLE + CAMERA * camera
        values, axes = np.linalg.eigh(covariance)
        root[begin : begin + CAMERA, begin : begin + CAMERA] = axes * np.sqrt(np.maximum(values, 0.0))
    mean = np.zeros(count)
    mean[:3] = pose
    return Belief(stamp_s, mean, root, len(mountings))


def predict(
    belief: Belief,
    pieces: Sequence[Piece],
    noise: MotionNoise,
    turning: Collection[int] = (),
    has_untold: bool = False,
) -> Belief:
    """The belief after pieces of motion; the mountings of some cameras are ``turning``.

    With ``has_untold`` it may be off by what a late odometry has not told yet. That is not to be carried on
    from image to image: once it is told, the next pieces have it.
    """
    belief_ahead = foresee(belief, pieces, noise, turning, has_untold)
    if belief_ahead.root.shape[1] == len(belief_ahead.mean):
        return belief_ahead
    return replace(belief_ahead, root=_square(belief_ahead.root))


def foresee(
    belief: Belief,
    pieces: Sequence[Piece],
    noise: MotionNoise,
    turning: Collection[int] = (),
    has_untold: bool = False,
) -> Belief:
    """As :func:`predict`, with a wide root: for a look ahead that nothing is to correct, in less time."""
    if not pieces:
        return belief
    mean = belief.mean.copy()
    change = np.eye(VEHICLE)
    spread = np.zeros((VEHICLE, VEHICLE))
    for piece in pieces:
        step, by_state, pushed = _step(mean, piece, noise)
        mean[:VEHICLE] = step
        change = by_state @ change
        spread = by_state @ spread @ by_state.T + pushed
    if has_untold:
        late_s2 = float(belief.root[LATE] @ belief.root[LATE])
        spread += _untold(mean, late_s2, sum(piece.length_s for piece in pieces))
    length_s = sum(piece.length_s for piece in pieces)
    width = belief.root.shape[1]
    creep_rad = [TURNING_RAD if camera in turning else CREEP_RAD for camera in range(belief.cameras)]
    creep = np.repeat([[_CREEP_M, angle_rad] for angle_rad in creep_rad], 3) * np.sqrt(length_s)
    values, axes = np.linalg.eigh(spread)
    grown = np.zeros((len(mean), width + belief.first_marking))
    grown[:, :width] = belief.root
    grown[:VEHICLE, :width] = change @ belief.root[:VEHICLE]
    grown[:VEHICLE, width : width + VEHICLE] = axes * np.sqrt(np.maximum(values, 0.0))
    mountings = np.arange(VEHICLE, belief.first_marking)
    grown[mountings, width + mountings] = creep
    return replace(belief, stamp_s=belief.stamp_s + length_s, mean=mean, root=grown)


def _untold(mean: FloatArray, late_s2: float, length_s: float) -> FloatArray:
    """The covariance (11, 11) of the vehicle's motion since the newest odometry, which is late.

    ``late_s2`` is the variance of the lateness, s^2. The last speed and yaw rate are taken to last until now;
    accelerations since then move the place along and the heading. The last belief, ``length_s`` ago, was
    off by as much, but for what the accelerations have changed by: these fade as a first-order process.
    """
    changed = math.sqrt(2 * (1 - math.exp(-length_s / _ACCELERATES_S)))
    half_s2 = 0.5 * (float(mean[LATE]) ** 2 + late_s2) * changed
    ahead = np.array([np.cos(mean[HEADING]), np.sin(mean[HEADING])])
    covariance = np.zeros((VEHICLE, VEHICLE))
    covariance[:2, :2] = (half_s2 * ACCELERATION_M_S2) ** 2 * np.outer(ahead, ahead)
    covariance[HEADING, HEADING] = (half_s2 * TURN_ACCELERATION_RAD_S2) ** 2
    return covariance


def _step(mean: FloatArray, piece: Piece, noise: MotionNoise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means of the vehicle's states after a piece, their derivatives, and the noise's covariance."""
    length_s = piece.length_s
    out = mean[:VEHICLE].copy()
    turn = piece.yaw_rate_rad_s - mean[BIAS]
    speed = piece.speed_m_s * np.exp(mean[SCALE])
    middle = mean[HEADING] + 0.5 * turn * length_s
    ahead = np.array([np.cos(middle), np.sin(middle)])
    left = np.array([-ahead[1], ahead[0]])
    # A late odometry states the motion of a piece over a piece that begins and ends later by as much.
    faster_m_s = piece.faster_m_s * np.exp(mean[SCALE])
    way_m = speed * length_s + mean[LATE] * faster_m_s
    out[:2] += way_m * ahead
    out[HEADING] += turn * length_s + mean[LATE] * piece.turning_more_rad_s
    change = np.eye(VEHICLE)
    change[:2, HEADING] = way_m * left
    change[:2, SCALE] = way_m * ahead
    change[:2, BIAS] = -0.5 * length_s * way_m * left
    change[HEADING, BIAS] = -length_s
    change[:2, LATE] = faster_m_s * ahead
    change[HEADING, LATE] = piece.turning_more_rad_s
    way_m2 = noise.speed_m_sqrt_s**2 * length_s + (piece.speed_sigma_m_s * length_s) ** 2
    yaw_rad2 = noise.yaw_rad_sqrt_s**2 * length_s + (piece.yaw_rate_sigma_rad_s * length_s) ** 2
    pushed = np.zeros((VEHICLE, VEHICLE))
    pushed[:2, :2] = way_m2 * np.outer(ahead, ahead) + noise.slip_m_sqrt_s**2 * length_s * np.outer(
        left, left
    )
    pushed[HEADING, HEADING] = yaw_rad2
    pushed[BIAS, BIAS] = noise.bias_walk_rad_s**2 * length_s
    pushed[LATE, LATE] = noise.late_walk_s**2 * length_s
    for state, sigma, fades_s in _SPRINGS:
        keeps = np.exp(-length_s / fades_s)
        out[state] *= keeps
        change[state, state] = keeps
        pushed[state, state] = sigma**2 * (1 - keeps**2)
    return out, change, pushed


def with_markings(belief: Belief, markings: Sequence[int], priors: Sequence[FloatArray]) -> Belief:
    """The belief with the places' errors of more markings, of covariances (2, 2) each."""
    if not markings:
        return belief
    count = len(belief.mean)
    root = np.zeros((count + 2 * len(markings),) * 2)
    root[:count, :count] = belief.root
    for number, prior in enumerate(priors):
        begin = count + 2 * number
        values, axes = np.linalg.eigh(prior)
        root[begin : begin + 2, begin : begin + 2] = axes * np.sqrt(np.maximum(values, 1e-12))
    mean = np.concatenate([belief.mean, np.zeros(2 * len(markings))])
    return replace(belief, mean=mean, root=root, markings=(*belief.markings, *markings))


def only_markings(belief: Belief, markings: Sequence[int]) -> Belief:
    """The belief without the states of all other markings."""
    numbers = [number for number, marking in enumerate(belief.markings) if marking in set(markings)]
    if len(numbers) == len(belief.markings):
        return belief
    first = belief.first_marking
    rows = [*range(first), *(first + 2 * number + axis for number in numbers for axis in (0, 1))]
    return replace(
        belief,
        mean=belief.mean[rows],
        root=_square(belief.root[rows]),
        markings=tuple(belief.markings[number] for number in numbers),
    )


def with_latest(belief: Belief, features: Sequence[int], most: int) -> Belief:
    """The belief with so many of the features that were seen last; ``features`` are seen now."""
    earlier = [feature for feature in belief.markings if feature not in set(features)]
    order = [*earlier, *features]
    return belief if len(order) <= most else only_markings(belief, order[-most:])


def loosened(belief: Belief, cameras: Sequence[int], sigma_rad: float) -> Belief:
    """The belief in which the mountings of cameras may each have turned by so much since."""
    rows = [VEHICLE + CAMERA * camera + axis for camera in cameras for axis in (3, 4, 5)]
    return _widened(belief, rows, sigma_rad)


def perhaps_later(belief: Belief, sigma_s: float) -> Belief:
    """The belief in which the odometry may be later, or earlier, than was thought by so much."""
    return _widened(belief, [LATE], sigma_s)


def _widened(belief: Belief, states: Sequence[int], sigma: float) -> Belief:
    """The belief in which some states may each have changed by so much."""
    rows = list(states)
    count = len(belief.mean)
    grown = np.concatenate([belief.root, np.zeros((count, len(rows)))], axis=1)
    grown[rows, range(count, count + len(rows))] = sigma
    return replace(belief, root=_square(grown))


def pinned(belief: Belief, states: Sequence[int], values: FloatArray, sigma: float) -> Belief:
    """The belief in which some states (K,) are known to have values (K,) with a standard deviation."""
    rows = list(states)
    return corrected(belief, (values - belief.mean[rows]) / sigma, belief.root[rows] / sigma)


def corrected(belief: Belief, residual: FloatArray, slope: FloatArray) -> Belief:
    """The belief after measurements (R,) of unit noise.

    ``residual`` (R,) is measured less expected, ``slope`` (R, n) the derivative of what is expected by the
    whitened states.
    """
    inner = np.linalg.inv(np.linalg.cholesky(np.eye(len(belief.mean)) + slope.T @ slope))
    root = belief.root @ inner.T
    mean = belief.mean + root @ (inner @ (slope.T @ residual))
    return replace(belief, mean=mean, root=root)


def bounds(covariance: FloatArray, heading_rad: float) -> tuple[float, float, float]:
    """Bounds ahead, to the left and of the heading that one error in a thousand exceeds."""
    c = np.cos(heading_rad)
    s = np.sin(heading_rad)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    sigma = np.sqrt(np.diag(turn @ covariance @ turn.T))
    ahead, left, heading = (_PROTECTION_SIGMAS * sigma).tolist()
    return ahead, left, heading


def _square(root: FloatArray) -> FloatArray:
    """A square root (n, n) of the covariance that a wide one (n, m) has."""
    upper: FloatArray = np.asarray(np.linalg.qr(root.T, mode="r"))  # without its orthogonal factor
    return upper.T
