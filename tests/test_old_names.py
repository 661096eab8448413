"""Names of 1.0 that 1.1 has changed are taken until 2.0, each with a line that says the new one."""

import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from v2hdm.cli import old_scripts
from v2hdm.cli.compose import compose_run_file, to_dataclass
from v2hdm.cli.main import command_names, run
from v2hdm.cli.old_names import renamed_overrides, share_of
from v2hdm.errors import ConfigError
from v2hdm.pipeline.config import RunConfig

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
OLD_SCRIPTS = [name for name in PROJECT["scripts"] if name != "v2hdm"]
OLD_FILE = """# @package _global_
defaults:
  - port2
mapping:
  mode: incremental
  device: cpu
  acceptance: {max_sigma_m: 0.1}
  association: {max_gap_m: 3.0}
  survey: {points_map: [[3.21, 4.05]], sigma_m: 0.02}
"""


def check_settings(settings):
    """The settings are those of :data:`OLD_FILE`."""
    assert (settings.mode, settings.device) == ("incremental", "cpu")
    (point,) = settings.mapping.survey.points
    assert (point.id, point.position_map, point.sigma_m) == ("3.21 4.05", [3.21, 4.05], [0.02, 0.02])


def check_lines(text):
    """One line for each old name, with the new one."""
    assert text.count("\n") == 5
    assert "mapping.mode is deprecated and goes with 2.0: it is called mode" in text
    assert "mapping.device is deprecated and goes with 2.0: it is called device" in text
    assert (
        "mapping.survey.points_map is deprecated and goes with 2.0: it is called mapping.survey.points"
        in text
    )
    assert "has no effect since 1.1 and goes with 2.0: mapping.acceptance.accuracy=A, B or C" in text
    assert "mapping.association" in text


def test_each_script_of_1_0_is_there_and_is_a_command():
    assert len(OLD_SCRIPTS) == 13
    for name in OLD_SCRIPTS:
        short = name.removeprefix("v2hdm-")
        assert old_scripts.COMMANDS.get(short, short) in command_names()


@pytest.mark.parametrize("name", OLD_SCRIPTS)
def test_a_script_of_1_0_runs_its_command_and_says_what_to_type(name, monkeypatch, capsys):
    script = EntryPoint(name, PROJECT["scripts"][name], "console_scripts").load()
    monkeypatch.setattr("v2hdm.cli.main.answer_signals", lambda: None)
    monkeypatch.setattr(sys, "argv", [f"/usr/bin/{name}", "--version"])
    assert script() == 0
    said = capsys.readouterr()
    assert said.out.startswith("v2hdm 1.")
    short = name.removeprefix("v2hdm-")
    command = old_scripts.COMMANDS.get(short, short)
    assert said.err == f"{name} is deprecated and goes with 2.0: type v2hdm {command}\n"


@pytest.mark.parametrize("name", ["fast", "fleet"])
def test_an_extra_of_1_0_is_the_extra_map(name):
    assert PROJECT["optional-dependencies"][name] == ["v2hdm[map]"]


def test_a_run_file_of_1_0_is_read(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text(OLD_FILE)
    check_settings(to_dataclass(compose_run_file(path, "map", RunConfig), RunConfig, ""))
    check_lines(capsys.readouterr().err)
    assert path.read_text() == OLD_FILE


def test_a_run_file_of_1_0_in_a_folder_of_runs_and_a_line_of_overrides_mean_the_same(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.yaml").write_text(OLD_FILE)
    assert run(["map", "--cfg", "job", "--config-dir", str(tmp_path), "+run=mine"]) == 0
    said = capsys.readouterr()
    check_lines(said.err)
    by_file = yaml.safe_load(said.out)
    line = [
        "mapping.mode=incremental", "mapping.device=cpu", "mapping.acceptance.max_sigma_m=0.1",
        "mapping.association.max_gap_m=3.0", "mapping.survey.points_map=[[3.21, 4.05]]",
    ]  # fmt: skip
    assert run(["map", "--cfg", "job", "+run=port2", "mapping.survey.sigma_m=0.02", *line]) == 0
    said = capsys.readouterr()
    check_lines(said.err)
    by_line = yaml.safe_load(said.out)
    assert by_line["mapping"] == by_file["mapping"]
    assert by_line["mode"] == by_file["mode"] == "incremental"


def test_settings_of_now_are_left_as_they_are(capsys):
    line = ["+run=port2", "mode=batch", "mapping.survey.sigma_m=0.02", "~export", "drive.path=mapping.mode"]
    assert renamed_overrides(line) == line
    assert capsys.readouterr().err == ""


def test_a_survey_of_1_0_that_holds_no_places_is_one_line():
    with pytest.raises(ConfigError, match=r"mapping.survey.points_map: give pairs of x and y in m"):
        renamed_overrides(["mapping.survey.points_map=[[3.21]]"])


def test_a_share_of_a_fleet_is_taken_and_says_what_shares_out_work_now(capsys):
    assert share_of("2/4") == (2, 4)
    assert "--share is deprecated and goes with 2.0: --cluster ADDRESS" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="--share 5/4: give K/N"):
        share_of("5/4")
