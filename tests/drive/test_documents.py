from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.docs.blocks import blocks
from tests.drive.example import make_drive
from v2hdm.io.calibration import read_camera_info
from v2hdm.io.drive import read_drive

BLOCKS = [block.text for block in blocks("docs/drive-format.md", "yaml")]


def test_the_documented_drive_reads_and_its_cameras_look_at_their_rois(tmp_path: Path) -> None:
    make_drive(tmp_path)
    (tmp_path / "drive.yaml").write_text(BLOCKS[0])
    for name in ("front", "rear"):
        (tmp_path / name / "camera_info.yaml").write_text(BLOCKS[1])
        for image in (tmp_path / name / "images").iterdir():
            cv2.imwrite(str(image), np.zeros((720, 1280, 3), np.uint8))
    drive = read_drive(tmp_path)
    assert drive.name == "quay-7"
    for camera in drive.cameras.values():
        pinhole_px = np.linalg.inv(camera.ipm["estimated"]) @ [*camera.roi_vehicle.mean(axis=0), 1.0]
        u, v = pinhole_px[:2] / pinhole_px[2]
        assert 500 < u < 780
        assert 300 < v < 720


def test_the_documented_camera_info_reads(tmp_path: Path) -> None:
    (tmp_path / "camera_info.yaml").write_text(BLOCKS[1])
    assert read_camera_info(tmp_path / "camera_info.yaml").width == 1280
