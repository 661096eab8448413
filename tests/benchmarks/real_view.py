"""Where the images of a real drive see the road, and in what light: for ``tests.benchmarks.real_drive``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tests.benchmarks.real_reference import Painted
from v2hdm.detection.frames import read_image
from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px, project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import LANE_DASH, CameraInfo, Drive, FloatArray
from v2hdm.surface.surface import Surface

LIGHT_RANGE_M = 15.0

_NEAREST_M = 0.5
_ROUNDS = 3  # towards the point of a curved road at a pixel; heights are small against the camera's
_BESIDE_M = (0.15, 0.3, 0.45)


@dataclass(frozen=True)
class View:
    """One image's camera over the road of the map, ``cam_from_map`` (4, 4).

    The road is flat, or the ``surface`` as seen from this image alone.
    """

    info: CameraInfo
    cam_from_map: FloatArray
    surface: Surface | None = None

    def project(self, points_map: FloatArray) -> FloatArray:
        """Pixels (N, 2) of ground points (N, 2), nan behind the camera."""
        on_plane = self._on_plane(points_map)
        pinhole, depth_m = project_ground(self.info.intrinsic, self.cam_from_map, on_plane)
        pinhole[depth_m < _NEAREST_M] = np.nan
        return distort_points(self.info, pinhole)

    def ground(self, points_px: FloatArray) -> FloatArray:
        """Ground points (N, 2) m of pixels (N, 2); nan above the horizon."""
        pinhole = undistort_points(self.info, points_px)
        flat = apply_in_front(ground_from_pinhole_px(self.info.intrinsic, self.cam_from_map), pinhole)
        points_map = flat
        for _ in range(_ROUNDS):
            points_map = points_map + flat - self._on_plane(points_map)
        return points_map

    def _on_plane(self, points_map: FloatArray) -> FloatArray:
        """Points (N, 2) of the flat road that the camera shows where it shows those of the road."""
        is_finite = np.isfinite(points_map).all(axis=1)
        if self.surface is None or not is_finite.any():
            return points_map
        out = points_map.copy()
        out[is_finite] = self.surface.on_plane(points_map[is_finite], self.cam_from_map, 0)
        return out

    def range_m(self, point_map: FloatArray) -> float:
        """Distance on the ground of a point (2,) from the camera."""
        return float(self.ranges_m(point_map[None])[0])

    def ranges_m(self, points_map: FloatArray) -> FloatArray:
        """Distances (N,) on the ground of points (N, 2) from the camera."""
        centre = camera_centre(self.cam_from_map)
        return np.asarray(np.linalg.norm(points_map - centre[:2], axis=1))

    def holds(self, polygon_px: FloatArray) -> bool:
        """Whether a polygon lies wholly inside the image."""
        limit = np.array([self.info.width, self.info.height]) - 1
        return bool(((polygon_px >= 0) & (polygon_px <= limit)).all())


def shaded_share(drive: Drive, views: Sequence[View], painted: Sequence[Painted]) -> FloatArray:
    """Share (M,) of the road around each dash that lies in shade; nan for what no image shows near.

    Looked at are points at 0.15 to 0.45 m beside the dash, in all images that show it wholly within 15 m.
    Shade is what is darker than the value that parts the grey values of all these points best (Otsu's, on
    their logarithm). Shadows stand still for the seconds of a passage, so a dash has one share: the median.
    """
    grey: dict[int, list[FloatArray]] = {m: [] for m in range(len(painted))}
    around = {
        m: points_around(marking.polygon_map)
        for m, marking in enumerate(painted)
        if marking.kind == LANE_DASH
    }
    for view, image in zip(views, drive.images, strict=True):
        pixels = read_image(image, drive.cameras[image.camera])
        for m, points in around.items():
            if view.range_m(points.mean(axis=0)) > LIGHT_RANGE_M:
                continue
            at = view.project(points)
            if view.holds(at):
                u, v = np.round(at).astype(int).T
                grey[m].append(np.asarray(pixels[v, u].mean(axis=1)))
    values = np.concatenate([g for gs in grey.values() for g in gs] or [np.empty(0)])
    if not len(values):
        return np.full(len(painted), np.nan)
    steps = np.round(255 * np.log1p(values) / np.log(256)).astype(np.uint8)
    level, _ = cv2.threshold(steps[:, None], 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    darkest = np.expm1(level / 255 * np.log(256))
    return np.array(
        [np.median([(g <= darkest).mean() for g in gs]) if gs else np.nan for gs in grey.values()]
    )


def points_around(quad: FloatArray) -> FloatArray:
    """Ground points (N, 2) beside the long sides of a quadrilateral (4, 2)."""
    sides = np.roll(quad, -1, axis=0) - quad
    first = int(np.argmax(np.linalg.norm(sides, axis=1)))
    middle = quad.mean(axis=0)
    out = []
    for k in (first, (first + 2) % 4):
        beside = np.array([sides[k][1], -sides[k][0]]) / np.linalg.norm(sides[k])
        outwards = beside if beside @ (quad[k] - middle) > 0 else -beside
        along = quad[k] + np.linspace(0, 1, 31)[:, None] * sides[k]
        out += [along + reach * outwards for reach in _BESIDE_M]
    return np.concatenate(out)
