"""Cameras and frames as the mapping believes them to be.

Arrows, chevrons and other symbols: evidence against the markings that lie upon them.

From some places only the shaft of an arrow is seen, and is a dash as far as its image goes. Other images
show the whole arrow there.

Detections as one table of arrays: what every later step of the mapping works on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.errors import MappingError
from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px
from v2hdm.geometry.lens import has_distortion, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, Camera, CameraInfo, Drive, FloatArray, ImageDetections, IntArray


@dataclass(frozen=True)
class Rig:
    """Cameras and frames as the mapping currently believes them to be.

    ``intrinsic`` (C, 3, 3), ``cam_from_vehicle`` (C, 4, 4), ``map_from_vehicle`` (F, 4, 4).
    """

    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    map_from_vehicle: FloatArray

    @property
    def height_m(self) -> FloatArray:
        """Heights (C,) of the camera centres above the ground of the vehicle."""
        return np.asarray(np.maximum(camera_centre(self.cam_from_vehicle)[:, 2], 0.1))


def build_rig(
    infos: Mapping[str, CameraInfo], cam_from_vehicle: Mapping[str, FloatArray], map_from_vehicle: FloatArray
) -> Rig:
    """Stack cameras in the order of ``infos`` with the frames' poses (F, 4, 4)."""
    return Rig(
        intrinsic=np.stack([info.intrinsic for info in infos.values()]),
        cam_from_vehicle=np.stack([cam_from_vehicle[name] for name in infos]),
        map_from_vehicle=map_from_vehicle,
    )


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


SIDE_SIGMA_PX = 3.0
"""Largest sigma across, px, of a corner that is known to lie on a line; a vaguer one says next to nothing."""

POINT_SIGMA_PX = 10.0
"""Largest sigma, px, that a detector states for a corner that it takes for a point."""


@dataclass(frozen=True)
class Sightings:
    """S quadrilateral detections of a drive, in the order of its images.

    ``image`` indexes ``Drive.images``, ``camera`` indexes ``cameras``, ``frame`` indexes the
    F distinct time stamps ``stamp_s`` (F,) whose recorded poses are ``map_from_vehicle`` (F, 4, 4), so that
    images taken together share a frame. ``kind`` indexes ``kinds``, the names of the classes.
    ``corners_pinhole_px`` (S, 4, 2) have covariances ``covariance_px`` (S, 4, 2, 2), px^2; ``valid`` (S, 4)
    says which of them are points, small in every direction. ``symbols`` are those of the same images.
    ``visit`` (F,) is the visit of each frame, as in ``Image.visit``; frames are sorted by it, then by time.
    """

    cameras: tuple[str, ...]
    stamp_s: FloatArray
    map_from_vehicle: FloatArray
    image: IntArray
    camera: IntArray
    frame: IntArray
    kind: IntArray
    corners_pinhole_px: FloatArray
    covariance_px: FloatArray
    valid: BoolArray
    kinds: tuple[str, ...]
    visit: IntArray
    symbols: Symbols = NO_SYMBOLS

    def __len__(self) -> int:
        return len(self.image)

    @property
    def informs(self) -> BoolArray:
        """Which corners (S, 4) the adjustment may use: points, and corners that lie on a known line.

        The end of a dash that the image's border cuts is such a corner: its sigma is small across the dash
        and large along it. A corner that is no point, but claims to be small in every direction, is neither.
        """
        finite = np.asarray(np.isfinite(self.covariance_px).all(axis=(2, 3)))
        finite &= np.isfinite(self.corners_pinhole_px).all(axis=2)
        variance = np.linalg.eigvalsh(np.where(finite[..., None, None], self.covariance_px, np.eye(2)))
        line = (variance[..., 0] <= SIDE_SIGMA_PX**2) & (variance[..., 1] > POINT_SIGMA_PX**2)
        return np.asarray(finite & (self.valid | line))

    def subset(self, rows: IntArray | BoolArray) -> Sightings:
        """The sightings at ``rows`` (indices or a mask), over the same cameras and frames."""
        return Sightings(
            cameras=self.cameras,
            stamp_s=self.stamp_s,
            map_from_vehicle=self.map_from_vehicle,
            image=self.image[rows],
            camera=self.camera[rows],
            frame=self.frame[rows],
            kind=self.kind[rows],
            corners_pinhole_px=self.corners_pinhole_px[rows],
            covariance_px=self.covariance_px[rows],
            valid=self.valid[rows],
            kinds=self.kinds,
            visit=self.visit,
            symbols=self.symbols,
        )


@dataclass(frozen=True)
class Frames:
    """The distinct time stamps of a drive, of each of its visits by itself.

    ``frame_of_image`` (I,) indexes ``visit`` (F,), ``stamp_s`` (F,) and ``map_from_vehicle`` (F, 4, 4), the
    recorded poses.
    """

    frame_of_image: IntArray
    visit: IntArray
    stamp_s: FloatArray
    map_from_vehicle: FloatArray


def frames_of(drive: Drive) -> Frames:
    """Number the distinct times of ``drive``; images of one visit that were taken together share a frame."""
    taken = np.array([(image.visit, image.taken_s) for image in drive.images])
    distinct, first, inverse = np.unique(taken, axis=0, return_index=True, return_inverse=True)
    poses = np.stack([drive.images[i].map_from_vehicle for i in first])
    return Frames(
        frame_of_image=inverse.ravel().astype(np.int64),
        visit=distinct[:, 0].astype(np.int64),
        stamp_s=distinct[:, 1],
        map_from_vehicle=poses.astype(np.float64),
    )


def collect_sightings(
    drive: Drive, detections: Sequence[ImageDetections], cameras: Sequence[str]
) -> Sightings:
    """Put the quadrilateral detections of ``cameras`` into one table, lens distortion removed.

    Raises:
        MappingError: The drive has no such camera, or its images hold no usable marking.
    """
    camera_index = _camera_index(drive, cameras)
    frames = frames_of(drive)
    rows = [
        (found.image, marking)
        for found in sorted(detections, key=lambda one: one.image)
        if drive.images[found.image].camera in camera_index
        for marking in found.markings
        if not len(marking.outline_px)
    ]
    nothing = (
        f"no marking was found in the images of {', '.join(cameras)} of drive {drive.name}; check "
        "that the detector knows this kind of paint and that the images show it within range."
    )
    if not rows:
        raise MappingError(nothing)
    kinds = tuple(sorted({marking.kind for _, marking in rows}))
    image = np.array([i for i, _ in rows], dtype=np.int64)
    camera = np.array([camera_index[drive.images[i].camera] for i in image], dtype=np.int64)
    corners = np.stack([marking.corners_px for _, marking in rows]).astype(np.float64)
    covariance = np.stack([_corner_blocks(marking.covariance_px) for _, marking in rows])
    for name, c in camera_index.items():
        own = camera == c
        corners[own], covariance[own] = _undistort(drive.cameras[name].info, corners[own], covariance[own])
    valid = np.stack([marking.corner_valid for _, marking in rows]).astype(bool)
    valid &= np.isfinite(corners).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3))
    sightings = Sightings(
        cameras=tuple(cameras),
        stamp_s=frames.stamp_s,
        map_from_vehicle=frames.map_from_vehicle,
        image=image,
        camera=camera,
        frame=frames.frame_of_image[image],
        kind=np.array([kinds.index(m.kind) for _, m in rows], dtype=np.int64),
        corners_pinhole_px=corners,
        covariance_px=covariance,
        valid=valid,
        kinds=kinds,
        visit=frames.visit,
        symbols=collect_symbols(drive, detections, camera_index, frames.frame_of_image),
    )
    sightings = sightings.subset(sightings.informs.sum(axis=1) >= 2)
    if not len(sightings):
        raise MappingError(nothing)
    return sightings


def camera_of(drive: Drive, name: str) -> Camera:
    """The camera ``name`` of ``drive``.

    Raises:
        MappingError: The drive has no such camera.
    """
    if name not in drive.cameras:
        known = ", ".join(drive.cameras)
        raise MappingError(f"drive {drive.name} has no camera '{name}'; choose among {known}.")
    return drive.cameras[name]


def _camera_index(drive: Drive, cameras: Sequence[str]) -> dict[str, int]:
    for name in cameras:
        camera_of(drive, name)
    return {name: c for c, name in enumerate(cameras)}


def _corner_blocks(covariance_px: FloatArray) -> FloatArray:
    """The four 2 x 2 diagonal blocks of an 8 x 8 corner covariance."""
    blocks = np.asarray(covariance_px, dtype=np.float64).reshape(4, 2, 4, 2)
    return blocks[range(4), :, range(4), :]


def _undistort(
    info: CameraInfo, corners_px: FloatArray, covariance_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Corners (S, 4, 2) and covariances (S, 4, 2, 2) moved from recorded to pinhole pixels."""
    if not has_distortion(info):
        return corners_px, covariance_px
    step_px = 0.5
    flat = corners_px.reshape(-1, 2)
    columns = [
        undistort_points(info, flat + step) - undistort_points(info, flat - step)
        for step in (np.array([step_px, 0.0]), np.array([0.0, step_px]))
    ]
    jacobian = np.stack(columns, axis=2).reshape(*corners_px.shape, 2) / (2 * step_px)
    moved = jacobian @ covariance_px @ np.swapaxes(jacobian, -1, -2)
    return undistort_points(info, flat).reshape(corners_px.shape), moved
