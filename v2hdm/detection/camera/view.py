"""What the detector works out once per camera: the band of rows with road in it, the lens, the ground."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.ipm import apply_in_front, extrinsic_from_ipm, facing_ipm, homography_jacobian
from v2hdm.geometry.lens import distort_points, has_distortion, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, Camera, FloatArray

_LUT_STEP_PX = 4
_HORIZON_MARGIN_PX = 16

FARTHEST_M = 60.0
"""Neither markings nor lines are looked for beyond this: networks are shown none beyond 50 m."""

_SURROUNDINGS_PX = 24
"""So far above the farthest ground what is there helps to tell what lies on it."""

FINE_ENOUGH_M = 0.007
"""Ground per pixel, across the view, of which half the resolution shows enough: a dash stays 10 px wide."""

ASIDE_RAD = np.deg2rad(60)
"""A camera that looks farther than this off the way that its vehicle drives, ahead or back, looks aside."""


class CameraView:
    """One camera as the detector sees it: fast lens and ground mappings, and the rows worth looking at.

    ``top`` and ``height`` are the band of image rows below the horizon of the camera's initial IPM
    (with a margin, since that IPM is coarse); ``height`` is a multiple of ``multiple`` where the
    image is tall enough. ``far_row``, by a multiple of ``multiple`` below ``top``, is the one from which on
    it is worth looking at for ground within :data:`FARTHEST_M`. From ``fine_row`` on (None if there is no
    such row) a pixel is less than :data:`FINE_ENOUGH_M` of ground wide. ``aside`` cameras look
    across the way that the vehicle drives. Points far from any lens singularity are assumed.
    """

    def __init__(self, camera: Camera, multiple: int = 16):
        self.camera = camera
        self.info = camera.info
        self.vehicle_from_pinhole_px: FloatArray = camera.ipm[camera.initial_ipm]
        self.pinhole_px_from_vehicle: FloatArray = np.asarray(np.linalg.inv(self.vehicle_from_pinhole_px))
        self._pinhole_lut = _build_pinhole_lut(camera) if has_distortion(camera.info) else None
        self._ground_from_pinhole_px = facing_ipm(
            self.vehicle_from_pinhole_px, camera.roi_vehicle.mean(axis=0)
        )
        cam_from_vehicle = extrinsic_from_ipm(self.info, self.vehicle_from_pinhole_px)
        ahead, left, _ = cam_from_vehicle[2, :3]
        self.aside = bool(np.arctan2(abs(left), abs(ahead)) > ASIDE_RAD)
        self.foot_vehicle = camera_centre(cam_from_vehicle)[:2]
        self.top, self.height = self._band_rows(multiple)
        spare = max(self.first_row_within(FARTHEST_M) - _SURROUNDINGS_PX - self.top, 0)
        self.far_row = self.top + spare // multiple * multiple
        self.fine_row = self._fine_row()

    def undistort(self, points_px: FloatArray) -> FloatArray:
        """Recorded pixels (N, 2) to pinhole pixels, from a table; within 1e-2 px of the lens model."""
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        if self._pinhole_lut is None or not len(points):
            return points.copy()
        rows, columns = self._pinhole_lut.shape[:2]
        cell = points / _LUT_STEP_PX
        first = np.minimum(np.maximum(np.floor(cell).astype(np.intp), 0), (columns - 2, rows - 2))
        right, down = np.hsplit(cell - first, 2)
        at = first[:, 0] + columns * first[:, 1]
        lut = self._pinhole_lut.reshape(-1, 2)
        upper = lut.take(at, axis=0) * (1 - right) + lut.take(at + 1, axis=0) * right
        at += columns
        lower = lut.take(at, axis=0) * (1 - right) + lut.take(at + 1, axis=0) * right
        return np.asarray(upper * (1 - down) + lower * down)

    def distort(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Pinhole pixels (N, 2) to recorded pixels."""
        return distort_points(self.info, points_pinhole_px)

    def distort_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`distort`, by central differences over one pixel."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        if self._pinhole_lut is None:
            return np.broadcast_to(np.eye(2), (len(points), 2, 2)).copy()
        steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        moved = self.distort((points[:, None] + steps).reshape(-1, 2)).reshape(-1, 4, 2)
        return np.stack([moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]], axis=2)

    def ground(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Where pinhole pixels (N, 2) meet the ground, vehicle frame, m; NaN at and above the horizon."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        return apply_in_front(self._ground_from_pinhole_px, points)

    def ground_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`ground`, m per px; NaN where that is NaN."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        return homography_jacobian(self._ground_from_pinhole_px, points)

    def range_m(self, points_vehicle: FloatArray) -> FloatArray:
        """Distance on the ground from below the camera; NaN stays NaN."""
        return np.asarray(np.linalg.norm(points_vehicle - self.foot_vehicle, axis=-1))

    def coarse(self, rows_px: FloatArray) -> BoolArray:
        """Which rows (N,) lie so near that they are looked at in half the resolution."""
        first = np.inf if self.fine_row is None else self.fine_row
        return np.asarray(rows_px >= first)

    def inside(self, points_px: FloatArray, border_px: float) -> BoolArray:
        """Which recorded points (N, 2) lie at least ``border_px`` inside the image."""
        u, v = points_px[..., 0], points_px[..., 1]
        across = (u >= border_px) & (u <= self.info.width - 1 - border_px)
        return np.asarray(across & (v >= border_px) & (v <= self.info.height - 1 - border_px))

    def first_row_within(self, range_m: float) -> int:
        """The uppermost row of the band that shows ground within ``range_m`` of the camera's foot."""
        near = self.range_m(self._row_grid_vehicle()) <= range_m
        return max(self.top, int(np.argmax(near.any(axis=1)))) if near.any() else self.info.height

    def _row_grid_vehicle(self) -> FloatArray:
        """Ground points (H, 9, 2) of every row at nine columns, vehicle frame; nan above the horizon."""
        columns = np.linspace(0, self.info.width - 1, 9)
        rows = np.arange(self.info.height, dtype=np.float64)
        grid_px = np.stack(np.meshgrid(columns, rows), axis=-1)
        return self.ground(self.undistort(grid_px.reshape(-1, 2))).reshape(grid_px.shape)

    def _band_rows(self, multiple: int) -> tuple[int, int]:
        on_ground = np.any(np.isfinite(self._row_grid_vehicle()).all(axis=2), axis=1)
        first = int(np.argmax(on_ground))
        height = self.info.height - max(0, first - _HORIZON_MARGIN_PX)
        height = min(-(-height // multiple) * multiple, self.info.height)
        return self.info.height - height, height

    def _fine_row(self) -> int | None:
        middle = (self.info.width - 1) / 2
        rows = np.arange(self.top, self.info.height, dtype=np.float64)
        left, right = (
            self.ground(self.undistort(np.column_stack([np.full_like(rows, middle + side), rows])))
            for side in (-0.5, 0.5)
        )
        coarse = ~(np.linalg.norm(right - left, axis=1) <= FINE_ENOUGH_M)
        first = int(np.flatnonzero(coarse)[-1]) + 1 if coarse.any() else 0
        return self.top + first if first < len(rows) else None


def _build_pinhole_lut(camera: Camera) -> FloatArray:
    """Pinhole pixel of every ``_LUT_STEP_PX``-th recorded pixel, one cell beyond the image's far border."""
    columns = np.arange(0, camera.info.width + _LUT_STEP_PX, _LUT_STEP_PX, dtype=np.float64)
    rows = np.arange(0, camera.info.height + _LUT_STEP_PX, _LUT_STEP_PX, dtype=np.float64)
    grid_px = np.stack(np.meshgrid(columns, rows), axis=-1)
    return undistort_points(camera.info, grid_px.reshape(-1, 2)).reshape(*grid_px.shape)
