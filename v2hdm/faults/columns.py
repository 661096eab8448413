"""The columns of derivatives of every fault: what residuals would do if an input erred by one unit.

:data:`OF_CAMERAS` and :data:`OF_DRIVE` give, for each fault, the hypotheses that a problem allows for. Faults
of cameras are hypotheses on each camera, and on all of them together.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.problem import Problem
from v2hdm.faults import table
from v2hdm.faults.ground_columns import (
    seen_by_lens,
    seen_by_moved_vehicle,
    seen_by_shifted_image,
    seen_over_tilted_ground,
)
from v2hdm.faults.sensitivity import Rows, Sensitivity, raised, stretches
from v2hdm.faults.table import Fault
from v2hdm.records import FloatArray

_STRETCHES_PER_CHANGE = 2  # segments between candidate frames of a change of inputs

_MOST_CHANGES = 12
"""Candidate frames of a change, over all sessions: each costs a test of every camera and axis."""

_DRIFTS = 3  # shapes of a clock drift: linear, and cosines of two and three half waves

_STEPS = ((1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5), (-(0.5**0.5), 0.5**0.5))
"""Directions of position steps in the map: no direction is more than 22.5 deg from one of them."""

_FOCAL_SHARES = ((1.0, 1.0), (0.0, 1.0))
"""Shares of fx and fy in an error of the focal length: in both, or in fy alone.

One of fx alone looks like one of both: over a plane, fy is nearly the camera's height.
"""

_SURE_SLIP = 0.002
"""Standard deviation of the slip, rad for each m/s2, below which the poses tell it: 0.0009 with a gyro, 0.005
without."""

_LEAST_SPEED_MPS = 0.5  # a slower vehicle has no course

_BY_FOCAL, _BY_K1 = 0, 1  # rows of the changes of the ground by the lens

Column = Callable[[Sensitivity], Rows]
"""Derivatives of a solution's residuals by one parameter, in its unit."""


@dataclass(frozen=True)
class Hypothesis:
    """One fault, and its column of the Jacobian."""

    fault: Fault
    column: Column
    camera: int = -1  # camera, axis and item as in :class:`v2hdm.faults.ScoreTest`
    axis: int = 0
    item: int = -1

    @property
    def key(self) -> Hashable:
        """The fault that is tested; a sudden and a gradual step from one frame share it."""
        return self.fault, self.camera, self.axis, self.item


@dataclass(frozen=True)
class Setting:
    """A solved problem, as far as it says which faults it can have."""

    problem: Problem
    arrays: Arrays

    @property
    def cameras(self) -> range:
        """Indices of the cameras."""
        return range(self.arrays.camera_count)

    @property
    def is_moving(self) -> bool:
        """Whether the vehicle's velocity is known, on which errors of time depend."""
        return self.problem.twist_vehicle is not None

    @property
    def has_centres(self) -> bool:
        """Whether camera centres are surveyed."""
        return bool((self.arrays.centre_information_root > 0).any())

    @cached_property
    def changes(self) -> list[int]:
        """Candidate frames of a change: about a dozen, evenly spread over the segments of all sessions."""
        stretch = stretches(self.arrays)
        session = self.arrays.session
        begins = (stretch.diff() > 0).nonzero()[:, 0] + 1
        within = [int(j) for j in begins if session[j] == session[j - 1]]
        return within[1 :: max(_STRETCHES_PER_CHANGE, -(-len(within) // _MOST_CHANGES))]


def hypotheses(problem: Problem, arrays: Arrays) -> Iterator[Hypothesis]:
    """Every fault that a problem can have, with its columns."""
    setting = Setting(problem, arrays)
    for camera in [*([-1] if arrays.camera_count > 1 else []), *setting.cameras]:
        for of_camera in OF_CAMERAS.values():
            yield from of_camera(setting, camera)
    for of_drive in OF_DRIVE.values():
        yield from of_drive(setting)


def _clock(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    if not setting.is_moving:
        return
    problem = setting.problem
    for session in range(problem.session_count) if problem.session_count > 1 else [-1]:
        is_late = (problem.session_of_frame == session) | (session < 0)
        yield Hypothesis(table.CLOCK, _moving(partial(_late, problem, camera, is_late)), camera, item=session)


def _focal(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    for axis, (in_x, in_y) in enumerate(_FOCAL_SHARES):
        column = partial(_zoomed, setting.problem, camera, in_x, in_y)
        yield Hypothesis(table.FOCAL, column, camera, axis)


def _distortion(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    yield Hypothesis(table.DISTORTION, partial(_bent, setting.problem, camera), camera)


def _principal(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    for axis in (0, 1):
        column = partial(_shifted_image, setting.problem, camera, axis)
        yield Hypothesis(table.PRINCIPAL, column, camera, axis)


def _clock_drift(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    problem = setting.problem
    for axis in range(_DRIFTS if setting.is_moving else 0):
        # The clock's error (J,) goes from half the value to minus half, in one half wave or more.
        share = np.linspace(0.0, 1.0, len(problem.map_from_vehicle))
        wave = share - 0.5 if axis == 0 else 0.5 * np.cos((axis + 1) * np.pi * share)
        yield Hypothesis(table.CLOCK_DRIFT, _moving(partial(_late, problem, camera, wave)), camera, axis)


def _knock(setting: Setting, camera: int) -> Iterator[Hypothesis]:
    for frame in setting.changes:
        for axis in (1, 2):
            yield Hypothesis(
                table.KNOCK, _moving(partial(_knocked, camera, axis, frame)), camera, axis, frame
            )


def _slope(_: Setting) -> Iterator[Hypothesis]:
    for axis in (0, 1):
        yield Hypothesis(table.SLOPE, _moving(partial(_rising, axis)), axis=axis)


def _step(setting: Setting) -> Iterator[Hypothesis]:
    changes = setting.changes
    sudden = list(zip(changes, changes, strict=True))
    gradual = list(zip(changes, changes[2:], strict=False))
    for axis in range(len(_STEPS)):
        for frame, until in sudden + gradual:
            yield Hypothesis(
                table.STEP, _moving(partial(_stepped, axis, frame, until)), axis=axis, item=frame
            )


def _crown(_: Setting) -> Iterator[Hypothesis]:
    for axis in range(3):
        yield Hypothesis(table.CROWN, partial(_falling, axis), axis=axis)


def _course(setting: Setting) -> Iterator[Hypothesis]:
    if setting.is_moving:
        yield Hypothesis(table.COURSE, _moving(partial(_sideslip, setting.problem)))


def _slip(setting: Setting) -> Iterator[Hypothesis]:
    slip = max(sigma.heading_slip for sigma in setting.problem.pose_sigmas)
    if setting.is_moving and slip > _SURE_SLIP:
        yield Hypothesis(table.SLIP, _moving(partial(_slipping, setting.problem)))


def _survey(setting: Setting) -> Iterator[Hypothesis]:
    for axis in range(3 if setting.has_centres else 0):
        for camera in setting.cameras:
            yield Hypothesis(table.SURVEY, partial(_shifted_centre, camera, axis), camera, axis)


def _lever(setting: Setting) -> Iterator[Hypothesis]:
    for axis in range(3 if setting.has_centres and len(setting.cameras) > 1 else 0):
        yield Hypothesis(table.LEVER, partial(_shifted_centre, -1, axis), -1, axis)


def _scale(setting: Setting) -> Iterator[Hypothesis]:
    if setting.has_centres:
        yield Hypothesis(table.SCALE, _stretched)


def _datum(setting: Setting) -> Iterator[Hypothesis]:
    for axis in range(2 if bool((setting.arrays.control_root > 0).any()) else 0):
        yield Hypothesis(table.DATUM, partial(_shifted_points, axis), axis=axis)


def _size(setting: Setting) -> Iterator[Hypothesis]:
    length_m = setting.arrays.lengths.length_m
    for item, stated_m in enumerate(torch.unique(length_m)):
        yield Hypothesis(table.SIZE, partial(_longer, length_m == stated_m), item=item)


OF_CAMERAS: dict[Fault, Callable[[Setting, int], Iterator[Hypothesis]]] = {
    table.CLOCK: _clock,
    table.FOCAL: _focal,
    table.DISTORTION: _distortion,
    table.PRINCIPAL: _principal,
    table.CLOCK_DRIFT: _clock_drift,
    table.KNOCK: _knock,
}
"""Hypotheses on one camera, or on all cameras together (-1), by fault."""

OF_DRIVE: dict[Fault, Callable[[Setting], Iterator[Hypothesis]]] = {
    table.SLOPE: _slope,
    table.STEP: _step,
    table.CROWN: _crown,
    table.COURSE: _course,
    table.SLIP: _slip,
    table.SURVEY: _survey,
    table.LEVER: _lever,
    table.SCALE: _scale,
    table.DATUM: _datum,
    table.SIZE: _size,
}
"""Hypotheses on everything else, by fault; surveyed points are tested one by one without a column."""


def _zoomed(problem: Problem, camera: int, in_x: float, in_y: float, solved: Sensitivity) -> Rows:
    """Relative error of the focal lengths fx and fy, by the shares ``in_x`` and ``in_y`` of the value."""
    # Projected points rather than measured ones: pixels, whose noise is stated, do not scale.
    is_of_camera = (solved.camera == camera) | (camera < 0)
    shares = solved.projected.new_tensor([[in_x], [in_y]])
    # On the ground, whose height and distances ahead it scales, fy is most of a focal length.
    ground = seen_by_lens(problem, camera, _BY_FOCAL, solved)
    return {"observations": solved.whiten(solved.projected * shares * is_of_camera), **ground}


def _bent(problem: Problem, camera: int, solved: Sensitivity) -> Rows:
    """Error of the first radial coefficient."""
    projected = solved.projected
    is_of_camera = (solved.camera == camera) | (camera < 0)
    off = projected * projected.square().sum(0) * is_of_camera
    return {"observations": solved.whiten(off), **seen_by_lens(problem, camera, _BY_K1, solved)}


def _shifted_image(problem: Problem, camera: int, axis: int, solved: Sensitivity) -> Rows:
    """A principal point one pixel farther right, or down."""
    camera_of = solved.camera
    focal_px = torch.as_tensor(problem.intrinsic[:, axis])
    off = ((camera_of == camera) | (camera < 0)) / focal_px.to(camera_of.device)[camera_of]
    still = torch.zeros_like(off)
    observations = solved.whiten(torch.stack([off, still] if axis == 0 else [still, off]))
    return {"observations": observations, **seen_by_shifted_image(problem, camera, axis, solved)}


def _moving(motion: Callable[[Arrays, Tensor], Tensor]) -> Column:
    """The column of a ``motion`` (C, J, 6) of the vehicle in its own frame, which is written into zeros."""

    def column(solved: Sensitivity) -> Rows:
        extrinsic = solved.whitening.estimate.cam_from_vehicle[:, None]
        arrays = solved.arrays
        still = arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6)
        of_frames = motion(arrays, still)
        tangent = arrays.at_moments(of_frames, axis=1)
        shift = (extrinsic[..., :3, :3] @ tangent[..., :3, None])[..., 0]
        turn = (extrinsic[..., :3, :3] @ tangent[..., 3:, None])[..., 0]
        shift = shift + torch.linalg.cross(extrinsic[..., :3, 3].expand_as(turn), turn)
        observations = solved.jacobians.along_tangents(-torch.cat([shift, turn], dim=-1))
        return {"observations": observations, **seen_by_moved_vehicle(of_frames, solved)}

    return column


def lateness(problem: Problem, share: FloatArray, *, is_drift: bool = False) -> Hypothesis:
    """The clock of all images late by a ``share`` (J,) of the value, which may drift."""
    fault = table.CLOCK_DRIFT if is_drift else table.CLOCK
    return Hypothesis(fault, _moving(partial(_late, problem, -1, share)))


def _late(problem: Problem, camera: int, share: FloatArray, _: Arrays, out: Tensor) -> Tensor:
    """Images late by a ``share`` (J,) of the value."""
    twist = torch.as_tensor(np.asarray(problem.twist_vehicle) * share[:, None])
    out[slice(None) if camera < 0 else camera] = twist.to(out.device)
    return out


def _sideslip(problem: Problem, _: Arrays, out: Tensor) -> Tensor:
    """Heading taken from the course of a point ahead of the rear axle, which sideslips in bends."""
    twist = np.asarray(problem.twist_vehicle)
    speed = np.hypot(twist[:, 0], twist[:, 1])
    curvature = np.where(speed > _LEAST_SPEED_MPS, twist[:, 5] / np.maximum(speed, _LEAST_SPEED_MPS), 0.0)
    out[..., 5] = -torch.as_tensor(curvature).to(out.device)
    return out


def _slipping(problem: Problem, _: Arrays, out: Tensor) -> Tensor:
    """Heading taken from a course that the acceleration to the side has turned."""
    twist = np.asarray(problem.twist_vehicle)
    aside = np.hypot(twist[:, 0], twist[:, 1]) * twist[:, 5]
    out[..., 5] = torch.as_tensor(aside).to(out.device)
    return out


def _stepped(axis: int, frame: int, until: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Positions recorded short along a direction: growing from ``frame`` to ``until``, then constant."""
    out[..., :3] = arrays.vehicle_from_map[:, :3, :2] @ arrays.centre.new_tensor(_STEPS[axis])
    after = torch.arange(1 - frame, 1 - frame + arrays.frame_count, device=out.device)[:, None]
    return out * _since(arrays, frame) * (after / (until - frame + 1)).clamp(max=1.0)


def _stretched(solved: Sensitivity) -> Rows:
    """Positions recorded too close together, as those of a grid that shrinks the ground.

    Distances are those between adjusted poses: noise would lengthen recorded ones, and be found in the
    residuals again, which would look like a scale.
    """
    position = solved.map_from_vehicle[:, :3, 3:]

    def motion(arrays: Arrays, out: Tensor) -> Tensor:
        away = position - position.mean(dim=0)
        out[..., :3] = (arrays.vehicle_from_map[:, :3, :3] @ away)[..., 0]
        return out

    return _moving(motion)(solved)


def _knocked(camera: int, axis: int, frame: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Rotation of a camera about its own centre; load rotates all of them about the rear axle."""
    turn = torch.eye(3, dtype=out.dtype, device=out.device)[axis]
    chosen = slice(None) if camera < 0 else slice(camera, camera + 1)
    out[chosen, :, 3:] = turn
    if camera >= 0:
        out[chosen, :, :3] = torch.linalg.cross(arrays.centre[chosen], turn.expand(1, 3))[:, None]
    return out * _since(arrays, frame)


def _since(arrays: Arrays, frame: int) -> Tensor:
    """1 for the frames (J, 1) from ``frame`` to the end of its session, else 0."""
    later = torch.arange(arrays.frame_count, device=arrays.session.device) >= frame
    return (later & (arrays.session == arrays.session[frame])).to(arrays.centre.dtype)[:, None]


def _falling(axis: int, solved: Sensitivity) -> Rows:
    """Corners lower by the value times their distance from the route, on both sides or one."""
    arrays = solved.arrays
    estimate = solved.whitening.estimate
    frames = arrays.vehicle_from_map.inverse()
    route = KDTree(frames[:, :2, 3].cpu().numpy())
    nearest = torch.as_tensor(route.query(estimate.corners_map.cpu().numpy())[1], device=frames.device)
    left = ((estimate.corners_map - frames[nearest, :2, 3]) * frames[nearest, :2, 1]).sum(1)
    lower = (left.abs(), left.clamp(min=0), -left.clamp(max=0))[axis]
    # The ground's estimate knows of falls to both sides alike: of one to one side that is half.
    tilt = (0.0, 0.5, -0.5)[axis]
    return {**raised(solved, -lower[arrays.corner.long()]), **seen_over_tilted_ground(tilt, solved)}


def _rising(axis: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Ground that rises along an axis of the map, unknown to the poses."""
    turn = arrays.centre.new_tensor([0.0, -1.0, 0.0] if axis == 0 else [1.0, 0.0, 0.0])
    out[..., 3:] = arrays.vehicle_from_map[:, :3, :3] @ turn
    return out


def _shifted_centre(camera: int, axis: int, solved: Sensitivity) -> Rows:
    out = torch.zeros_like(solved.arrays.centre)
    which = slice(None) if camera < 0 else camera
    out[which, axis] = -solved.arrays.centre_information_root[which, axis]
    return {"camera_centre": out}


def _shifted_points(axis: int, solved: Sensitivity) -> Rows:
    out = torch.zeros_like(solved.arrays.control)
    out[:, axis:] = -solved.arrays.control_root[:, 2 * axis : 2 + axis]
    return {"control_points": out}


def _longer(is_of_size: Tensor, solved: Sensitivity) -> Rows:
    return {"known_lengths": -solved.arrays.lengths.information_root * is_of_size}
