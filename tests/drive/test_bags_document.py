"""docs/bags.md does what it says."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.drive.bags import messages_of, write_ros2
from tests.drive.example import make_drive
from v2hdm import check
from v2hdm.drive import ReadOptions, read_drive
from v2hdm.drive.poses import POSE_FORMATS, TOPIC_KEYS
from v2hdm.drive.poses.settings import COMMON_KEYS
from v2hdm.drive.poses.table import NAMES
from v2hdm.drive.sources import IMAGE_SOURCES

TEXT = (Path(__file__).parents[2] / "docs/bags.md").read_text()
COMMANDS = re.findall(r"^python -m (.*)$", TEXT, re.MULTILINE)


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
    door, *arguments = shlex.split(COMMANDS[0])
    assert door == "v2hdm.check"
    assert check.main(arguments) == 0
    printed = capsys.readouterr().out
    assert re.search(r"/odom +21  nav_msgs/msg/Odometry", printed)
    Path("drive.yaml").write_text(printed.split("# drive.yaml\n")[1])
    assert len(read_drive(site.parent).images) == 6


def test_the_documented_check_and_map_take_a_bag(site: Path) -> None:
    """The example is too short to be mapped; a bag is read and judged like its folder."""
    assert COMMANDS[2] == "v2hdm.map drive.path=site"
    for folder in ("folder", "site"):
        arguments = shlex.split(COMMANDS[1].replace("site", folder))
        done = subprocess.run(
            [sys.executable, "-m", *arguments, "--no-ground", "--output", f"{folder}-check"],
            cwd=site.parent, env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert done.returncode in (0, 3), done.stderr
        assert (site.parent / f"{folder}-check" / "front_1.jpg").is_file()


def test_the_documented_description_reads(site: Path) -> None:
    (block,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    (site.parent / "drive.yaml").write_text(block)
    shutil.rmtree(site.parent / "folder")
    drive = read_drive(site.parent, ReadOptions(cache=str(site.parent / "cache")))
    assert [image.camera for image in drive.images] == ["front"] * 3


def test_every_key_and_column_is_documented() -> None:
    described: list[Any] = [yaml.safe_load(text) for text in re.findall(r"`(\{.*?\})`", TEXT)]
    used = {key for entry in described for key in entry}
    assert {*POSE_FORMATS, *IMAGE_SOURCES, *TOPIC_KEYS} - {"stamps"} <= used
    for name in (*COMMON_KEYS, *NAMES):
        assert f"`{name}`" in TEXT, name
