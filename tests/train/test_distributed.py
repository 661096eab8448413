"""Two processes train one network, as torchrun starts them."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from train.data import training_batches
from train.distributed import Team, choose_device, joined_team
from v2hdm.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:
    """The folder and what each of two processes leaves that train two updates, then go on for two more."""
    folder = tmp_path_factory.mktemp("team")
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*launch, "-m", "tests.train.team_member", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return folder, [torch.load(folder / f"member{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.slow
def test_all_members_end_with_identical_weights(team: tuple[Path, list[dict]]) -> None:
    _, (one, other) = team
    for kind in ("net", "averaged"):
        assert one[kind].keys() == other[kind].keys()
        for name, value in one[kind].items():
            assert torch.equal(value, other[kind][name]), f"{kind} {name}"


def test_an_average_is_that_of_all_members(team: tuple[Path, list[dict]]) -> None:
    assert [member["mean"].tolist() for member in team[1]] == [[0.5, 5.0]] * 2


def test_no_two_members_see_the_same_render(team: tuple[Path, list[dict]]) -> None:
    _, (one, other) = team
    assert one["seen"]
    assert not set(one["seen"]) & set(other["seen"])


def test_the_team_goes_on_where_it_was_left(team: tuple[Path, list[dict]]) -> None:
    folder, members = team
    assert [(m["left"], m["step"], m["renders"]) for m in members] == [(2, 4, 8)] * 2
    last = torch.load(folder / "run" / "last.pt", weights_only=True)
    assert last["step"] == 4
    for name, value in last["averaged"].items():
        assert torch.equal(value, members[1]["averaged"][name])


def test_only_the_leader_writes(team: tuple[Path, list[dict]]) -> None:
    folder, _ = team
    written = sorted(path.name for path in (folder / "run").iterdir())
    assert [name for name in written if not name.startswith("events")] == ["best.pt", "last.pt"]
    assert len(written) == 4  # one log of TensorBoard for each of the two parts of the run


def test_one_process_alone_is_a_team_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with joined_team("cpu") as team:
        assert team == Team(torch.device("cpu"))
        value = torch.tensor([2.0])
        team.average([value])
        team.follow([value])
        assert (value.item(), team.agree(3.0), team.from_leader(lambda: "made")) == (2.0, 3.0, "made")


def test_a_device_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="device=gpu is unknown"):
        choose_device("gpu")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert choose_device("cuda", 0) == torch.device("cuda", 0)
    with pytest.raises(ConfigError, match="more processes than this machine's 1 GPUs"):
        choose_device("cuda", 1)


def test_the_only_member_of_a_team_is_shown_what_a_process_alone_is() -> None:
    from tests.train.small import tiny

    data = tiny(Path("unused"), 1).data
    alone, member = (next(training_batches(data, 5, 2, 0, *part)) for part in ([], [(0, 1)]))
    assert torch.equal(alone[0], member[0])
