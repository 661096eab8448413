"""A result folder is whole or absent, belongs to one process, and keeps what is the user's."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.faults.judge import full_disk
from v2hdm.errors import ConfigError
from v2hdm.store import results
from v2hdm.store.files import replace_text, write_json
from v2hdm.store.inputs import LIST, note_input, protected_inputs
from v2hdm.store.results import added_to, files_of_result, growing_folder, listed_files, result_folder

ROOT = Path(__file__).parents[2]


def write(target, **files):
    with result_folder(target) as folder:
        for name, text in files.items():
            (folder / name).write_text(text)


def names(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.name != LIST)


def test_a_failed_run_leaves_the_earlier_result_untouched(tmp_path):
    target = tmp_path / "run"
    write(target, config="first")
    with pytest.raises(ZeroDivisionError), result_folder(target) as folder:
        (folder / "config").write_text(f"second {1 / 0}")
    assert (target / "config").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_failed_first_run_leaves_no_folder_that_it_made(tmp_path):
    with pytest.raises(ZeroDivisionError), result_folder(tmp_path / "outputs" / "run"):
        print(1 / 0)
    assert not list(tmp_path.iterdir())


def test_a_disk_that_fails_before_the_first_file_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "_write_list", lambda *_: (_ for _ in ()).throw(OSError(5, "broken")))
    with pytest.raises(ConfigError, match="broken"), result_folder(tmp_path / "out"):
        pass
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == []


def test_a_second_run_replaces_the_first_whole(tmp_path):
    write(tmp_path / "run", config="first", first="")
    write(tmp_path / "run", config="second", second="")
    assert names(tmp_path / "run") == ["config", "second"]


def test_notes_of_the_user_survive_a_rerun(tmp_path):
    target = tmp_path / "run"
    write(target, config="first")
    (target / "notes.md").write_text("mine")
    (target / "photos" / "deep").mkdir(parents=True)
    (target / "photos" / "deep" / "a.jpg").write_text("photo")
    (target / "empty").mkdir()
    (target / "link").symlink_to(tmp_path)
    for text in ("second", "third"):
        write(target, config=text)
    assert (target / "config").read_text() == "third"
    assert (target / "notes.md").read_text() == "mine"
    assert (target / "photos" / "deep" / "a.jpg").read_text() == "photo"
    assert (target / "empty").is_dir()
    assert (target / "link").is_symlink()


def test_a_file_of_the_users_that_we_write_too_is_kept_beside_ours(tmp_path):
    target = tmp_path / "run"
    write(target, config="first")
    (target / "figure.png").write_text("mine")
    write(target, config="second", **{"figure.png": "ours"})
    assert (target / "figure.png").read_text() == "ours"
    assert (target / "figure.kept.png").read_text() == "mine"


def test_a_result_that_was_edited_is_not_replaced(tmp_path):
    write(tmp_path / "run", map="first")
    (tmp_path / "run" / "map").write_text("edited")
    with pytest.raises(ConfigError, match="was changed after we wrote it"):
        write(tmp_path / "run", map="second")
    assert (tmp_path / "run" / "map").read_text() == "edited"


def test_a_link_to_a_result_goes_on_leading_there(tmp_path):
    write(tmp_path / "run", config="first")
    (tmp_path / "latest").symlink_to("run")
    write(tmp_path / "latest", config="second")
    assert (tmp_path / "latest").is_symlink()
    assert (tmp_path / "run" / "config").read_text() == "second"


def test_a_link_to_what_we_wrote_is_the_users_and_kept(tmp_path):
    write(tmp_path / "run", config="first")
    (tmp_path / "run" / "config").rename(tmp_path / "elsewhere")
    (tmp_path / "run" / "config").symlink_to("../elsewhere")
    write(tmp_path / "run", config="second")
    assert (tmp_path / "run" / "config").read_text() == "second"
    assert (tmp_path / "run" / "config.kept").is_symlink()
    assert (tmp_path / "elsewhere").read_text() == "first"


def test_nothing_is_written_through_a_link_in_the_place_of_a_folder_of_ours(tmp_path):
    folder = tmp_path / "there"
    with listed_files(folder, "--output", MADE):
        replace_text(folder / "deep" / "a", "first")
    (folder / "deep").rename(tmp_path / "elsewhere")
    (folder / "deep").symlink_to("../elsewhere")
    refused = pytest.raises(ConfigError, match="a link is not replaced")
    with refused, listed_files(folder, "--output", MADE):
        replace_text(folder / "deep" / "a", "second")
    assert (tmp_path / "elsewhere" / "a").read_text() == "first"


def test_a_mount_point_which_cannot_be_replaced_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "is_mount", lambda _: True)
    with pytest.raises(ConfigError, match="is a mount point"):
        write(tmp_path / "run", config="first")


@pytest.mark.parametrize("kind", ["part", "previous"])
def test_a_hidden_folder_of_the_users_is_not_taken_for_what_a_kill_has_left(kind, tmp_path):
    notes = tmp_path / f".run.{kind}" / "notes.md"
    notes.parent.mkdir()
    notes.write_text("mine")
    with pytest.raises(ConfigError, match="was not written by V2HDM"):
        write(tmp_path / "run", config="first")
    assert notes.read_text() == "mine"


def test_a_damaged_list_of_ours_is_one_line(tmp_path):
    write(tmp_path / "run", config="first")
    (tmp_path / "run" / LIST).write_text("{}\n[" * 9000)
    with pytest.raises(ConfigError, match="damaged"):
        write(tmp_path / "run", config="")


def test_an_earlier_result_that_a_kill_left_aside_is_put_back(tmp_path):
    write(tmp_path / "run", config="first")
    (tmp_path / "run").rename(tmp_path / ".run.previous")
    (tmp_path / ".run.part").mkdir()
    with pytest.raises(ZeroDivisionError), result_folder(tmp_path / "run"):
        print(1 / 0)
    assert (tmp_path / "run" / "config").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


HOLDER = """
import sys, time
from pathlib import Path
from v2hdm.store.results import result_folder
with result_folder(Path(sys.argv[1])) as folder:
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_folder_that_another_process_writes_is_refused_by_its_name_until_it_dies(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "run")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(ConfigError, match=f"being written by process {holder.pid} on "):
            write(tmp_path / "run", config="mine")
        holder.send_signal(signal.SIGKILL)
    write(tmp_path / "run", config="mine")
    assert names(tmp_path) == ["run", "run/config"]


def test_single_files_are_added_and_replaced_but_never_the_users(tmp_path):
    drawn, photos = tmp_path / "drawn", tmp_path / "photos"
    for text in (b"first", b"second"):
        with growing_folder(drawn, "--draw") as add:
            add("a.jpg", text)
    assert (drawn / "a.jpg").read_bytes() == b"second"
    (drawn / "b.jpg").write_bytes(b"mine")
    with growing_folder(drawn, "--draw") as add, pytest.raises(ConfigError, match="not a file of V2HDM"):
        add("b.jpg", b"ours")
    assert (drawn / "b.jpg").read_bytes() == b"mine"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"mine")
    with pytest.raises(ConfigError, match="did not write"), growing_folder(photos, "--draw"):
        pass


def test_a_file_stays_ours_where_the_work_was_cut_off_before_or_after_its_replacement(tmp_path, monkeypatch):
    folder = tmp_path / "drawn"
    with growing_folder(folder, "--draw") as add:
        add("a.jpg", b"first")
        add("b.jpg", b"first")
    monkeypatch.setattr(Path, "replace", lambda *_: 1 / 0)
    for name in ("a.jpg", "b.jpg"):
        with growing_folder(folder, "--draw") as add, pytest.raises(ZeroDivisionError):
            add(name, b"second")
    monkeypatch.undo()
    (folder / "b.jpg").write_bytes(b"second")
    assert (folder / "a.jpg").read_bytes() == b"first"
    with growing_folder(folder, "--draw") as add:
        add("a.jpg", b"third")
        add("b.jpg", b"third")


def test_what_is_added_to_a_result_is_on_its_list_and_the_users_stays(tmp_path):
    write(tmp_path / "run", config="ours")
    with added_to(tmp_path / "run", "RESULT") as folder:
        write_json(folder / "more.json", {"a": 1})
    assert "more.json" in files_of_result(tmp_path / "run")
    (tmp_path / "run" / "mine.json").write_text("mine")
    with (
        pytest.raises(ConfigError, match="not a file of V2HDM"),
        added_to(tmp_path / "run", "RESULT") as folder,
    ):
        write_json(folder / "mine.json", {"a": 1})
    assert (tmp_path / "run" / "mine.json").read_text() == "mine"


def test_a_list_never_ends_in_half_a_line(tmp_path, monkeypatch):
    with growing_folder(tmp_path / "drawn", "--draw") as add:
        add("a.jpg", b"first")
    before = (tmp_path / "drawn" / LIST).read_bytes()
    refused = pytest.raises(ConfigError, match="cannot be written")
    with refused, full_disk(len(before) + 9), growing_folder(tmp_path / "drawn", "--draw") as add:
        add("b.jpg", b"second")
    assert (tmp_path / "drawn" / LIST).read_bytes() == before


def test_json_leaves_out_what_does_not_exist(tmp_path):
    write_json(tmp_path / "m.json", {"a": {"recall": float("nan"), "n": np.int64(3)}, "b": [np.float64(1.5)]})
    assert json.loads((tmp_path / "m.json").read_text()) == {"a": {"n": 3}, "b": [1.5]}


MADE = "v2hdm map of /data/monday"


def test_a_result_that_is_an_input_is_not_replaced(tmp_path):
    write(tmp_path / "run", map="earlier")

    def make(read_before):
        with protected_inputs():
            if read_before:
                note_input(tmp_path / "run" / "map")
            with result_folder(tmp_path / "run"):
                assert not read_before
                note_input(tmp_path / "run" / "map")

    for read_before in (True, False):
        with pytest.raises(ConfigError, match="is one of the inputs"):
            make(read_before)
        assert (tmp_path / "run" / "map").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_is_put_into_a_result_while_it_is_made_again_is_kept(tmp_path, monkeypatch):
    """At any instant: while the work is done, and between the last look and the exchange of the folders."""
    target, replace = tmp_path / "run", Path.replace
    write(target, map="first")

    def last_moment(self, other):
        if self == target:
            (target / "late.md").write_text("mine")
            (target / "map").write_text("edited")
        return replace(self, other)

    with result_folder(target) as folder:
        (folder / "map").write_text("second")
        (target / "early.md").write_text("mine")
        monkeypatch.setattr(Path, "replace", last_moment)
    monkeypatch.undo()
    texts = {name: (target / name).read_text() for name in names(target)}
    assert texts == {"map": "second", "map.kept": "edited", "late.md": "mine", "early.md": "mine"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_a_kill_has_left_aside_beside_the_new_result_is_given_to_it(tmp_path):
    write(tmp_path / ".run.previous", map="first")
    (tmp_path / ".run.previous" / "notes.md").write_text("mine")
    write(tmp_path / "run", map="second")
    with pytest.raises(ZeroDivisionError), result_folder(tmp_path / "run"):
        print(1 / 0)
    assert (tmp_path / "run" / "map").read_text() == "second"
    assert (tmp_path / "run" / "notes.md").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_another_command_has_added_stays_its_own_and_what_is_stale_is_named(tmp_path, caplog):
    with result_folder(tmp_path / "run", maker=MADE) as folder:
        (folder / "map").write_text("first")
    with added_to(tmp_path / "run", "RESULT") as folder:
        write_json(folder / "mosaic.json", {})
    export = "v2hdm export of map.geojson"
    for _ in range(2):
        with listed_files(tmp_path / "run", "--output", export):
            replace_text(tmp_path / "run" / "map.csv", "exported")
        with result_folder(tmp_path / "run", maker=MADE) as folder:
            (folder / "map").write_text("second")
    assert names(tmp_path / "run") == ["map", "map.csv"]
    assert "removed with the earlier result: mosaic.json" in caplog.text
