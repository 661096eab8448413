"""Wrong times and poses."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.wrong.fault import CAMERAS, Fault, edit, edit_poses
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.description import POSES_FILE
from v2hdm.io.image_lists import read_image_list, write_image_list
from v2hdm.records import FloatArray
from v2hdm.store.files import replace_text


def _later(offset_s: float, cameras: tuple[str, ...], folder: Path) -> None:
    """Images are stamped ``offset_s`` too early: they were taken that much later than they say."""
    for camera in cameras:
        stamp_s, names = read_image_list(folder / camera / "images.txt")
        write_image_list(stamp_s - offset_s, names, folder / camera / "images.txt")


def _yaw_of(poses: FloatArray) -> FloatArray:
    return np.arctan2(poses[:, 1, 0], poses[:, 0, 0])


def _turned(poses: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    zero = np.zeros(len(poses))
    poses[:, :3, :3] = rotation_from_euler(zero, zero, yaw_rad)
    return poses


def _swap_axes(poses: FloatArray) -> FloatArray:
    poses[:, :2, 3] = poses[:, 1::-1, 3].copy()
    return poses


def _tilt(grade: float, stamp_s: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The world tilted about the y axis of the map: heights and attitudes recorded as on a real slope."""
    tilt = np.eye(4)
    tilt[:3, :3] = rotation_from_euler(np.zeros(1), np.array([-np.arctan(grade)]), np.zeros(1))[0]
    return stamp_s, tilt @ poses


def _raise(height_m: float, stamp_s: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    poses[:, 2, 3] += height_m
    return stamp_s, poses


def _path_m(poses: FloatArray) -> FloatArray:
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _jump(shift_m: float, length_m: float, stamp_s: FloatArray, poses: FloatArray) -> Any:
    path_m = _path_m(poses)
    middle = path_m[-1] / 2
    poses[np.abs(path_m - middle) < length_m / 2, 1, 3] += shift_m
    return stamp_s, poses


def _float_solution(sigma_m: float, stamp_s: FloatArray, poses: FloatArray) -> Any:
    rng = np.random.default_rng(0)
    keep, out = np.exp(-np.diff(_path_m(poses)) / 10.0), rng.normal(size=(len(poses), 2))
    for k in range(1, len(out)):
        out[k] = keep[k - 1] * out[k - 1] + np.sqrt(1 - keep[k - 1] ** 2) * out[k]
    poses[:, :2, 3] += sigma_m * out
    return stamp_s, poses


def _frozen_poses(stamp_s: FloatArray, poses: FloatArray) -> Any:
    begin = len(poses) // 2
    poses[begin : begin + 30] = poses[begin]
    return stamp_s, poses


def _lever(ahead_m: float, left_m: float, stamp_s: FloatArray, poses: FloatArray) -> Any:
    poses[:, :3, 3] += (poses[:, :3, :3] @ np.array([ahead_m, left_m, 0.0])[:, None])[..., 0]
    return stamp_s, poses


def _w_first(folder: Path) -> None:
    lines = [line.split() for line in (folder / POSES_FILE).read_text().splitlines() if line[0] != "#"]
    rows = [" ".join([*row[:4], row[7], *row[4:7]]) for row in lines]
    replace_text(folder / POSES_FILE, "\n".join(rows) + "\n")


def _scaled_stamps(folder: Path, factor: float, of_poses: bool) -> None:
    names = [POSES_FILE] if of_poses else [f"{camera}/images.txt" for camera in CAMERAS]
    for name in names:
        lines = [
            line.split(maxsplit=1) for line in (folder / name).read_text().splitlines() if line[0] != "#"
        ]
        replace_text(folder / name, "".join(f"{float(a) * factor:.0f} {b}\n" for a, b in lines))


def _as_degrees(stamp_s: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    metres_per_degree = 111_320.0
    poses[:, 0, 3] = 9.9 + poses[:, 0, 3] / (metres_per_degree * np.cos(np.deg2rad(53.5)))
    poses[:, 1, 3] = 53.5 + poses[:, 1, 3] / metres_per_degree
    return stamp_s, poses


def _as_feet(stamp_s: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    poses[:, :3, 3] /= 0.3048
    return stamp_s, poses


def _z_down(stamp_s: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    return stamp_s, poses @ np.diag([1.0, -1.0, -1.0, 1.0])


def _noise(folder: Path, **values: float) -> None:
    edit(folder, lambda content: content["pose_noise"].update(values))


_CLOCK = r"\bclock|\bstamps?\b"  # what names a fault of a clock


def _clock_faults() -> list[Fault]:
    """Images that are stamped late or early."""
    return [
        Fault("clock: all 30 ms late", _CLOCK, partial(_later, 0.03, CAMERAS), hidden_on_straight=_CLOCK),
        Fault("clock: all 60 ms early", _CLOCK, partial(_later, -0.06, CAMERAS), hidden_on_straight=_CLOCK),
        Fault("clock: all 120 ms late", _CLOCK, partial(_later, 0.12, CAMERAS), hidden_on_straight=_CLOCK),
        Fault(
            "clock: front 120 ms late", _CLOCK, partial(_later, 0.12, ("front",)), hidden_on_straight=_CLOCK
        ),
        Fault("clock: rear 60 ms late", _CLOCK, partial(_later, 0.06, ("rear",)), hidden_on_straight=_CLOCK),
        Fault("clock: all 400 ms late", _CLOCK, partial(_later, 0.4, CAMERAS), hidden_on_straight=_CLOCK),
    ]


def _convention_faults() -> list[Fault]:
    """Poses and stamps by other conventions of axes, angles and units."""
    return [
        Fault(
            "axes swapped",
            r"\baxes|swapped|mirror",
            partial(edit_poses, lambda t, p: (t, _swap_axes(p))),
        ),
        Fault(
            "yaw clockwise from north",
            "north|clockwise",
            partial(edit_poses, lambda t, p: (t, _turned(p, np.pi / 2 - _yaw_of(p)))),
        ),
        Fault(
            "NED: axes swapped and yaw from north",
            "NED|mirror|swapped",
            partial(edit_poses, lambda t, p: (t, _turned(_swap_axes(p), np.pi / 2 - _yaw_of(p)))),
            hidden_on_straight="mirror|swapped|NED",
        ),
        Fault(
            "yaw off by 180 deg",
            "180|backward|opposite",
            partial(edit_poses, lambda t, p: (t, _turned(p, _yaw_of(p) + np.pi))),
        ),
        Fault("quaternion w first", "quaternion|qw", _w_first),
        Fault(
            "poses inverted",
            "invers|vehicle_from_map",
            partial(edit_poses, lambda t, p: (t, np.linalg.inv(p))),
        ),
        Fault(
            "pose stamps in ns",
            r"nanosec|\bunit|not seconds",
            partial(_scaled_stamps, factor=1e9, of_poses=True),
        ),
        Fault(
            "image stamps in ms",
            r"millisec|\bunit|not seconds",
            partial(_scaled_stamps, factor=1e3, of_poses=False),
        ),
        Fault("latitude and longitude as metres", "degree|latitude", partial(edit_poses, _as_degrees)),
        Fault("positions in feet", "feet", partial(edit_poses, _as_feet)),
        Fault("z axis down", r"z axis|upside|\bz\b.* down", partial(edit_poses, _z_down)),
    ]


def _motion_faults() -> list[Fault]:
    """Positions, heights and headings that are off, jump or stand."""
    return [
        Fault(
            "heading off by 2 deg",
            None,
            partial(edit_poses, lambda t, p: (t, _turned(p, _yaw_of(p) + 0.035))),
        ),
        Fault("heights of 46.2 m", None, partial(edit_poses, partial(_raise, 46.2))),
        Fault("heights of 1.8 m", None, partial(edit_poses, partial(_raise, 1.8))),
        Fault("grade of 0.3 %", None, partial(edit_poses, partial(_tilt, 0.003))),
        Fault("grade of 1 %", None, partial(edit_poses, partial(_tilt, 0.01))),
        Fault(
            "position jumps 0.5 m for 15 m",
            r"\bjump|\bposition|\bfix\b",
            partial(edit_poses, partial(_jump, 0.5, 15.0)),
        ),
        Fault(
            "float solution of 0.3 m",
            r"\bpositions?\b|noise|scatter|\bfloat",
            partial(edit_poses, partial(_float_solution, 0.3)),
        ),
        Fault("poses frozen for 3 s", "frozen|repeat|jump|stands", partial(edit_poses, _frozen_poses)),
        Fault(
            "antenna 1.2 m ahead of the axle",
            r"antenna|lever|\bsurvey|\bcentre|\borigin",
            partial(edit_poses, partial(_lever, 1.2, 0.0)),
            hidden_on_straight=r"antenna|lever|\bsurvey|\bcentre|\borigin",
        ),
        Fault(
            "antenna 0.8 m to the left",
            r"antenna|lever|\bsurvey|\bcentre|\borigin",
            partial(edit_poses, partial(_lever, 0.0, 0.8)),
            hidden_on_straight=r"antenna|lever|\bsurvey|\bcentre|\borigin",
        ),
    ]


def _noise_faults() -> list[Fault]:
    """Noise of poses that is stated too large or too small."""
    return [
        Fault("pose_noise: heading 0.15", r"\bnoise\b|heading_rad", partial(_noise, heading_rad=0.15)),
        Fault("pose_noise: position 2.0", r"\bnoise\b|position_m", partial(_noise, position_m=2.0)),
        Fault(
            "pose_noise a tenth of the truth",
            r"noise|scatter",
            partial(
                _noise,
                position_m=0.001,
                position_drift_m=0.0008,
                heading_rad=0.0001,
                heading_drift_rad=0.00008,
                roll_pitch_rad=0.0002,
                roll_pitch_drift_rad=0.0001,
            ),
        ),
    ]


def poses_faults() -> list[Fault]:
    """All that can be wrong with times and poses."""
    return [*_clock_faults(), *_convention_faults(), *_motion_faults(), *_noise_faults()]
