"""A word painted on a plane, and images of it from a vehicle that drives past."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from v2hdm.geometry.ipm import cam_from_mounting, pinhole_px_from_ground
from v2hdm.geometry.rigid import inverse
from v2hdm.records import Calibration, Camera, CameraInfo, FloatArray, HDMap, Image, Symbol
from v2hdm.site.living.wear import Footage

INFO = CameraInfo("front", 640, 480, np.array([[450.0, 0, 320], [0, 450.0, 240], [0, 0, 1.0]]))
CAMERA = Camera(INFO, {}, "", np.zeros((4, 2)))
CALIBRATION = Calibration(INFO, cam_from_mounting(np.array([2.0, 0.0, 1.6]), np.deg2rad([0.0, 20.0, 0.0])))
CELL_M = 0.01
ASPHALT, WHITE = 70, 190


def painted(text: str) -> tuple[np.ndarray, FloatArray]:
    """The ground (H, W), its columns towards the right of who drives on, and the size (2,) of the word, m."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 3.0, 14)
    pixels = np.full((300, 500), ASPHALT, dtype=np.uint8)
    left, foot = 250 - width // 2, 150 + height // 2
    cv2.putText(pixels, text, (left, foot), cv2.FONT_HERSHEY_SIMPLEX, 3.0, WHITE, 14, cv2.LINE_AA)
    return pixels, CELL_M * np.array([width, height + 14.0])


def poses(yaw_rad: float, distances_m=(9.0, 7.5, 6.0)) -> list[FloatArray]:
    """The vehicle before the word at the map's origin, heading to it."""
    out = []
    for distance_m in distances_m:
        pose = np.eye(4)
        ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
        pose[:2, :2] = np.column_stack([ahead, [-ahead[1], ahead[0]]])
        pose[:2, 3] = -distance_m * ahead
        out.append(pose)
    return out


def word_map(size_m: FloatArray, first: int = 0) -> HDMap:
    """A map with the word's rectangle, its corners from any one on; it is read by who drives to the east."""
    width, height = size_m / 2
    corners = np.array([[-height, width], [-height, -width], [height, -width], [height, width]])
    order = np.roll(np.arange(4), -first)
    return HDMap(
        (), symbols=(Symbol("text", corners[order], 3, covariance_m2=np.diag(np.repeat(order, 2) + 1.0)),)
    )


def footage_of(ways: list[FloatArray]) -> Footage:
    images = [Image("front", float(k), Path(f"{k}.png"), way) for k, way in enumerate(ways)]
    return Footage(images, ways, {"front": CALIBRATION}, None)


def lights(ground: np.ndarray, footage: Footage):
    """Reads the image of the ground from each pose, whose columns lead to the south."""
    east_from_pixel = np.array([[0.0, -CELL_M, CELL_M * 150], [-CELL_M, 0.0, CELL_M * 250], [0.0, 0.0, 1.0]])

    def light(image: Image) -> np.ndarray:
        cam_from_map = CALIBRATION.cam_from_vehicle @ inverse(image.map_from_vehicle)
        px_from_pixel = pinhole_px_from_ground(INFO.intrinsic, cam_from_map) @ east_from_pixel
        size = (INFO.width, INFO.height)
        warped = cv2.warpPerspective(ground, px_from_pixel, size, flags=cv2.INTER_AREA, borderValue=ASPHALT)
        return warped.astype(np.float32)

    return light
