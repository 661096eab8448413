"""A drive of detections goes through the whole pipeline; what pictures would show is said to be left out."""

import json
import shutil
from pathlib import Path

import pytest

from tests.ports import run_config
from v2hdm.cli.main import main
from v2hdm.pipeline.run import run


@pytest.fixture(scope="module")
def mapped(survey, tmp_path_factory):
    """The result of a run over one drive of the survey."""
    return run(run_config(survey[0], tmp_path_factory.mktemp("mapped") / "out", mosaic=True))


def test_a_survey_without_pictures_is_mapped_and_reported(mapped):
    result = mapped
    metrics = json.loads((result.folder / "metrics.json").read_text())
    assert (result.folder / "report.html").stat().st_size > 10_000
    assert not list(result.folder.glob("overlay*"))
    (opt,) = metrics["results"].values()
    assert opt["Opt"]["markings"] >= 20
    assert metrics["results"]["both"]["Opt"]["recall"] > 0.9
    of_pictures = [finding for finding in result.verdict.findings if finding.check == "pictures"]
    assert ["detections in place of pictures" in finding.line for finding in of_pictures] == [True]


def test_commands_that_need_pictures_say_so_in_one_line(mapped, survey, capsys):
    needing = (
        ["mosaic", str(mapped.folder)],
        ["labels", str(mapped.folder), "--output", "labels"],
        ["calibrate", "ground", str(survey[0])],
        ["detect", str(survey[0])],
    )
    for words in needing:
        assert main(words) == 2, words
        (said,) = capsys.readouterr().err.strip().splitlines()[-1:]
        assert "has detections in place of pictures" in said, said


@pytest.mark.parametrize("damage", ["{", '{"markings": 1}'])
def test_damaged_detections_end_a_run_in_one_line(survey, tmp_path, capsys, damage):
    folder = shutil.copytree(survey[0], tmp_path / "drive")
    (folder / "front" / "detections" / "000003.json").write_text(damage)
    assert (
        main(["map", f"drive.path={folder}", f"cache={tmp_path}/c", f"output={tmp_path}/o", "workers=1"]) == 2
    )
    assert "000003.json" in capsys.readouterr().err


def test_a_drive_is_mapped_in_sections_by_one_setting(survey, tmp_path):
    """80 m of street are one section: more would each have too few markings for two cameras."""
    config = run_config(survey[0], tmp_path / "out")
    config.map.section_m = 200.0
    result = run(config)
    figures = json.loads((result.folder / "metrics.json").read_text())["results"]["both"]["Opt"]
    assert figures["recall"] > 0.9
    assert not list(Path(f"{tmp_path}/out.cache").glob("sections-*"))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["map.section_m=20"], "map.section_m is 20"),
        (["map.section_m=500", "all_maps=true"], "map.section_m and all_maps"),
        (["map.section_m=500", "mapping.ground=surface"], "mapping.ground=surface: not with sections"),
    ],
)
def test_sections_that_cannot_be_are_refused_before_any_work(survey, tmp_path, capsys, words, says):
    arguments = [f"drive.path={survey[0]}", f"cache={tmp_path}/c", f"output={tmp_path}/o", "workers=1"]
    assert main(["map", *arguments, *words]) == 2
    assert says in capsys.readouterr().err
