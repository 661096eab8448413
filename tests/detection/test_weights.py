"""The fitted files belong together, or the detector says which does not and what to do."""

import json
import shutil
import time

import pytest

from v2hdm.detection import weights
from v2hdm.detection.detector import Detector
from v2hdm.errors import DetectorError


@pytest.fixture
def folder(tmp_path):
    copy = tmp_path / "weights"
    shutil.copytree(weights.FOLDER, copy, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return copy


def refusal(folder) -> str:
    with pytest.raises(DetectorError) as caught:
        weights.check_weights(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_shipped_files_belong_together(folder):
    weights.check_weights()
    weights.check_weights(folder)
    manifest = weights.read_manifest()
    assert set(manifest["files"]) == set(weights.COMMANDS)
    assert len(manifest["commit"]) >= 40


@pytest.mark.parametrize("name", list(weights.COMMANDS))
def test_a_file_that_is_not_the_manifests_is_refused_with_the_command_that_makes_it(folder, name):
    with (folder / name).open("ab") as file:
        file.write(b" ")
    message = refusal(folder)
    assert name in message
    assert weights.COMMANDS[name] in message


@pytest.mark.parametrize("name", list(weights.COMMANDS))
def test_a_missing_file_is_refused(folder, name):
    (folder / name).unlink()
    assert f"{folder / name}: no such file" in refusal(folder)


def test_a_judge_of_another_network_is_refused_until_it_is_fitted(folder):
    manifest = weights.read_manifest(folder)
    manifest["files"]["judge.onnx"]["network"] = "0" * 64
    (folder / "manifest.json").write_text(json.dumps(manifest))
    message = refusal(folder)
    assert "fitted to another network" in message
    assert "python -m train.ship v2hdm/detection/weights/default.onnx" in message
    with weights.being_fitted():
        weights.check_weights(folder)
    refusal(folder)


@pytest.mark.parametrize("content", [None, "{", "[]", '{"files": {}}'])
def test_a_missing_or_damaged_manifest_is_refused(folder, content):
    path = folder / "manifest.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert "missing or damaged" in refusal(folder)


def test_a_detector_is_not_loaded_from_files_that_do_not_belong_together(monkeypatch):
    monkeypatch.setattr(weights, "_problem", lambda folder: "judge.onnx: was fitted to another network")
    with pytest.raises(DetectorError, match="another network"):
        Detector.load()
    with weights.being_fitted():
        Detector.load()


def test_the_user_of_an_own_network_is_told_whose_judge_scores_it(tmp_path):
    own = tmp_path / "own.onnx"
    own.write_bytes(weights.NETWORK_FILE.read_bytes())
    assert weights.unknown_network(own) is None
    own.write_bytes(b"another network")
    message = weights.unknown_network(own)
    assert message is not None
    assert "judge of the shipped network" in message
    assert "\n" not in message
    with pytest.raises(DetectorError, match="no such detector model"):
        weights.unknown_network(tmp_path / "none.onnx")


def test_the_check_takes_less_than_20_ms_and_none_the_second_time():
    times_s = []
    for kept in (False, False, False, True):
        if not kept:
            weights._problem.cache_clear()
        begin = time.perf_counter()
        weights.check_weights()
        times_s.append(time.perf_counter() - begin)
    assert min(times_s[:3]) < 0.02
    assert times_s[3] < 0.001
