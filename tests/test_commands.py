"""The commands: a list of them, their versions, and one line for Ctrl-C or a missing library."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from v2hdm import __version__
from v2hdm.cli.main import COMMANDS, run, version_line

ROOT = Path(__file__).parents[1]
PRESSED_TWICE = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{signal})
    time.sleep(9)
finally:
    os.kill(os.getpid(), signal.{signal})
    time.sleep(0.01)
"""


def run_command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command that finds modules of ``folder`` in place of those of the same name."""
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    ("arguments", "slow"),
    [
        (("v2hdm", "map", "+run=port2"), "torch"),
        (("train",), "torch"),
        (("train.ship", "runs/gpu"), "onnx"),
        (("export", "checkpoint=a", "output=b"), "onnx"),
        (("v2hdm", "mosaic", "outputs/port2"), "torch"),
        (("v2hdm", "detect", "images"), "cv2"),
        (("v2hdm", "check", "drive"), "cv2"),
        (("v2hdm", "report", "results"), "cv2"),
        (
            (
                "v2hdm",
                "experiment",
            ),
            "torch",
        ),
        (("v2hdm", "fleet", "drive.yaml"), "ray"),
        (("v2hdm", "export", "map.geojson", "--format", "csv"), "cv2"),
        (("v2hdm", "calibrate", "points", "points.csv", "--intrinsics", "a.yaml"), "torch"),
    ],
)
def test_an_interruption_while_libraries_are_loaded_is_one_line(
    arguments: tuple[str, ...], slow: str, signal: str, tmp_path: Path
) -> None:
    (tmp_path / f"{slow}.py").write_text(PRESSED_TWICE.format(signal=signal))
    done = run_command(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: interrupted")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "missing", "extra"),
    [
        (("v2hdm", "map", "+run=port2"), "torch", "map"),
        (("v2hdm", "map", "+run=port2"), "kornia", "map"),
        (
            (
                "v2hdm",
                "experiment",
            ),
            "matplotlib",
            "map",
        ),
        (("v2hdm", "check", "drive"), "matplotlib", "map"),
        (("v2hdm", "calibrate", "points", "points.csv", "--intrinsics", "a.yaml"), "kornia", "map"),
        (("v2hdm", "mosaic", "outputs/port2"), "kornia", "map"),
        (("v2hdm", "report", "results"), "jinja2", "map"),
        (("v2hdm", "fleet", "drive.yaml"), "ray", "fleet"),
        (("train",), "tensorboard", "train"),
        (("train.ship", "runs/gpu"), "onnx", "train"),
        (("export", "checkpoint=a", "output=b"), "onnx", "train"),
    ],
)
def test_a_library_that_is_not_installed_is_one_line_that_names_the_extra(
    arguments: tuple[str, ...], missing: str, extra: str, tmp_path: Path
) -> None:
    text = f'raise ModuleNotFoundError("not installed", name="{missing}")'
    (tmp_path / f"{missing}.py").write_text(text)
    done = run_command(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    called = next(
        (f"v2hdm {name}" for name in COMMANDS if " ".join(arguments).startswith(f"v2hdm {name}")),
        f"python -m {arguments[0]}",
    )
    assert done.stderr.startswith(f"error: {called} needs {missing}: install the {extra} extra")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [("v2hdm.map", "--help"), ("v2hdm", "detect", "--help"), ("v2hdm", "--help")]
)
def test_help_that_nobody_reads_to_its_end_is_no_error(arguments: tuple[str, ...]) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = subprocess.run(
            [sys.executable, "-m", *arguments], cwd=ROOT, stdout=closed, stderr=subprocess.PIPE, timeout=60
        )
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(("given", "expected"), [(None, "passive"), ("active", "active")])
def test_openmp_waits_without_spinning_unless_the_user_says_so(
    given: str | None, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", given)
    (tmp_path / "torch.py").write_text("import os; raise SystemExit(os.environ['OMP_WAIT_POLICY'])")
    assert run_command(tmp_path, "v2hdm.map", "+run=port2").stderr.strip() == expected


SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def test_the_list_has_a_sentence_for_each_command_and_each_has_a_file(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run([]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert {line.split("  ")[1].strip() for line in lines} == set(COMMANDS)
    assert all(line.endswith(".") for line in lines)
    assert run(["calibrate"]) == 0
    assert capsys.readouterr().out.count("\n  calibrate ") == 3
    for name in COMMANDS:
        assert (ROOT / "v2hdm" / "cli" / f"{name.replace(' ', '_')}.py").is_file(), name
    assert run(["calibrate", "pints"]) == 2
    assert (
        capsys.readouterr().err == "error: v2hdm calibrate pints: no such command; v2hdm --help lists them\n"
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_each_command_and_names_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with suppress(SystemExit):  # of argparse
        assert run([*name.split(), "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"v2hdm {name} " in text
    assert COMMANDS[name].says in text


def test_help_is_there_at_once() -> None:
    code = "import sys; from v2hdm.cli.main import run; run([]); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert not {"numpy", "cv2", "torch", "hydra", "yaml"} & set(done.stderr.split())


OLD = {"extrinsic": "calibrate ground", "calibration": "calibrate compare", "calibrate": "calibrate points"}


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_console_script_is_a_command_old_names_too(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    script = EntryPoint(name, SCRIPTS[name], "console_scripts").load()
    asked: list[list[str]] = []
    monkeypatch.setattr("v2hdm.cli.main.answer_signals", lambda: None)
    monkeypatch.setattr("v2hdm.cli.main.run", lambda words: asked.append(list(words)) or 0)
    monkeypatch.setattr(sys, "argv", [f"/usr/bin/{name}", "--version"])
    assert script() == 0
    (words,) = asked
    old = name.removeprefix("v2hdm").removeprefix("-")
    assert words == [*OLD.get(old, old).split(), "--version"]


@pytest.mark.parametrize(
    "how", [["v2hdm"], ["v2hdm", "map"], ["v2hdm.map"], ["v2hdm", "calibrate", "ground"]]
)
def test_every_command_reports_the_version(how: list[str], tmp_path: Path) -> None:
    line = f"v2hdm {re.escape(__version__)}, (torch|no torch).*, (onnxruntime|no onnx).*, (numba|no numba).*"
    told = run_command(tmp_path, *how, "--version").stdout
    assert re.fullmatch(line + ", weights [0-9a-f]{8}\n", told)


def test_a_version_is_told_where_libraries_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert version_line().startswith(f"v2hdm {__version__}, no torch, no onnxruntime, no numba, weights ")


def test_every_file_that_states_the_version_states_the_same() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["version"] == citation["version"] == __version__
    # The wheel holds a library of another licence; what one cites is ours.
    assert citation["license"] == project["license"].split(" AND ")[0]
