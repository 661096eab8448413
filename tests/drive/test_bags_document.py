"""docs/bags.md does what it says; its commands run in tests/docs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.docs.blocks import blocks, document
from tests.drive.bags import messages_of, write_ros2
from tests.drive.example import make_drive
from v2hdm.cli.main import run
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.sources import IMAGE_SOURCES
from v2hdm.io.importers.poses import POSE_FORMATS, TOPIC_KEYS
from v2hdm.io.importers.poses.settings import COMMON_KEYS
from v2hdm.io.importers.poses.table import NAMES

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
