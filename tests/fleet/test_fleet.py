"""A fleet maps each drive as the mapping door does; what fails is a row, what is finished is kept."""

import csv
import json
import os
import re
import signal
import threading
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.run_files import written

pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")

from v2hdm.detection import network
from v2hdm.detection.batch import detect_all, with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DriveError, WorkerError
from v2hdm.fleet.cluster import DETECTORS_A_GPU, Shares
from v2hdm.fleet.plan import Row, exit_code, plan, plan_site
from v2hdm.fleet.run import FleetOptions, run_fleet
from v2hdm.fleet.workers import DetectorActor, ProgressActor, detect_by, map_drive, open_detectors
from v2hdm.io.drive import read_drive
from v2hdm.pipeline.config import RunConfig
from v2hdm.pipeline.run import run
from v2hdm.records import ImageDetections


def detectors_of(ray, count, **options):
    return [
        ray.remote(DetectorActor).options(num_cpus=0.1, **options).remote(str(Path.cwd()))
        for _ in range(count)
    ]


def found_by(detectors, drive, **settings):
    options, found = DetectorOptions(**settings), []
    whole = with_own_vehicle(read_drive(drive), Detector.load(options=options))
    detect_by(detectors, whole, options, range(len(whole.images)), 1, found.append)
    return repr(found)


def test_actors_find_what_processes_find_also_when_one_is_killed(ray, drive, monkeypatch):
    monkeypatch.setattr("v2hdm.fleet.workers.IMAGES_A_BATCH", 2)
    detectors = detectors_of(ray, 2, max_restarts=-1, max_task_retries=3)
    killed = ray.get(detectors[0].process.remote())
    expected = repr(detect_all(read_drive(drive), DetectorOptions()))
    threading.Timer(0.3, os.kill, (killed, signal.SIGKILL)).start()
    assert found_by(detectors, drive) == expected
    assert ray.get(detectors[0].process.remote()) != killed
    for one in detectors:
        ray.kill(one)


def test_what_is_wrong_with_an_image_is_told_as_by_the_mapping_door(ray, drive):
    whole = read_drive(drive)
    detectors = detectors_of(ray, 1)
    image = whole.images[2].path
    content = image.read_bytes()
    try:
        image.write_bytes(content[: len(content) // 2])
        with pytest.raises(DriveError, match=image.name):
            detect_by(detectors, whole, DetectorOptions(), range(len(whole.images)), 1, print)
    finally:
        image.write_bytes(content)
        ray.kill(detectors[0])


def test_an_actor_that_dies_again_and_again_is_told(ray, drive):
    class Blind(DetectorActor):
        def detect(self, *_):
            os.kill(os.getpid(), signal.SIGKILL)
            return []

    detectors = [ray.remote(Blind).options(num_cpus=0.1).remote(str(Path.cwd()))]
    with pytest.raises(WorkerError, match="died again and again"):
        found_by(detectors, drive)


def test_actors_share_a_gpu(ray, drive, monkeypatch):
    class OnGpu(DetectorActor):
        def __init__(self, folder):
            # There is no GPU here: what is asked for there is done on the CPU.
            network._PROVIDERS["cuda"] = network._PROVIDERS["cpu"]
            super().__init__(folder)

        def gpus(self):
            ids: list[Any] = ray.get_gpu_ids()
            return ids

    monkeypatch.setattr("v2hdm.fleet.workers.DetectorActor", OnGpu)
    cuda = RunConfig(detector=DetectorOptions(device="cuda"))
    shares = Shares.of([cuda])
    detectors = open_detectors({"cuda"}, 2, 1, shares.detector, str(Path.cwd()), 0)["cuda"]
    assert [ray.get(one.gpus.remote()) for one in detectors] == [[0], [0]]
    assert ray.available_resources()["GPU"] == 1 - 2 * shares.detector
    whole = with_own_vehicle(read_drive(drive), Detector.load())
    found: list[ImageDetections] = []
    detect_by(detectors, whole, cuda.detector, range(3), 1, found.append)
    assert repr(found) == repr(detect_all(read_drive(drive), DetectorOptions())[:3])
    for one in detectors:
        ray.kill(one)


def test_all_that_shares_a_gpu_fits_on_it():
    detects = RunConfig(detector=DetectorOptions(device="cuda"))
    maps = RunConfig(device="cuda")
    assert Shares.of([detects, RunConfig()]).detector * DETECTORS_A_GPU == 1
    assert Shares.of([maps, RunConfig()]).mapping == 1
    both = Shares.of([detects, maps])
    assert both.detector * DETECTORS_A_GPU + both.mapping == 1


def test_a_drive_that_wants_a_gpu_where_there_is_none_is_a_row(ray, drive, tmp_path, monkeypatch):
    class WithoutGpus:
        def __getattr__(self, name):
            return (lambda: {"CPU": 1.0}) if name == "cluster_resources" else getattr(ray, name)

    @contextmanager
    def here(address, workers):
        yield WithoutGpus()

    monkeypatch.setattr("v2hdm.fleet.run.cluster", here)
    for setting in ("device=cuda", "detector.device=cuda"):
        files, options = [written(tmp_path, "good", drive)], FleetOptions(tmp_path / "table")
        (row,) = run_fleet(files, [setting], options, lambda *_: None)
        assert (row.status, "none of Ray's machines has a GPU" in row.says) == ("ERROR", True)


@pytest.mark.slow
def test_a_drive_and_results_at_an_object_store_make_the_same_map(ray, s3, drive, tmp_path):
    for path in drive.rglob("*"):
        if path.is_file():
            s3.upload_file(str(path), "bucket", f"drives/tiny/{path.relative_to(drive).as_posix()}")
    settings = ["output=s3://bucket/results", f"cache={tmp_path / 'cache'}"]
    (job,) = plan([written(tmp_path, "good", "s3://bucket/drives/tiny")], settings).jobs
    assert job.place == "s3://bucket/results/good"
    detectors, progress = detectors_of(ray, 1), ray.remote(ProgressActor).options(num_cpus=0).remote()
    for kept in (False, True):
        row, trace = map_drive(job, detectors, progress, str(Path.cwd()))
        assert (row.status, row.kept, row.folder) == ("PASS", kept, job.place), (row, trace)
    ray.kill(detectors[0])

    # Another drive's folder of the same content: what was detected is in the cache.
    settings = [f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
    (job,) = plan([written(tmp_path, "good", drive)], settings).jobs
    row, trace = map_drive(job, [], progress, str(Path.cwd()))
    assert row.status == "PASS", (row, trace)
    for name in ("map.geojson", "calibration_front.yaml"):
        there = s3.get_object(Bucket="bucket", Key=f"results/good/{name}")["Body"].read()
        assert there == (tmp_path / "out" / "good" / name).read_bytes()


@pytest.mark.slow
def test_a_fleet_outlives_its_workers_keeps_what_is_finished_and_goes_on_past_what_fails(
    ray, drive, tmp_path, monkeypatch
):
    @contextmanager
    def here(address, workers):
        yield ray

    def dies_once(*arguments):
        if not (tmp_path / "died").exists():
            (tmp_path / "died").touch()
            threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGKILL)).start()
        return map_drive(*arguments)

    monkeypatch.setattr("v2hdm.fleet.run.cluster", here)
    monkeypatch.setattr("v2hdm.fleet.workers.map_drive", dies_once)
    good, nowhere = written(tmp_path, "good", drive), written(tmp_path, "nowhere", tmp_path / "absent")
    typo = written(tmp_path, "typo", drive)
    typo.write_text(typo.read_text() + "mapping: {max_rang_m: 3}\n")
    overrides = [f"output={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
    told: list[tuple[str, str, int, int]] = []

    def fleet(*files):
        options = FleetOptions(tmp_path / "table")
        return run_fleet(files, overrides, options, lambda *message: told.append(message))

    rows = fleet(good, nowhere, typo)
    assert (tmp_path / "died").exists()
    images = len(read_drive(drive).images)
    assert [row.status for row in rows] == ["PASS", "ERROR", "ERROR"]
    assert (rows[0].images, rows[0].kept) == (images, False)
    assert "no such drive folder" in rows[1].says
    assert re.search("did you mean .*mapping.max_range_m", rows[2].says)
    assert ("good", "detect", images, images) in told
    table = list(csv.DictReader(StringIO((tmp_path / "table" / "fleet.csv").read_text())))
    assert [row["drive"] for row in table] == ["good", "nowhere", "typo"]
    assert json.loads((tmp_path / "table" / "fleet.json").read_text())["drives"][0]["status"] == "PASS"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good"]
    (job,) = plan([good], [f"output={tmp_path / 'alone'}", f"cache={tmp_path / 'other'}", "workers=1"]).jobs
    alone = run(job.config, job.config_yaml).folder
    for name in ("map.geojson", "calibration_front.yaml", "residuals.csv", "trajectory.tum"):
        assert (tmp_path / "out" / "good" / name).read_bytes() == (alone / name).read_bytes(), name

    assert fleet(good)[0].kept


def test_two_run_files_never_write_one_folder(tmp_path, drive):
    files = [written(tmp_path, "one", drive), tmp_path / "other.yaml"]
    files[1].write_text(files[0].read_text())
    planned = plan(files, [])
    assert [job.name for job in planned.jobs] == ["one"]
    assert "name one otherwise" in planned.refused[0].says


def test_the_drives_of_run_files_become_one_site(tmp_path):
    monday = written(tmp_path, "monday", "drives/monday")
    week = written(tmp_path, "week", "[drives/tuesday, drives/friday]")
    planned = plan_site([monday, week], ["output=maps", "mapping.rounds=3"], "port")
    (job,) = planned.jobs
    assert job.config.drive.path == ["drives/monday", "drives/tuesday", "drives/friday"]
    assert (job.name, job.place, job.config.mapping.rounds) == ("port", str(Path("maps/port").resolve()), 3)
    assert planned.sources == [f"{monday}, {week}"] == [job.source]
    far = written(tmp_path, "far", "s3://bucket/drives/far")
    (job,) = plan_site([monday, far], [], "port").jobs
    assert job.config.drive.path == ["drives/monday", "s3://bucket/drives/far"]


def test_files_that_make_no_site_are_one_row_that_says_why(tmp_path):
    monday, tuesday = (written(tmp_path, name, name) for name in ("monday", "tuesday"))
    tuesday.write_text(tuesday.read_text() + "mapping: {max_range_m: 9.0}\n")
    (row,) = plan_site([monday, tuesday], [], "port").refused
    assert (row.drive, row.status) == ("port", "ERROR")
    assert "tuesday.yaml: mapping.max_range_m is 9.0, and 16.0 in" in row.says
    assert plan_site([monday, tuesday], ["mapping.max_range_m=9.0"], "port").jobs
    rendered = tmp_path / "rendered.yaml"
    rendered.write_text("# @package _global_\nname: rendered\nsimulate: {}\n")
    (row,) = plan_site([rendered, monday], [], "port").refused
    assert "set drive.path" in row.says
    (row,) = plan_site([monday, tmp_path / "absent.yaml"], [], "port").refused
    assert "absent.yaml" in row.says
    with pytest.raises(ConfigError, match="--site"):
        plan_site([monday], [], "../port")


def test_what_would_be_gone_with_a_worker_is_refused(tmp_path, drive):
    planned = plan([written(tmp_path, "one", drive)], ["output=memory://results"])
    assert not planned.jobs
    assert "gone with the process" in planned.refused[0].says


def test_the_table_has_a_code_for_the_worst_of_its_rows():
    def row(status):
        return Row("a", status, "", 1, 1, 1.0, False, "", status)

    assert exit_code([row("PASS"), row("WARN")]) == 0
    assert exit_code([row("FAIL"), row("PASS")]) == 3
    assert exit_code([row("FAIL"), row("ERROR")]) == 2
