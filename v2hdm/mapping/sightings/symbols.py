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


def images_with_symbol(symbols: Symbols, rig: Rig, corners_map: FloatArray) -> IntArray:
    """In how many images a symbol lies along each of the quadrilaterals (G, 4, 2); nan ones have none.

    It lies along one that it holds most of the middle line of: an arrow that crosses a stop line does not.
    """
    count = np.zeros(len(corners_map), dtype=np.int64)
    known = np.flatnonzero(np.isfinite(corners_map).all(axis=(1, 2)))
    centre, points = corners_map.mean(axis=1), _middle_line(corners_map)
    for ground in outlines_on_ground(symbols, rig):
        if ground is None:
            continue
        middle, size_m = ground.mean(axis=0), float(np.ptp(ground, axis=0).max())
        polygon = (ground - middle).astype(np.float32)
        for group in known[np.linalg.norm(centre[known] - middle, axis=1) < size_m]:
            inside = [
                cv2.pointPolygonTest(polygon, at, False) >= 0 for at in (points[group] - middle).tolist()
            ]
            count[group] += 2 * sum(inside) > len(inside)
    return count


def _middle_line(corners_map: FloatArray) -> FloatArray:
    """Five points (G, 5, 2) spread evenly over the longer middle lines of quadrilaterals (G, 4, 2)."""
    sides = (corners_map + np.roll(corners_map, -1, axis=1)) / 2
    across = np.stack([sides[:, 2] - sides[:, 0], sides[:, 3] - sides[:, 1]], axis=1)
    longer = np.argmax(np.linalg.norm(across, axis=2), axis=1)
    way = across[np.arange(len(across)), longer]
    return np.asarray(corners_map.mean(axis=1)[:, None] + np.linspace(-0.4, 0.4, 5)[:, None] * way[:, None])


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
