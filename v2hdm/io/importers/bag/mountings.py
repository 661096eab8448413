"""Where a bag's frames put a camera: the optical frame that is meant, and what is wrong with another one.

ROS has two frames per camera (REP-103): ``camera_link``, x ahead and z up, and ``camera_link_optical``, z
ahead and y down, which headers of images should name. Drivers and simulators often name the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import LEVEL, mounting_angles
from v2hdm.geometry.rigid import inverse, make_transform
from v2hdm.io.importers.bag.frames import Frames
from v2hdm.records import FloatArray

_OPTICAL = "optical"
_HIGHEST = np.sin(np.deg2rad(30))  # sine of an optical axis' angle up from where no ground is seen; chosen
_ABOVE = 0.01  # sine of the angle above the horizon from which an axis points up, not level; chosen
_LEVEL = np.sin(np.deg2rad(20))  # sine of the angle up to which an axis counts as level; chosen
_MOST_FRAMES = 4  # most frames that a question for a camera's frame offers; chosen


class Mount(NamedTuple):
    """A camera's frame and ``vehicle_from_cam`` (4, 4), None where ``problem`` says why there is none.

    ``offer`` is the mounting that the problem's likeliest reason leads to, as ``drive.yaml`` has it.
    """

    frame: str
    vehicle_from_cam: FloatArray | None
    problem: str = ""
    offer: str = ""


def mount_of(frames: Frames, vehicle: str, names: Sequence[str], camera: str) -> Mount:
    """The mounting of the ``camera`` whose messages name the frames ``names``, the likelier ones first."""
    in_tree = [frame for name in names if (frame := frames.named(name, vehicle)) is not None]
    if not in_tree:
        return Mount(names[0] if names else "", None)
    frame = in_tree[0]
    if not vehicle:
        return Mount(frame, None)
    if frame == vehicle:
        return Mount("", None, f"its images name {frame}, the vehicle's own frame")
    vehicle_from_cam = frames.fixed(vehicle, frame)
    if vehicle_from_cam is None:
        return Mount(frame, None, frames.link(vehicle, frame).problem)
    if is_optical(vehicle_from_cam):
        return Mount(frame, vehicle_from_cam)
    children = {
        name: child
        for name in frames.below(frame)
        if _OPTICAL in name.lower()
        and (child := _pose_of(frames, vehicle, name)) is not None
        and is_optical(child)
    }
    if len(children) > 1:
        children = {name: child for name, child in children.items() if camera in name} or children
    if len(children) == 1:
        ((name, child),) = children.items()
        return Mount(name, child)
    elevation_deg = np.degrees(np.arcsin(np.clip(vehicle_from_cam[2, 2], -1, 1)))
    problem = f"{frame} is not an optical frame: its z axis, along which a camera looks, points "
    problem += f"{abs(elevation_deg):.0f} deg {'up' if elevation_deg > 0 else 'down'}"
    if children:
        return Mount("", None, f"{problem}; several hang on it: {', '.join(children)}")
    # Of a camera that looks along the frame's x.
    ahead = vehicle_from_cam @ make_transform(LEVEL, np.zeros(3))
    return Mount("", None, problem, _mounting_text(ahead) if is_optical(ahead) else "")


def is_optical(vehicle_from_cam: FloatArray) -> bool:
    """Whether a pose of a frame (4, 4) in the vehicle's can be a camera's that sees the ground: z not far up.

    A frame whose x is ahead, of a camera that looks down steeply, has z nearly level, and y as well.
    """
    up = vehicle_from_cam[2, :3]
    lies_on_its_side = up[2] > _ABOVE and abs(up[1]) < _LEVEL and abs(up[0]) > _HIGHEST
    return bool(up[2] < _HIGHEST and not lies_on_its_side)


def mounting_of(vehicle_from_cam: FloatArray) -> dict[str, list[float]]:
    """A pose (4, 4) as ``mounting`` of ``drive.yaml`` has it."""
    angles_deg = np.degrees(mounting_angles(inverse(vehicle_from_cam)))
    xyz_m = np.round(vehicle_from_cam[:3, 3], 9).tolist()
    return {"xyz_m": xyz_m, "rpy_deg": np.round(angles_deg, 9).tolist()}


def _mounting_text(vehicle_from_cam: FloatArray) -> str:
    """A pose (4, 4) as a short value of ``--set cameras.NAME.mounting``."""
    values = {
        key: [round(value, 3) + 0.0 for value in numbers]
        for key, numbers in mounting_of(vehicle_from_cam).items()
    }
    return f"'{{xyz_m: {values['xyz_m']}, rpy_deg: {values['rpy_deg']}}}'"


def _pose_of(frames: Frames, vehicle: str, name: str) -> FloatArray | None:
    """``vehicle_from_frame`` where fixed and sound transforms lead there."""
    try:
        return frames.fixed(vehicle, name)
    except DriveError:
        return None


def frames_like(frames: Frames, vehicle: str, camera: str) -> list[str]:
    """Frames fixed on the vehicle that may be a camera's by name and direction, the likeliest ones first."""
    fitting = [
        name
        for name in frames.names
        if name != vehicle
        and (_OPTICAL in name.lower() or camera.lower() in name.lower())
        and (pose := _pose_of(frames, vehicle, name)) is not None
        and is_optical(pose)
    ]
    fitting.sort(key=lambda name: (camera.lower() not in name.lower(), _OPTICAL not in name.lower(), name))
    return fitting[:_MOST_FRAMES]
