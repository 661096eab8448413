import pytest

from v2hdm.executor import HERE
from v2hdm.simulate.port.config import (
    CalibrationConfig,
    CameraConfig,
    MountConfig,
    PortConfig,
    RouteConfig,
    SurfaceConfig,
    YardConfig,
)
from v2hdm.simulate.port.drive import render_drive

FRONT = MountConfig(x_m=3.6, y_m=0.05, z_m=2.45, yaw_deg=0.6, pitch_deg=16.0, roll_deg=0.3)
LENDER = MountConfig(x_m=3.4, y_m=-0.07, z_m=2.58, yaw_deg=-0.7, pitch_deg=17.1, roll_deg=-0.6)
REAR = MountConfig(x_m=-1.1, y_m=0.0, z_m=2.6, yaw_deg=179.5, pitch_deg=17.5)


def tiny_port(**changes):
    """Ten frames of two 96 x 64 cameras with the field of view of the real ones."""
    small = {"width": 96, "height": 64, "focal_px": 64.0, "principal_offset_px": [0.5, -0.5]}
    values: dict[str, object] = {
        "name": "tiny",
        "cameras": {
            "front": CameraConfig(mount=FRONT, borrowed_mount=LENDER, **small),
            "rear": CameraConfig(mount=REAR, borrowed_mount=FRONT_MIRRORED, **small),
        },
        "calibration": CalibrationConfig(click_sigma_px=0.05),
        "route": RouteConfig(pieces=[[16.0, 0.0], [14.0, 60.0]], image_spacing_m=2.6),
        "surface": SurfaceConfig(patches=2, oil_stains=5, tyre_marks=0.05),
        "yard": YardConfig(parked_trucks=1, barriers=2, lamp_posts=1, moving_trucks=1, shadow_strips=2),
    }
    return PortConfig(**(values | changes))


FRONT_MIRRORED = MountConfig(x_m=-0.9, y_m=0.1, z_m=2.47, yaw_deg=180.9, pitch_deg=16.3)


@pytest.fixture(scope="session")
def tiny_drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulate") / "tiny"
    render_drive(tiny_port(), folder, HERE, lambda done, total: None)
    return folder
