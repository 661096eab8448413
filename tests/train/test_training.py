"""A training in miniature: it learns, resumes, refuses what would spoil a run, and may be a team's."""

import logging
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.train.small import tiny, train
from train import __main__ as door
from train import data
from train.checkpoint import fresh_checkpoint, load_checkpoint, save_checkpoint
from train.config import DataConfig, LossConfig, TrainConfig
from train.data import training_batches
from train.distributed import Team, choose_device, joined_team
from train.loop import Trainer
from train.scenes.scenes import TrainingSample
from train.targets import Targets, targets
from v2hdm.cli.compose import register
from v2hdm.errors import ConfigError
from v2hdm.store.inputs import protected_inputs

CONF = str(Path(__file__).resolve().parents[2] / "conf")


def test_a_run_leaves_checkpoints_whose_network_runs(tmp_path):
    state = train(tiny(tmp_path))
    assert state.step == 3
    loaded = load_checkpoint(tmp_path / "best.pt")
    assert set(loaded.metrics) >= {"mean_iou", "paint_iou"}
    with torch.inference_mode():
        prediction = loaded.network()(torch.zeros((1, 32, 32, 3), dtype=torch.uint8))
    assert all(torch.isfinite(output).all() for output in prediction)
    assert not list(tmp_path.glob(".*.part"))


def test_the_loss_falls_on_a_batch_seen_again_and_again(tmp_path):
    trainer = Trainer(replace(tiny(tmp_path, 60), warmup=0.0), lambda share, line: None)
    image = torch.randint(0, 60, (2, 32, 64, 3), dtype=torch.uint8)
    labels = np.zeros((32, 64), dtype=np.uint8)
    image[:, 8:24, 16:40] = 230
    labels[8:24, 16:40] = 1
    lane = np.array([[20.0, 40.0], [30.0, -5.0]])
    of_sample = targets(TrainingSample(image[0].numpy(), labels, labels > 9, (lane,)))
    batch = image, Targets(*(torch.stack([target, target]) for target in of_sample))
    losses = [trainer._update(batch) for _ in range(50)]
    assert losses[-1] < 0.3 * losses[0]


def test_a_run_goes_on_where_it_was_left(tmp_path, caplog):
    left = train(tiny(tmp_path, steps=2))
    with caplog.at_level(logging.INFO):
        trainer = Trainer(tiny(tmp_path, steps=4), lambda share, line: None)
    assert "resuming at step 2" in caplog.text
    for name, value in trainer.averaged.module.state_dict().items():
        torch.testing.assert_close(value, left.averaged[name])
    assert trainer.optimizer.state_dict()["state"]
    assert trainer.run().step == 4


def test_going_on_under_other_settings_is_refused_by_name(tmp_path):
    train(tiny(tmp_path, steps=2))
    with pytest.raises(ConfigError, match="another loss"):
        train(replace(tiny(tmp_path, steps=4), loss=LossConfig(dice=0.1)))


def test_a_run_without_an_end_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="set minutes= or steps="):
        Trainer(replace(tiny(tmp_path), steps=None), lambda share, line: None)


def test_the_learning_rate_warms_up_and_ends_at_nothing(tmp_path):
    trainer = Trainer(replace(tiny(tmp_path, 100), warmup=0.1), lambda share, line: None)
    rates = []
    for step in range(101):
        trainer.state.step = step
        rates.append(trainer._learning_rate())
    assert max(rates) == rates[10] == trainer.config.learning_rate
    assert rates[0] < 0.1 * rates[10]
    assert math.isclose(rates[100], 0.0, abs_tol=1e-9)


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_no_code_of_a_checkpoint_is_run(tmp_path):
    torch.save({"config": Evil(tmp_path / "ran")}, tmp_path / "last.pt")
    with pytest.raises(ConfigError, match="is no checkpoint"):
        load_checkpoint(tmp_path / "last.pt")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_a_recipe_is_the_trainers_settings_by_one_name(name):
    register("train", TrainConfig)
    with initialize_config_dir(CONF, version_base="1.3"):
        config = OmegaConf.to_object(compose("train", overrides=[f"recipe={name}"]))
        shorter = OmegaConf.to_object(compose("train", overrides=[f"recipe={name}", "minutes=1"]))
        assert name != "cpu" or config == OmegaConf.to_object(compose("train"))
    assert config.output == f"runs/{name}"
    assert config.minutes <= 150
    assert config.start is None
    assert shorter == replace(config, minutes=1.0)


def test_a_recipe_trains_from_nothing_and_goes_on_after_a_kill(tmp_path):
    """The settings of the GPU's recipe, with a network and images that a CPU can bear."""
    register("train", TrainConfig)
    with initialize_config_dir(CONF, version_base="1.3"):
        recipe = OmegaConf.to_object(compose("train", overrides=["recipe=gpu"]))
    small = tiny(tmp_path)
    sizes = {key: getattr(small.data, key) for key in ("width", "height", "render_width", "render_height")}
    shown = replace(recipe.data, **sizes, workers=1)
    config = replace(recipe, output=str(tmp_path), steps=1, data=shown, net=small.net)
    config = replace(config, validation=small.validation)
    assert train(config).step == 1
    state = train(replace(config, steps=2))
    assert state.step == 2
    assert (tmp_path / "best.pt").is_file()


def test_a_worker_for_each_core_is_one_or_more(monkeypatch, tmp_path):
    worker_counts: list[int] = []
    monkeypatch.setattr(
        data, "DataLoader", lambda *_, num_workers, **__: worker_counts.append(num_workers) or []
    )
    for cores, part in ((8, (0, 1)), (8, (1, 2)), (1, (0, 1)), (None, (0, 1))):
        monkeypatch.setattr(data.os, "cpu_count", lambda cores=cores: cores)
        data.training_batches(DataConfig(workers=None), 1, 2, 0, part)
    data.training_batches(DataConfig(workers=0), 1, 2, 0)
    assert worker_counts == [7, 3, 1, 1, 0]


def test_the_average_follows_a_short_run_and_forgets_its_random_start(tmp_path):
    trainer = Trainer(tiny(tmp_path, 40), lambda share, line: None)
    trainer.run()
    begin = Trainer(tiny(tmp_path / "begin", 40), lambda share, line: None).net
    nets = (begin, trainer.averaged.module, trainer.net)
    pairs = zip(*([p.detach() for p in net.parameters()] for net in nets), strict=True)
    still_to_go, gone = 0.0, 0.0
    for first, average, last in pairs:
        still_to_go += float((last - average).norm())
        gone += float((last - first).norm())
    assert still_to_go < 0.5 * gone


@pytest.mark.parametrize("argument", ["learning_rat=1", "batch=many", "recipe=gpuu"])
def test_a_mistyped_argument_is_one_line_and_exit_code_2(argument, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train", argument])
    assert door.main() == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("error: configuration")
    assert argument.split("=")[0] in line
    assert "\n" not in line


def test_an_output_that_is_a_file_is_one_line_and_stays(tmp_path, monkeypatch, capsys):
    (tmp_path / "taken").write_text("kept", encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["train", f"output={tmp_path / 'taken'}"])
    assert door.main() == 2
    assert "taken is a file; give another output=" in capsys.readouterr().err
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "kept"


def test_a_checkpoint_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "taken").write_text("kept", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"last\.pt: cannot be written \(File exists\)"):
        save_checkpoint(train(tiny(tmp_path / "run")), tmp_path / "taken" / "last.pt")


def test_a_run_starts_from_the_weights_of_another(tmp_path):
    first = train(tiny(tmp_path / "first"))
    config = replace(tiny(tmp_path / "second"), start=str(tmp_path / "first" / "last.pt"))
    trainer = Trainer(config, lambda share, line: None)
    for name, value in trainer.net.state_dict().items():
        assert torch.equal(value, first.averaged[name]), name
    assert trainer.state.step == 0
    assert trainer.state.renders == first.renders, "the renders that taught it would be shown again"
    assert trainer.run().step == 3


@pytest.mark.parametrize("name", ["last.pt", "best.pt"])
def test_a_start_that_the_run_would_write_over_is_refused(name, tmp_path):
    (tmp_path / name).write_bytes(b"of an earlier run")
    config = replace(tiny(tmp_path), start=str(tmp_path / name))
    with protected_inputs(), pytest.raises(ConfigError, match="is one of the inputs"):
        fresh_checkpoint(config)


def test_a_start_of_another_network_is_refused(tmp_path):
    train(tiny(tmp_path / "first"))
    config = tiny(tmp_path / "second")
    narrower = replace(config.net, widths=[16, 16, 16, 8])
    config = replace(config, start=str(tmp_path / "first" / "last.pt"), net=narrower)
    with pytest.raises(ConfigError, match=r"start=.*holds the network"):
        Trainer(config, lambda share, line: None)


ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    """The folder and what each of two processes leaves that train two updates, then go on for two more."""
    folder = tmp_path_factory.mktemp("team")
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*launch, "-m", "tests.train.team_member", str(folder)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert process.returncode == 0, process.stderr
    return folder, [torch.load(folder / f"member{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.slow
def test_all_members_end_with_identical_weights(team):
    _, (first, other) = team
    for kind in ("net", "averaged"):
        assert first[kind].keys() == other[kind].keys()
        for name, value in first[kind].items():
            assert torch.equal(value, other[kind][name]), f"{kind} {name}"


def test_an_average_is_that_of_all_members(team):
    assert [member["mean"].tolist() for member in team[1]] == [[0.5, 5.0]] * 2


def test_no_two_members_see_the_same_render(team):
    _, (first, other) = team
    assert first["seen"]
    assert not set(first["seen"]) & set(other["seen"])


def test_the_team_goes_on_where_it_was_left(team):
    folder, members = team
    assert [(m["left"], m["step"], m["renders"]) for m in members] == [(2, 4, 8)] * 2
    last = torch.load(folder / "run" / "last.pt", weights_only=True)
    assert last["step"] == 4
    for name, value in last["averaged"].items():
        assert torch.equal(value, members[1]["averaged"][name])


def test_only_the_leader_writes(team):
    folder, _ = team
    written = sorted(path.name for path in (folder / "run").iterdir())
    assert [name for name in written if not name.startswith("events")] == ["best.pt", "last.pt"]
    assert len(written) == 4  # one log of TensorBoard for each of the two parts of the run


def test_one_process_alone_is_a_team_of_one(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with joined_team("cpu") as team:
        assert team == Team(torch.device("cpu"))
        value = torch.tensor([2.0])
        team.average([value])
        team.follow([value])
        assert (value.item(), team.agree(3.0), team.from_leader(lambda: "made")) == (2.0, 3.0, "made")


def test_a_device_that_is_not_there_is_named(monkeypatch):
    with pytest.raises(ConfigError, match="device=gpu is unknown"):
        choose_device("gpu")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert choose_device("cuda", 0) == torch.device("cuda", 0)
    with pytest.raises(ConfigError, match="more processes than this machine's 1 GPUs"):
        choose_device("cuda", 1)


def test_the_only_member_of_a_team_is_shown_what_a_process_alone_is():
    data = tiny(Path("unused"), 1).data
    alone, member = (next(training_batches(data, 5, 2, 0, *part)) for part in ([], [(0, 1)]))
    assert torch.equal(alone[0], member[0])
