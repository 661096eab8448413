"""docs/bags.md and docs/drive-format.md do what they say."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from tests.docs.blocks import blocks, document
from tests.drive.bags import messages_of, write_ros2
from tests.drive.example import make_drive
from v2hdm.cli.main import run
from v2hdm.io.calibration import read_camera_info
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.sources import IMAGE_SOURCES
from v2hdm.io.importers.poses import COMMON_KEYS, POSE_FORMATS, TOPIC_KEYS
from v2hdm.io.importers.tables import NAMES

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


TEXT = document("docs/bags.md")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "folder"
    folder.mkdir()
    make_drive(folder)
    return write_ros2(tmp_path / "site", messages_of(folder))


def test_the_documented_listing_ends_in_a_description_that_is_read(
    site: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(site.parent)
    assert run(["check", "site", "--list-topics"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"/odom +21  nav_msgs/msg/Odometry", printed)
    Path("drive.yaml").write_text(printed.split("# drive.yaml\n")[1])
    assert len(read_drive(site.parent).images) == 6


def test_the_documented_description_reads(site: Path) -> None:
    (block,) = blocks("docs/bags.md", "yaml")
    (site.parent / "drive.yaml").write_text(block.text)
    shutil.rmtree(site.parent / "folder")
    drive = read_drive(site.parent, ReadOptions(cache=str(site.parent / "cache")))
    assert [image.camera for image in drive.images] == ["front"] * 3


def test_every_key_and_column_is_documented() -> None:
    described: list[Any] = [yaml.safe_load(text) for text in re.findall(r"`(\{.*?\})`", TEXT)]
    used = {key for entry in described for key in entry}
    assert {*POSE_FORMATS, *IMAGE_SOURCES, *TOPIC_KEYS} - {"stamps"} <= used
    for name in (*COMMON_KEYS, *NAMES):
        assert f"`{name}`" in TEXT, name
