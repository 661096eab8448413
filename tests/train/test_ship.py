"""A trained network becomes the detector's own by one command, whole or not at all, and after a kill, too."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from export.onnx_file import export_checkpoint
from models.judge import Judge
from tests.train.small import tiny, train
from train import fit_judge, fit_lane_score, ship, shipment
from train.bar import Share
from train.checkpoint import load_checkpoint
from train.exported import read_exported
from train.shipment import Order
from v2hdm.detection import weights
from v2hdm.detection.classifier import AMONG, SHAPES
from v2hdm.detection.evidence import CHANNELS, FEATURES


@pytest.fixture
def into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the detector's folder; ``runs/`` is made in a folder of the test."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(weights.FOLDER, tmp_path / "into", ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return tmp_path / "into"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a training."""
    train(tiny(tmp_path / "trained"))
    return tmp_path / "trained"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[range]:
    """Nothing is looked at and what is learnt is anything; returns the parts that were gathered."""
    gathered: list[range] = []

    def in_this_process(work, jobs, processes, start, arguments, take) -> None:
        for job in jobs:
            take(work(job))

    def gather(part: fit_judge.Part) -> None:
        fit_judge.Gathered().save(part.path)
        gathered.append(part.numbers)

    judge = Judge(len(CHANNELS), len(FEATURES), len(SHAPES), width=4, dropout=0.0).eval()
    among = {name: {"bias": 0.0, "weights": dict.fromkeys(AMONG, 0.5)} for name in SHAPES}
    lines = {name: (np.ones(len(keys)), 0.0) for name, keys in fit_lane_score.KEYS.items()}
    monkeypatch.setattr(shipment, "share_out", in_this_process)
    monkeypatch.setattr(fit_judge, "gather", gather)
    monkeypatch.setattr(fit_judge, "fit_all", lambda gathered, tell: (tell(0.5), (judge, among))[1])
    monkeypatch.setattr(fit_lane_score, "see", lambda part: [None] * len(part.numbers))
    monkeypatch.setattr(fit_lane_score, "fit_to", lambda images: lines)
    return gathered


def shipped(order: Order) -> list[tuple[float, str]]:
    told: list[tuple[float, str]] = []
    shipment.ship(order, lambda share, doing: told.append((share, doing)))
    return told


def digests(folder: Path) -> dict[str, str]:
    return {path.name: weights.digest(path) for path in sorted(folder.iterdir())}


@pytest.mark.slow
def test_a_training_is_shipped_with_a_manifest_that_the_detector_accepts(into, run, quick):
    told = shipped(Order(source=run, into=into, precision="float32", judge_images=130, lane_images=110))
    weights._problem.cache_clear()
    weights.check_weights(into)
    files = weights.read_manifest(into)["files"]
    assert {entry["command"] for entry in files.values()} == {
        f"python -m train.ship {run} --precision float32 --judge-images 130 --lane-images 110"
    }
    before = digests(weights.FOLDER)
    assert all(entry["sha256"] != before[name] for name, entry in files.items())
    assert read_exported(into / "marking_net.onnx").label["steps"] == 3
    assert [numbers.stop for numbers in quick] == [25, 50, 75, 100, 125, 130]
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert not list(Path("runs").iterdir()), "what was kept to go on from is gone"


@pytest.mark.slow
def test_without_another_folder_the_detectors_own_files_and_the_float32_file_are_replaced(
    into, run, quick, monkeypatch, tmp_path
):
    monkeypatch.setattr(weights, "FOLDER", into)
    monkeypatch.setattr(shipment, "_FLOAT_FILE", tmp_path / "models" / "marking_net.onnx")
    shipped(Order(source=run, precision="float32"))
    weights.check_weights(into)
    assert read_exported(tmp_path / "models" / "marking_net.onnx").label["precision"] == "float32"
    assert not (into / "marking_net.onnx").exists()


def test_a_killed_shipment_goes_on_and_until_its_end_the_files_are_as_they_were(
    into, run, quick, monkeypatch
):
    order = Order(source=run, into=into, precision="float32", judge_images=100, lane_images=100)
    before = digests(into)

    def killed(gathered: fit_judge.Gathered, tell: Share) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(fit_judge, "fit_all", killed)
        with pytest.raises(KeyboardInterrupt):
            shipped(order)
    assert digests(into) == before
    assert len(quick) == 4
    (left,) = Path("runs").iterdir()
    (left / "2.npz").unlink()
    shipped(order)
    assert quick[4:] == [range(50, 75)], "only what was not done yet"
    assert digests(into)["judge.onnx"] != before["judge.onnx"]


def test_another_network_or_other_numbers_begin_anew(into, run):
    order = Order(source=run, into=into)
    state = shipment._state(order)
    assert shipment._state(replace(order, judge_images=1651)) != state
    train(tiny(run, steps=5))
    assert shipment._state(order) != state


def test_judge_and_lane_score_can_be_kept_for_a_network_that_was_exported_before(into, quick):
    network = weights.NETWORK_FILE
    before = digests(into)
    shipped(Order(source=network, into=into, keep=("lane_score",)))
    after = digests(into)
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed == {"judge.onnx", "confidence.json", "manifest.json"}
    shipped(Order(source=network, into=into, keep=("judge", "lane_score")))
    assert weights.read_manifest(into)["files"]["judge.onnx"]["command"].endswith("--keep judge lane_score")
    assert digests(into)["judge.onnx"] == after["judge.onnx"]


@pytest.mark.slow
def test_a_float32_file_is_exported_as_a_checkpoint_is(into, run, quick, tmp_path):
    checkpoint = load_checkpoint(run / "best.pt")
    export_checkpoint(checkpoint, tmp_path / "net.onnx", 18, 1e-3)
    shipped(Order(source=tmp_path / "net.onnx", into=into, precision="float32"))
    assert read_exported(into / "default.onnx").label["steps"] == checkpoint.step


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["nothing/there"], "no network at nothing/there: train one"),
        (["into"], "no network at into/best.pt: train one"),
        (["into/default.onnx", "--judge-images", "3"], "--judge-images 3: give 100 or more"),
        (["into/manifest.json"], "manifest.json is no checkpoint"),
        (["into/judge.onnx"], "judge.onnx was not written by `python -m export`"),
    ],
)
def test_what_cannot_be_shipped_is_one_line(arguments, line, into, capsys):
    before = digests(into)
    assert ship.main([*arguments, "--into", "into"]) == 2
    printed = capsys.readouterr().err.strip().splitlines()[-1]
    assert printed.startswith("error: ")
    assert line in printed
    assert digests(into) == before
