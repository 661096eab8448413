"""Arrows, chevrons and other symbols: evidence against the markings that lie upon them.

From some places only the shaft of an arrow is seen, and is a dash as far as its image goes. Other images
show the whole arrow there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px
from v2hdm.geometry.lens import undistort_points
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.records import Drive, FloatArray, ImageDetections, IntArray

_MAX_RANGE_M = 16.0
"""Farther from the camera a symbol's place on the ground is too vague to speak against a neighbour."""


@dataclass(frozen=True)
class Symbols:
    """N detected symbols: ``camera`` and ``frame`` (N,) as in sightings, pinhole outlines, classes."""

    camera: IntArray
    frame: IntArray
    outlines_pinhole_px: tuple[FloatArray, ...]
    kinds: tuple[str, ...]


NO_SYMBOLS = Symbols(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), (), ())


def collect_symbols(
    drive: Drive,
    detections: Sequence[ImageDetections],
    camera_index: Mapping[str, int],
    frame_of_image: IntArray,
) -> Symbols:
    """The symbols that the images of some cameras show, lens distortion removed."""
    camera, frame, outlines, kinds = [], [], [], []
    for found in detections:
        name = drive.images[found.image].camera
        if name not in camera_index:
            continue
        for marking in found.markings:
            if len(marking.outline_px) >= 3:
                camera.append(camera_index[name])
                frame.append(int(frame_of_image[found.image]))
                kinds.append(marking.kind)
                outlines.append(undistort_points(drive.cameras[name].info, marking.outline_px))
    indices = np.array(camera, dtype=np.int64), np.array(frame, dtype=np.int64)
    return Symbols(*indices, tuple(outlines), tuple(kinds))


def images_with_symbol(symbols: Symbols, rig: Rig, points_map: FloatArray) -> IntArray:
    """In how many images a symbol lies on each of the ground points (G, 2); nan points have none."""
    count = np.zeros(len(points_map), dtype=np.int64)
    known = np.flatnonzero(np.isfinite(points_map).all(axis=1))
    for ground in outlines_on_ground(symbols, rig):
        if ground is None:
            continue
        size_m = float(np.ptp(ground, axis=0).max())
        near = known[np.linalg.norm(points_map[known] - ground.mean(axis=0), axis=1) < size_m]
        polygon = (ground - ground.mean(axis=0)).astype(np.float32)
        for group in near:
            at = (points_map[group] - ground.mean(axis=0)).tolist()
            count[group] += cv2.pointPolygonTest(polygon, at, False) >= 0
    return count


def outlines_on_ground(symbols: Symbols, rig: Rig) -> list[FloatArray | None]:
    """The outline (K, 2) of each symbol in the map, None of those too far away."""
    if not len(symbols.camera):
        return []
    map_from_vehicle = rig.map_from_vehicle[symbols.frame]
    cam_from_map = rig.cam_from_vehicle[symbols.camera] @ np.linalg.inv(map_from_vehicle)
    homographies = ground_from_pinhole_px(rig.intrinsic[symbols.camera], cam_from_map)
    found: list[FloatArray | None] = []
    for homography, pose, outline in zip(
        homographies, map_from_vehicle, symbols.outlines_pinhole_px, strict=True
    ):
        ground = apply_in_front(homography, outline)
        near = np.isfinite(ground).all() and (
            np.linalg.norm(ground - pose[:2, 3], axis=1).max() <= _MAX_RANGE_M
        )
        found.append(ground if near else None)
    return found
