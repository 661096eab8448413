"""Runs from and to object stores are those of folders: finished ones are kept, none is half there."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.example import make_drive
from v2hdm.errors import ConfigError
from v2hdm.io.drive import read_drive
from v2hdm.mapping.options import MappingOptions
from v2hdm.pipeline.config import Contents, DriveConfig, RunConfig, result_key, run_name
from v2hdm.pipeline.run import RunResult, note_finished, take_or_make
from v2hdm.store import remote
from v2hdm.store.cache import code_key, key_of
from v2hdm.store.results import result_folder
from v2hdm.verdict import Verdict


def quiet(*_):
    pass


@pytest.fixture
def config(memory, tmp_path):
    make_drive(tmp_path / "drive")
    drive = DriveConfig(path=str(tmp_path / "drive"))
    return RunConfig(mosaic=False, drive=drive, output=f"{memory}/results", cache=str(tmp_path / "local"))


class Work:
    """Writes a result of one file, of the range that is set; counts how often."""

    def __init__(self):
        self.done: list[RunConfig] = []

    def __call__(self, config, cache):
        self.done.append(config)
        drives = [read_drive(path, config.drive) for path in config.drive.paths]
        folder = Path(config.output) / run_name(config)
        with result_folder(folder) as unfinished:
            (unfinished / "maps").mkdir()
            (unfinished / "maps" / "map.geojson").write_text(str(config.mapping.max_range_m))
        result = RunResult(folder, {"name": drives[0].name}, ["done"], Verdict.of([]))
        key = result_key(config, drives, Contents.of(drives), key_of(code_key()))
        note_finished(result, key, cache)
        return result


def test_a_result_goes_to_its_place_and_is_kept_there(config, memory, tmp_path):
    work = Work()
    first, is_kept = take_or_make(config, work, True, quiet)
    assert (first.place, is_kept) == (f"{memory}/results/example", False)
    place = memory.below("results/example")
    assert place.read("maps/map.geojson") == str(config.mapping.max_range_m).encode()
    assert not (tmp_path / "local" / "uploads").exists()
    elsewhere = replace(config, cache=str(tmp_path / "other machine"))
    second, is_kept = take_or_make(elsewhere, work, True, quiet)
    assert is_kept
    assert (second.place, second.metrics, second.verdict) == (first.place, first.metrics, first.verdict)
    assert len(work.done) == 1
    nearer = replace(config, mapping=MappingOptions(max_range_m=9.0))
    assert not take_or_make(nearer, work, True, quiet)[1]
    assert place.read("maps/map.geojson") == b"9.0"
    assert not take_or_make(nearer, work, False, quiet)[1]


def test_a_result_whose_upload_failed_is_not_made_again(config, memory, monkeypatch):
    work = Work()

    def gone(*_):
        raise ConfigError("no network")

    with monkeypatch.context() as patch:
        patch.setattr(remote, "upload", gone)
        with pytest.raises(ConfigError, match="no network"):
            take_or_make(config, work, True, quiet)
    assert not memory.below("results").listed()
    assert not take_or_make(config, work, True, quiet)[1]
    assert len(work.done) == 1
    assert memory.below("results/example").read("maps/map.geojson")


def test_what_another_finishes_meanwhile_is_taken(config, tmp_path):
    first, second = Work(), Work()

    def after_another(local, cache):
        elsewhere = replace(config, cache=str(tmp_path / "other machine"))
        assert not take_or_make(elsewhere, first, True, quiet)[1]
        return second(local, cache)

    result, is_kept = take_or_make(config, after_another, True, quiet)
    assert is_kept
    assert result.place.endswith("/results/example")
    assert not (tmp_path / "local" / "uploads").exists()


def test_two_processes_of_a_machine_do_not_upload_one_result_at_once(config, memory, monkeypatch):
    upload = remote.upload

    def slowly(*arguments):
        monkeypatch.setattr(remote, "upload", upload)
        with pytest.raises(ConfigError, match="is being written by process"):
            take_or_make(config, Work(), True, quiet)
        upload(*arguments)

    monkeypatch.setattr(remote, "upload", slowly)
    assert not take_or_make(config, Work(), True, quiet)[1]
    assert memory.below("results/example").read("maps/map.geojson")


def test_what_is_not_ours_is_reported_before_any_work(config, memory):
    memory.write("results/example/notes", b"mine")
    work = Work()
    with pytest.raises(ConfigError, match="not results of V2HDM"):
        take_or_make(config, work, True, quiet)
    assert not work.done


@pytest.mark.parametrize("name", ["../other", "a/b", ".hidden", ".."])
def test_a_name_that_leads_elsewhere_at_a_store_is_refused_before_any_work(name, config, memory):
    work = Work()
    with pytest.raises(ConfigError, match=r"path separator|begins with a dot"):
        take_or_make(replace(config, name=name), work, True, quiet)
    assert not work.done
    assert not memory.listed()


def test_a_cache_at_a_store_is_refused(config, memory):
    with pytest.raises(ConfigError, match=r"cache=memory.*: is a URL; give a folder"):
        take_or_make(replace(config, cache=f"{memory}/cache"), Work(), True, quiet)
