"""``v2hdm benchmark``: a drive without truth, a score of any file, bad input in one line, the page."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from tests.benchmark.hand import paint, write
from v2hdm.benchmark.sites import all_sites, reference_of, site_of
from v2hdm.cli.main import main
from v2hdm.executor import HERE
from v2hdm.io.drive import read_drive
from v2hdm.progress import silent

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def streets(cache):
    return reference_of(site_of("streets"), cache, HERE, silent)


def test_make_writes_a_drive_and_prints_its_published_hash(tmp_path, cache, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", "make", "streets", "drive", "--cache", str(cache), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert site_of("streets").input_sha256 in said
    assert "not as published" not in said
    assert read_drive(tmp_path / "drive").truth_dir is None
    assert len(read_drive(tmp_path / "drive").images) == 1244


def test_a_site_by_a_design_is_as_published(tmp_path, cache, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", "make", "quay", "drive", "--cache", str(cache), "--workers", "1"]) == 0
    assert f"{site_of('quay').input_sha256}: as published" in capsys.readouterr().out


def test_the_true_map_has_a_perfect_score_and_a_moved_one_its_error(tmp_path, cache, streets, capsys):
    words = ["streets", "--cache", str(cache), "--json"]
    path = write(tmp_path / "map.geojson", paint(streets))
    assert main(["benchmark", "score", str(path), *words]) == 0
    score = json.loads(capsys.readouterr().out)
    assert score["truth_is_published"]
    assert score["markings"]["recall"] == 1.0
    assert score["markings"]["corner_rmse_m"] < 1e-6
    path = write(tmp_path / "map.geojson", paint(streets, (0.0, 0.12))[::2], verdict="PASS")
    assert main(["benchmark", "score", str(path), *words]) == 0
    score = json.loads(capsys.readouterr().out)
    assert score["markings"]["corner_rmse_m"] == pytest.approx(0.12, abs=1e-4)
    assert score["markings"]["recall"] == pytest.approx(0.5, abs=0.05)
    assert score["verdict_is"].startswith("wrong")
    assert main(["benchmark", "score", str(path), *words[:-1]]) == 0
    assert "12.0 cm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["make", "port3", "drive"], "'port3': is not a site of the benchmark"),
        (["score", "nothing.geojson", "streets"], "nothing.geojson: no such file"),
        (["score", "empty.geojson", "streets"], "has no marking of four corners to score"),
        (["score", "empty.geojson", "streets", "--class", "a"], "--class a: give it as NAME=CLASS"),
    ],
)
def test_bad_input_is_one_line(words, says, tmp_path, cache, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "empty.geojson", [])
    assert main(["benchmark", *words, "--cache", str(cache)]) == 2
    (*_, line) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert says in line


def page_tool():
    specification = importlib.util.spec_from_file_location("benchmark_page", ROOT / "docs/tools/benchmark.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules["benchmark_page"] = module
    specification.loader.exec_module(module)
    return module


def test_the_table_of_the_page_is_written_from_scores(tmp_path, cache, streets, capsys):
    tool = page_tool()
    path = write(tmp_path / "map.geojson", paint(streets, (0.03, 0.0), sigma_m=0.03), verdict="PASS")
    assert main(["benchmark", "score", str(path), "streets", "--cache", str(cache), "--json"]) == 0
    text = tool.table([json.loads(capsys.readouterr().out)])
    head, _, recall, _, *more_lines = text.splitlines()
    assert head == "| figure | `streets` |"
    assert recall.startswith("| recall | 100.0 % of ")
    cells = [row.split(" | ")[1].removesuffix(" |") for row in more_lines]
    assert cells == [
        "3.0 cm", "3.0 cm", "0.50", "2.00 / - / 0.00", "100.0 %", "-", "PASS: right", "right"
    ]  # fmt: skip
    page = tool.PAGE.read_text()
    written = tool.with_table(page, text)
    assert text in written
    assert tool.with_table(written, text) == written


def test_the_page_has_the_score_of_every_site():
    lines = page_tool().PAGE.read_text().splitlines()
    (head,) = (line for line in lines if line.startswith("| figure | "))
    (recall,) = (line for line in lines if line.startswith("| recall | "))
    assert head == f"| figure | {' | '.join(f'`{name}`' for name in all_sites())} |"
    assert recall.count(" % of ") == len(all_sites())
