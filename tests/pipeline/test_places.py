"""Runs from and to object stores are those of folders: finished ones are kept, none is half there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.example import make_drive
from v2hdm.errors import ConfigError, DriveError
from v2hdm.io.importers.mirror import mirrored
from v2hdm.mapping.options import MappingOptions
from v2hdm.pipeline import places
from v2hdm.pipeline.config import DriveConfig, RunConfig, run_name
from v2hdm.pipeline.finished import RunResult, note_finished
from v2hdm.pipeline.keys import Contents, read_drives, result_key
from v2hdm.pipeline.places import in_place
from v2hdm.store.cache.keys import code_key, key_of
from v2hdm.store.cache.store import Store
from v2hdm.store.objects.bucket import Bucket
from v2hdm.store.outputs import result_folder
from v2hdm.verdict import Verdict

pytestmark = pytest.mark.usefixtures("quick")


def quiet(*_: object) -> None:
    pass


@pytest.fixture
def config(memory: Bucket, tmp_path: Path) -> RunConfig:
    make_drive(tmp_path / "drive")
    drive = DriveConfig(path=str(tmp_path / "drive"))
    return RunConfig(
        drive=drive, output=f"{memory}/results", cache=f"{memory}/cache", local_cache=str(tmp_path / "local")
    )


class Work:
    """Writes a result of one file, of the range that is set; counts how often."""

    def __init__(self) -> None:
        self.done: list[RunConfig] = []

    def __call__(self, config: RunConfig, store: Store) -> RunResult:
        self.done.append(config)
        drives = read_drives(config, config.drive.paths)
        folder = Path(config.output) / run_name(config)
        with result_folder(folder) as unfinished:
            (unfinished / "maps").mkdir()
            (unfinished / "maps" / "map.geojson").write_text(str(config.mapping.max_range_m))
        result = RunResult(folder, {"name": drives[0].name}, ["done"], Verdict.of([]))
        key = result_key(config, drives, Contents.of(drives), key_of(code_key()))
        note_finished(result, key, store)
        return result


def test_a_result_goes_to_its_place_and_is_kept_there(
    config: RunConfig, memory: Bucket, tmp_path: Path
) -> None:
    work = Work()
    made, kept = in_place(config, work, True, quiet)
    assert (made.place, kept) == (f"{memory}/results/example", False)
    there = memory.below("results/example")
    assert there.read("maps/map.geojson") == str(config.mapping.max_range_m).encode()
    assert not (tmp_path / "local" / "uploads").exists()
    elsewhere = replace(config, local_cache=str(tmp_path / "other machine"))
    taken, kept = in_place(elsewhere, work, True, quiet)
    assert kept
    assert (taken.place, taken.metrics, taken.verdict) == (made.place, made.metrics, made.verdict)
    assert len(work.done) == 1
    nearer = replace(config, mapping=MappingOptions(max_range_m=9.0))
    assert not in_place(nearer, work, True, quiet)[1]
    assert there.read("maps/map.geojson") == b"9.0"
    assert not in_place(nearer, work, False, quiet)[1]
    assert not memory.below("results/.v2hdm-leases").listed()


def test_a_result_whose_upload_failed_is_not_made_again(
    config: RunConfig, memory: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work()

    def gone(*_: object) -> None:
        raise ConfigError("no network")

    with monkeypatch.context() as patch:
        patch.setattr(places.ResultObjects, "put", gone)
        with pytest.raises(ConfigError, match="no network"):
            in_place(config, work, True, quiet)
    assert not memory.below("results").listed()
    assert not in_place(config, work, True, quiet)[1]
    assert len(work.done) == 1
    assert memory.below("results/example").read("maps/map.geojson")


def test_what_another_finishes_while_its_lease_is_waited_for_is_taken(
    config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Work(), Work()
    leased = places.ResultObjects.leased

    def after_another(*arguments: Any) -> Any:
        monkeypatch.setattr(places.ResultObjects, "leased", leased)
        assert not in_place(config, first, True, quiet)[1]
        return leased(*arguments)

    monkeypatch.setattr(places.ResultObjects, "leased", after_another)
    assert in_place(config, second, True, quiet)[1]
    assert (len(first.done), len(second.done)) == (1, 0)


def test_what_is_not_ours_is_told_before_any_work(config: RunConfig, memory: Bucket) -> None:
    memory.write("results/example/notes", b"mine")
    work = Work()
    with pytest.raises(ConfigError, match="no results of ours"):
        in_place(config, work, True, quiet)
    assert not work.done


def test_a_folder_named_by_a_url_is_that_folder(config: RunConfig, tmp_path: Path) -> None:
    local = replace(config, output=f"file://{tmp_path}/out", cache=f"file://{tmp_path}/kept")
    work = Work()
    assert in_place(local, work, True, quiet)[0].place == str(tmp_path / "out" / "example")
    assert in_place(local, work, True, quiet)[1]
    drive = DriveConfig(path=f"file://{tmp_path}/drive")
    assert in_place(replace(local, drive=drive), work, True, quiet)[1]
    assert (work.done[0].cache, work.done[0].output) == (str(tmp_path / "kept"), str(tmp_path / "out"))


def uploaded(folder: Path, place: Bucket) -> Bucket:
    for path in folder.rglob("*"):
        if path.is_file():
            place.write(path.relative_to(folder).as_posix(), path)
    return place


def test_a_drive_at_a_store_is_copied_once_for_each_content(
    config: RunConfig, memory: Bucket, tmp_path: Path
) -> None:
    place = uploaded(tmp_path / "drive", memory.below("drives/monday"))
    told: list[tuple[int, int]] = []
    copy = mirrored(place, tmp_path / "cache", lambda *at: told.append(at))
    files = sum(path.is_file() for path in (tmp_path / "drive").rglob("*"))
    assert told[-1] == (files, files)
    assert copy.name == "monday"
    for path in (tmp_path / "drive").rglob("*"):
        if path.is_file():
            assert (copy / path.relative_to(tmp_path / "drive")).read_bytes() == path.read_bytes()
    told.clear()
    assert mirrored(place, tmp_path / "cache", lambda *at: told.append(at)) == copy
    assert not told
    place.write("poses.tum", (tmp_path / "drive" / "poses.tum").read_bytes() + b"# more\n")
    assert mirrored(place, tmp_path / "cache", quiet) != copy

    work = Work()
    made, _ = in_place(replace(config, drive=DriveConfig(path=str(place))), work, True, quiet)
    assert made.place == f"{memory}/results/monday"
    assert work.done[0].drive.paths[0].is_relative_to(tmp_path / "local")


@pytest.mark.parametrize(
    ("names", "says"),
    [
        ([], "no such drive"),
        (["../../escape"], "is none of a file in a folder"),
        (["a//b"], "is none of a file in a folder"),
        (["..\\escape"], "is none of a file in a folder"),
    ],
)
def test_a_drive_that_leads_out_of_its_folder_is_refused(
    names: list[str], says: str, memory: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed: Callable[..., Any] = Bucket.listed
    memory.write("drive/x", b"x")
    thing = listed(memory)["drive/x"]
    monkeypatch.setattr(Bucket, "listed", lambda self: dict.fromkeys(names, thing))
    with pytest.raises(DriveError, match=says):
        mirrored(memory.below("drive"), tmp_path / "cache", quiet)
    assert not list(tmp_path.iterdir())


def test_a_copy_that_failed_leaves_nothing(
    memory: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory.write("drive/x", b"x")

    def gone(*_: object) -> None:
        raise ConfigError("no network")

    monkeypatch.setattr(Bucket, "fetch", gone)
    with pytest.raises(ConfigError, match="no network"):
        mirrored(memory.below("drive"), tmp_path / "cache", quiet)
    assert not list((tmp_path / "cache").iterdir())
