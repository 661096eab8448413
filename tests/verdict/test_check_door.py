"""``v2hdm check``: one line a finding, a verdict, pictures, an exit code."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.verdict.drives import drive, noisy, poses, with_yaw, yaw_of
from v2hdm.cli.main import run
from v2hdm.io.drive import Trajectory
from v2hdm.io.drive.writing import write_drive
from v2hdm.records import Image


def written(folder: Path, recorded: Trajectory) -> Path:
    """A drive of one camera, an image every 2.5 m in ``folder``."""
    bare = drive(recorded, every=10)
    images = []
    for k, image in enumerate(bare.images):
        path = folder / "front" / "images" / f"{k:06d}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), noisy(k))
        images.append(Image("front", image.stamp_s, path, image.map_from_vehicle))
    write_drive(folder, replace(bare, name="tiny", root=folder, images=images), recorded)
    return folder


def test_a_clean_drive_ends_with_its_verdict_and_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "check"
    arguments = [str(written(tmp_path / "drive", poses(4.0, 1.0))), "--no-ground", "--output", str(output)]
    assert run(["check", *arguments]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^verdict: PASS \(nothing raised, \d+ checks passed\)$", shown, re.MULTILINE)
    assert "PASS speed" not in shown
    assert json.loads((output / "verdict.json").read_text())["status"] == "PASS"
    assert {path.name for path in output.glob("*.[jp][pn]g")} == {
        "route.png", "front_1.jpg", "front_2.jpg", "front_3.jpg",
    }  # fmt: skip
    assert run(["check", *arguments, "--all"]) == 0  # over its own earlier result
    assert "PASS speed (poses): " in capsys.readouterr().out


def test_a_drive_that_fails_exits_with_3_and_still_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = poses(4.0, 1.0)
    folder = written(tmp_path / "drive", with_yaw(recorded, np.pi / 2 - yaw_of(recorded)))
    assert run(["check", str(folder), "--no-ground", "--output", str(tmp_path / "check")]) == 3
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("FAIL heading (poses): yaw counts clockwise from north")
    assert (tmp_path / "check" / "route.png").is_file()


def test_a_folder_of_other_files_is_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(tmp_path / "drive", poses(4.0, 1.0))
    assert run(["check", str(folder), "--no-ground", "--output", str(folder)]) == 2
    assert "holds files that are no results of ours" in capsys.readouterr().err
    assert (folder / "drive.yaml").is_file()


def test_a_drive_that_cannot_be_read_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(tmp_path / "nowhere")]) == 2
    assert capsys.readouterr().err.startswith("error: ")
