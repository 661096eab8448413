"""The fits of the detector's scores, and the command that ships a trained network."""

import shutil
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from export.judge_file import read_judge, write_judge
from export.onnx_file import export_checkpoint
from models.judge import Judge
from tests.export.graphs import graphs_made_once as graphs_made_once
from tests.train.small import tiny, train
from train import fit_judge, fit_lane_score, ship, shipment
from train.checkpoint import load_checkpoint
from train.confident_spots import lit
from train.examples import TrueMarking, example, polygon_overlap, whole_ones
from train.exported import read_exported
from train.fit_judge import Gathered, is_true
from train.fit_lane_score import proposed, seen
from train.judge import JudgeConfig, Quadrilaterals, judged, train_judge
from train.scenes.paint import Brush, rectangle, rhombus
from train.scenes.symbols import hollow_diamond
from train.shipment import Order
from v2hdm.detection import weights
from v2hdm.detection.classifier import AMONG, COMPANIES, SHAPES
from v2hdm.detection.detector import Detector
from v2hdm.detection.evidence import CHANNELS, FEATURES
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DetectorError
from v2hdm.executor import HERE, open_executor
from v2hdm.records import ARROW, DIAMOND, LANE_DASH

SEED = 4711


@pytest.fixture(scope="module")
def shown():
    """A scene with several markings and lines."""
    cv2.setNumThreads(1)
    scenes = (example(index, 0.2, SEED) for index in range(30))
    return next(s for s in scenes if sum(m.fair for m in s.markings) > 3 and len(s.lanes_px) > 1)


@pytest.fixture
def detector():
    return Detector.load(options=DetectorOptions(max_range_m=24.0, min_confidence=0.0))


def reported(shown, detector, spots):
    with pytest.MonkeyPatch.context() as patch:
        run = detector.run_network
        patch.setattr(detector, "run_network", lambda *arguments: spots.claimed(run(*arguments)))
        markings, _ = detector.detect(shown.image, shown.camera)
    return [marking for marking in markings if len(marking.outline_px) == 0]


def found(shown, markings):
    """The markings that must be found, by number, and are, as their class."""

    def is_seen(true):
        overlaps = (polygon_overlap(m.corners_px, true.polygon_px) for m in markings if m.kind == true.kind)
        return any(overlap >= 0.5 for overlap in overlaps)

    return {number for number, true in enumerate(shown.markings) if true.fair and is_seen(true)}


def test_spots_of_sun_are_proposed_as_markings_and_known_to_be_none(shown, detector):
    view = detector.road_camera(shown.camera)
    spotted, spots = lit(shown, view, np.random.default_rng(1))
    without, with_spots = Gathered(), Gathered()
    without.add(0, shown, detector)
    with_spots.add(0, spotted, detector, spots)
    assert (spots.light > 0).any()
    assert without.true.count(True) > 3
    lists = (without.kind, without.evidence, without.views, without.true, without.lit)
    assert len({len(values) for values in lists}) == 1
    assert all(with_spots.lit)
    assert with_spots.true.count(False) > without.true.count(False)
    plain = [m for m in detector.detect(shown.image, shown.camera)[0] if len(m.outline_px) == 0]
    before, after = found(shown, plain), found(shown, reported(spotted, detector, spots))
    assert len(before) > 3
    assert len(before - after) <= 1, "markings stay what they are, but for one that a spot may touch"
    unlit = spots.light == 0
    np.testing.assert_array_equal(spotted.image[unlit], shown.image[unlit])


def test_spots_of_sun_that_the_network_takes_for_markings_are_not_reported(shown):
    detector = Detector.load(options=DetectorOptions())
    view = detector.road_camera(shown.camera)
    for seed in range(3):
        spotted, spots = lit(shown, view, np.random.default_rng(seed))
        for marking in reported(spotted, detector, spots):
            mask = np.zeros(spots.light.shape, np.uint8)
            cv2.fillPoly(mask, [np.round(marking.corners_px).astype(np.int32)], 1)
            assert spots.light[mask > 0].mean() < 0.5


def test_lines_of_lanes_are_proposed_with_their_truth(shown, detector):
    lane_lines = proposed(seen(shown, detector))
    assert len(lane_lines.lines) == len(lane_lines.alone) == len(lane_lines.true)
    assert lane_lines.true.any()


def test_readings_that_were_gathered_in_parts_are_those_gathered_at_once(tmp_path):
    cv2.setNumThreads(1)
    ranges = range(0, 1), range(1, 2), range(0, 2)
    parts = [
        fit_judge.Part(numbers, 2, weights.NETWORK_FILE, tmp_path / f"{k}.npz")
        for k, numbers in enumerate(ranges)
    ]
    first, second, whole = (Gathered.load([fit_judge.gather(part).path]) for part in parts)
    together = Gathered.load([part.path for part in parts[:2]])
    assert 0 < len(first.kind) < len(whole.kind) == len(first.kind) + len(second.kind)
    for item in fields(Gathered):
        of_parts, other = getattr(together, item.name), getattr(whole, item.name)
        assert type(of_parts[0]) is type(other[0])
        np.testing.assert_array_equal(np.array(of_parts), np.array(other), err_msg=item.name)
    assert {type(true) for true in whole.true} <= {bool, type(None)}


def test_what_is_seen_of_lanes_comes_back_from_another_process():
    seen_there: list[fit_lane_score.Seen] = []
    part = fit_lane_score.Part(range(3), 100, weights.NETWORK_FILE)
    with open_executor(1, isolated=True) as executor:
        executor.share_out(fit_lane_score.see, [part], cv2.setNumThreads, (1,), seen_there.extend)
    lines = [proposal.lines for image in seen_there if (proposal := proposed(image)) is not None]
    assert len(seen_there) == 3
    assert sum(map(len, lines)) > 0


def test_the_head_of_an_arrow_is_no_diamond_and_a_hidden_dash_is_neither_true_nor_false():
    head = np.array([[100.0, 100], [130, 160], [160, 100]])
    hidden = np.array([[300.0, 100], [310, 100], [310, 200], [300, 200]])
    shown = SimpleNamespace(
        unknown=None,
        markings=[TrueMarking(ARROW, head, 5.0, False), TrueMarking(LANE_DASH, hidden, 5.0, False)],
    )
    over_head = np.array([[130.0, 90], [105, 115], [130, 140], [155, 115]])
    assert is_true(shown, DIAMOND, over_head) == (False, None)
    assert is_true(shown, LANE_DASH, hidden)[0] is True
    assert is_true(shown, LANE_DASH, hidden - [0, 70])[0] is None
    assert is_true(shown, LANE_DASH, hidden + np.array([200.0, 0.0])) == (False, None)


def test_a_hollow_diamond_is_one_marking_as_worn_as_the_worst_of_its_strokes():
    rng = np.random.default_rng(0)
    brush = Brush((0.7, 0.7, 0.7), 0.3, 0.1)
    dash = brush.paint(rng, LANE_DASH, rectangle(np.array([5.0, 2.0]), 3.0, 0.15))
    filled = brush.paint(rng, DIAMOND, rhombus(np.array([9.0, 0.0]), 2.0, 1.4))
    outlines = [hollow_diamond(brush, rng, rhombus(np.array([x, 0.0]), 2.0, 1.4), 0.2) for x in (5.0, 7.0)]
    whole = whole_ones([dash, *outlines[0], *outlines[1], filled])
    assert whole[0] is dash
    assert whole[3] is filled
    for diamond, strokes in zip(whole[1:3], outlines, strict=True):
        np.testing.assert_array_equal(diamond.polygon_map, strokes[0].polygon_map)
        assert diamond.wear == max(stroke.wear for stroke in strokes[1:]) < 1


CONFIG = JudgeConfig(epochs=6, width=4)


def quadrilaterals(seed, count, noise=0.2):
    """True ones are bright squares, false ones round spots as bright; the evidence is noise."""
    rng = np.random.default_rng(seed)
    true = rng.random(count) < 0.5
    v, u = np.mgrid[:20, :20] - 9.5
    square, disc = np.maximum(np.abs(u), np.abs(v)) < 5, np.hypot(u, v) < 5.8
    views = np.where(true[:, None, None], square, disc)[:, None] + noise * rng.normal(size=(count, 3, 20, 20))
    evidence = 5 * rng.normal(size=(count, 4)) + 3
    shape = np.eye(2)[rng.integers(2, size=count)]
    # The side at the top is as far off as the first feature says, the others not at all.
    error = np.zeros((count, 4))
    error[:, 0] = np.exp(evidence[:, 0] / 5) * rng.normal(size=count)
    parts = (part.astype(np.float32) for part in (views, evidence, shape))
    return Quadrilaterals(*parts, true, error.astype(np.float32), np.full((count, 4), 0.01, np.float32))


def test_what_shows_in_views_alone_is_learnt_and_a_seed_repeats_it():
    gathered, unseen = quadrilaterals(1, 1200), quadrilaterals(2, 400)
    odds, _ = judged(train_judge(gathered, CONFIG), unseen)
    assert ((odds > 0) == unseen.true).mean() > 0.95
    np.testing.assert_array_equal(odds, judged(train_judge(gathered, CONFIG), unseen)[0])


def test_the_errors_of_sides_are_learnt_one_by_one():
    """The errors of top and bottom, which mirroring makes alike, are large; those of the ends are not."""
    gathered = replace(quadrilaterals(7, 2000), true=np.ones(2000, dtype=bool))
    _, sigma_px = judged(train_judge(gathered, replace(CONFIG, epochs=12)), gathered)
    typical = np.median(sigma_px, axis=0)
    assert typical[[0, 2]].min() > 3 * typical[[1, 3]].max()


def test_where_the_paint_network_is_confident_the_image_has_a_say_of_its_own():
    """It claims what is true in training, and later that all are: then only the views can decide."""
    gathered, unseen = (replace(quadrilaterals(seed, 1200, 0.5), claimed_features=(0,)) for seed in (5, 6))
    for part, true in ((gathered, gathered.true), (unseen, True)):
        part.evidence[:, 0] = np.where(true, 2.0, -2.0)
    differences = {}
    for share in (0.0, 0.3):
        odds, _ = judged(train_judge(gathered, replace(CONFIG, claimed_share=share, side_weight=0.0)), unseen)
        differences[share] = np.median(odds[unseen.true]) - np.median(odds[~unseen.true])
    assert differences[0.3] > differences[0.0] + 0.5


def test_the_file_answers_as_the_network_does_for_any_number_of_rows_and_can_be_read_again(tmp_path):
    gathered = quadrilaterals(3, 200)
    judge = train_judge(gathered, CONFIG)
    path = tmp_path / "judge.onnx"
    write_judge(judge, (3, 20, 20), {"features": ["a"]}, path)
    assert not onnx.load(path).graph.node[0].metadata_props
    session = onnxruntime.InferenceSession(path)
    for rows in (1, 33, 200):
        part = gathered.take(np.arange(rows))
        fields = {"views": part.views, "evidence": part.evidence, "shape": part.shape}
        odds, log_sigma = session.run(None, fields)
        expected = judged(judge, part)
        np.testing.assert_allclose(odds, expected[0], atol=1e-4)
        np.testing.assert_allclose(np.exp(log_sigma), expected[1], rtol=1e-3)
    again = read_judge(path, 3, 4, 2, CONFIG.width)
    assert again is not None
    for new, old in zip(judged(again.eval(), gathered), judged(judge, gathered), strict=True):
        np.testing.assert_allclose(new, old, atol=1e-5)
    assert read_judge(path, 3, 5, 2, CONFIG.width) is None


def test_a_judge_that_learns_on_begins_as_it_was_and_leaves_the_first_alone():
    gathered, more = quadrilaterals(5, 300), quadrilaterals(6, 600)
    first = train_judge(gathered, CONFIG)
    before = judged(first, more)[0]
    on = train_judge(more, CONFIG, first)
    after = judged(on, more)[0]
    np.testing.assert_array_equal(judged(first, more)[0], before)
    torch.testing.assert_close(on.mean, first.mean)
    assert fit_judge.log_loss(after, more.true) < fit_judge.log_loss(before, more.true)
    assert np.corrcoef(before, after)[0, 1] > 0.5


def test_a_judge_of_broken_weights_is_not_written(tmp_path):
    judge = train_judge(quadrilaterals(4, 100), CONFIG)
    with torch.no_grad():
        judge.weigh[0].bias[0] = torch.nan
    with pytest.raises(DetectorError, match="not written"):
        write_judge(judge, (3, 20, 20), {}, tmp_path / "judge.onnx")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def into(tmp_path, monkeypatch):
    """A copy of the detector's folder; ``runs/`` is made in a folder of the test."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(weights.FOLDER, tmp_path / "into", ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return tmp_path / "into"


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a training."""
    folder = tmp_path_factory.mktemp("ship") / "trained"
    train(tiny(folder))
    return folder


@pytest.fixture
def run(tmp_path, trained):
    """A copy of it."""
    return shutil.copytree(trained, tmp_path / "trained")


@pytest.fixture
def quick(monkeypatch):
    """Nothing is looked at and what is learnt is anything; returns the parts that were gathered."""
    gathered: list[range] = []

    def gather(part):
        fit_judge.Gathered().save(part.path)
        gathered.append(part.numbers)

    judge = Judge(len(CHANNELS), len(FEATURES), len(SHAPES), width=4, dropout=0.0).eval()
    among = {name: {"bias": 0.0, "weights": dict.fromkeys(AMONG, 0.5)} for name in COMPANIES}
    lines = {name: (np.ones(len(keys)), 0.0) for name, keys in fit_lane_score.KEYS.items()}
    monkeypatch.setattr(shipment, "open_executor", lambda *_, **__: nullcontext(HERE))
    monkeypatch.setattr(fit_judge, "gather", gather)
    monkeypatch.setattr(fit_judge, "fit_all", lambda gathered, tell, start: (tell(0.5), (judge, among))[1])
    monkeypatch.setattr(fit_lane_score, "see", lambda part: [None] * len(part.numbers))
    monkeypatch.setattr(fit_lane_score, "fit_to", lambda images: lines)
    return gathered


def shipped(order):
    progress: list[tuple[float, str]] = []
    shipment.ship(order, lambda share, doing: progress.append((share, doing)))
    return progress


def digests(folder):
    return {path.name: weights.digest(path) for path in sorted(folder.iterdir()) if path.is_file()}


@pytest.mark.slow
def test_a_training_is_shipped_with_a_manifest_that_the_detector_accepts(into, run, quick):
    progress = shipped(Order(source=run, into=into, precision="float32", judge_images=130, lane_images=110))
    weights._problem.cache_clear()
    weights.check_weights(into)
    files = weights.read_manifest(into)["files"]
    assert {entry["command"] for entry in files.values()} == {
        f"python -m train.ship {run.name} --precision float32 --judge-images 130 --lane-images 110"
    }
    before = digests(weights.FOLDER)
    assert all(entry["sha256"] != before[name] for name, entry in files.items())
    assert read_exported(into / "marking_net.onnx").label["steps"] == 3
    assert [numbers.stop for numbers in quick] == [25, 50, 75, 100, 125, 130]
    shares = [share for share, _ in progress]
    assert shares == sorted(shares)
    assert not list(Path("runs").iterdir()), "what was kept to go on from is gone"


@pytest.mark.slow
def test_a_float32_file_replaces_the_detectors_own_files_as_a_checkpoint_does(
    into, run, quick, monkeypatch, tmp_path
):
    checkpoint = load_checkpoint(run / "best.pt")
    export_checkpoint(checkpoint, tmp_path / "net.onnx", 18, 1e-3)
    monkeypatch.setattr(weights, "FOLDER", into)
    monkeypatch.setattr(shipment, "_FLOAT_FILE", tmp_path / "models" / "marking_net.onnx")
    shipped(Order(source=tmp_path / "net.onnx", precision="float32"))
    weights.check_weights(into)
    assert read_exported(into / "default.onnx").label["steps"] == checkpoint.step
    assert read_exported(tmp_path / "models" / "marking_net.onnx").label["precision"] == "float32"
    assert not (into / "marking_net.onnx").exists()


def test_a_killed_shipment_goes_on_and_until_its_end_the_files_are_as_they_were(into, quick, monkeypatch):
    network = onnx.load(weights.NETWORK_FILE)
    network.doc_string = "other bytes"
    onnx.save(network, "other.onnx")
    order = Order(source=Path("other.onnx"), into=into, judge_images=100, lane_images=100)
    before = digests(into)

    def killed(*_):
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
    after = digests(into)
    assert all(after[name] != before[name] for name in ("default.onnx", "judge.onnx"))


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


def test_a_rounded_network_is_kept_but_for_its_classes(into, quick):
    shutil.copy(shipment._FLOAT_FILE, into)
    before = digests(into)
    every = ("network", "judge", "lane_score")
    shipped(Order(source=shipment._FLOAT_FILE, into=into, keep=every))
    after = digests(into)
    assert {name for name in before if before[name] != after[name]} <= {
        "default.onnx", "marking_net.onnx", "manifest.json",
    }  # fmt: skip
    stored = [
        {t.name: t.SerializeToString() for t in onnx.load(path).graph.initializer}
        for path in (weights.NETWORK_FILE, into / "default.onnx")
    ]
    assert stored[0] == stored[1]


def test_a_network_that_stays_rounded_cannot_become_float32(into):
    with pytest.raises(ConfigError, match="leave out --precision, or --keep network"):
        shipped(Order(source=weights.NETWORK_FILE, into=into, keep=("network",), precision="float32"))


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
