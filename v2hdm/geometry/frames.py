"""A calibration in the vehicle's own tree of frames: the edges that it may replace, and their transforms."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import inverse, make_transform
from v2hdm.records import CameraFrames, FloatArray, FrameStep


def frame_from_vehicle(height_m: float) -> FloatArray:
    """The transform (4, 4) from ``vehicle``, on the ground, to a frame ``height_m`` above it."""
    out = np.eye(4)
    out[2, 3] = -height_m
    return out


def edges_of(frames: CameraFrames, cam_from_vehicle: FloatArray) -> list[FrameStep]:
    """Each edge between vehicle and camera with the transform that makes the tree agree with a calibration.

    The other edges stay as they are; the last edge is the one nearest to the camera. An edge that the tree
    lacks is the only one: without it the tree has no place for the calibration.
    """
    frame_from_cam = frame_from_vehicle(frames.height_m) @ inverse(cam_from_vehicle)
    if frames.rectified_from_camera is not None:  # the tree's frame is that of the camera as it is built
        frame_from_cam = frame_from_cam @ make_transform(frames.rectified_from_camera, np.zeros(3))
    if not frames.steps:
        return [FrameStep(frames.vehicle, frames.camera, frame_from_cam)]
    nodes = nodes_of(frames)
    is_down = [step.parent == node for step, node in zip(frames.steps, nodes, strict=False)]
    near_from_far = [_near_from_far(step, down) for step, down in zip(frames.steps, is_down, strict=True)]
    edges = []
    for place, (step, down) in enumerate(zip(frames.steps, is_down, strict=True)):
        near_from_frame = inverse(_chained(near_from_far[:place]))
        cam_from_far = inverse(_chained(near_from_far[place + 1 :]))
        near_from_far_end = near_from_frame @ frame_from_cam @ cam_from_far
        edge = FrameStep(step.parent, step.child, near_from_far_end if down else inverse(near_from_far_end))
        if step.parent_from_child is None:
            return [edge]
        edges.append(edge)
    return edges


def nodes_of(frames: CameraFrames) -> list[str]:
    """The frames that the steps of ``frames`` lead through, from the vehicle's to the camera's."""
    nodes = [frames.vehicle]
    for step in frames.steps:
        nodes.append(step.child if step.parent == nodes[-1] else step.parent)
    return nodes


def _near_from_far(step: FrameStep, is_down: bool) -> FloatArray:
    """The transform from a step's end at the camera to that at the vehicle; the identity if unknown."""
    if step.parent_from_child is None:
        return np.eye(4)
    return step.parent_from_child if is_down else inverse(step.parent_from_child)


def _chained(transforms: list[FloatArray]) -> FloatArray:
    out = np.eye(4)
    for transform in transforms:
        out = out @ transform
    return out
