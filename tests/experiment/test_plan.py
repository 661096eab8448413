"""What is mapped follows from the settings; what cannot be mapped is one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from tests.experiment.scene import experiment
from v2hdm.cli import compose as config
from v2hdm.errors import ConfigError
from v2hdm.experiment.plan import ExperimentConfig, Site, jobs


def composed(*overrides: str) -> ExperimentConfig:
    config.register("experiment", ExperimentConfig)
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        return config.to_dataclass(compose("experiment", overrides=list(overrides)), ExperimentConfig, "")


def test_both_ports_are_driven_with_every_one_of_five_seeds() -> None:
    found = jobs(composed())
    assert {(job.port, job.seed) for job in found} == {
        (p, s) for p in ("port1", "port2") for s in range(1, 6)
    }
    assert all(job.site.simulate is not None and job.site.simulate.seed == job.seed for job in found)
    starts = {job.port: job.site.simulate.initial_ipm for job in found if job.site.simulate}
    assert starts == {"port1": "calibrated", "port2": "estimated"}
    assert len({job.folder for job in found}) == 10


def test_recipes_differ_in_what_they_are_named_for() -> None:
    options = jobs(composed())[0].options
    assert (options["paper"].pose_model, options["paper"].loss, options["paper"].mode) == (
        "paper",
        "none",
        "batch",
    )
    assert options["incremental"].mode == "incremental"
    assert (options["ours"].pose_model, options["ours"].loss, options["ours"].mode) == (
        "auto",
        "cauchy",
        "batch",
    )


def test_the_short_trial_shortens_both_routes() -> None:
    full, short = jobs(composed()), jobs(composed("+trial=short"))
    assert [job.title for job in short] == ["port1 seed 1", "port2 seed 1"]
    for job in (full[0], *short):
        assert job.site.simulate is not None
    lengths = [sum(piece[0] for piece in job.site.simulate.route.pieces) for job in (full[0], *short)]
    assert max(lengths[1:]) < 0.25 * lengths[0]


def test_a_recorded_drive_is_mapped_once_whatever_the_seeds() -> None:
    assert [job.title for job in jobs(experiment("out", seeds=[3, 4]))] == ["port1", "port2"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "seeds"),
        ({"recipes": ["ours", "papers"]}, "papers"),
        ({"ports": {}}, "ports is empty"),
        ({"ports": {"port1": Site()}}, "ports.port1"),
        ({"ports": {"a/b": Site()}}, "a/b"),
        ({"name": ".."}, "name"),
        ({"workers": -1}, "workers"),
    ],
)
def test_what_cannot_be_mapped_is_named(changes: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        jobs(experiment("out", **changes))


def test_a_typo_at_the_door_is_one_line_that_names_the_key(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "v2hdm.experiment", "sedes=[1]"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "did you mean seeds" in done.stderr
    assert not list(tmp_path.iterdir())
