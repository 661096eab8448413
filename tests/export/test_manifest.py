"""The manifest is written by the commands that make the files, and tells files that were not fitted anew."""

import shutil

import pytest

from export import manifest
from v2hdm.detection import weights
from v2hdm.errors import DetectorError


@pytest.fixture
def folder(tmp_path):
    copy = tmp_path / "weights"
    shutil.copytree(weights.FOLDER, copy, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return copy


def check(folder) -> None:
    weights._problem.cache_clear()
    weights.check_weights(folder)


def change(folder, name: str) -> None:
    with (folder / name).open("ab") as file:
        file.write(b"\n")


def test_a_new_network_is_refused_until_judge_and_lane_score_were_fitted_to_it(folder):
    change(folder, "default.onnx")
    manifest.record(["default.onnx"], "python -m export", folder)
    with pytest.raises(DetectorError, match=r"judge\.onnx: was fitted to another network .* train\.ship"):
        check(folder)
    change(folder, "judge.onnx")
    change(folder, "confidence.json")
    manifest.record(["judge.onnx", "confidence.json"], "python -m train.ship runs/gpu", folder)
    with pytest.raises(DetectorError, match=r"lane_score\.json: .* train\.ship"):
        check(folder)
    manifest.record(["lane_score.json"], "kept", folder)
    check(folder)
    files = weights.read_manifest(folder)["files"]
    assert files["lane_score.json"]["command"] == "kept"
    assert len({entry["network"] for entry in files.values()}) == 1


def test_the_manifest_names_the_commit_the_day_and_the_command(folder):
    manifest.record(["judge.onnx"], "python -m train.ship runs/gpu", folder)
    written = weights.read_manifest(folder)
    entry = written["files"]["judge.onnx"]
    assert written["commit"] is None or len(written["commit"].removesuffix("-dirty")) == 40
    assert entry["command"] == "python -m train.ship runs/gpu"
    assert entry["made"].count("-") == 2


def test_an_export_elsewhere_leaves_the_manifest_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(manifest, "record", lambda *_: pytest.fail("the manifest was written"))
    manifest.record_network(tmp_path / "mine.onnx", "python -m export")


def test_what_is_no_fitted_file_is_refused(folder):
    with pytest.raises(DetectorError, match=r"scores\.json: no fitted file .* give one of default\.onnx"):
        manifest.record(["scores.json"], "by hand", folder)
