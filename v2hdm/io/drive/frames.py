"""The vehicle's own frames in a ``drive.yaml``, and the way from its vehicle to its cameras in the bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.io.drive.sources import Sources
from v2hdm.io.importers.bag.frames import Frames
from v2hdm.io.importers.bag.streams import TfStream
from v2hdm.records import CameraFrames, FrameStep
from v2hdm.safe.fields import take_frame, take_frame_height

_Reader = Callable[[], Mapping[str, CameraFrames]]


def plan_frames(
    content: Mapping[str, Any], entries: Mapping[str, Mapping[str, Any]], sources: Sources, where: str
) -> _Reader:
    """The function that reads the frames of the cameras ``entries``, to be called once all is planned.

    A frame that the bag's transforms do not lead to from the vehicle's is refused where they have it not, and
    has no chain, with the reason, where they move.
    """
    height_m = take_frame_height(
        content.get("vehicle_frame_height_m", 0.0), f"{where}: vehicle_frame_height_m", DriveError
    )
    named = content.get("vehicle_frame")
    vehicle = "" if named is None else take_frame(named, f"{where}: vehicle_frame", DriveError)
    names = {
        camera: take_frame(entry["frame"], f"{where}: camera '{camera}', frame", DriveError)
        for camera, entry in entries.items()
        if entry.get("frame") is not None
    }
    stream = TfStream(f"{where}: vehicle_frame", needed=False)
    has_tree = sources.bag is not None and vehicle and names
    folder = sources.want(stream) if has_tree else None

    def frames_of_cameras() -> Mapping[str, CameraFrames]:
        tree = Frames({}) if folder is None else stream.frames(folder())
        vehicle_in_tree = tree.needed(vehicle, f"{where}: vehicle_frame") if vehicle else ""
        return {
            camera: _frames_of(tree, vehicle_in_tree, names.get(camera, ""), height_m) for camera in entries
        }

    return frames_of_cameras


def _frames_of(tree: Frames, vehicle: str, name: str, height_m: float) -> CameraFrames:
    """The frames of a camera whose images are in the frame ``name``, either empty if not stated."""
    camera = tree.named(name, vehicle)
    if not vehicle or not name or camera is None:
        return CameraFrames(vehicle, name, height_m)
    link = tree.link(vehicle, camera)
    if link.steps is not None:
        return CameraFrames(vehicle, camera, height_m, link.steps)
    if tree.leads(vehicle, camera):
        return CameraFrames(vehicle, camera, height_m, problem=link.problem)
    # The camera's driver knows its own frames alone: what they hang on is what the calibration tells.
    root = tree.root(camera)
    driver_link = tree.link(root, camera)
    if driver_link.steps is None:
        return CameraFrames(vehicle, camera, height_m, problem=driver_link.problem)
    return CameraFrames(vehicle, camera, height_m, (FrameStep(vehicle, root, None), *driver_link.steps))
