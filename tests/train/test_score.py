"""``python -m train.score``: a network is scored as its training scored it."""

from dataclasses import replace

import pytest

from tests.train.small import coco, tiny, train
from train.checkpoint import load_checkpoint
from train.config import DataConfig
from train.labels import VALIDATION, held_out
from train.score import scores_of
from v2hdm.errors import ConfigError


def silent(_share, _doing):
    """Tell nobody."""


def test_a_checkpoint_scores_what_its_training_recorded(tmp_path):
    config = tiny(tmp_path / "run")
    train(config)
    recorded = load_checkpoint(tmp_path / "run" / "best.pt").metrics
    score_config = replace(config, start=str(tmp_path / "run" / "best.pt"), output=str(tmp_path / "other"))
    assert scores_of(score_config, silent)["2 renders"].figures() == pytest.approx(recorded)


def test_held_out_photographs_are_a_set_of_their_own(tmp_path):
    names = [f"{number}.png" for number in range(40)]
    is_held = [role == VALIDATION for role in held_out([name.removesuffix(".png") for name in names])]
    assert any(is_held)
    images = [{"id": i, "file_name": name, "width": 96, "height": 64} for i, name in enumerate(names)]
    labels = coco(tmp_path, images=images, annotations=[])
    for name in names:
        (tmp_path / name).write_bytes((tmp_path / "b.png").read_bytes())
    config = tiny(tmp_path / "run")
    train(config)
    data = DataConfig(**(vars(config.data) | {"coco": str(labels), "coco_held_out": True}))
    start = str(tmp_path / "run" / "last.pt")
    score_config = replace(config, start=start, output=str(tmp_path / "other"), data=data)
    assert list(scores_of(score_config, silent)) == ["2 renders", f"{sum(is_held)} photographs"]


def test_nothing_to_score_is_an_error(tmp_path):
    config = tiny(tmp_path)
    with pytest.raises(ConfigError, match="start names no network"):
        scores_of(config, silent)
    nothing = replace(config, start="a.pt", validation=replace(config.validation, images=0))
    with pytest.raises(ConfigError, match=r"validation\.images is 0"):
        scores_of(nothing, silent)
