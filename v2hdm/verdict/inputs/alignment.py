r"""The constant angle between heading and course: a heading that is off, or a vehicle that drives askew.

The rear axle goes where the vehicle points. Under a heading that is off by b, recorded positions therefore
leave the path that follows the heading, to the side, by b times the driven distance x:

.. math:: y_i = y_0 + b x_i + e_i.

The errors e are those of the positions (white and drift), those of the path that follows the heading (its
drift integrated over the way, its white noise summed over the poses), and the way to the side of a point that
is not at the axle, as the heading turns. Their covariance is the stated one, or larger where the residuals
are. Straight stretches yield b by generalised least squares: 60 m of road know it to some hundredths of a
degree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from v2hdm.records import Camera, FloatArray, PoseNoise
from v2hdm.verdict.inputs.poses import Motion
from v2hdm.verdict.verdict import Finding, Status, judge, passed

CHECK = "heading offset"

_LARGEST_RAD = np.deg2rad(1.0)
"""Largest offset that passes where no camera's centre is surveyed, which a heading could contradict."""

_ASKEW_RAD = np.deg2rad(0.25)
"""Angle by which the axles of a sound vehicle may steer it aside: the tolerance of a wheel alignment."""

_CONVENTION_DEG = 15.0  # a larger angle is a wrong convention, which the check of the heading names
_SURE = 4.0  # sigmas of an estimated offset beyond which it is reported
_TURNED_RAD = np.deg2rad(30.0)  # turn that tells a heading's error from a camera's yaw; chosen
_STRAIGHT_RAD = np.deg2rad(2.0)  # turn of the heading within a straight stretch, at most
_SHORTEST_M = 10.0  # length of a straight stretch: on a shorter one, positions move less than their noise
_ORIGIN_M = 1.0  # usual distance, m, of an origin that is not at the axle
_LEAST_NOISE_M = 1e-4  # of positions without noise, whose covariance would be singular
_MOST_POSES = 300  # of a stretch: more of them know no more than their drift allows


class _Slope(NamedTuple):
    """The course minus the heading on one stretch."""

    offset_rad: float
    variance: float  # rad^2, by the stated noise
    squared: float  # sum of squared residuals, in sigmas
    freedom: int  # of that sum


class _Tolerance(NamedTuple):
    """The largest angle that passes."""

    camera: str  # whose survey a larger one contradicts; empty where none is surveyed as closely
    away_m: float  # distance of its centre from the axle
    angle_rad: float


def check_alignment(
    motion: Motion, noise: PoseNoise, cameras: Mapping[str, Camera], *, by_course: bool = False
) -> Iterator[Finding]:
    """Whether the vehicle drives where its heading points, as closely as the cameras' surveys need it.

    ``by_course`` states that the headings were made of the course.
    """
    if not len(motion.chords):
        return  # the check of the path's length says so
    if by_course:
        yield _of_course(motion)
        return
    finding = _constant_offset(motion, noise, cameras)
    if finding.value is None or abs(finding.value) < _CONVENTION_DEG:
        yield finding


def _of_course(motion: Motion) -> Finding:
    """The finding on a drive whose headings are its course, which leaves the yaw of the mounting open."""
    turned_deg = float(np.rad2deg(np.ptp(_heading_rad(motion))))
    least_deg = float(np.rad2deg(_TURNED_RAD))
    if turned_deg >= least_deg:
        says = "headings are the course of the rear axle: a constant error of theirs is in the cameras' yaw"
        return Finding(CHECK, Status.PASS, turned_deg, least_deg, "deg", says, "poses")
    says = (
        f"headings are the course, and the drive turns by {turned_deg:.0f} deg only: a constant error of the "
        "heading and the cameras' yaw look the same, as does an antenna elsewhere; include a turn"
    )
    return Finding(CHECK, Status.WARN, turned_deg, least_deg, "deg", says, "poses")


def _constant_offset(motion: Motion, noise: PoseNoise, cameras: Mapping[str, Camera]) -> Finding:
    slopes = [slope for stretch in _stretches(motion) if (slope := _slope(motion, noise, stretch))]
    if not slopes:
        return passed(CHECK, "poses", "the route has no straight stretch that would show it")
    information = sum(1 / slope.variance for slope in slopes)
    offset_rad = sum(slope.offset_rad / slope.variance for slope in slopes) / information
    scatter = sum(slope.squared for slope in slopes) / sum(slope.freedom for slope in slopes)
    sigma_rad = float(np.sqrt(max(scatter, 1.0) / information))
    size_rad = abs(offset_rad)
    tolerance = _tolerance(cameras)
    moves = ""
    if tolerance.camera:
        by_cm = 100 * tolerance.away_m * size_rad
        moves = f", which moves the surveyed centre of {tolerance.camera} by {by_cm:.0f} cm"
    return judge(
        CHECK, "poses", float(np.rad2deg(offset_rad)),
        float(np.rad2deg(tolerance.angle_rad + _SURE * sigma_rad)), "deg",
        fine="on straight stretches the vehicle goes where its heading points",
        wrong=f"on straight stretches the vehicle drives {np.rad2deg(size_rad):.1f} deg to the "
        f"{'left' if offset_rad > 0 else 'right'} of its heading{moves}; fix the alignment of the heading's "
        "antennas",
        status=Status.WARN,
    )  # fmt: skip


def _tolerance(cameras: Mapping[str, Camera]) -> _Tolerance:
    """The angle by which a heading moves no surveyed centre, in the frame of the poses, by over a sigma."""
    first = _Tolerance("", 0.0, float(_LARGEST_RAD))
    for name, camera in cameras.items():
        prior = camera.centre_prior
        if prior is None:
            continue
        away_m = float(np.hypot(*prior.centre_vehicle[:2]))
        angle_rad = float(np.max(prior.sigma_m[:2])) / max(away_m, 1e-9)
        if angle_rad < first.angle_rad:
            first = _Tolerance(name, away_m, angle_rad)
    return first._replace(angle_rad=max(first.angle_rad, float(_ASKEW_RAD)))


def _heading_rad(motion: Motion) -> FloatArray:
    """Headings (P,), unwrapped."""
    return np.unwrap(np.arctan2(motion.rotation[:, 1, 0], motion.rotation[:, 0, 0]))


def _stretches(motion: Motion) -> Iterator[slice]:
    """Straight stretches of the poses, one after the other: each ends where the heading has turned away."""
    heading_rad = _heading_rad(motion)
    begin = 0
    count = len(heading_rad)
    while begin < count:
        width = 64
        while True:
            away = np.abs(heading_rad[begin : begin + width] - heading_rad[begin]) > _STRAIGHT_RAD
            if away.any() or begin + width >= count:
                break
            width *= 2
        end = begin + int(np.argmax(away)) if away.any() else count
        yield slice(begin, end)
        begin = end


def _slope(motion: Motion, noise: PoseNoise, stretch: slice) -> _Slope | None:
    """The offset on one stretch; None where that is too short."""
    position = motion.position[stretch, :2]
    forward = motion.rotation[stretch, :2, 0]
    if len(position) < 3:
        return None
    middle = forward[:-1] + forward[1:]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    step = np.diff(position, axis=0)
    along_m = np.concatenate([[0.0], np.cumsum((step * middle).sum(axis=1))])
    left = np.column_stack([-middle[:, 1], middle[:, 0]])
    aside_m = np.concatenate([[0.0], np.cumsum((step * left).sum(axis=1))])
    if np.ptp(along_m) < _SHORTEST_M:
        return None
    picked = np.unique(np.linspace(0, len(position) - 1, min(len(position), _MOST_POSES)).astype(np.intp))
    turned_rad = (_heading_rad(motion)[stretch] - _heading_rad(motion)[stretch.start])[picked]
    covariance = _covariance(noise, along_m[picked], float(np.abs(np.diff(along_m)).mean()), turned_rad)
    design = np.column_stack([np.ones(len(picked)), along_m[picked]])
    whitened = np.linalg.solve(covariance, np.column_stack([design, aside_m[picked]]))
    inverse = np.linalg.inv(design.T @ whitened[:, :2])
    solution = inverse @ design.T @ whitened[:, 2]
    residual = aside_m[picked] - design @ solution
    squared = float(residual @ (whitened[:, 2] - whitened[:, :2] @ solution))
    return _Slope(float(solution[1]), float(inverse[1, 1]), squared, len(picked) - 2)


def _covariance(noise: PoseNoise, along_m: FloatArray, step_m: float, turned_rad: FloatArray) -> FloatArray:
    """Covariance (N, N), m^2, of positions aside of a path that follows the heading, without its offset.

    ``step_m`` is the mean distance from pose to pose.
    """
    way_m = np.abs(along_m - along_m[0])
    apart_m = np.abs(along_m[:, None] - along_m)
    white_m2 = max(noise.position_m**2 - noise.position_drift_m**2, _LEAST_NOISE_M**2)
    covariance = white_m2 * np.eye(len(along_m))
    covariance += noise.position_drift_m**2 * np.exp(-apart_m / noise.position_drift_over_m)
    shared_m = np.minimum(way_m[:, None], way_m)
    # The integral of a Gauss-Markov process, from the begin of the stretch.
    over_m = noise.heading_drift_over_m
    fades = np.exp(-way_m / over_m)
    ends = 1.0 - fades[:, None] - fades + np.exp(-apart_m / over_m)
    covariance += noise.heading_drift_rad**2 * over_m * (2.0 * shared_m - over_m * ends)
    white_rad2 = max(noise.heading_rad**2 - noise.heading_drift_rad**2, 0.0)
    covariance += white_rad2 * step_m * shared_m
    return np.asarray(covariance + _ORIGIN_M**2 * np.outer(turned_rad, turned_rad))
