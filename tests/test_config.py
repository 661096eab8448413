"""Every shipped run composes, every key is explained, a typo is one line."""

import re
from functools import reduce
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from export.config import ExportConfig
from tests.docs.smaller import SMALL_PORT
from tests.faults.settings import SIGNED, measures
from train.config import TrainConfig
from v2hdm.cli import compose as config
from v2hdm.cli.compose import Door, help_text, keys_of
from v2hdm.cli.main import command_of, run
from v2hdm.errors import ConfigError
from v2hdm.io.drive import read_drive
from v2hdm.pipeline.config import PortConfig, RunConfig, admit
from v2hdm.simulate.port.drive import folder_of_port

RUNS = sorted(path.stem for path in (config.conf_dir() / "run").glob("*.yaml"))


def composed(*overrides):
    config.register("map", RunConfig)
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        return config.to_dataclass(compose("map", overrides=list(overrides)), RunConfig, "choose a run")


@pytest.mark.parametrize("run", RUNS)
def test_every_shipped_run_composes_into_dataclasses(run):
    assert composed(f"+run={run}", "drive.path=x" if run == "kitti" else "workers=1").name == run


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("+run=port2 maping.max_range_m=3", "maping"),
        ("+run=port2 mapping.max_rnge_m=3", "max_range_m"),
        ("+run=port9", "port9"),
        ("", "drive.path is not set: name the folder of the drive, e.g. drive.path=my_drive, or choose"),
        ("drive.path=nowhere", "nowhere: no such drive folder"),
        ("+run=port2 workers=many", "workers"),
        ("+run=port2 simulate.route.pieces=[[62.0,0.0],[23,-90.0]]", "write 23.0"),
        ("+run=port2 +mapping.known_sizes.by_class_m={diamond:[1,0.7]}", "write 1.0"),
        ("+run=port2 export=gpkg", "write export=[gpkg]"),
        ("+run=port2 drive.limit=0", "set 1 to 1e+12"),
        ("+run=port2 mapping.acceptance.accuracy=D", "mapping.acceptance.accuracy is 'D'; choose from A, B"),
        ("drive.path = nowhere", "write drive.path=nowhere"),
        ("+run=kitti", "drive.path"),
        ("+run=kitti drive.path=nowhere", "nowhere"),
        ("+run=kitti drive.path=straße", "needs quotes"),
        ("./drive", "'./drive' is not key=value; write drive.path=./drive"),
        (".", "write drive.path=."),
        ("+run=kitti drive.path=a(1)", "needs quotes"),
    ],
)
def test_a_wrong_argument_is_one_line_that_names_it(line, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["map", *line.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert named in error
    assert error.count("\n") == 1
    assert not list(tmp_path.rglob("metrics.json"))


@pytest.mark.parametrize("name", ["straße", "a (1)", "it's", "a,b", "a=b", "20240517", "1.0", "a{b}", "[a]b"])
def test_the_path_of_a_folder_that_exists_needs_no_quotes(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path(name).mkdir()
    line = f"drive.path={name}" if name != "[a]b" else f"drive.path={tmp_path / name}"
    assert run(["map", line]) == 2
    assert f"{name}: not a drive in any known format" in capsys.readouterr().err


def test_a_users_own_runs_join_the_shipped_ones(tmp_path, monkeypatch, capsys):
    run_folder = tmp_path / "conf" / "run"
    run_folder.mkdir(parents=True)
    (run_folder / "mysite.yaml").write_text(
        "# @package _global_\nname: mysite\ndrive:\n  path: nowhere_at_all\n"
    )
    monkeypatch.chdir(tmp_path)
    assert run(["map", "--config-dir", str(tmp_path / "conf"), "+run=mysite"]) == 2
    assert "nowhere_at_all" in capsys.readouterr().err


@pytest.mark.parametrize("key", [key for key in measures(PortConfig()) if key.split(".")[-1] not in SIGNED])
def test_a_measure_of_a_rendered_port_that_is_below_zero_is_refused(key):
    config = RunConfig(simulate=PortConfig())
    *parts, name = key.split(".")
    setattr(reduce(getattr, parts, config.simulate), name, -1e-3)
    with pytest.raises(ConfigError, match=key):
        admit(config)


FRONT = PortConfig().cameras["front"]


@pytest.mark.parametrize(
    ("port", "says"),
    [
        (PortConfig(name="../x"), "simulate.name: the name '../x' has a path separator"),
        (PortConfig(cameras={"../x": FRONT}), "simulate.cameras: the name '../x' has a path separator"),
        (PortConfig(cameras={"both": FRONT}), "simulate.cameras: a camera is called 'both'"),
    ],
)
def test_names_of_a_rendered_port_that_become_files_are_checked(port, says):
    with pytest.raises(ConfigError, match=re.escape(says)):
        admit(RunConfig(name="run", simulate=port))


def test_device_and_mode_reach_the_mapping_and_are_keys_once():
    mapping = composed("+run=port1", "device=cuda", "mode=incremental").mapping
    assert (mapping.device, mapping.mode) == ("cuda", "incremental")
    assert composed("+run=port1").mapping.mode == "batch"
    names = [key.name for key in keys_of(RunConfig)]
    assert [name for name in names if name.split(".")[-1] in ("device", "mode")] == [
        "detector.device", "device", "mode"
    ]  # fmt: skip


def test_a_port_is_rendered_where_a_run_of_it_takes_it_from(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["+run=port2", "workers=1", *SMALL_PORT, "simulate.exposure.jpeg_quality=60"]
    assert run(["simulate", *words]) == 0
    printed = Path(capsys.readouterr().out.strip())
    port = composed(*words).simulate
    assert printed == folder_of_port(port, Path("cache"))
    assert read_drive(printed).truth_dir is not None
    assert run(["simulate", "workers=1"]) == 2
    assert "simulate is not set: choose a port to render" in capsys.readouterr().err


def test_the_keys_of_rendered_ports_are_listed_where_ports_are_rendered(capsys):
    assert run(["simulate", "--help"]) == 0
    rendering = capsys.readouterr().out
    assert run(["map", "--help"]) == 0
    mapping = capsys.readouterr().out
    listed = re.findall(r"^  ([\w.]+) \(", mapping, re.MULTILINE)
    assert len(listed) <= 73
    assert not [key for key in listed if key.startswith("simulate.")]
    assert "v2hdm simulate --help" in mapping
    for key in keys_of(RunConfig):
        assert f"\n  {key.name} (" in (rendering if key.name.startswith("simulate.") else mapping)


@pytest.mark.parametrize("schema", [RunConfig, TrainConfig, ExportConfig])
def test_every_key_is_explained(schema):
    keys = list(keys_of(schema))
    assert len(keys) > 10
    assert [key.name for key in keys if not key.meaning] == []
    assert not [key.name for key in keys if "`" in key.meaning or "\n" in key.meaning]


def test_the_page_has_every_key_with_its_default_and_the_runs_that_are_shipped():
    page = help_text(command_of("map"), Door("map", RunConfig, ""))
    assert "v2hdm map [key=value ...]" in page
    assert "mapping.max_range_m (number, 16.0)\n      sightings farther from" in page
    assert "Shipped runs: kitti, port1, port2, signs" in page
    assert all(key.name in page for key in keys_of(RunConfig))
    assert max(map(len, page.splitlines())) <= 110
