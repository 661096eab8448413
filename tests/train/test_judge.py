"""The judge learns what shows in views alone, and its file answers as it does."""

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from export.judge_file import write_judge
from train.judge import JudgeConfig, Quadrilaterals, judged, train_judge
from v2hdm.errors import DetectorError

CONFIG = JudgeConfig(epochs=6, width=4)


def quadrilaterals(seed: int, count: int, noise: float = 0.2) -> Quadrilaterals:
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
    known, unseen = quadrilaterals(1, 1200), quadrilaterals(2, 400)
    odds, _ = judged(train_judge(known, CONFIG), unseen)
    assert ((odds > 0) == unseen.true).mean() > 0.95
    np.testing.assert_array_equal(odds, judged(train_judge(known, CONFIG), unseen)[0])


def test_the_errors_of_sides_are_learnt_one_by_one():
    """Those of the top and the bottom, which mirroring makes alike, and not those of the ends."""
    known = replace(quadrilaterals(7, 2000), true=np.ones(2000, dtype=bool))
    _, sigma_px = judged(train_judge(known, replace(CONFIG, epochs=12)), known)
    typical = np.median(sigma_px, axis=0)
    assert typical[[0, 2]].min() > 3 * typical[[1, 3]].max()


def test_where_the_paint_network_is_confident_the_image_has_a_say_of_its_own():
    """It claims what is true in training, and later that all are: then only the views can decide."""
    known, unseen = (replace(quadrilaterals(seed, 1200, 0.5), claimed_features=(0,)) for seed in (5, 6))
    for part, true in ((known, known.true), (unseen, True)):
        part.evidence[:, 0] = np.where(true, 2.0, -2.0)
    told = {}
    for share in (0.0, 0.3):
        odds, _ = judged(train_judge(known, replace(CONFIG, claimed_share=share, side_weight=0.0)), unseen)
        told[share] = np.median(odds[unseen.true]) - np.median(odds[~unseen.true])
    assert told[0.3] > told[0.0] + 0.5


def test_the_file_answers_as_the_network_does_for_any_number_of_rows(tmp_path):
    known = quadrilaterals(3, 200)
    judge = train_judge(known, CONFIG)
    path = tmp_path / "judge.onnx"
    write_judge(judge, (3, 20, 20), {"features": ["a"]}, path)
    assert not onnx.load(path).graph.node[0].metadata_props
    session = onnxruntime.InferenceSession(path)
    for rows in (1, 33, 200):
        part = known.take(np.arange(rows))
        given = {"views": part.views, "evidence": part.evidence, "shape": part.shape}
        odds, log_sigma = session.run(None, given)
        expected = judged(judge, part)
        np.testing.assert_allclose(odds, expected[0], atol=1e-4)
        np.testing.assert_allclose(np.exp(log_sigma), expected[1], rtol=1e-3)


def test_a_judge_of_broken_weights_is_not_written(tmp_path):
    judge = train_judge(quadrilaterals(4, 100), CONFIG)
    with torch.no_grad():
        judge.weigh[0].bias[0] = torch.nan
    with pytest.raises(DetectorError, match="not written"):
        write_judge(judge, (3, 20, 20), {}, tmp_path / "judge.onnx")
    assert not list(tmp_path.iterdir())
