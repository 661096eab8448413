"""Where made-up cameras sit on their vehicles, by SciPy: none of the package's own rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def mounted(centre, pitch_deg=0.0, yaw_deg=0.0, roll_deg=0.0):
    """``cam_from_vehicle`` of a camera at ``centre`` that looks ahead, down by pitch, to the left by yaw."""
    vehicle_from_body = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    out = np.eye(4)
    out[:3, :3] = OPTICAL_FROM_BODY @ vehicle_from_body.T
    out[:3, 3] = -out[:3, :3] @ np.asarray(centre)
    return out


def apply(dst_from_src, points_src):
    """Points (..., N, 3) of ``src`` in ``dst``."""
    return points_src @ np.swapaxes(dst_from_src[..., :3, :3], -1, -2) + dst_from_src[..., None, :3, 3]


def level(x_m, y_m=0.0, yaw_rad=0.0):
    """``map_from_vehicle`` (N, 4, 4) of a vehicle on level ground at places x (N,) and y, headed by yaw."""
    x_m, y_m, yaw_rad = np.broadcast_arrays(x_m, y_m, yaw_rad)
    out = np.tile(np.eye(4), (len(x_m), 1, 1))
    out[:, :3, :3] = Rotation.from_euler("z", yaw_rad[:, None]).as_matrix()
    out[:, 0, 3], out[:, 1, 3] = x_m, y_m
    return out
