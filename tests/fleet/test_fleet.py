"""A fleet maps each drive as the mapping door does; what fails is a row, what is finished is kept."""

import csv
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
from contextlib import nullcontext
from io import StringIO
from pathlib import Path

import pytest

from tests.fleet.runs import written
from v2hdm import fleet
from v2hdm.cli.main import run as command
from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.fleet import FleetOptions, Row, exit_code, plan, run_fleet
from v2hdm.io.drive import read_drive
from v2hdm.pipeline.run import take_or_run

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_results_at_an_object_store_are_those_of_a_folder(s3, drive, alone, tmp_path):
    settings = ["output=s3://bucket/results", f"cache={tmp_path / 'cache'}", "workers=1"]
    (job,) = plan([written(tmp_path, "good", drive)], settings).jobs
    assert job.place == "s3://bucket/results/good"
    for is_kept in (False, True):
        result, taken = take_or_run(job.config, job.config_yaml, lambda *_: None)
        assert (result.place, taken) == (job.place, is_kept)
    for name in ("map.geojson", "calibration_front.yaml"):
        content = s3.get_object(Bucket="bucket", Key=f"results/good/{name}")["Body"].read()
        assert content == (alone / name).read_bytes()


@pytest.mark.slow
def test_a_fleet_outlives_its_processes_keeps_what_is_finished_and_goes_on_past_what_fails(
    drive, alone, tmp_path
):
    good, nowhere = written(tmp_path, "good", drive), written(tmp_path, "nowhere", tmp_path / "absent")
    doomed, typo = written(tmp_path, "doomed", drive), written(tmp_path, "typo", drive)
    typo.write_text(typo.read_text() + "mapping: {max_rang_m: 3}\n")
    overrides = [f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
    messages: list[tuple[str, str, int, int]] = []
    killed: list[str] = []

    def kills(*message):
        messages.append(message)
        if message[1] in ("check", "detect") and (message[0] == "doomed" or "good" not in killed):
            killed.append(message[0])
            (process,) = multiprocessing.active_children()
            os.kill(process.pid, signal.SIGKILL)

    def fleet(*files):
        return run_fleet(files, overrides, FleetOptions(tmp_path / "table", workers=1), kills)

    rows = fleet(good, nowhere, doomed, typo)
    assert set(killed) == {"good", "doomed"}
    images = len(read_drive(drive).images)
    assert [row.status for row in rows] == ["PASS", "ERROR", "ERROR", "ERROR"], rows
    assert (rows[0].images, rows[0].kept) == (images, False)
    assert "no such drive folder" in rows[1].says
    assert "died twice over the same work" in rows[2].says
    assert re.search("did you mean .*mapping.max_range_m", rows[3].says)
    assert ("good", "detect", images, images) in messages
    table = list(csv.DictReader(StringIO((tmp_path / "table" / "fleet.csv").read_text())))
    assert [row["drive"] for row in table] == ["good", "nowhere", "doomed", "typo"]
    assert json.loads((tmp_path / "table" / "fleet.json").read_text())["drives"][0]["status"] == "PASS"
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name[0] != "."] == ["good"]
    for name in ("map.geojson", "calibration_front.yaml", "residuals.csv", "trajectory.tum"):
        assert (tmp_path / "out" / "good" / name).read_bytes() == (alone / name).read_bytes(), name
    assert fleet(good)[0].kept
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_a_fleet_that_is_ended_takes_its_processes_with_it(end, drive, tmp_path):
    file = written(tmp_path, "good", drive)
    arguments = [str(file), f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}", "--workers", "1"]
    command = [sys.executable, "-m", "v2hdm", "fleet", *arguments, "--table", str(tmp_path / "table")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=ROOT, **pipes)
    assert process.stdout.readline().startswith("good: check")  # a process is at work
    os.kill(process.pid, end)
    _, errors = process.communicate(timeout=60)  # returns when the last process has closed its end
    assert (process.returncode, errors[:18]) in [(2, "error: interrupted"), (-9, "")], errors
    assert errors.count("\n") == (end == signal.SIGTERM)
    assert not list((tmp_path / "out").glob("*"))


def test_two_run_files_never_write_one_folder(tmp_path, drive):
    files = [written(tmp_path, "one", drive), tmp_path / "other.yaml"]
    files[1].write_text(files[0].read_text())
    planned = plan(files, [])
    assert [job.name for job in planned.jobs] == ["one"]
    assert "name one otherwise" in planned.refused[0].says


@pytest.mark.parametrize("files", [["TYPO/*.yaml"], ["TYPO/a.yaml", "TYPO/b.yaml"], []])
def test_a_fleet_without_a_run_file_is_an_error(files, capsys, tmp_path):
    arguments = [
        "fleet",
        *(f"{tmp_path}/{file}" for file in files),
        "output=x",
        "--table",
        str(tmp_path / "t"),
    ]
    assert command(arguments) == 2
    problem = "no such run file; check the path" if files else "no drives given: name run files"
    assert problem in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_run_files_that_name_different_clusters_are_refused(tmp_path, drive):
    files = [written(tmp_path, name, drive) for name in ("a", "b")]
    files[1].write_text(files[1].read_text() + "cluster: tcp://127.0.0.1:1\n")
    with pytest.raises(ConfigError, match=r"cluster differs between the run files .*; give one for all"):
        run_fleet(files, [], FleetOptions(tmp_path / "table"), lambda *_: None)


def test_a_fleet_on_a_cluster_that_is_not_there_is_one_line(capsys, tmp_path, drive, monkeypatch):
    monkeypatch.setattr("v2hdm.executor.connecting._CONNECT_S", 1.0)
    file = written(tmp_path, "a", drive)
    arguments = ["fleet", str(file), "--cluster", "tcp://127.0.0.1:9", "--table", str(tmp_path / "table")]
    assert command(arguments) == 2
    assert re.fullmatch(
        r"error: cluster=tcp://127.0.0.1:9: no Dask scheduler answers .*\n", capsys.readouterr().err
    )


def test_what_would_be_gone_with_a_worker_is_refused(tmp_path, drive):
    planned = plan([written(tmp_path, "one", drive)], ["output=memory://results"])
    assert not planned.jobs
    assert "is temporary, for one process" in planned.refused[0].says


def test_a_drive_in_place_of_a_run_file_is_named_as_one(drive):
    planned = plan([drive / "drive.yaml"], [])
    assert "a drive; give a run file that names its folder" in planned.refused[0].says


def test_a_run_whose_name_is_no_name_of_a_folder_is_refused_before_any_work(tmp_path, drive):
    file = written(tmp_path, "one", drive)
    file.write_text(file.read_text().replace("name: one", "name: ../one"))
    planned = plan([file], [f"output={tmp_path / 'out'}"])
    assert not planned.jobs
    assert "has a path separator" in planned.refused[0].says


def test_a_bug_is_a_row_whose_traceback_lies_beside_the_table(tmp_path, drive, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(fleet, "take_or_run", broken)
    monkeypatch.setattr(fleet, "open_executor", lambda *_, **__: nullcontext(HERE))
    files = [written(tmp_path, name, drive) for name in ("one", "two")]
    options = FleetOptions(tmp_path / "table")
    rows = run_fleet(files, [f"output={tmp_path / 'out'}"], options, lambda *_: None)
    assert [row.status for row in rows] == ["ERROR", "ERROR"]
    assert "a bug in V2HDM, ZeroDivisionError: a bug" in rows[0].says
    for name in ("one", "two"):
        trace = (tmp_path / "table" / f"{name}.traceback.txt").read_text()
        assert trace.rstrip().endswith("ZeroDivisionError: a bug")


def test_the_table_has_a_code_for_the_worst_of_its_rows():
    def row(status):
        return Row("a", status, "", 1, 1, 1.0, False, "", status)

    assert exit_code([row("PASS"), row("WARN")]) == 0
    assert exit_code([row("FAIL"), row("PASS")]) == 3
    assert exit_code([row("FAIL"), row("ERROR")]) == 2
