"""How far the recorded poses of a set of images may be off, together.

Robust least squares: the mounting under which matched pixels show the same ground.

What is known of a camera and its vehicle's poses before the ground is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.ground.model import GroundHits, Mount, by_lens, by_pixel, hit_ground
from v2hdm.ground.motion import Motion
from v2hdm.records import BoolArray, Camera, Drive, FloatArray, IntArray, PoseNoise

HEAVE_SIGMA_M = 0.01
"""How far a vehicle's body moves up and down on its suspension on paved ground; the mapper's figure."""

_LEAST = 1e-6
"""Poses stated to be exact would make the matrix singular: m or rad."""

STATES = ("roll", "pitch", "yaw", "forward", "left", "up")
"""Errors of a pose, rad and m, in vehicle axes."""


def state_sigmas(noise: PoseNoise) -> FloatArray:
    """Standard deviations (6,) of a pose's :data:`STATES`."""
    tilt, position = noise.roll_pitch_rad, noise.position_m
    sigmas = [tilt, tilt, noise.heading_rad, position, position, HEAVE_SIGMA_M]
    return np.asarray(np.maximum(np.array(sigmas), _LEAST))


def pose_information(noise: PoseNoise, path_m: FloatArray, loosened: FloatArray) -> FloatArray:
    """Inverse covariance (6, I, I) of each state's errors at the images.

    Args:
        noise: as the drive states it; drifts tie images together that are near to each other on the path.
        path_m: (I,) distance driven at each image.
        loosened: (6,) factors on the standard deviations.
    """
    apart_m = np.abs(path_m[:, None] - path_m[None])
    drifts = (
        [(noise.roll_pitch_drift_rad, noise.roll_pitch_drift_over_m)] * 2
        + [(noise.heading_drift_rad, noise.heading_drift_over_m)]
        + [(noise.position_drift_m, noise.position_drift_over_m)] * 2
        + [(0.0, 1.0)]
    )
    out = []
    for sigma, (drift, over_m), factor in zip(state_sigmas(noise), drifts, loosened, strict=True):
        white = np.sqrt(max(sigma**2 - drift**2, _LEAST**2))
        covariance = white**2 * np.eye(len(path_m)) + drift**2 * np.exp(-apart_m / over_m)
        out.append(np.linalg.inv(factor**2 * covariance))
    return np.array(out)


PIXEL_SIGMA = 0.4
"""What a patch's place in an image is off, px, at the most; the unit of the residuals."""

_LEAST_PIXEL_SIGMA = 0.1
"""Below this interpolation and the grid itself show, px."""

_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))
"""Median length of a plane vector whose components have a standard deviation of one."""

_CAUCHY = 2.5
"""Length of a whitened residual from which on it loses its weight."""

_LENS_SIGMA_PX = 0.1
"""How far a good lens model and the matching are off, px, smoothly over the image and alike in all: little
against a pixel, but thousands of matches share it."""

_BENDS = 6
"""Terms of a smooth error of each pixel coordinate: a polynomial of the second degree."""

_LARGEST_TURN_RAD = 0.05
_LARGEST_SHIFT_M = 0.2
"""A step larger than these leaves what the equations are linear in."""

_STEPS = 20
_CONVERGED = 0.02
"""A step below so many standard deviations is the last."""

CENTRE, TURN = slice(3, 6), slice(0, 3)


@dataclass(frozen=True)
class Observations:
    """Matches of all pairs of one camera.

    Attributes:
        first: (N,) the image of each match's first pixel, a row of the poses below.
        second: (N,) that of its second.
        first_px: (N, 2) raw pixels.
        second_px: (N, 2) raw pixels.
        pair: (N,) the pair.
    """

    first: IntArray
    second: IntArray
    first_px: FloatArray
    second_px: FloatArray
    pair: IntArray

    def only(self, keep: BoolArray) -> Observations:
        """Those of a mask (N,)."""
        return Observations(
            self.first[keep], self.second[keep], self.first_px[keep], self.second_px[keep], self.pair[keep]
        )


@dataclass(frozen=True)
class Believed:
    """What is known before the ground is seen.

    Attributes:
        poses: (I, 4, 4) ``map_from_vehicle`` as recorded.
        pose_information: (6, I, I) of the poses' errors; see :func:`v2hdm.ground.adjust.pose_information`.
        velocity: (I, 3) smoothed motion.
        climb_m: (I,) what a grade of 1 has lifted the poses by, m.
        centre_vehicle: (3,) surveyed camera centre.
        centre_sigma_m: (3,) of it.
    """

    poses: FloatArray
    pose_information: FloatArray
    velocity: FloatArray
    climb_m: FloatArray
    centre_vehicle: FloatArray
    centre_sigma_m: FloatArray


@dataclass(frozen=True)
class Adjusted:
    """The solution.

    Attributes:
        mount: with the lens as freed.
        extra: the freed parameter's value, 0 without one.
        covariance: (K, K) of turn (3, rad), centre (3, m) and the freed parameter, if any.
        pose_errors: (I, 6) estimated :data:`v2hdm.ground.adjust.STATES`.
        bends: (12,) estimated smooth error of the pixels, px.
        poses: (I, 4, 4) ``map_from_vehicle`` with their errors, and the parameter, taken in.
        residual: (N,) lengths in units of :data:`PIXEL_SIGMA` over both pixels.
        weight: (N,) 1 for a match that fits, 0 for one that does not.
    """

    mount: Mount
    extra: float
    covariance: FloatArray
    pose_errors: FloatArray
    bends: FloatArray
    poses: FloatArray
    residual: FloatArray
    weight: FloatArray


def adjust(
    observations: Observations,
    believed: Believed,
    start: Mount,
    free: str | None = None,
    tolerance: float = 1.0,
    near: Adjusted | None = None,
) -> Adjusted:
    """Find the mounting, beside one parameter ``free`` if any, by Gauss-Newton with Cauchy's weights.

    Args:
        observations: the matches.
        believed: poses, survey and their noise.
        start: where to start from.
        free: ``clock_s``, ``focal_scale``, ``distortion_k1`` or ``grade``, or None.
        tolerance: factor on the length of residual from which on a match loses its weight.
        near: a solution for the same images, without the parameter, to start from instead.
    """
    mount, extra = start if near is None else near.mount, 0.0
    errors = np.zeros((len(believed.poses), 6)) if near is None else near.pose_errors
    bends = np.zeros(2 * _BENDS) if near is None else near.bends
    sigma_px = PIXEL_SIGMA
    for _ in range(_STEPS):
        residual, jacobian, root = _linearised(observations, believed, mount, extra, errors, bends, free)
        length = np.linalg.norm((root @ residual[:, :, None])[..., 0], axis=1)
        usable = np.isfinite(length)
        scale = float(np.median(length[usable])) / _RAYLEIGH_MEDIAN if usable.any() else 1.0
        sigma_px = float(np.clip(PIXEL_SIGMA * scale, _LEAST_PIXEL_SIGMA, tolerance * PIXEL_SIGMA))
        unit = PIXEL_SIGMA / sigma_px
        weight = np.where(usable, 1 / (1 + (length * unit / (_CAUCHY * tolerance)) ** 2), 0.0)
        system, gradient = _normal(
            observations, believed, mount, errors, bends, residual, jacobian, root * unit, weight
        )
        step = _short(np.asarray(np.linalg.solve(system, -gradient)))
        known = len(step) - errors.size
        mount = mount.moved(step[TURN], step[CENTRE])
        bends = bends + step[6 : 6 + 2 * _BENDS]
        if free is not None:
            change = float(step[known - 1])
            extra += change
            if free == "focal_scale":
                mount = mount.with_focal_scale((1 + extra) / (1 + extra - change) - 1)
            elif free == "distortion_k1":
                mount = mount.with_k1(change)
        errors = errors + step[known:].reshape(-1, 6)
        if np.max(np.abs(step) * np.sqrt(np.diag(system))) < _CONVERGED:
            break
    wanted = [*range(6), *range(known - (free is not None), known)]
    covariance = np.asarray(np.linalg.inv(system)[np.ix_(wanted, wanted)])
    return Adjusted(
        mount, extra, covariance, errors, bends, moved_poses(believed, errors, extra, free), length, weight
    )


def _short(step: FloatArray) -> FloatArray:
    """The step, shortened to what its linearisation holds for."""
    turn, shift = np.abs(step[TURN]).max(), np.abs(step[CENTRE]).max()
    return step / max(1.0, float(turn) / _LARGEST_TURN_RAD, float(shift) / _LARGEST_SHIFT_M)


def _linearised(
    observations: Observations,
    believed: Believed,
    mount: Mount,
    extra: float,
    errors: FloatArray,
    bends: FloatArray,
    free: str | None,
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Differences (N, 2) m, their derivatives by mount, parameter and both poses, whitening (N, 2, 2)."""
    sides = []
    spread = np.zeros((len(observations.first), 2, 2))
    poses = moved_poses(believed, errors, extra, free)
    for image, px in (
        (observations.first, observations.first_px),
        (observations.second, observations.second_px),
    ):
        hits = hit_ground(mount, px, poses[image])
        by_px = by_pixel(mount, hits)
        bending = _bending(mount, px, by_px)
        by_known = np.concatenate([hits.by_mount(), bending], axis=2)
        if free is not None:
            column = _by_parameter(free, mount, hits, px, poses[image], believed, image)
            by_known = np.concatenate([by_known, column[:, :, None]], axis=2)
        sides.append((hits.points_map + bending @ bends, by_known, hits.by_pose()))
        blur = PIXEL_SIGMA * by_px
        spread = spread + blur @ np.swapaxes(blur, 1, 2)
    (points, known, pose), (points_2, known_2, pose_2) = sides
    usable = np.isfinite(spread).all(axis=(1, 2))
    root = np.full(spread.shape, np.nan)
    root[usable] = np.linalg.inv(np.linalg.cholesky(spread[usable]))
    return points - points_2, [known - known_2, pose, -pose_2], root


def _bending(mount: Mount, px: FloatArray, by_px: FloatArray) -> FloatArray:
    """Derivative (N, 2, 12) of ground points by the terms of a smooth error of the pixels, in px."""
    u, v = (2 * px / [mount.info.width, mount.info.height] - 1).T
    terms = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
    return np.concatenate([by_px[:, :, k, None] * terms[:, None] for k in (0, 1)], axis=2)


def _by_parameter(
    free: str,
    mount: Mount,
    hits: GroundHits,
    px: FloatArray,
    poses: FloatArray,
    believed: Believed,
    image: IntArray,
) -> FloatArray:
    if free == "clock_s":
        return hits.by_motion(believed.velocity[image])
    if free == "grade":
        return np.asarray(-hits.plane[:, :, 2] * believed.climb_m[image][:, None])
    return by_lens(mount, px, poses, free)


def moved_poses(believed: Believed, errors: FloatArray, extra: float, free: str | None) -> FloatArray:
    """The poses (I, 4, 4) with their estimated ``errors`` (I, 6) taken in, and the freed parameter."""
    shift = errors[:, 3:].copy()
    turn = errors[:, :3].copy()
    if free == "clock_s":
        shift[:, :2] += extra * believed.velocity[:, :2]
        turn[:, 2] += extra * believed.velocity[:, 2]
    if free == "grade":
        shift[:, 2] -= extra * believed.climb_m
    out = believed.poses.copy()
    turns = np.array([rotation_from_vector(vector) for vector in turn])
    out[:, :3, 3] += (believed.poses[:, :3, :3] @ shift[:, :, None])[..., 0]
    out[:, :3, :3] = believed.poses[:, :3, :3] @ turns
    return out


def _normal(
    observations: Observations,
    believed: Believed,
    mount: Mount,
    errors: FloatArray,
    bends: FloatArray,
    residual: FloatArray,
    jacobian: list[FloatArray],
    root: FloatArray,
    weight: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The normal equations over mount, parameter and the six errors of every pose."""
    known = jacobian[0].shape[2]
    count = len(believed.poses)
    size = known + 6 * count
    system, gradient = np.zeros((size, size)), np.zeros(size)
    good = weight > 0
    scaled = np.sqrt(weight[good])[:, None, None] * root[good]
    rows = scaled @ np.concatenate([part[good] for part in jacobian], axis=2)
    value = (scaled @ residual[good][:, :, None])[..., 0]
    first, second = observations.first[good], observations.second[good]
    cuts = np.flatnonzero(np.diff(observations.pair[good])) + 1
    for low, high in zip([0, *cuts], [*cuts, len(first)], strict=True):
        if high == low:
            continue
        block = rows[low:high].reshape(-1, known + 12)
        at = np.concatenate(
            [np.arange(known)] + [known + 6 * int(image[low]) + np.arange(6) for image in (first, second)]
        )
        system[np.ix_(at, at)] += block.T @ block
        gradient[at] += block.T @ value[low:high].ravel()
    for state in range(6):
        at = known + 6 * np.arange(count) + state
        system[np.ix_(at, at)] += believed.pose_information[state]
        gradient[at] += believed.pose_information[state] @ errors[:, state]
    information = believed.centre_sigma_m**-2
    system[range(3, 6), range(3, 6)] += information
    gradient[CENTRE] += information * (mount.centre_vehicle - believed.centre_vehicle)
    system[range(6, 6 + 2 * _BENDS), range(6, 6 + 2 * _BENDS)] += _LENS_SIGMA_PX**-2
    gradient[6 : 6 + 2 * _BENDS] += bends / _LENS_SIGMA_PX**2
    # Hardly any matches must not make it singular: an angle is known to a radian, a parameter to ten units.
    system[range(3), range(3)] += 1.0
    system[range(6 + 2 * _BENDS, known), range(6 + 2 * _BENDS, known)] += 0.01
    return system, gradient


def tangent_covariance(mount: Mount, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the left tangent of ``cam_from_vehicle`` from that of turn and centre."""
    turn = -mount.vehicle_from_cam_rotation.T
    jacobian = np.zeros((6, 6))
    jacobian[:3, CENTRE] = turn
    jacobian[3:, TURN] = turn
    return np.asarray(jacobian @ covariance[:6, :6] @ jacobian.T)


_FORWARD_LOOSENED = 2.0
"""At most so much for the place along the path: with more, distance and height slide together."""

_UNSURVEYED_M = 0.5
"""How far the centre that follows from a guess may be off, m."""

_HEIGHT_SIGMA_M = 0.2
"""The ground tells the height to millimetres; a survey's own sigma would only pull it, m."""


@dataclass(frozen=True)
class Beliefs:
    """Poses, survey and their noise; ``clock_s`` is added to the images' stamps.

    ``centre_sigma_m`` replaces the survey's own along single axes; not ``surveyed``, only the
    guess tells where the centre is.
    """

    drive: Drive
    camera: Camera
    motion: Motion
    guess: Mount
    clock_s: float = 0.0
    centre_sigma_m: dict[int, float] = field(default_factory=dict)
    surveyed: bool = True

    def at_clock(self, clock_s: float) -> Beliefs:
        """The same with another offset of the clock."""
        return replace(self, clock_s=clock_s)

    def poses(self) -> FloatArray:
        """``map_from_vehicle`` (I, 4, 4) at all images."""
        return self.motion.poses(self.clock_s)

    def path_m(self) -> FloatArray:
        """Distance driven (I,) at all images."""
        return self.motion.path_at_images(self.clock_s)

    def about(
        self, observations: Observations, loosened: float = 1.0
    ) -> tuple[Observations, Believed, IntArray]:
        """The observations with images counted anew, what is known of these images, and their rows.

        Args:
            observations: matches between rows of the motion.
            loosened: how much further off than stated headings and sideways places may be.
        """
        rows, place = np.unique(
            np.concatenate([observations.first, observations.second]), return_inverse=True
        )
        count = len(observations.first)
        path_m = self.path_m()[rows]
        prior = self.camera.centre_prior if self.surveyed else None
        sigma_m = np.full(3, _UNSURVEYED_M) if prior is None else prior.sigma_m.copy()
        sigma_m[2] = max(sigma_m[2], _HEIGHT_SIGMA_M)
        for axis, wider_m in self.centre_sigma_m.items():
            sigma_m[axis] = wider_m
        ahead = min(loosened, _FORWARD_LOOSENED)
        factors = np.array([1.0, 1.0, loosened, ahead, loosened, 1.0])
        believed = Believed(
            poses=self.poses()[rows],
            pose_information=pose_information(self.drive.pose_noise, path_m, factors),
            velocity=self.motion.velocity_at_images(self.clock_s)[rows],
            climb_m=path_m - path_m.mean(),
            centre_vehicle=self.guess.centre_vehicle if prior is None else prior.centre_vehicle,
            centre_sigma_m=sigma_m,
        )
        return replace(observations, first=place[:count], second=place[count:]), believed, rows
