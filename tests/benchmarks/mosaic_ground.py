"""The mosaic of a rendered port against its truth: cells that show what stands, width beyond the markings.

    python -m tests.benchmarks.mosaic_ground RESULT DRIVE [--config port1] [--frames 300]

``DRIVE`` is the rendered drive that ``RESULT`` is of. What stands is known: each image is replaced by a mask
of the boxes of its scene and blended as the image was, so that a cell shows what stands where more than half
of its weight does. Width is measured outwards from the markings that no other lies beyond: how far the mosaic
goes on without a hole. Where it stops within a metre, the reason is one of

- ``no image``: no image shows the place within the reach of its camera;
- ``hidden``: something stands in the way in all that do;
- ``not told``: images see the place, and the consensus does not take it for ground.

The thresholds of :mod:`v2hdm.mosaic.consensus` were chosen on port 2 of its own seed.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from v2hdm.benchmark.sites import site_of
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.drive import drive_of
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mosaic.blend import blend
from v2hdm.mosaic.consensus import Consensus
from v2hdm.mosaic.result import SEEN_ALPHA, Ground, ground_of
from v2hdm.mosaic.views import REACH_M, Lens, Shot
from v2hdm.records import BoolArray, CameraInfo, FloatArray, HDMap
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.drive import hidden_by
from v2hdm.simulate.render.scene import Box
from v2hdm.store import names

CELL_M = 0.08  # side of a cell of the mosaic that is scored, m
_MASK_STEP_PX = 8  # distance of the pixels at which a mask is computed
_FARTHEST_M = 14.0  # distance from the way up to which markings count: that of the mosaic
_ROW_M = 6.0  # markings as near as this along the way are of one place
_STEP_M = 0.1  # steps in which the width is measured
_ENOUGH_M = 1.0  # width that is asked for


def main() -> None:
    """Score one mosaic, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--config", default="port2", help="port1 or port2, as it ships")
    parser.add_argument("--seed", type=int, help="another seed than the shipped one")
    parser.add_argument("--frames", type=int, help="use the first so many frames of each camera alone")
    parser.add_argument("--without-consensus", action="store_true", help="each image counts everywhere")
    parser.add_argument("--picture", type=Path, help="PNG in which cells that show what stands are red")
    parsed = parser.parse_args()
    config = site_of(parsed.config).config
    if parsed.seed is not None:
        config = replace(config, seed=parsed.seed)
    port = build_port(config)
    hd_map = read_geojson(parsed.result / names.MAP)
    ground = ground_of(parsed.result, drive_of(parsed.result, parsed.drive), CELL_M, hd_map)
    if parsed.frames is not None:
        ground = replace(ground, after=[shot for shot in ground.after if int(shot.path.stem) < parsed.frames])
    began_s = time.process_time()
    consensus = None if parsed.without_consensus else ground.consensus()
    rgba = _blended(ground, ground.after, consensus)
    print(f"{len(ground.after)} images, {time.process_time() - began_s:.0f} s CPU", flush=True)
    is_shown = rgba[..., 3] >= SEEN_ALPHA
    _print_width(ground, port, hd_map, is_shown)
    stands = _shows_standing(ground, port, consensus) & is_shown
    print(
        f"{is_shown.sum() * CELL_M**2:.0f} m2 shown, {100 * stands.sum() / max(is_shown.sum(), 1):.2f} % of "
        "them show what stands"
    )
    if parsed.picture:
        picture = np.where(is_shown[..., None], rgba[..., 2::-1], (255, 200, 255)).astype(np.uint8)
        picture[stands] = (0, 0, 255)
        cv2.imwrite(str(parsed.picture), picture)


def _blended(ground: Ground, shots: Sequence[Shot], consensus: Consensus | None) -> np.ndarray:
    """The mosaic (rows, columns, 4) of some images by a consensus of them all."""
    canvas = ground.canvas
    rgba = np.zeros((canvas.rows, canvas.columns, 4), dtype=np.uint8)
    for sheet in blend(canvas, shots, ground.lenses, None, consensus, ground.area):
        rows, columns = sheet.rgba.shape[:2]
        rgba[sheet.row : sheet.row + rows, sheet.column : sheet.column + columns] = sheet.rgba
    return rgba


def _shows_standing(ground: Ground, port: Port, consensus: Consensus | None) -> BoolArray:
    """The cells (rows, columns) most of whose weight is of pixels that show what stands."""
    with TemporaryDirectory() as scratch:
        masks = []
        for shot in ground.after:
            path = Path(scratch) / f"{shot.camera}_{shot.path.stem}.png"
            mask = _mask(port, shot)
            cv2.imwrite(str(path), cv2.merge([mask, mask, mask]), [cv2.IMWRITE_PNG_COMPRESSION, 1])
            masks.append(replace(shot, path=path))
        return np.asarray(_blended(ground, masks, consensus)[..., 0] > 127)


def _mask(port: Port, shot: Shot) -> np.ndarray:
    """255 where a pixel (height, width) that looks at the ground within reach shows what stands."""
    info = port.cameras[shot.camera].info
    frame = int(shot.path.stem)
    cam_from_map = port.cam_from_map(shot.camera, frame)
    centre_map = camera_centre(cam_from_map)
    v, u = np.mgrid[
        _MASK_STEP_PX // 2 : info.height : _MASK_STEP_PX, _MASK_STEP_PX // 2 : info.width : _MASK_STEP_PX
    ]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    pinhole = np.column_stack([undistort_points(info, pixels), np.ones(len(pixels))])
    rays_map = pinhole @ np.linalg.inv(info.intrinsic).T @ cam_from_map[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        points_map = centre_map[:2] - centre_map[2] / rays_map[:, 2:] * rays_map[:, :2]
        is_near = (rays_map[:, 2] < 0) & (np.hypot(*(points_map - centre_map[:2]).T) < REACH_M + 1)
    is_hidden = np.zeros(len(pixels), dtype=np.bool_)
    is_near_hidden = hidden_by(_boxes_near(port, frame, centre_map), centre_map, points_map[is_near])
    is_hidden[is_near] = is_near_hidden
    mask = (255 * is_hidden.reshape(v.shape)).astype(np.uint8)
    return cv2.resize(mask, (info.width, info.height), interpolation=cv2.INTER_NEAREST)


def _boxes_near(port: Port, frame: int, centre_map: FloatArray) -> list[Box]:
    """The boxes of a scene that may hide ground within a camera's reach."""
    boxes = port.renderer.scene.boxes + port.moving_boxes(frame)
    return [
        box
        for box in boxes
        if np.hypot(*(box.centre_map - centre_map[:2])) < REACH_M + 1 + np.hypot(*box.size_m[:2])
    ]


class _Outermost(NamedTuple):
    """The farthest corners (M, 2) of the outermost markings, and the directions (M, 2) away from the way."""

    corners_map: FloatArray
    outwards_map: FloatArray


def _outermost(hd_map: HDMap, way_map: FloatArray) -> _Outermost:
    """The markings beyond which no other lies, on either side of the way (P, 2)."""
    outlines = [marking.corners_map for marking in hd_map.markings]
    centres = np.array([outline.mean(axis=0) for outline in outlines])
    aside_m, nearest = cKDTree(way_map).query(centres)
    corners = []
    outwards = []
    for j, outline in enumerate(outlines):
        if not 2 <= aside_m[j] <= _FARTHEST_M:
            continue
        foot = way_map[nearest[j]]
        side = (centres[j] - foot) / aside_m[j]
        is_beside = np.linalg.norm(centres - centres[j], axis=1) < _ROW_M
        if (is_beside & ((centres - foot) @ side > aside_m[j] + 0.5)).any():
            continue
        corners.append(outline[np.argmax((outline - foot) @ side)])
        outwards.append(side)
    return _Outermost(np.reshape(corners, (-1, 2)), np.reshape(outwards, (-1, 2)))


def _print_width(ground: Ground, port: Port, hd_map: HDMap, is_shown: BoolArray) -> None:
    """Print how far the mosaic reaches beyond the outermost markings, and why no farther."""
    canvas = ground.canvas
    way_map = np.array([shot.centre_map[:2] for shot in ground.after if shot.centre_map is not None])
    edge = _outermost(hd_map, way_map)
    steps_m = np.arange(_STEP_M, _ENOUGH_M + _STEP_M / 2, _STEP_M)
    points_map = edge.corners_map[:, None] + steps_m[:, None] * edge.outwards_map[:, None]
    offset = (points_map - canvas.corner_map) / canvas.cell_m
    column = np.clip(np.floor(offset[..., 0]).astype(int), 0, canvas.columns - 1)
    row = np.clip(np.floor(-offset[..., 1]).astype(int), 0, canvas.rows - 1)
    is_there = is_shown[row, column]
    count = len(edge.corners_map)
    is_wide = is_there.all(axis=1)
    print(f"{count} outermost markings: {100 * is_wide.mean():.0f} % have {_ENOUGH_M:g} m beyond them")
    first = np.argmin(is_there, axis=1)
    stops_map = points_map[np.arange(count), first][~is_wide]
    reasons = Counter(_reason(views) for views in _views_of(ground, port, stops_map))
    print("the others stop:", ", ".join(f"{number} {reason}" for reason, number in reasons.most_common()))
    visible = sum(reason == "not told" for reason in reasons.elements())
    reachable = is_wide.sum() + visible
    print(f"where an image shows the ground: {100 * is_wide.sum() / max(reachable, 1):.0f} % of {reachable}")


class _Views(NamedTuple):
    """How many images cover a place on the ground, and how many of them see it."""

    covering: int
    seeing: int


def _views_of(ground: Ground, port: Port, points_map: FloatArray) -> list[_Views]:
    """The images of each point (N, 2) on the ground, by the truth of the scene."""
    covering = np.zeros(len(points_map), dtype=int)
    seeing = np.zeros(len(points_map), dtype=int)
    for shot in ground.after:
        frame = int(shot.path.stem)
        cam_from_map = port.cam_from_map(shot.camera, frame)
        centre_map = camera_centre(cam_from_map)
        is_covered = _covered(port.cameras[shot.camera].info, ground.lenses, shot, cam_from_map, points_map)
        is_covered &= np.hypot(*(points_map - centre_map[:2]).T) < REACH_M
        if not is_covered.any():
            continue
        is_hidden = hidden_by(_boxes_near(port, frame, centre_map), centre_map, points_map[is_covered])
        covering[is_covered] += 1
        seeing[is_covered] += ~is_hidden
    return [_Views(int(a), int(b)) for a, b in zip(covering, seeing, strict=True)]


def _covered(
    info: CameraInfo,
    lenses: Mapping[str, Lens],
    shot: Shot,
    cam_from_map: FloatArray,
    points_map: FloatArray,
) -> BoolArray:
    """Which points (N, 2) on the ground lie in the part of an image that the mosaic uses."""
    points = np.column_stack([points_map, np.zeros(len(points_map))])
    points_cam = points @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    is_inside = points_cam[:, 2] > 0.3
    pinhole = points_cam[is_inside] @ info.intrinsic.T
    pixels = np.rint(distort_points(info, pinhole[:, :2] / pinhole[:, 2:])).astype(int)
    in_image = ((pixels >= 0) & (pixels < (info.width, info.height))).all(axis=1)
    trust = lenses[shot.camera].trust
    is_trusted = np.zeros(len(pixels), dtype=np.bool_)
    is_trusted[in_image] = trust[pixels[in_image, 1], pixels[in_image, 0]] > 0
    is_inside[is_inside] = is_trusted
    return np.asarray(is_inside)


def _reason(views: _Views) -> str:
    if not views.covering:
        return "no image"
    return "not told" if views.seeing else "hidden"


if __name__ == "__main__":
    main()
