"""Detections of a drive as one table of arrays, and the rig that took them: the input of all later steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import logit

from v2hdm.errors import MappingError, shown
from v2hdm.geometry.lens import has_distortion, undistort_points
from v2hdm.geometry.rigid import camera_centre, exp
from v2hdm.records import (
    LANE_LINE,
    BoolArray,
    Camera,
    CameraInfo,
    Drive,
    FloatArray,
    ImageDetections,
    IntArray,
)

LEAST_HEIGHT_M = 0.1  # floor of a camera's height, m, in divisions


@dataclass(frozen=True)
class Rig:
    """Present estimate of cameras and frames."""

    intrinsic: FloatArray  # (C, 3, 3)
    cam_from_vehicle: FloatArray  # (C, 4, 4)
    map_from_vehicle: FloatArray  # (F, 4, 4)
    read_out_s: FloatArray | None = None  # (C,), None for global shutters
    twist_vehicle: FloatArray | None = None  # (F, 6) vehicle velocity, m/s, rad/s

    def cam_from_map(
        self, camera: IntArray, frame: IntArray, row_share: FloatArray | None = None
    ) -> FloatArray:
        """Poses (..., 4, 4) of cameras (...) at frames (...), at the read-out of rows ``row_share`` (...)."""
        cam_from_vehicle = self.cam_from_vehicle[camera]
        if row_share is None or self.read_out_s is None or self.twist_vehicle is None:
            return np.asarray(cam_from_vehicle @ self.vehicle_from_map[frame])
        late_s = self.read_out_s[camera] * np.nan_to_num(row_share)
        poses = self.map_from_vehicle[frame] @ exp(self.twist_vehicle[frame] * late_s[..., None])
        return np.asarray(cam_from_vehicle @ np.linalg.inv(poses))

    @cached_property
    def vehicle_from_map(self) -> FloatArray:
        """Inverse poses (F, 4, 4): each is asked for by hundreds of sightings."""
        return np.asarray(np.linalg.inv(self.map_from_vehicle))

    @property
    def height_m(self) -> FloatArray:
        """Heights (C,), m, of the camera centres above the vehicle's ground."""
        return np.asarray(np.maximum(camera_centre(self.cam_from_vehicle)[:, 2], LEAST_HEIGHT_M))


def row_shares(info: CameraInfo, points_px: FloatArray) -> FloatArray:
    """Read-out time of the rows of points (..., 2): from -1/2 for the first row to 1/2 for the last."""
    return np.asarray(np.clip(points_px[..., 1] / max(info.height - 1, 1), 0.0, 1.0) - 0.5)


@dataclass(frozen=True)
class Symbols:
    """N detected symbols: ``camera`` and ``frame`` (N,), pinhole outlines, row shares and classes.

    ``seen_sides`` flags the sides, each from its point to the next, that lie along an edge of the paint.
    """

    camera: IntArray
    frame: IntArray
    outlines_pinhole_px: tuple[FloatArray, ...]
    kinds: tuple[str, ...]
    row_shares: tuple[FloatArray, ...]
    seen_sides: tuple[BoolArray, ...]

    @property
    def symbol_of_point(self) -> IntArray:
        """Index (P,) of the symbol of each point of all outlines, one after the other."""
        length = [len(outline) for outline in self.outlines_pinhole_px]
        return np.repeat(np.arange(len(length)), length)

    def by_symbol(self, values: FloatArray) -> list[FloatArray]:
        """Values (P, ...) of the points of all outlines, split by symbol."""
        return np.split(values, np.cumsum([len(outline) for outline in self.outlines_pinhole_px])[:-1])


NO_SYMBOLS = Symbols(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), (), (), (), ())
"""The symbols of images that show none."""


class _Outline(NamedTuple):
    """The outline of a symbol, or the centre line of a piece of line, in one image."""

    image: int
    kind: str
    points_px: FloatArray  # (K, 2)
    seen_sides: BoolArray  # (K,) sides along an edge of the paint; empty for a line


def collect_outlines(
    drive: Drive,
    detections: Sequence[ImageDetections],
    camera_index: Mapping[str, int],
    frame_of_image: IntArray,
) -> tuple[Symbols, Symbols]:
    """Undistorted symbols of the cameras' images, and pieces of solid lines: centre lines for outlines."""
    unseen = np.zeros(0, dtype=np.bool_)
    images = [detected for detected in detections if drive.images[detected.image].camera in camera_index]
    symbols = [
        _Outline(detected.image, marking.kind, marking.outline_px, marking.outline_seen)
        for detected in images
        for marking in detected.markings
        if len(marking.outline_px) >= 3
    ]
    lines = [
        _Outline(detected.image, lane.kind, lane.points_px.astype(np.float64), unseen)
        for detected in images
        for lane in detected.lanes
        if lane.kind == LANE_LINE and len(lane.points_px) >= 2
    ]

    def undistorted(outlines: Sequence[_Outline]) -> Symbols:
        image = np.array([outline.image for outline in outlines], dtype=np.int64)
        names = [drive.images[i].camera for i in image.tolist()]
        recorded = [
            (drive.cameras[name].info, outline.points_px)
            for name, outline in zip(names, outlines, strict=True)
        ]
        return Symbols(
            camera=np.array([camera_index[name] for name in names], dtype=np.int64),
            frame=frame_of_image[image],
            outlines_pinhole_px=tuple(undistort_points(info, points_px) for info, points_px in recorded),
            kinds=tuple(outline.kind for outline in outlines),
            row_shares=tuple(row_shares(info, points_px) for info, points_px in recorded),
            seen_sides=tuple(outline.seen_sides for outline in outlines),
        )

    return undistorted(symbols), undistorted(lines)


@dataclass(frozen=True)
class Sightings:
    """S quadrilateral detections of a drive, by image; simultaneous images share a frame."""

    cameras: tuple[str, ...]
    stamp_s: FloatArray  # (F,) distinct times, sorted by session, then time
    map_from_vehicle: FloatArray  # (F, 4, 4) as recorded
    image: IntArray  # (S,) indices into ``Drive.images``
    camera: IntArray  # (S,) into ``cameras``
    frame: IntArray  # (S,) into the frames
    kind: IntArray  # (S,) into ``kinds``, the names of the classes
    corners_pinhole_px: FloatArray  # (S, 4, 2)
    covariance_px: FloatArray  # (S, 4, 2, 2), px^2
    valid: BoolArray  # (S, 4) corners that are points: small in every direction
    kinds: tuple[str, ...]
    session: IntArray  # (F,) as in ``Image.session``
    row_share: FloatArray  # (S, 4) read-out time of the corners' rows, see :func:`row_shares`
    log_odds: FloatArray  # (S,) log-odds of being a marking, from the detector
    symbols: Symbols = NO_SYMBOLS  # of the same images
    lines: Symbols = NO_SYMBOLS  # pieces of solid lines in them: centre lines for outlines

    def __len__(self) -> int:
        return len(self.image)

    @property
    def informs(self) -> BoolArray:
        """Corners (S, 4) with a position and a covariance, points or not: both weigh by their information."""
        finite = np.isfinite(self.covariance_px).all(axis=(2, 3))
        return np.asarray(finite & np.isfinite(self.corners_pinhole_px).all(axis=2))

    def subset(self, rows: IntArray | BoolArray) -> Sightings:
        """The sightings at ``rows`` (indices or a mask), over the same cameras and frames."""
        of_rows = ["image", "camera", "frame", "kind"]
        of_rows += ["corners_pinhole_px", "covariance_px", "valid", "row_share", "log_odds"]
        return replace(self, **{name: getattr(self, name)[rows] for name in of_rows})


@dataclass(frozen=True)
class Frames:
    """Distinct times of sessions and the recorded poses, (F,) each, indexed by ``frame_of_image`` (I,)."""

    frame_of_image: IntArray
    session: IntArray
    stamp_s: FloatArray
    map_from_vehicle: FloatArray


def frames_of(drive: Drive) -> Frames:
    """Number the distinct times of ``drive``; simultaneous images of one session share a frame."""
    moments = np.array([(image.session, image.taken_s) for image in drive.images])
    distinct, first, inverse = np.unique(moments, axis=0, return_index=True, return_inverse=True)
    poses = np.stack([drive.images[i].map_from_vehicle for i in first])
    frame = inverse.ravel().astype(np.int64)
    session = distinct[:, 0].astype(np.int64)
    return Frames(frame, session, distinct[:, 1], poses.astype(np.float64))


def check_detections(drive: Drive, detections: Sequence[ImageDetections]) -> None:
    """Raise MappingError for detections of images that the drive does not have, or that lie beside them."""
    for detected in detections:
        problem = None
        if not 0 <= detected.image < len(drive.images):
            problem = f"the drive has images 0 to {len(drive.images) - 1}"
        else:
            info = drive.cameras[drive.images[detected.image].camera].info
            seen_px = [marking.corners_px[marking.corner_valid] for marking in detected.markings]
            beyond = [px for px in seen_px if ((px < -0.5) | (px > [info.width, info.height])).any()]
            problem = f"its camera has {info.width} x {info.height} px" if beyond else None
        if problem is not None:
            raise MappingError(
                f"detections of image {detected.image} are not of drive {drive.name}: {problem}; give those "
                "of this drive, as a result has them"
            )


def collect_sightings(
    drive: Drive, detections: Sequence[ImageDetections], cameras: Sequence[str]
) -> Sightings:
    """Quadrilateral detections of ``cameras`` in one table, lens distortion removed.

    Raises MappingError for an unknown camera, or if its images hold no usable marking.
    """
    infos = [camera_of(drive, name).info for name in cameras]
    camera_index = {name: c for c, name in enumerate(cameras)}
    frames = frames_of(drive)
    rows = [
        (detected.image, marking)
        for detected in sorted(detections, key=lambda detected: detected.image)
        if drive.images[detected.image].camera in camera_index
        for marking in detected.markings
        if not len(marking.outline_px)
    ]
    if not rows:
        raise _no_markings(drive, cameras)
    kinds = tuple(sorted({marking.kind for _, marking in rows}))
    image = np.array([i for i, _ in rows], dtype=np.int64)
    camera = np.array([camera_index[drive.images[i].camera] for i in image], dtype=np.int64)
    corners = np.stack([marking.corners_px for _, marking in rows]).astype(np.float64)
    covariance = np.stack([marking.covariance_px for _, marking in rows]).astype(np.float64)
    covariance = np.stack([covariance[:, c : c + 2, c : c + 2] for c in (0, 2, 4, 6)], axis=1)
    row_share = np.zeros(corners.shape[:2])
    for c, info in enumerate(infos):
        is_of_camera = camera == c
        row_share[is_of_camera] = row_shares(info, corners[is_of_camera])
        corners[is_of_camera], covariance[is_of_camera] = _undistort(
            info, corners[is_of_camera], covariance[is_of_camera]
        )
    valid = np.stack([marking.corner_valid for _, marking in rows]).astype(bool)
    valid &= np.isfinite(corners).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3))
    symbols, lines = collect_outlines(drive, detections, camera_index, frames.frame_of_image)
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
        session=frames.session,
        row_share=row_share,
        log_odds=logit(np.clip([marking.score for _, marking in rows], 1e-4, 1 - 1e-4)),
        symbols=symbols,
        lines=lines,
    )
    sightings = sightings.subset(sightings.informs.sum(axis=1) >= 2)
    if not len(sightings):
        raise _no_markings(drive, cameras)
    return sightings


def _no_markings(drive: Drive, cameras: Sequence[str]) -> MappingError:
    return MappingError(
        f"no markings were found in the images of {', '.join(cameras)} of drive {drive.name}; check "
        "that the detector knows this kind of paint and that the images show it within range."
    )


def camera_of(drive: Drive, name: str) -> Camera:
    """The camera ``name`` of ``drive``; raises MappingError if unknown."""
    if name not in drive.cameras:
        names = ", ".join(drive.cameras)
        raise MappingError(f"drive {drive.name} has no camera {shown(name)}; choose among {names}.")
    return drive.cameras[name]


def _undistort(
    info: CameraInfo, corners_px: FloatArray, covariance_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Corners (S, 4, 2) and covariances (S, 4, 2, 2) from recorded to pinhole pixels."""
    if not has_distortion(info):
        return corners_px, covariance_px
    step_px = 0.5
    flat = corners_px.reshape(-1, 2)
    columns = [
        undistort_points(info, flat + step) - undistort_points(info, flat - step)
        for step in (np.array([step_px, 0.0]), np.array([0.0, step_px]))
    ]
    jacobian = np.stack(columns, axis=2).reshape((*corners_px.shape, 2)) / (2 * step_px)
    pinhole_covariance = jacobian @ covariance_px @ np.swapaxes(jacobian, -1, -2)
    return undistort_points(info, flat).reshape(corners_px.shape), pinhole_covariance
