"""Whether something stands on the ground beyond the ends of markings, and may hide the rest of them.

Where a thing stands on paint, the paint ends as cleanly as by itself, at one place in every image. But what
lies beyond tells: from image to image it moves as the ground does, or as an upright face with its foot at the
end. So what one image shows beyond an end is looked up in another in both ways, as in plane and parallax
(Irani and Anandan, "A unified approach to moving object detection in 2D and 3D scenes", PAMI 20, 1998).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.association.ground import BORDER_PX, Views
from v2hdm.association.sightings import Rig
from v2hdm.geometry.ipm import apply_in_front, ground_from_pinhole_px
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, Camera, CameraInfo, FloatArray
from v2hdm.safe.pixels import grey_of

Pixels = NDArray[np.float32] | NDArray[np.uint8]  # grey values (H, W), or colours (H, W, 3)
Grey = Callable[[int], Pixels]  # pixels of an image, by its index in the drive, whose grey values count

_RANGE_M = (2.5, 16.0)  # depths, m, of an end in images that are compared: nearer and farther it is a few px
_LEAST_RATIO = 1.2  # least ratio of the depths of an end in two images, that ground and face move apart
_MOST_PAIRS = 3  # most pairs of images an end is looked at in

_BESIDE_M = 0.6  # how far to the sides of an end's middle it is looked at, m
_HIGH_M = 1.1  # how high above an end it is looked at, m
_STEPS = 40  # points looked at in each direction
_FAR_M = 6.0  # ground beyond an end that is farther from it, m, is not looked at
_APART_PX = 1.5  # least distance of where the ground and a face would be in the other image, px
_LEAST_POINTS = 60  # least number of points that tell

_DARK = 3.0  # added to grey values of 8 bits before logarithms: noise of dark pixels
_BLUR_SIGMAS = 5  # reach of a blur in its standard deviations: OpenCV's ends at four
_LEAST_DEPTH_M = 1.0  # least depth of a point in front of a camera, m
_MOST_CORRELATION = 0.995  # beyond it all correlations are alike

# Logistic regression on 58 ends of dashes at the foot of boxes and 140 on bare ground, in 12 rendered ports
# (tests/benchmarks/standing_ends.py), by how much better the ground matches, in differences of Fisher's z. It
# ranks 99 % of the pairs of both kinds right.
_BIAS = 0.7  # log-likelihood ratio of something that stands where ground and face match alike
_PER_BETTER_GROUND = -3.9  # log-likelihood ratio that a difference of one in z adds


@dataclass(frozen=True)
class Watch:
    """The images of a drive under a ``rig``, read by ``grey``; the ground is ``height_m`` above the plane."""

    views: Views
    rig: Rig
    cameras: Sequence[Camera]  # the rig's
    grey: Grey
    height_m: Callable[[FloatArray], FloatArray] | None = None  # at points (N, 2); None for the plane

    def standing_odds(self, corners_map: FloatArray, is_end: BoolArray) -> FloatArray:
        """Log-likelihood ratios (G, 4) that something stands beyond the sides of quadrilaterals (G, 4, 2).

        Looked at are the sides ``is_end`` (G, 4), each from its corner to the next; of all others, and where
        no two images tell, the ratio is 0.
        """
        odds = np.zeros(is_end.shape)
        # Neighbouring ends are seen in the same images: along the route each of these is read about once.
        read = lru_cache(maxsize=16)(self.grey)
        route = cKDTree(self.rig.map_from_vehicle[:, :2, 3])
        frame = route.query(np.nan_to_num(corners_map.mean(axis=1)))[1]
        ends = np.argwhere(is_end)
        for group, side in ends[np.argsort(frame[ends[:, 0]], kind="stable")].tolist():
            end = _End.of(corners_map[group], side, self._height_m(corners_map[group]))
            face = end.face()
            of_pairs = [
                self._better_ground(end, face, look, nearer, read) for look, nearer in self._pairs(end)
            ]
            differences_z = [value for value in of_pairs if value is not None]
            if differences_z:
                odds[group, side] = _BIAS + _PER_BETTER_GROUND * float(np.mean(differences_z))
        return odds

    def _height_m(self, corners_map: FloatArray) -> float:
        """Mean height, m, of the ground at points (N, 2) above the plane."""
        return 0.0 if self.height_m is None else float(np.mean(self.height_m(corners_map)))

    def _pairs(self, end: _End) -> Iterator[tuple[_Look, _Look]]:
        """Pairs of images of one camera, a far and a near one, that see an end over its paint."""
        for camera in range(len(self.cameras)):
            looks = sorted(self._looks(end, camera), key=lambda look: look.depth_m)
            nearer = looks[0] if looks else None
            pairs = 0
            for look in looks[1:]:
                if pairs < _MOST_PAIRS and nearer and look.depth_m > _LEAST_RATIO * nearer.depth_m:
                    yield look, nearer
                    nearer = look
                    pairs += 1

    def _looks(self, end: _End, camera: int) -> Iterator[_Look]:
        """The images of a camera that see an end over its paint."""
        info = self.cameras[camera].info
        rows = np.flatnonzero(self.views.camera == camera)
        vehicle_map = self.rig.map_from_vehicle[self.views.frame[rows]][:, :2, 3]
        rows = rows[np.linalg.norm(vehicle_map - end.middle_map[:2], axis=1) < 2 * _RANGE_M[1]]
        cam_from_map = self.rig.cam_from_map(self.views.camera[rows], self.views.frame[rows])
        corners = _project(info, cam_from_map, end.corners_map)
        depth_m = corners.depth_m.mean(axis=1)
        looks_outwards = (end.middle_map - camera_centre(cam_from_map))[:, :2] @ end.outwards > 0
        in_range = (depth_m > _RANGE_M[0]) & (depth_m < _RANGE_M[1])
        for number in np.flatnonzero(looks_outwards & in_range & corners.inside.all(axis=1)).tolist():
            image = int(self.views.image[rows[number]])
            yield _Look(image, info, cam_from_map[number], float(depth_m[number]))

    def _better_ground(
        self, end: _End, face: FloatArray, farther: _Look, nearer: _Look, read: Grey
    ) -> float | None:
        """How much better two images match as ground than as a ``face`` (N, 3); None: too few points tell.

        It is the difference of the correlations of their log grey values, in Fisher's z.
        """
        as_seen = farther.project(face)
        on_ground = np.full(face.shape, end.middle_map[2])
        on_ground[:, :2] = farther.ground(as_seen.pinhole_px, end.middle_map[2])
        as_face = nearer.project(face)
        as_ground = nearer.project(np.nan_to_num(on_ground))
        away_m = np.linalg.norm(on_ground - end.middle_map, axis=1)
        usable = as_seen.inside & as_face.inside & as_ground.inside
        with np.errstate(invalid="ignore"):
            usable &= away_m < _FAR_M
        usable &= np.hypot(*(as_face.px - as_ground.px).T) > _APART_PX
        if np.count_nonzero(usable) < _LEAST_POINTS:
            return None
        # The nearer image is blurred to what the farther one resolves.
        blur_px = max(0.5 * float(np.sqrt((farther.depth_m / nearer.depth_m) ** 2 - 1)), 0.1)
        light = _log_grey(read(farther.image), [as_seen.px[usable]])[0]
        matches = _log_grey(read(nearer.image), [as_ground.px[usable], as_face.px[usable]], blur_px)
        ground_z, face_z = (_fisher_z(light, match) for match in matches)
        return ground_z - face_z


class _Points(NamedTuple):
    """Where N points are in images (...)."""

    pinhole_px: FloatArray  # (..., N, 2)
    px: FloatArray  # (..., N, 2) recorded px
    depth_m: FloatArray  # (..., N)
    inside: BoolArray  # (..., N) in front of the camera and off the image's border


def _project(info: CameraInfo, cam_from_map: FloatArray, points_map: FloatArray) -> _Points:
    """Where points (N, 3) are in images of a camera at poses (..., 4, 4)."""
    cam = points_map @ cam_from_map[..., :3, :3].swapaxes(-1, -2) + cam_from_map[..., None, :3, 3]
    depth_m = cam[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pinhole_px = ((cam / depth_m[..., None]) @ info.intrinsic.T)[..., :2]
        px = distort_points(info, pinhole_px.reshape(-1, 2)).reshape(pinhole_px.shape)
        limit = np.array([info.width, info.height]) - BORDER_PX
        inside = (depth_m > _LEAST_DEPTH_M) & ((px > BORDER_PX) & (px < limit)).all(axis=-1)
    return _Points(pinhole_px, px, depth_m, np.asarray(inside))


class _Look(NamedTuple):
    """An image that sees an end, at a depth, m."""

    image: int
    info: CameraInfo
    cam_from_map: FloatArray
    depth_m: float

    def project(self, points_map: FloatArray) -> _Points:
        """Where points (N, 3) are in the image."""
        return _project(self.info, self.cam_from_map, points_map)

    def ground(self, pinhole_px: FloatArray, height_m: float) -> FloatArray:
        """Ground points (N, 2) at a height of pinhole pixels (N, 2), nan on and above the horizon."""
        cam_from_level = self.cam_from_map.copy()
        cam_from_level[:3, 3] += self.cam_from_map[:3, 2] * height_m
        map_from_pinhole_px = ground_from_pinhole_px(self.info.intrinsic, cam_from_level)
        return apply_in_front(map_from_pinhole_px, np.nan_to_num(pinhole_px))


class _End(NamedTuple):
    """An end of a marking on the ground."""

    corners_map: FloatArray  # (2, 3) m
    middle_map: FloatArray  # (3,) m
    outwards: FloatArray  # (2,) direction away from the paint

    @classmethod
    def of(cls, corners_map: FloatArray, side: int, height_m: float) -> _End:
        """The ``side`` of a quadrilateral (4, 2), from its corner to the next, at a height."""
        corners = np.column_stack([corners_map[[side, (side + 1) % 4]], np.full(2, height_m)])
        middle = corners.mean(axis=0)
        outwards = middle[:2] - corners_map.mean(axis=0)
        return cls(corners, middle, outwards / max(float(np.linalg.norm(outwards)), 1e-9))

    def face(self) -> FloatArray:
        """Points (N, 3) on an upright face with its foot at the end."""
        beside = np.array([-self.outwards[1], self.outwards[0], 0.0])
        steps = (np.arange(_STEPS) + 0.5) / _STEPS
        across, up = np.meshgrid(_BESIDE_M * (2 * steps - 1), _HIGH_M * steps)
        return np.asarray(
            self.middle_map + across.reshape(-1, 1) * beside + up.reshape(-1, 1) * np.array([0.0, 0.0, 1.0])
        )


def _log_grey(pixels: Pixels, points_px: Sequence[FloatArray], blur_px: float = 0.0) -> list[FloatArray]:
    """Logarithms of an image's grey values at points (N, 2), interpolated, after a blur.

    Only the part of the image with the points is looked at: it is a small one.
    """
    points = [np.ascontiguousarray(px.T, dtype=np.float32) for px in points_px]
    margin = int(np.ceil(_BLUR_SIGMAS * blur_px)) + 2
    corner = np.maximum(np.min([px.min(axis=1) for px in points], axis=0).astype(np.int64) - margin, 0)
    end = np.max([px.max(axis=1) for px in points], axis=0).astype(np.int64) + margin + 1
    values = np.log(grey_of(pixels[corner[1] : end[1], corner[0] : end[0]]) + np.float32(_DARK))
    if blur_px:
        values = cv2.GaussianBlur(values, (0, 0), blur_px)
    maps = [px - corner.astype(np.float32)[:, None] for px in points]
    return [
        np.asarray(cv2.remap(values, u[None], v[None], cv2.INTER_LINEAR)[0], dtype=np.float64)
        for u, v in maps
    ]


def _fisher_z(first: FloatArray, second: FloatArray) -> float:
    """Fisher's z of the correlation of two samples (N,); 0 where one of them is constant."""
    first = first - first.mean()
    second = second - second.mean()
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    correlation = float(first @ second) / size if size > 0 else 0.0
    return float(np.arctanh(np.clip(correlation, -_MOST_CORRELATION, _MOST_CORRELATION)))
