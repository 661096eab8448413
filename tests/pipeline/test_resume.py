"""A run goes on from what earlier ones have found, and ends in the bytes that one in one go makes."""

import json
import os
import shutil
import signal
import subprocess
import sys

import pytest

from tests.ports import blind_copy, run_config
from v2hdm.detection import batch
from v2hdm.errors import DriveError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.mapping.options import MappingOptions
from v2hdm.pipeline import inspect as inspection
from v2hdm.pipeline import run as running
from v2hdm.pipeline import stages
from v2hdm.pipeline.run import RunResult, run
from v2hdm.store.cache import items_of
from v2hdm.store.files import replace_text
from v2hdm.store.results import added_to

SAME = ("map.geojson", "calibration_front.yaml", "trajectory.tum", "excluded.geojson", "residuals.csv")


@pytest.fixture(scope="module")
def site(small_drive, small_mapped, tmp_path_factory):
    """A folder with a drive, what a first run has made of it, and its cache."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(small_drive, folder / "drive")
    shutil.copytree(small_mapped[1], folder / "cache")  # the same drive elsewhere, detected and mapped
    run(config(folder, "first"))
    return folder


def config(folder, output, **changes):
    settings = {"cache": str(folder / "cache"), **changes}
    return run_config(folder / "drive", folder / output, **settings)


def assert_same(folder, other):
    for name in SAME:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


def test_two_processes_find_the_same_map_to_the_byte_without_the_truth(site, tmp_path):
    blind_copy(site / "drive", tmp_path / "drive")
    assert_same(run(config(tmp_path, "out", workers=2)).folder, site / "first" / "short")


def refused(*_, **__):
    raise AssertionError("this was to be taken from the cache")


def seen_images(monkeypatch):
    """The images that are detected in from now on, as indices."""
    looked: list[int] = []
    original = batch.detect_image

    def detect(detector, drive, index):
        looked.append(index)
        return original(detector, drive, index)

    monkeypatch.setattr(batch, "detect_image", detect)
    return looked


def test_another_mapping_setting_needs_no_image_again(site, monkeypatch):
    monkeypatch.setattr(inspection, "inspect", refused)
    monkeypatch.setattr(batch, "detect_image", refused)
    monkeypatch.setattr(batch, "own_vehicles", refused)
    nearer = run(config(site, "nearer", mapping=MappingOptions(max_range_m=6.0)))
    before, after = (
        (folder / "map.geojson").read_bytes() for folder in (site / "first" / "short", nearer.folder)
    )
    assert before != after


def test_with_nothing_changed_the_result_is_taken_as_it_lies(site, monkeypatch):
    monkeypatch.setattr(running, "map_and_save", refused)
    again = run(config(site, "first", workers=2))
    metrics = json.loads((site / "first" / "short" / "metrics.json").read_text())
    assert again.metrics["results"].keys() == metrics["results"].keys()
    assert again.verdict.as_json() == metrics["verdict"]
    assert again.headlines


def test_a_result_whose_report_was_made_again_and_has_a_mosaic_is_taken_as_it_lies(site, monkeypatch):
    folder = site / "first" / "short"
    with added_to(folder, "RESULT"):
        replace_text(folder / "mosaic.json", "added")
        replace_text(folder / "report.html", "made again")
    monkeypatch.setattr(running, "map_and_save", refused)
    run(config(site, "first"))
    assert (folder / "mosaic.json").read_text() == "added"
    assert (folder / "report.html").read_text() == "made again"


def test_a_finished_result_is_known_without_torch(site):
    code = (
        "import sys\n"
        "from v2hdm.pipeline.config import DriveConfig, RunConfig\nfrom v2hdm.pipeline.run import run\n"
        f"run(RunConfig(name='short', drive=DriveConfig(path={str(site / 'drive')!r}), workers=1,"
        f" mosaic=False, output={str(site / 'first')!r}, cache={str(site / 'cache')!r}))\n"
        "print('torch' in sys.modules)"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert process.stdout.strip() == "False", process.stderr


def remove_a_file(folder):
    (folder / "map.geojson").unlink()


def cut_the_entries(folder):
    for item in items_of(folder.parent.parent / "cache"):
        if item.path.is_file():
            item.path.write_bytes(item.path.read_bytes()[: item.size // 2])


@pytest.mark.parametrize("harm", [remove_a_file, cut_the_entries])
def test_what_is_missing_or_damaged_is_made_anew(site, harm, monkeypatch):
    results: list[RunResult] = []
    before = (site / "first" / "short" / "map.geojson").read_bytes()
    harm(site / "first" / "short")
    original = running.map_and_save
    monkeypatch.setattr(
        running, "map_and_save", lambda *arguments: results.append(original(*arguments)) or results[-1]
    )
    run(config(site, "first"))
    assert results
    assert (site / "first" / "short" / "map.geojson").read_bytes() == before


def test_an_image_that_changed_is_looked_at_again_and_no_other_piece(site, monkeypatch):
    looked = seen_images(monkeypatch)
    image = sorted((site / "drive").rglob("*.jpg"))[-1]
    before = image.read_bytes()
    try:
        image.write_bytes(before + b"\0")  # a decoder does not mind what follows the end
        run(config(site, "changed"))
    finally:
        image.write_bytes(before)
    total = len(read_drive(site / "drive").images)
    assert looked == list(range(total - total % stages.PIECE, total))


KILLED = """
import os, signal, sys
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.run import run
from v2hdm.store.cache import StageCache
original, kept = StageCache.put, []
def put(cache, stage, *rest):
    found = original(cache, stage, *rest)
    kept.append(stage)
    if kept.count("detect") == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return found
StageCache.put = put
drive = DriveConfig(path=sys.argv[1])
run(RunConfig(name="short", drive=drive, output=sys.argv[2], cache=sys.argv[3], workers=1, mosaic=False))
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_in_the_middle_of_detection(site, monkeypatch):
    cache, output = site / "killed_cache", site / "killed"
    arguments = [str(site / "drive"), str(output), str(cache)]
    process = subprocess.run([sys.executable, "-c", KILLED, *arguments], capture_output=True, timeout=300)
    assert process.returncode == -signal.SIGKILL, process.stderr
    looked = seen_images(monkeypatch)
    resumed = run(config(site, "killed", cache=str(cache)))
    assert looked
    assert looked[0] == stages.PIECE
    assert_same(resumed.folder, site / "first" / "short")


def test_the_limit_of_the_cache_is_kept(site):
    for item in items_of(site / "cache"):
        os.utime(item.path, (1000, 1000))
    before = len(items_of(site / "cache"))
    limited = run(config(site, "limited", cache_gb=0.0))
    left = items_of(site / "cache")
    assert {item.kind for item in left} == {"check", "own_vehicle", "detect", "map", "finished"}
    assert all(item.used_s > 1000 for item in left)
    assert len(left) < before
    assert_same(limited.folder, site / "first" / "short")


def test_part_of_a_drive_can_be_tried(site):
    whole = read_drive(site / "drive")
    first_s = whole.images[0].stamp_s
    few = read_drive(site / "drive", ReadOptions(limit=3))
    assert [image.path for image in few.images] == [image.path for image in whole.images[:3]]
    middle = read_drive(site / "drive", ReadOptions(start_s=0.5, end_s=2.0))
    assert {image.path for image in middle.images} == {
        image.path for image in whole.images if 0.5 <= image.stamp_s - first_s <= 2.0
    }
    assert len(middle.trajectory.stamp_s) == len(whole.trajectory.stamp_s)
    with pytest.raises(DriveError, match=r"no image of camera 'front' is left from 1000 to inf s"):
        read_drive(site / "drive", ReadOptions(start_s=1000.0))
    with pytest.raises(DriveError, match=r"drive\.limit is 0"):
        read_drive(site / "drive", ReadOptions(limit=0))
