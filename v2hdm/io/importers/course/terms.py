"""The terms that hold a vehicle's path together: residuals in sigmas, and their derivatives.

A state has per epoch the rear axle's place in the plane (2), the heading, the speed, the curvature and the
drift of the position (2); and for the whole drive :class:`Shared`. All residuals of one kind are one
:class:`Term`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from v2hdm.io.importers.course.recording import LONGEST_S, Course
from v2hdm.records import FloatArray, IntArray


class Epoch(IntEnum):
    """Places of an epoch's unknowns."""

    X = 0
    Y = 1
    HEADING = 2
    SPEED = 3
    CURVATURE = 4
    DRIFT_X = 5
    DRIFT_Y = 6


class Shared(IntEnum):
    """Places of the drive's unknowns."""

    GYRO_BIAS = 0  # rad/s
    GYRO_SCALE = 1  # of its turn less the true one
    LEVER = 2  # m that the antenna is farther ahead than stated
    SLIP = 3  # angle of the axle's slip by its sideways acceleration, rad per m/s2
    WHEELS = 4  # scale of the wheels' speed less 1


WIDTH = len(Epoch)
SHARED_SIGMAS = np.array([
    0.05,  # gyro bias, rad/s: the zero-rate offset of cheap MEMS gyros is 1 to 3 deg/s (data sheets)
    0.01,  # gyro scale: 1 % of MEMS (data sheets)
    0.03,  # antenna along the vehicle, m: measured with a tape
    0.005,  # slip, about SLIP
    0.03,  # wheels' scale: pressure and wear of tyres
])  # fmt: skip
"""Standard deviations of the drive's unknowns before it."""

SLIP = 0.005
"""The slip before the drive, rad per m/s2: a tyre's normalised cornering stiffness, 10 to 20 per rad
(Pacejka, Tire and Vehicle Dynamics), gives .005 to .01; a stiff axle at a crawl gives none."""

_ACCELERATION = 1.4  # of the speed after a second, m/s: accelerations of 1 m/s2 that last a second
_STEERING = 0.08  # sigma of a second's change of curvature, 1/m: tractors need 2 to 3 s to full lock
_SPEED_M_S = 20.0  # standard deviation of the speed before the drive, m/s
_CURVATURE_PER_M = 0.15  # standard deviation of the curvature before the drive: circles of 7 m
_SLIP_M = 0.003  # the way sideways after a metre, m: uneven ground; a course of .1 deg over 3 m
_STEER_RAD = 5e-4  # the turn that curvature does not tell after a metre, rad
_STILL_M = 5e-4  # the way of a standing vehicle from epoch to epoch, m: it rocks
_STILL_RAD = 1e-4  # the turn of a standing vehicle from epoch to epoch, rad
_GYRO_RAD = 1.8e-4  # angle random walk after a second, rad: .01 deg/s per root of Hz (data sheets of MEMS)
_WHEELS_M_S = 0.03  # noise of a wheel's speed, m/s: counts of an encoder
_DRIFT_SHARE = 0.5  # of a position's variance, that drifts: as in records.PoseNoise
_DRIFT_OVER_M = 30.0  # distance over which a position's drift fades, m: as in records.PoseNoise
_LEAST_WAY_M = 0.01  # least way per epoch over which a drift fades, m: it fades with time, too


@dataclass(frozen=True)
class Term:
    """Residuals (R,) in sigmas, with derivatives (R, C) by unknowns whose columns are (R, C)."""

    name: str
    residual: FloatArray
    derivative: FloatArray
    column: IntArray


@dataclass(frozen=True)
class State:
    """The unknowns: of epochs (P, 7) and shared (5,)."""

    epochs: FloatArray
    shared: FloatArray

    def moved(self, step: FloatArray) -> State:
        """The state a ``step`` (7 P + 5,) away."""
        count = self.epochs.size
        return State(self.epochs + step[:count].reshape(self.epochs.shape), self.shared + step[count:])


def terms_of(course: Course, state: State, way_m: FloatArray) -> list[Term]:
    """All residuals; ``way_m`` (P - 1,) is the way between epochs; noise grows with it."""
    return [
        _positions(course, state),
        _drifts(course, state, way_m),
        *_motion(course, state, way_m),
        *_inputs(course, state),
        *_priors(state),
    ]


def _columns(rows: IntArray, *places: int) -> IntArray:
    """Columns (R, C) of unknowns of epochs ``rows`` (R,)."""
    return np.asarray(np.column_stack([WIDTH * rows + place for place in places]))


def _shared_columns(count: int, state: State, *places: int) -> IntArray:
    """Columns (R, C) of shared unknowns, the same for ``count`` residuals."""
    return np.asarray(np.tile(np.array(places) + state.epochs.size, (count, 1)))


def _white(sigma_m: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(1 - _DRIFT_SHARE) * sigma_m)


def _positions(course: Course, state: State) -> Term:
    """The antenna is where its position says, but for noise and drift."""
    epochs = state.epochs
    rows = np.arange(len(epochs))
    cosine = np.cos(epochs[:, Epoch.HEADING])
    sine = np.sin(epochs[:, Epoch.HEADING])
    ahead = course.lever_arm_m[0] + state.shared[Shared.LEVER]
    left = course.lever_arm_m[1]
    offset_x = cosine * ahead - sine * left
    offset_y = sine * ahead + cosine * left
    sigma = _white(course.sigma_m)
    ones = np.ones(len(rows))
    residual_x = epochs[:, Epoch.X] + offset_x + epochs[:, Epoch.DRIFT_X] - course.antenna_map[:, 0]
    residual_y = epochs[:, Epoch.Y] + offset_y + epochs[:, Epoch.DRIFT_Y] - course.antenna_map[:, 1]
    by_x = np.column_stack([ones, -offset_y, ones, cosine])
    by_y = np.column_stack([ones, offset_x, ones, sine])
    lever = _shared_columns(len(rows), state, Shared.LEVER)
    columns_x = np.hstack([_columns(rows, Epoch.X, Epoch.HEADING, Epoch.DRIFT_X), lever])
    columns_y = np.hstack([_columns(rows, Epoch.Y, Epoch.HEADING, Epoch.DRIFT_Y), lever])
    return Term(
        "positions",
        np.concatenate([residual_x / sigma, residual_y / sigma]),
        np.concatenate([by_x / sigma[:, None], by_y / sigma[:, None]]),
        np.concatenate([columns_x, columns_y]),
    )


def _drifts(course: Course, state: State, way_m: FloatArray) -> Term:
    """Drifts fade over a distance (a Gauss-Markov process)."""
    rows = np.arange(len(way_m))
    fading = np.exp(-np.maximum(way_m, _LEAST_WAY_M) / _DRIFT_OVER_M)
    total = np.sqrt(_DRIFT_SHARE) * float(np.median(course.sigma_m))
    sigma = total * np.sqrt(1 - fading**2)
    residuals = []
    derivatives = []
    columns = []
    for place in (Epoch.DRIFT_X, Epoch.DRIFT_Y):
        drift = state.epochs[:, place]
        residuals.append(np.concatenate([[drift[0] / total], (drift[1:] - fading * drift[:-1]) / sigma]))
        derivatives.append(np.vstack([[[0.0, 1 / total]], np.column_stack([-fading / sigma, 1 / sigma])]))
        # The first epoch's residual has no epoch before it: its derivative by that one is 0.
        before = np.concatenate([[1], rows])
        after = np.concatenate([[0], rows + 1])
        columns.append(np.column_stack([WIDTH * before + place, WIDTH * after + place]))
    return Term("drift", np.concatenate(residuals), np.concatenate(derivatives), np.concatenate(columns))


def _motion(course: Course, state: State, way_m: FloatArray) -> list[Term]:
    """The axle rolls along an arc: along it, sideways, in heading, in speed and in curvature."""
    rows = np.flatnonzero(course.interval_s <= LONGEST_S)
    interval_s = course.interval_s[rows]
    way_m = way_m[rows]
    first = state.epochs[rows]
    last = state.epochs[rows + 1]
    speed = 0.5 * (first[:, Epoch.SPEED] + last[:, Epoch.SPEED])
    curvature = 0.5 * (first[:, Epoch.CURVATURE] + last[:, Epoch.CURVATURE])
    slip = state.shared[Shared.SLIP]
    acceleration = speed * np.abs(speed) * curvature  # the slip turns round with the direction
    course_rad = 0.5 * (first[:, Epoch.HEADING] + last[:, Epoch.HEADING]) - slip * acceleration
    cosine = np.cos(course_rad)
    sine = np.sin(course_rad)
    step = last[:, :2] - first[:, :2]
    ahead = cosine * step[:, 0] + sine * step[:, 1]
    aside = -sine * step[:, 0] + cosine * step[:, 1]
    way = speed * interval_s
    by_speed = -slip * np.abs(speed) * curvature  # of the course, by the speed of one epoch
    by_curvature = -0.5 * slip * speed * np.abs(speed)
    shared = _shared_columns(len(rows), state, Shared.SLIP)
    pair = (Epoch.X, Epoch.Y, Epoch.HEADING, Epoch.SPEED, Epoch.CURVATURE)
    columns = np.hstack([_columns(rows, *pair), _columns(rows + 1, *pair), shared])
    sigma_ahead = np.hypot(0.3 * _ACCELERATION * interval_s**1.5, _STILL_M)
    sigma_aside = np.hypot(_SLIP_M * np.sqrt(way_m), _STILL_M)

    def columns_of(by_x: FloatArray, by_y: FloatArray, by_course: FloatArray, more: FloatArray) -> FloatArray:
        sides = [0.5 * by_course, by_speed * by_course + more, by_curvature * by_course]
        whole = [-by_x, -by_y, *sides, by_x, by_y, *sides, -acceleration * by_course]
        return np.column_stack(whole)

    nothing = np.zeros(len(rows))
    along = columns_of(cosine, sine, aside, -0.5 * interval_s)
    across = columns_of(-sine, cosine, -ahead, nothing)
    sigma_turn = np.hypot(_STEER_RAD * np.sqrt(way_m), _STILL_RAD)
    turn = last[:, Epoch.HEADING] - first[:, Epoch.HEADING] - curvature * way
    ones = np.ones(len(rows))
    sides = [-0.5 * interval_s * curvature, -0.5 * way]
    by_turn = np.column_stack([-ones, *sides, ones, *sides])
    of_turn = (Epoch.HEADING, Epoch.SPEED, Epoch.CURVATURE)
    return [
        Term("rolling", (ahead - way) / sigma_ahead, along / sigma_ahead[:, None], columns),
        Term("slip", aside / sigma_aside, across / sigma_aside[:, None], columns),
        Term(
            "turning",
            turn / sigma_turn,
            by_turn / sigma_turn[:, None],
            np.hstack([_columns(rows, *of_turn), _columns(rows + 1, *of_turn)]),
        ),
        _walk("speed", Epoch.SPEED, _ACCELERATION, course.interval_s, state),
        _walk("curvature", Epoch.CURVATURE, _STEERING, course.interval_s, state),
    ]


def _walk(name: str, place: Epoch, after_a_second: float, interval_s: FloatArray, state: State) -> Term:
    """An unknown that changes little from epoch to epoch."""
    rows = np.arange(len(interval_s))
    weight = 1 / (after_a_second * np.sqrt(interval_s))
    change = np.diff(state.epochs[:, place])
    columns = np.column_stack([WIDTH * rows + place, WIDTH * (rows + 1) + place])
    return Term(name, change * weight, np.column_stack([-weight, weight]), columns)


def _inputs(course: Course, state: State) -> list[Term]:
    """The gyro's turns and the wheels' speeds."""
    epochs = state.epochs
    rows = np.flatnonzero(np.isfinite(course.turn_rad))
    interval_s = course.interval_s[rows]
    weight = 1 / (_GYRO_RAD * np.sqrt(interval_s))
    turn = epochs[rows + 1, Epoch.HEADING] - epochs[rows, Epoch.HEADING]
    scale = 1 + state.shared[Shared.GYRO_SCALE]
    gyro = scale * turn + state.shared[Shared.GYRO_BIAS] * interval_s - course.turn_rad[rows]
    by_gyro = np.column_stack([np.full(len(rows), -scale), np.full(len(rows), scale), interval_s, turn])
    heading = np.hstack([_columns(rows, Epoch.HEADING), _columns(rows + 1, Epoch.HEADING)])
    of_gyro = _shared_columns(len(rows), state, Shared.GYRO_BIAS, Shared.GYRO_SCALE)
    driven = np.flatnonzero(np.isfinite(course.speed_m_s))
    speed = 0.5 * (epochs[driven, Epoch.SPEED] + epochs[driven + 1, Epoch.SPEED])
    # Wheels that do not count backward give the amount.
    sign = np.where(speed * course.speed_m_s[driven] < 0, -1.0, 1.0)
    wheels = 1 + state.shared[Shared.WHEELS]
    off = (wheels * speed - sign * course.speed_m_s[driven]) / _WHEELS_M_S
    half = np.full(len(driven), 0.5 * wheels / _WHEELS_M_S)
    by_wheels = np.column_stack([half, half, speed / _WHEELS_M_S])
    of_wheels = np.hstack([
        _columns(driven, Epoch.SPEED), _columns(driven + 1, Epoch.SPEED),
        _shared_columns(len(driven), state, Shared.WHEELS),
    ])  # fmt: skip
    return [
        Term("gyro", gyro * weight, by_gyro * weight[:, None], np.hstack([heading, of_gyro])),
        Term("wheels", off, by_wheels, of_wheels),
    ]


def _priors(state: State) -> list[Term]:
    """The priors; curvature stays small also where the vehicle stands."""
    count = len(SHARED_SIGMAS)
    expected = np.zeros(count)
    expected[Shared.SLIP] = SLIP
    first = np.array([Epoch.SPEED])
    epochs = np.arange(len(state.epochs))
    # One hold on the curvature every epoch would pull curves straight: together they are one.
    curvature_sigma = _CURVATURE_PER_M * np.sqrt(len(epochs))
    curvature = state.epochs[:, Epoch.CURVATURE] / curvature_sigma
    return [
        Term(
            "priors",
            (state.shared - expected) / SHARED_SIGMAS,
            (1 / SHARED_SIGMAS)[:, None],
            (state.epochs.size + np.arange(count))[:, None],
        ),
        Term(
            "first speed",
            state.epochs[:1, Epoch.SPEED] / _SPEED_M_S,
            np.full((1, 1), 1 / _SPEED_M_S),
            first[:, None],
        ),
        Term(
            "curves",
            curvature,
            np.full((len(epochs), 1), 1 / curvature_sigma),
            _columns(epochs, Epoch.CURVATURE),
        ),
    ]
