"""Faults of a made drive: each changes the world, or its recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tests.benchmarks.made.world import HALF_TRACK_M, World, beside, make
from v2hdm.geometry.rigid import heading_rad, rotation_from_euler
from v2hdm.records import FloatArray, Trajectory

APART_S = 0.037
"""Time from camera to camera where these fire in turn: that of a recorder of eight images a second."""


@dataclass(frozen=True)
class Spoil:
    """One wrong input.

    Attributes:
        name: of the fault.
        cause: pattern that a finding must match to name the cause right, in its name or in its sentence up
            to the colon, behind which the recovery is; None where the input is only unusual, and the map must
            be right.
        change: spoils a world.
        hidden: pattern of the check that must say that a straight drive cannot tell.
    """

    name: str
    cause: str | None
    change: Callable[[World], World]
    hidden: str | None = None


def _with_poses(world: World, change: Callable[[FloatArray], FloatArray]) -> World:
    """Other recorded poses (P, 4, 4), at the same times."""
    poses = change(world.recorded.map_from_vehicle.copy())
    return replace(world, recorded=Trajectory(world.recorded.stamp_s, poses))


def _with_stamps(world: World, change: Callable[[FloatArray], FloatArray]) -> World:
    """Other stamps (F,) of the images, of all cameras alike."""
    return replace(world, stamp_s={name: change(stamp_s) for name, stamp_s in world.stamp_s.items()})


def _step(shift_m: float, world: World) -> World:
    """The position steps halfway, and stays there."""
    station = world.port.route.station_at(world.recorded.stamp_s)

    def change(poses: FloatArray) -> FloatArray:
        poses[station > world.station_m.mean(), :2, 3] += shift_m * np.array([0.6, 0.8])
        return poses

    return _with_poses(world, change)


def _fast_clock(share: float, world: World) -> World:
    """The images' clock runs fast, and was right when the drive began."""
    begin_s = world.taken_s[0]
    return _with_stamps(world, lambda stamp_s: begin_s + (1 + share) * (stamp_s - begin_s))


def _late(offset_s: float, world: World) -> World:
    """Images were taken ``offset_s`` later than they say."""
    return _with_stamps(world, lambda stamp_s: stamp_s - offset_s)


def _jitter(sigma_s: float, world: World) -> World:
    """Images are stamped when the operating system got to it: late by a random time."""
    off = np.random.default_rng([world.recipe.seed, 5]).normal(0.0, sigma_s, len(world.taken_s))
    return _with_stamps(world, lambda stamp_s: _rising(stamp_s + off))


def _jitter_of_poses(sigma_s: float, world: World) -> World:
    """Poses are stamped when they arrived."""
    stamp_s = world.recorded.stamp_s
    off = np.random.default_rng([world.recipe.seed, 6]).normal(0.0, sigma_s, len(stamp_s))
    return replace(world, recorded=Trajectory(_rising(stamp_s + off), world.recorded.map_from_vehicle))


def _rising(stamp_s: FloatArray) -> FloatArray:
    """Stamps (N,) that rise by a microsecond at least, as those of a queue do; nan where there is none."""
    rising = np.fmax.accumulate(stamp_s) + 1e-6 * np.arange(len(stamp_s))
    return np.where(np.isnan(stamp_s), np.nan, rising)


def _counted(world: World) -> World:
    """Stamps are counted from the first at the mean rate, which varied with the vehicle's speed."""

    def change(stamp_s: FloatArray) -> FloatArray:
        counted_s, frames = stamp_s.copy(), np.flatnonzero(np.isfinite(stamp_s))
        counted_s[frames] = np.linspace(*stamp_s[frames[[0, -1]]], len(frames))
        return counted_s

    return _with_stamps(world, change)


def _knocked(camera: str, roll_pitch_yaw_deg: tuple[float, float, float], world: World) -> World:
    """A camera is turned about the vehicle's axes, around its own centre, halfway."""
    angles = (np.array([np.deg2rad(angle)]) for angle in roll_pitch_yaw_deg)
    turn = rotation_from_euler(*angles)[0]
    of_camera = world.cam_from_vehicle[camera].copy()
    centre = np.linalg.inv(of_camera[0])[:3, 3]
    turned = of_camera[0, :3, :3] @ turn.T
    of_camera[world.second_half, :3, :3], of_camera[world.second_half, :3, 3] = turned, -turned @ centre
    return replace(world, cam_from_vehicle={**world.cam_from_vehicle, camera: of_camera})


def _loaded(pitch_deg: float, world: World) -> World:
    """Load pitches the body, with all cameras, in the second half."""
    angle = np.where(world.second_half, np.deg2rad(pitch_deg), 0.0)
    true, zero = world.map_from_vehicle.copy(), np.zeros(len(angle))
    true[:, :3, :3] = true[:, :3, :3] @ rotation_from_euler(zero, angle, zero)
    return replace(world, map_from_vehicle=true)


def _course(world: World) -> World:
    """The heading is the direction from the last position to this one."""

    def change(poses: FloatArray) -> FloatArray:
        moved = np.diff(poses[:, :2, 3], axis=0)
        yaw = np.arctan2(moved[:, 1], moved[:, 0])
        return _turned(poses, np.concatenate([yaw[:1], yaw]) - heading_rad(poses))

    return _with_poses(world, change)


def _turned(poses: FloatArray, by_rad: FloatArray) -> FloatArray:
    """Poses (P, 4, 4), turned to the left on the spot by angles (P,)."""
    zero = np.zeros(len(poses))
    poses[:, :3, :3] = rotation_from_euler(zero, zero, by_rad) @ poses[:, :3, :3]
    return poses


def _foreign(world: World) -> World:
    """The images of the middle third are those of a drive on the same route past other paint."""
    port = replace(world.recipe.port, seed=world.recipe.seed + 10_000)
    other = make(replace(world.recipe, port=port))
    count = min(len(world.taken_s), len(other.taken_s))
    return replace(world, elsewhere=(other, range(count // 3, 2 * count // 3)))


def _crown(fall: float, line_m: float, world: World) -> World:
    """The road falls to both sides of a crown to the left of the vehicle, which leans with its own side."""
    corners = world.corners_map.copy()
    _, left_m = beside(world.port.route, corners[..., :2].reshape(-1, 2))
    # Over the crown itself the wheels stand lower, and so does the vehicle's origin.
    lower_m = 2 * np.maximum(left_m - line_m, 0.0) if line_m else np.abs(left_m) - HALF_TRACK_M
    corners[..., 2] -= fall * lower_m.reshape(corners.shape[:2])
    return replace(world, corners_map=corners)


def _relief(relief: str, fall: float, world: World) -> World:
    """The road as a receiver records it, with relief and a crown."""
    shaped = make(world.recipe.recorded(relief))
    return _crown(fall, 0.0, shaped) if fall else shaped


def _in_turn(world: World) -> World:
    """Cameras that fire in turn, between the poses of a stream: neighbouring images share a pose's noise."""
    return make(world.recipe.in_turn(APART_S))


def _grade(grade: float, world: World, heights: bool = True) -> World:
    """The world tilted about the map's y axis: recorded as on a real slope, or without the heights."""
    tilt = np.eye(4)
    tilt[:3, :3] = rotation_from_euler(np.zeros(1), np.array([-np.arctan(grade)]), np.zeros(1))[0]

    def change(poses: FloatArray) -> FloatArray:
        tilted = tilt @ poses
        if not heights:
            tilted[:, 2, 3] = 0.0
        return tilted

    return _with_poses(world, change)


def _survey(shift_m: tuple[float, float, float], world: World) -> World:
    """Surveyed centres of all cameras are off."""
    cameras = {}
    for name, camera in world.cameras.items():
        prior = camera.centre_prior
        assert prior is not None
        centre = prior.centre_vehicle + np.array(shift_m)
        cameras[name] = replace(camera, centre_prior=replace(prior, centre_vehicle=centre))
    return replace(world, cameras=cameras)


def _lever(ahead_m: float, left_m: float, world: World) -> World:
    """The poses are those of an antenna."""

    def change(poses: FloatArray) -> FloatArray:
        poses[:, :3, 3] += (poses[:, :3, :3] @ np.array([ahead_m, left_m, 0.0])[:, None])[..., 0]
        return poses

    return _with_poses(world, change)


def _lens(fx: float, fy: float, right_px: float, world: World) -> World:
    """``camera_info`` states other focal lengths and another principal point than the lenses have."""
    cameras = {}
    for name, camera in world.cameras.items():
        intrinsic = camera.info.intrinsic.copy()
        intrinsic[0, 0] *= 1 + fx
        intrinsic[1, 1] *= 1 + fy
        intrinsic[0, 2] += right_px
        cameras[name] = replace(camera, info=replace(camera.info, intrinsic=intrinsic))
    return replace(world, cameras=cameras)


def _heading(turn_deg: float, world: World) -> World:
    """The recorded heading is off by a constant."""
    return _with_poses(world, lambda poses: _turned(poses, np.full(len(poses), np.deg2rad(turn_deg))))


_CLOCK = r"\bclock|\bstamp"
_JITTER = rf"jitter|{_CLOCK}"
_KNOCK = r"\bknock|\bmounting"
_LEVER = r"antenna|lever|survey|\bcentre"

SPOILS: Mapping[str, Spoil] = {
    fault.name: fault
    for fault in (
        Spoil("position step", r"\bsteps?\b|jump|\bfix\b", partial(_step, 0.06)),
        Spoil("fast clock", _CLOCK, partial(_fast_clock, 0.005), _CLOCK),
        Spoil("clock jitter", _JITTER, partial(_jitter, 0.02)),
        Spoil("jittered poses", _JITTER, partial(_jitter_of_poses, 0.02)),
        Spoil("counted stamps", _CLOCK, _counted, _CLOCK),
        Spoil("late clock", _CLOCK, partial(_late, 0.03), _CLOCK),
        Spoil("knocked in pitch", _KNOCK, partial(_knocked, "front", (0.0, 0.5, 0.0))),
        Spoil("knocked in yaw", _KNOCK, partial(_knocked, "rear", (0.0, 0.0, 0.5))),
        Spoil("load", r"\bload|\bnose\b", partial(_loaded, -0.3)),
        Spoil("course heading", "heading|course", _course),
        Spoil("heading off", None, partial(_heading, 0.5)),
        Spoil("foreign images", r"foreign|other drive|another (drive|place)|belong", _foreign),
        Spoil("crown", r"\bcrown|cross-?fall|falls to both", partial(_crown, 0.02, 0.0)),
        Spoil("crown beside", r"\bcrown|cross-?fall|falls to both", partial(_crown, 0.02, 1.75)),
        Spoil("grade", None, partial(_grade, 0.01)),
        Spoil("no heights", r"slope|grade|\bheights?\b", partial(_grade, 0.01, heights=False)),
        Spoil("survey", r"survey|\bcentre", partial(_survey, (0.1, 0.0, 0.0)), r"survey|\bcentre"),
        Spoil("survey height", r"survey|\bcentre|camera height", partial(_survey, (0.0, 0.0, 0.1))),
        Spoil("lever", _LEVER, partial(_lever, 1.2, 0.0), _LEVER),
        Spoil("lever left", _LEVER, partial(_lever, 0.0, 0.3), _LEVER),
        Spoil("focal length", r"focal", partial(_lens, 0.02, 0.02, 0.0)),
        Spoil("fy", r"focal", partial(_lens, 0.0, 0.01, 0.0), r"focal"),
        Spoil("principal point", r"principal", partial(_lens, 0.0, 0.0, 20.0), r"principal"),
    )
}
"""All faults by their names."""

RELIEFS: Mapping[str, Spoil] = {
    spoil.name: spoil
    for spoil in (
        Spoil("level", None, partial(_relief, "", 0.0)),
        Spoil("grade and crown", None, partial(_relief, "grade", 0.03)),
        Spoil("ramp", None, partial(_relief, "ramp", 0.0)),
        Spoil("crest", None, partial(_relief, "crest", 0.0)),
        Spoil("cameras in turn", None, _in_turn),
    )
}
"""Unusual drives with right recordings: nothing is wrong, but the mapper has to know of it.

Ground that is no plane; and cameras that fire 37 ms after each other, under poses at 20 Hz.
"""
