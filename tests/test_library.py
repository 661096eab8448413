"""The library: its names are documented with examples that run, and importing it loads nothing."""

import ast
import doctest
import inspect
from pathlib import Path

import cv2
import numpy as np
import pytest

import v2hdm
from tests.docs.sandbox import survey_camera
from v2hdm.io.drive.truth import read_truth

ASKED = {
    "read_drive", "check_drive", "Detector", "detect_images", "map_drive", "calibrate_from_points",
    "calibrate_from_ground", "localize", "read_map", "HDMap", "Calibration", "Result", "Verdict", "Problem",
    "solve", "simulate_port",
}  # fmt: skip
SETTINGS = {"DetectorOptions", "MappingOptions", "ReadOptions", "V2hdmError"}
"""They are explained attribute by attribute."""


@pytest.fixture(scope="module")
def names(small_drive, coarse_mosaics, tmp_path_factory):
    """Names that the examples use: the library, a rendered drive, its result, and a folder to write to."""
    folder = tmp_path_factory.mktemp("library")
    port = v2hdm.read_drive(small_drive)
    result = v2hdm.map_drive(port, accuracy_goal_cm=10.0, workers=1, cache=folder / "cache")
    survey_camera(folder, port, read_truth(port))
    public = {name: getattr(v2hdm, name) for name in v2hdm.__all__}
    places = {"folder": folder, "port": port, "result": result, "points": folder / "points.csv"}
    return {**public, **places, "np": np, "cv2": cv2}


@pytest.mark.parametrize("name", sorted(set(v2hdm.__all__) - SETTINGS))
def test_the_examples_of_each_public_name_run(name, names):
    documented = getattr(v2hdm, name)
    method = documented.to_geodataframe if name == "HDMap" else None
    if method is not None:
        pytest.importorskip("geopandas", reason="no geopandas: pip install 'v2hdm[gis]'")
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    examples = [
        test
        for source in (documented, method)
        if source is not None
        for test in finder.find(source, name, globs=names)
    ]
    assert any(test.examples for test in examples)
    for test in examples:
        said: list[str] = []
        assert runner.run(test, out=said.append).failed == 0, "".join(said)


def test_the_library_has_the_names_that_it_promises():
    assert set(v2hdm.__all__) >= ASKED
    assert set(dir(v2hdm)) >= set(v2hdm.__all__)
    tree = ast.parse(inspect.getsource(v2hdm))
    typed = {
        (alias.asname or alias.name)
        for block in tree.body if isinstance(block, ast.If)
        for line in block.body if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }  # fmt: skip
    assert typed == set(v2hdm.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = v2hdm.nothing


def test_what_is_saved_is_what_the_command_writes(names, tmp_path):
    from v2hdm.cli.main import run

    saved = names["result"].save(tmp_path / "saved")
    settings = f"name=run output={tmp_path} cache={names['folder'] / 'cache'} workers=1 accuracy_goal_cm=10"
    assert run(["map", f"drive.path={names['port'].root}", *settings.split()]) == 0
    written = {path.relative_to(tmp_path / "run") for path in (tmp_path / "run").rglob("*") if path.is_file()}
    of_runs = {Path("config.yaml"), Path("run.log")}
    assert {path.relative_to(saved) for path in saved.rglob("*") if path.is_file()} == written - of_runs
    for name in ("map.geojson", "trajectory.tum", "trajectory_sigma.csv", "residuals.csv"):
        assert (saved / name).read_bytes() == (tmp_path / "run" / name).read_bytes(), name


def test_nothing_is_left_by_a_mapping(names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    v2hdm.check_drive(names["port"], ground=False)
    few = v2hdm.read_drive(names["port"].root, v2hdm.ReadOptions(limit=8))
    v2hdm.map_drive(few, workers=1, options=v2hdm.MappingOptions(max_range_m=9.0))
    assert list(tmp_path.iterdir()) == []
