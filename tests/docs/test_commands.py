"""Every command in the README and in ``docs/`` does what it says, on one small rendered drive.

The blocks of a document run in their order, in a folder of that document's own. What cannot be run here says
so to its readers, with the reason; then the command that it names must exist and take its arguments.
"""

import importlib.util
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, blocks, document, documents
from tests.docs.processes import python_in
from tests.docs.sandbox import furnish
from v2hdm import __version__
from v2hdm.cli.main import command_names
from v2hdm.io.maps.reading import read_geojson

RUN_BY = {
    "docs/calibration.md": ("tests/calibration/test_door.py", "v2hdm calibrate points"),
    "docs/living-map.md": ("tests/pipeline/test_living_map.py", "v2hdm map"),
    "docs/accuracy.md": ("tests/pipeline/test_survey.py", "v2hdm map"),
}
"""Documents with commands that other tests run, on data made for them, to see what comes of them."""


def run_elsewhere(block):
    return block.document in RUN_BY and block.text.startswith(RUN_BY[block.document][1])


SHELL = [block for name in documents() for block in blocks(name, "sh")]
RUN = [block for block in SHELL if block.not_run_because is None and not run_elsewhere(block)]
PYTHON = [block for name in documents() for block in blocks(name, "python")]
NOT_RUN = [block for block in SHELL if block.not_run_because is not None]
COMPOSED = ("map", "simulate", "experiment", "train", "train.areas", "train.score", "export")
"""Commands whose arguments are checked by composing their configuration."""

FOREIGN = ("pip", "dask")
"""Programs of others that blocks call which are not run here."""

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def named(block):
    return f"{block.document}:{block.line}"


class Shell:
    """Runs blocks of shell, with ``python`` at hand quickly and runs of ports small."""

    def __init__(self, programs):
        self.programs = programs

    def __call__(self, text, folder):
        """The output of the commands."""
        ran = subprocess.run(
            ["bash", "-c", f"set -eo pipefail\n{text}"],
            cwd=folder, capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL,
            env={"PATH": f"{self.programs}:/usr/bin:/bin", "HOME": str(folder), "COLUMNS": "200"},
        )  # fmt: skip
        assert ran.returncode == 0, f"{text}\n{ran.stdout[-3000:]}{ran.stderr[-3000:]}"
        return ran.stdout + ran.stderr


MAKE = """#!/bin/bash
set -e
told=$({make} --no-print-directory -n -C {root} "$@")
if [ "$1" = map ]; then eval "python ${{told##*bin/python }}"; fi
"""
"""``make``: its target must be there; that of a run is run, and the others are what runs these tests."""


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    make = shutil.which("make")
    if make is None:
        pytest.skip("no make: install it")
    folder = tmp_path_factory.mktemp("programs")
    programs = {"make": MAKE.format(make=make, root=ROOT), "pip": "#!/bin/sh\n"}
    for name, text in programs.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    with python_in(folder) as programs:
        yield Shell(programs)


@pytest.fixture(scope="module")
def furnished(shell, tmp_path_factory):
    """The README's first block makes the drive and the result that all other commands work on."""
    folder = tmp_path_factory.mktemp("furnished")
    shell(RUN[0].text, folder)
    furnish(folder)
    return folder


@pytest.fixture(scope="module")
def folder_of(furnished, tmp_path_factory):
    """The folder of a document, furnished when it is first asked for."""
    folders: dict[str, Path] = {}

    def folder(name):
        if name not in folders:
            folders[name] = tmp_path_factory.mktemp(Path(name).stem) / "here"
            shutil.copytree(furnished, folders[name])
            for block in blocks(name):
                if block.title:
                    path = folders[name] / block.title
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_text(block.text)
        return folders[name]

    return folder


@pytest.mark.slow
def test_the_first_block_of_the_readme_makes_a_map_and_a_report(furnished):
    assert "make map" in RUN[0].text
    assert (furnished / "outputs/port2/report.html").stat().st_size > 100_000
    assert len(read_geojson(furnished / "outputs/port2/map.geojson").markings) > 5


@pytest.mark.parametrize("block", RUN[1:], ids=named)
def test_a_documented_block_runs(block, shell, folder_of):
    folder = folder_of(block.document)
    for line in shell(block.text, folder).splitlines():
        if re.fullmatch(r"[\w./-]+/[\w.-]+", line):  # a command that reports what it has written
            assert (folder / line).exists(), line


@pytest.mark.parametrize("block", PYTHON, ids=named)
def test_a_documented_program_runs(block, shell, folder_of):
    folder = folder_of(block.document)
    (folder / "program.py").write_text(block.text)
    assert shell("python program.py", folder), "every program prints what it found"


@pytest.mark.parametrize("name", RUN_BY)
def test_the_commands_that_other_tests_run_are_taken_from_the_document(name):
    assert f'blocks("{name}", "sh"' in (ROOT / RUN_BY[name][0]).read_text()
    assert any(run_elsewhere(block) for block in blocks(name, "sh"))


@pytest.mark.parametrize("block", NOT_RUN, ids=named)
def test_what_is_not_run_names_commands_and_settings_that_are_there(block, shell, tmp_path):
    for line in block.lines:
        called = re.search(r"(?:(?:python|torchrun\b.*?) -m |\b(?=v2hdm ))(.*)", line)
        if called is None:
            program = re.sub(r"^(\w+=(\$\(|\S+ ))+", "", line).split()[0]
            assert program in FOREIGN, line
            continue
        module, *arguments = shlex.split(called.group(1))
        if module == "v2hdm":
            name = next(command for command in command_names() if " ".join(arguments).startswith(command))
            program, arguments = ["v2hdm", *name.split()], arguments[len(name.split()) :]
            module = f"v2hdm.cli.commands.{name.replace(' ', '_')}"
        else:
            name, program = module.removeprefix("v2hdm."), ["python", "-m", module]
        assert importlib.util.find_spec(module) is not None, line
        if name in COMPOSED:
            own_class = ROOT / "docs" / "own-class"
            arguments = [argument.replace("docs/own-class", str(own_class)) for argument in arguments]
            assert shell(shlex.join([*program, *arguments, "--cfg=job"]), tmp_path)
        else:
            # Commands that share an option have it from one place.
            of_command = [*_sources(module), ROOT / "v2hdm" / "cli" / "arguments.py"]
            source = "".join(path.read_text() for path in of_command)
            options = [argument for argument in arguments if argument.startswith("--")]
            assert all(f'"{option}"' in source for option in options), line


def _sources(module):
    path = ROOT / module.replace(".", "/")
    return [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else list(path.glob("*.py"))


@pytest.mark.parametrize("name", documents())
def test_a_document_names_only_modules_extras_and_targets_that_are_there(name):
    text = document(name)
    for module in re.findall(r"python -m ([a-z][a-z_0-9.]*[a-z_0-9])\b", text):
        assert importlib.util.find_spec(module) is not None, module
    for name in re.findall(r"(?:`|^)v2hdm ((?:calibrate|benchmark) [a-z]+|[a-z]+)\b", text, re.MULTILINE):
        assert name in command_names(), name
    for listed in re.findall(r"(?:\.|v2hdm|\.whl)\[([a-z, ]+)\]'", text):
        assert {extra.strip() for extra in listed.split(",")} <= set(EXTRAS), listed
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`make ([a-z]+)", text)) <= set(targets)
    for version in re.findall(r"v2hdm-([\d.]+)-py3", text):
        assert version == __version__
