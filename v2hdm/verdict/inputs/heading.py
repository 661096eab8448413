"""Course over ground against the recorded attitude: the conventions that users mix up, reported by name.

A vehicle goes where it points. For each chord of the path its direction is compared with the vehicle's x
axis midway; where they disagree, each usual mistake is undone in turn, and the one after which they agree
is the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum

import numpy as np

from v2hdm.geometry.planar import angle_between, wrapped
from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_euler, rotation_from_quaternion
from v2hdm.records import BoolArray, FloatArray
from v2hdm.verdict.inputs.poses import STEEPEST_DEG, Chords, Motion
from v2hdm.verdict.verdict import Finding, Status, judge, passed

# Course and heading agree within this: so far off is an origin 1.5 m ahead of the axle on a circle of 6 m.
_AGREES_RAD = np.deg2rad(15)
# A convention fits if this share of the chords agrees: the rest may be wheel spin, ferries, bad fixes.
_FITS = 0.8
_LEVER_M = 0.3  # origin this far from the axle, along the vehicle: 15 sigmas of a surveyed camera centre
# Sigmas beyond which an offset is reported: the poses' drift makes sigmas optimistic by up to two.
_SURE = 5.0
_CURVED_PER_M = 0.02  # curvature of a turn that shows where the origin sits

Undo = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Corrects positions (P, 3) and rotations (P, 3, 3)."""


def _turned(sign: float, offset_deg: float) -> Undo:
    """Undo a yaw that is ``sign`` times the true one plus an offset: true yaw = sign * yaw + offset."""

    def undo(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        forward = rotation[:, :2, 0]
        yaw = sign * np.arctan2(forward[:, 1], forward[:, 0]) + np.deg2rad(offset_deg)
        zero = np.zeros(len(yaw))
        return position, rotation_from_euler(zero, zero, yaw)

    return undo


def _reordered(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    return position, rotation_from_quaternion(quaternion_from_rotation(rotation)[:, [1, 2, 3, 0]])


def _inverted(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    back = np.swapaxes(rotation, 1, 2)
    return -(back @ position[:, :, None])[:, :, 0], back


def _axes(matrix: list[list[float]]) -> Undo:
    return lambda position, rotation: (position, np.asarray(rotation @ np.array(matrix)))


# The usual mistakes, the likelier first: how to undo each, and what to write instead.
_CONVENTIONS: Mapping[str, tuple[Undo, str]] = {
    "quaternion order": (
        _reordered,
        "the quaternions are in the order qw qx qy qz; write them as qx qy qz qw",
    ),
    "z down": (
        _axes([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
        "the vehicle's z axis points down (x forward, y right); turn the attitude to x forward, y left, z up",
    ),
    "optical frame": (
        _axes([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        "the poses are those of a camera (z forward); give those of the vehicle (x forward, y left, z up)",
    ),
    "from north": (
        _turned(-1, 90),
        "yaw counts clockwise from north; write yaw = 90 deg - it, counter-clockwise from east",
    ),
    "clockwise": (_turned(-1, 0), "yaw counts clockwise; write it with the other sign"),
    "90 ahead": (_turned(1, -90), "yaw is 90 deg too large, as if y were forward; subtract 90 deg"),
    "90 behind": (_turned(1, 90), "yaw is 90 deg too small, counted from north; add 90 deg"),
    "inverse": (_inverted, "the poses are vehicle_from_map; write their inverse, the vehicle in the map"),
    "south": (_turned(-1, 180), "yaw counts clockwise from west; write yaw = 180 deg - it"),
    "from south": (_turned(-1, -90), "yaw counts clockwise from south; write yaw = -90 deg - it"),
}

# Conventions of yaw under which poses alone look like a path whose axes are swapped.
_REFLECTED = ("from north", "clockwise", "south", "from south")

AXES_SWAPPED = (
    "x and y of the positions are swapped or one has the wrong sign, which mirrors the world; write x east "
    "and y north"
)


class Path(Enum):
    """The recorded path, judged by the images' ground."""

    AS_GIVEN = "path and yaw agree with the images"
    RIGHT_YAW_WRONG = "the path is right, the yaw is not"
    MIRRORED = "the path is mirrored"


def check_heading(motion: Motion, path: Path | None = None) -> list[Finding]:
    """Whether the recorded poses drive where they point, z up; ``path`` is the verdict of the ground."""
    if not len(motion.chords):
        return []  # the check of the path's length says so
    _, either = _agreement(motion)
    if either >= _FITS:
        return [_as_given(motion, either, path), *_origin(motion)]
    says = _cause(motion, path)
    if says is None:
        return []  # the check of the attitude says so
    return [Finding("heading", Status.FAIL, 1 - either, 1 - _FITS, "", says, "poses")]


def _as_given(motion: Motion, agrees: float, path: Path | None) -> Finding:
    back = float((np.abs(_course_minus_yaw(motion)) > np.pi / 2).mean())
    if back > _FITS and path is Path.RIGHT_YAW_WRONG:
        says = "yaw points backwards although the images drive forwards; turn yaw by 180 deg"
        return Finding("heading", Status.FAIL, back, _FITS, "", says, "poses")
    if back > _FITS and path is not Path.AS_GIVEN:
        says = (
            "the vehicle drives backwards all the time; if it did not, yaw is off by 180 deg (turn it), or "
            "the poses are vehicle_from_map (write their inverse)"
        )
        return Finding("heading", Status.WARN, back, _FITS, "", says, "poses")
    how = f"it drives backwards on {100 * back:.0f} % of the way" if back > 0.01 else "it drives forwards"
    return passed("heading", "poses", f"the vehicle goes where its heading points; {how}", 1 - agrees)


def _origin(motion: Motion) -> list[Finding]:
    """The lever from the axle to the origin, as turns show it."""
    offset = _course_minus_yaw(motion)
    reverse = np.abs(offset) > np.pi / 2
    offset = np.where(reverse, wrapped(offset + np.pi), offset)
    curvature = motion.turn_rad / np.linalg.norm(motion.course, axis=1) * np.where(reverse, -1.0, 1.0)
    keep = np.abs(offset) < _AGREES_RAD
    # Neighbouring chords share poses: this many count as one.
    overlap = float(max(1.0, np.median(motion.chords.last - motion.chords.first)))
    return _lever(offset[keep], curvature[keep], overlap)


def _lever(offset_rad: FloatArray, curvature: FloatArray, overlap: float) -> list[Finding]:
    """Distance of the origin ahead of the axle, which does not slip sideways: tan(offset) / curvature."""
    turns = np.abs(curvature) > _CURVED_PER_M
    if turns.sum() < 30:
        same = "a straight route looks the same in a mirrored world (x and y swapped, NED): include a turn"
        unknown = "straight poses do not show how far the origin (antenna) is from the axle: include a turn"
        return [passed("mirrored", "poses", same), passed("origin", "poses", unknown)]
    centred = offset_rad - np.median(offset_rad[~turns]) if (~turns).any() else offset_rad
    lever = np.tan(centred[turns]) / curvature[turns]
    weight = curvature[turns] ** 2
    value = float((weight * lever).sum() / weight.sum())
    residual = np.tan(centred[turns]) - value * curvature[turns]
    sigma = float(np.std(residual) / np.sqrt(weight.sum() / overlap))
    return [
        judge(
            "origin", "poses", value, _LEVER_M + _SURE * sigma, "m",
            fine="in turns the recorded point follows its heading, like one at the rear axle",
            wrong=f"in turns the recorded point moves as one {abs(value):.1f} m "
            f"{'ahead of' if value > 0 else 'behind'} the rear axle does (the antenna?); give the poses and "
            "the survey of the cameras the same origin",
            status=Status.WARN,
        )
    ]  # fmt: skip


def _cause(motion: Motion, path: Path | None) -> str | None:
    """The sentence that names the error; None if it is not the heading's."""
    if path is Path.MIRRORED:
        return AXES_SWAPPED
    fitting = [name for name, (undo, _) in _CONVENTIONS.items() if _agreement(motion, undo)[0] >= _FITS]
    if fitting:
        says = [_CONVENTIONS[name][1] for name in fitting[:2]]
        if path is None and fitting[0] in _REFLECTED:
            says.insert(1, AXES_SWAPPED)
        return "; or ".join(says)
    if _upright(motion.rotation, motion.chords).mean() < _FITS:
        return None
    offset = _course_minus_yaw(motion)
    offset_rad = _circular_median(offset)
    if (np.abs(wrapped(offset - offset_rad)) < _AGREES_RAD).mean() >= _FITS:
        return (
            f"the vehicle drives {abs(np.rad2deg(offset_rad)):.0f} deg to the "
            f"{'left' if offset_rad > 0 else 'right'} of its heading all the time; subtract this offset of "
            "the heading antennas from yaw"
        )
    if _turns_too_fast(motion):
        return "yaw turns 57 times as fast as the path: degrees were taken for radians; convert yaw"
    return "heading and path have nothing to do with each other; check that both are of one drive"


def _upright(rotation: FloatArray, chords: Chords) -> BoolArray:
    """Flags (N,) of the chords on which the vehicle is upright."""
    return np.asarray(rotation[chords.first, 2, 2] > np.cos(np.deg2rad(STEEPEST_DEG)))


def _turns_too_fast(motion: Motion) -> bool:
    """Whether the heading turns about 180 / pi times as much as the path."""
    course = np.unwrap(np.arctan2(motion.course[:, 1], motion.course[:, 0]))
    path_turn = np.abs(np.diff(course)).sum()
    steps = angle_between(motion.rotation[:-1, :2, 0], motion.rotation[1:, :2, 0])
    return bool(np.abs(steps).sum() > 10 * max(path_turn, 0.1))


def _agreement(motion: Motion, undo: Undo | None = None) -> tuple[float, float]:
    """Fractions of chords on which the vehicle is upright and points ahead, and ahead or back."""
    position = motion.position
    rotation = motion.rotation
    chords = motion.chords
    if undo is not None:
        position, rotation = undo(position, rotation)
    angle = angle_between(_forward(rotation, chords), position[chords.last, :2] - position[chords.first, :2])
    along = (np.abs(np.sin(angle)) < np.sin(_AGREES_RAD)) & _upright(rotation, chords)
    return float((along & (np.cos(angle) > 0)).mean()), float(along.mean())


def _course_minus_yaw(motion: Motion) -> FloatArray:
    """Angles (N,) from the vehicle's x axis, midway on each chord, to the chord."""
    return angle_between(_forward(motion.rotation, motion.chords), motion.course)


def _forward(rotation: FloatArray, chords: Chords) -> FloatArray:
    """The vehicle's x axis (N, 2) in the plane, midway on each chord."""
    return np.asarray(rotation[chords.first, :2, 0] + rotation[chords.last, :2, 0])


def _circular_median(angles_rad: FloatArray) -> float:
    mean = np.arctan2(np.sin(angles_rad).mean(), np.cos(angles_rad).mean())
    return float(wrapped(np.array([mean + np.median(wrapped(angles_rad - mean))]))[0])
