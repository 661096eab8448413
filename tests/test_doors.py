"""Ctrl-C at a door is one line, whenever it comes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from v2hdm import __version__
from v2hdm.cli.door import version_line

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


def run_door(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A door that finds modules of ``folder`` in place of those of the same name."""
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
        (("v2hdm.map", "+run=port2"), "torch"),
        (("train",), "torch"),
        (("train.ship", "runs/gpu"), "onnx"),
        (("export", "checkpoint=a", "output=b"), "onnx"),
        (("v2hdm.cli.mosaic", "outputs/port2"), "torch"),
        (("v2hdm.detect", "images"), "cv2"),
        (("v2hdm.cli.check", "drive"), "cv2"),
        (("v2hdm.report", "results"), "cv2"),
        (("v2hdm.experiment",), "torch"),
        (("v2hdm.fleet", "drive.yaml"), "ray"),
        (("v2hdm.cli.export", "map.geojson", "--format", "csv"), "cv2"),
        (("v2hdm.cli.calibrate", "points.csv", "--intrinsics", "a.yaml"), "torch"),
    ],
)
def test_an_interruption_while_libraries_are_loaded_is_one_line(
    arguments: tuple[str, ...], slow: str, signal: str, tmp_path: Path
) -> None:
    (tmp_path / f"{slow}.py").write_text(PRESSED_TWICE.format(signal=signal))
    done = run_door(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: interrupted")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "missing", "extra"),
    [
        (("v2hdm.map", "+run=port2"), "torch", "map"),
        (("v2hdm.map", "+run=port2"), "kornia", "map"),
        (("v2hdm.experiment",), "matplotlib", "map"),
        (("v2hdm.cli.check", "drive"), "matplotlib", "map"),
        (("v2hdm.cli.calibrate", "points.csv", "--intrinsics", "a.yaml"), "kornia", "map"),
        (("v2hdm.cli.mosaic", "outputs/port2"), "kornia", "map"),
        (("v2hdm.report", "results"), "jinja2", "map"),
        (("v2hdm.fleet", "drive.yaml"), "ray", "fleet"),
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
    done = run_door(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(
        f"error: python -m {arguments[0]} needs {missing}: install the {extra} extra"
    )
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", [("v2hdm.map", "--help"), ("v2hdm.detect", "--help")])
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
    assert run_door(tmp_path, "v2hdm.map", "+run=port2").stderr.strip() == expected


SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def test_every_console_script_is_a_door_and_resolves_to_a_callable() -> None:
    assert {"v2hdm-map", "v2hdm-detect", "v2hdm-check", "v2hdm-export"} <= set(SCRIPTS)
    for name, target in SCRIPTS.items():
        assert callable(EntryPoint(name, target, "console_scripts").load()), name
        door = ROOT / "v2hdm" / name.removeprefix("v2hdm-")
        assert door.with_suffix(".py").is_file() or (door / "__main__.py").is_file(), name


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_door_tells_its_version_as_a_module_and_as_a_script(script: str) -> None:
    door = script.removeprefix("v2hdm-")
    module, _, function = SCRIPTS[script].partition(":")
    as_script = (
        f"import sys; sys.argv[0] = {script!r}; from {module} import {function} as run; sys.exit(run())"
    )
    told = {
        subprocess.run(
            [sys.executable, *how, "--version"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        ).stdout
        for how in (["-m", f"v2hdm.{door}"], ["-c", as_script])
    }
    line = f"v2hdm {re.escape(__version__)}, (torch|no torch).*, (onnxruntime|no onnx).*, (numba|no numba).*"
    (only,) = told
    assert re.fullmatch(line + ", weights [0-9a-f]{8}\n", only)


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
