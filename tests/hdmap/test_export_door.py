"""``python -m v2hdm.export``: the commands of docs/exports.md, and what a user may get wrong."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.drive.example import camera_info, looking_forward
from tests.hdmap.gis import street
from v2hdm import export
from v2hdm.config import Job, to_dataclass, work_on
from v2hdm.hdmap import read_geojson, write_calibration, write_geojson
from v2hdm.hdmap.formats import FORMATS, check_formats
from v2hdm.hdmap.geopackage import read_geopackage_verdict, write_geopackage
from v2hdm.pipeline import RunConfig
from v2hdm.records import Calibration

ROOT = Path(__file__).parents[2]
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", (ROOT / "docs/exports.md").read_text(), re.DOTALL)
    for line in block.splitlines()
]
EXPORTS = [line for line in COMMANDS if "v2hdm.export" in line]
VERDICT = {"status": "PASS"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_geojson(street(), tmp_path / "map.geojson", VERDICT)
    write_geopackage(street(), tmp_path / "map.gpkg", VERDICT)
    write_calibration(Calibration(camera_info(), looking_forward()), tmp_path / "calibration_front.yaml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", EXPORTS)
def test_the_documented_commands_write_what_they_name(
    folder: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    python, _, module, *arguments = shlex.split(command)
    assert (python, module) == ("python", "v2hdm.export")
    assert export.main(arguments) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert len(paths) == arguments.count("--format")
    for path in paths:
        assert (folder / path).stat().st_size > 200


def test_every_format_of_a_map_is_documented() -> None:
    text = " ".join(EXPORTS)
    assert all(f"--format {name}" in text for name in FORMATS)


def test_the_documented_run_composes_with_its_formats(monkeypatch: pytest.MonkeyPatch) -> None:
    (command,) = [line for line in COMMANDS if "v2hdm.map" in line]
    monkeypatch.setattr(sys, "argv", ["v2hdm.map", *shlex.split(command)[3:]])
    composed: list[Job] = []
    assert work_on("map", RunConfig, composed.append, lambda work: work() or 0, "") == 0
    config = to_dataclass(composed[0].composed, RunConfig, "")
    assert config.export == list(FORMATS)
    check_formats(config.export, "export")


def test_the_verdict_goes_along(folder: Path) -> None:
    assert export.main(["map.geojson", "--format", "gpkg", "--output", "there"]) == 0
    assert read_geopackage_verdict(folder / "there" / "map.gpkg") == VERDICT


def test_an_edited_geopackage_becomes_the_geojson_again(folder: Path) -> None:
    before = read_geojson(folder / "map.geojson")
    assert export.main(["map.gpkg", "--format", "geojson"]) == 0
    after = read_geojson(folder / "map.geojson")
    for old, new in zip(before.markings, after.markings, strict=True):
        np.testing.assert_array_equal(new.corners_map, old.corners_map)
        assert new.id == old.id


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["map.geojson", "--format", "shp"],
            "--format: unknown format 'shp'; choose from: geojson, csv",
        ),
        (["calibration_front.yaml", "--format", "gpkg"], "unknown format 'gpkg' of a calibration"),
        (["map.geojson", "--format", "geojson"], "map.geojson would be written over"),
        (["map.csv", "--format", "gpkg"], "map.csv: no map that can be read"),
        (["none.geojson", "--format", "csv"], "none.geojson: no such file"),
        (["none.gpkg", "--format", "csv"], "none.gpkg: no such file"),
        (["none.yaml", "--format", "urdf"], "none.yaml: no such file"),
        (["map.geojson", "--format", "lanelet2", "--projector", "UTM"], "unknown projector 'UTM'"),
        (["map.geojson", "--format", "csv", "--output", "map.gpkg"], "cannot be written"),
    ],
)
def test_what_a_user_must_mend_is_one_line(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_without_its_package_a_format_is_one_line_that_names_the_extra(folder: Path) -> None:
    (folder / "pyogrio.py").write_text('raise ModuleNotFoundError("not installed", name="pyogrio")')
    arguments = [sys.executable, "-m", "v2hdm.export", "map.geojson", "--format", "gpkg"]
    done = subprocess.run(
        arguments, cwd=folder, env={"PYTHONPATH": f"{folder}:{ROOT}"}, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr == (
        "error: the format gpkg needs pyogrio: install the gis extra, pip install 'v2hdm[gis]'\n"
    )
