"""Ten surveyed points before a camera whose mounting is known, projected by OpenCV."""

from pathlib import Path

import cv2
import numpy as np

from tests.cameras import mounted
from v2hdm.records import CameraInfo, FloatArray

MATRIX = np.array([[900.0, 0.0, 645.5], [0.0, 900.0, 355.5], [0.0, 0.0, 1.0]])
LENS = (-0.11, 0.035, 0.0004, -0.0003, 0.0)
INFO = CameraInfo("front", 1280, 720, MATRIX, "plumb_bob", LENS)
PLACES = np.array(
    [
        [7.6, 2.2], [7.6, -2.2], [8.8, 0.0], [10.6, 4.0], [10.6, -4.0],
        [13.1, 1.5], [13.1, -1.5], [16.6, 4.2], [16.6, -4.2], [16.6, 0.0],
    ]
)  # fmt: skip
CENTRE = np.array([3.6, 0.05, 2.45])
ANGLES_DEG = (0.3, 16.0, 0.6)


def mounting(angles_deg: tuple[float, float, float] = ANGLES_DEG, centre: FloatArray = CENTRE) -> FloatArray:
    """``cam_from_vehicle`` of roll, pitch (down), yaw (left) and the camera's place."""
    roll_deg, pitch_deg, yaw_deg = angles_deg
    return mounted(centre, pitch_deg, yaw_deg, roll_deg)


def project(cam_from_vehicle: FloatArray, places: FloatArray, matrix: FloatArray = MATRIX) -> FloatArray:
    """Recorded pixels (N, 2) of ground places (N, 2), by OpenCV."""
    points = np.column_stack([places, np.zeros(len(places))])
    rotation = cv2.Rodrigues(cam_from_vehicle[:3, :3])[0]
    px, _ = cv2.projectPoints(points, rotation, cam_from_vehicle[:3, 3], matrix, np.array(LENS))
    return np.asarray(px.reshape(-1, 2))


def clicked(
    seed: int, pixel_px: float = 0.5, survey_m: float = 0.01, cam_from_vehicle: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Pixels and places (10, 2) with errors of clicking and of surveying."""
    rng = np.random.default_rng(seed)
    px = project(mounting() if cam_from_vehicle is None else cam_from_vehicle, PLACES)
    return px + rng.normal(0, pixel_px, px.shape), PLACES + rng.normal(0, survey_m, PLACES.shape)


def write_table(folder: Path, px: FloatArray, places: FloatArray) -> Path:
    """The points as a CSV file, P1 and on."""
    rows = [
        f"P{n},{u:.17g},{v:.17g},{x:.17g},{y:.17g}"
        for n, (u, v, x, y) in enumerate(np.hstack([px, places]), 1)
    ]
    path = folder / "points.csv"
    path.write_text("\n".join(["name,u,v,x,y", *rows]) + "\n")
    return path
