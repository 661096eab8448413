"""The wheel, the source archive, and the files of those who package and test a release."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
import yaml
from hatchling import build
from packaging.requirements import Requirement
from twine.commands.check import check

from tests.docs.blocks import ROOT
from v2hdm import __version__

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONDA = {
    "opencv-python-headless": "py-opencv",
    "torch": "pytorch",
    "matplotlib": "matplotlib-base",
}  # the others are called alike


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    """The wheel and the source archive as ``python -m build`` makes them."""
    folder, before = tmp_path_factory.mktemp("dist"), os.getcwd()  # noqa: PTH109  # what hatchling builds
    os.chdir(ROOT)
    try:
        return folder / build.build_wheel(str(folder)), folder / build.build_sdist(str(folder))
    finally:
        os.chdir(before)


def test_an_index_takes_both_archives(released, capfd):
    assert not check([str(archive) for archive in released], strict=True), capfd.readouterr().out


def test_the_wheel_holds_the_library_with_its_data_and_nothing_else(released):
    with zipfile.ZipFile(released[0]) as wheel:
        names = set(wheel.namelist())
        metadata = wheel.read(f"v2hdm-{__version__}.dist-info/METADATA").decode()
    assert Parser().parsestr(metadata)["Version"] == __version__
    assert {name.split("/")[0] for name in names} == {"v2hdm", f"v2hdm-{__version__}.dist-info"}
    needed = {
        "conf/map.yaml",
        "conf/run/port2.yaml",
        "conf/schema/drive.json",
        "conf/schema/run.json",
        "paper/claims.py",
        "paper/templates/experiment.md",
        "report/page/vendor/leaflet.js",
        "report/page/templates/features.js",
        "report/page/templates/map.js",
    }
    assert {f"v2hdm/{name}" for name in needed} <= names
    assert any(name.startswith("v2hdm/detection/weights/") and name.endswith(".onnx") for name in names)
    assert not [
        name for name in names if re.search(r"conf/(local|train|recipe|export)|__pycache__|\.pyc$", name)
    ]
    assert sum(name.endswith("LICENSE") for name in names) >= 2  # ours and that of the library in the report


def test_the_source_archive_can_be_tested_and_holds_nothing_of_this_machine(released):
    with tarfile.open(released[1]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {
        "pyproject.toml",
        "constraints.txt",
        "Makefile",
        ".ci/run",
        "tests/test_release.py",
        "docs/design.md",
    } <= names
    assert not [
        name for name in names if re.match(r"(outputs|cache|data|runs|site|\.venv|conf/local)/", name)
    ]


def test_the_conda_recipe_asks_for_what_the_wheel_does():
    recipe = yaml.safe_load((ROOT / ".ci" / "conda-recipe.yaml").read_text())
    assert str(recipe["context"]["version"]) == __version__
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["license_file"] == PROJECT["license-files"]
    assert recipe["build"]["python"]["entry_points"] == [f"v2hdm = {PROJECT['scripts']['v2hdm']}"]
    requirements = {f"python {PROJECT['requires-python']}"}
    for requirement in map(Requirement, [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["map"]]):
        limits = ",".join(sorted(map(str, requirement.specifier), reverse=True))
        requirements.add(f"{CONDA.get(requirement.name, requirement.name.lower())} {limits}")
    assert set(recipe["requirements"]["run"]) == requirements


def test_the_image_is_of_the_pinned_versions_and_its_user_is_not_root():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    instructions = [line.split()[0] for line in lines if re.match("[A-Z]+ ", line)]
    assert any("-c constraints.txt" in line for line in lines)
    assert "'.[map]'" in "".join(lines)
    assert instructions.index("USER") < instructions.index("ENTRYPOINT")
    assert next(line for line in lines if line.startswith("USER")) != "USER root"
    # Whatever the build copies is let through to it.
    let_through = re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE)
    copied = "v2hdm", "conf", "pyproject.toml", "hatch_build.py", "constraints.txt", "README.md", "LICENSE"
    assert set(copied) == set(let_through)
    assert all((ROOT / name).exists() for name in let_through)


def test_the_workflow_runs_what_a_change_must_pass():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    assert workflow["permissions"] == {"contents": "read"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert [step["run"] for step in steps if "run" in step] == [".ci/run"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_an_audit_that_reaches_no_advisories_says_so():
    place = f"BIN={Path(sys.executable).parent}", "ADVISORIES=http://127.0.0.1:9/"
    command = ["make", "--no-print-directory", "--old-file", ".venv/.installed-dev", *place, "audit"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    assert process.stdout == "audit skipped: no advisories at http://127.0.0.1:9/\n"


def test_a_release_publishes_wheels_archive_site_and_image_without_a_key():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    jobs = workflow["jobs"]
    assert set(jobs) == {"wheels", "archive", "pypi", "docs", "container"}
    assert (ROOT / jobs["wheels"]["uses"]).is_file()
    assert jobs["pypi"]["permissions"] == {"id-token": "write"}
    commands = [
        step["run"].split() for job in jobs.values() for step in job.get("steps", ()) if "run" in step
    ]
    targets = {words[1] for words in commands if words[0] == "make"}
    assert targets == {"sbom", "docs"}
    rules = (ROOT / "Makefile").read_text()
    assert all(re.search(f"^{target}:", rules, re.MULTILINE) for target in targets)
    assert "secrets.PYPI" not in str(workflow)


def test_the_version_is_the_same_wherever_it_is_stated():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    released = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert {str(cited["version"]), released[0]} == {__version__}


def test_the_table_of_licences_has_every_part_that_is_installed(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "tools"))
    import licences

    text = licences.TABLE.read_text()
    listed = set(re.findall(r"^([a-z0-9-]+),[0-9]", text, re.MULTILINE))
    assert {part.name for part in licences.parts()} == listed
    assert not re.search("not stated", text)
