"""Objects are read as they were put, created once, and what fails is told in one line."""

from pathlib import Path

import pytest

from v2hdm.errors import ConfigError
from v2hdm.store.files import whole_file
from v2hdm.store.remote import RemoteFolder, place_of
from v2hdm.store.results import result_folder


def test_what_was_put_is_read_listed_and_removed(memory, tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    memory.write("c/b", tmp_path / "file")
    memory.write("a", b"x")
    memory.write("a", b"xy")
    assert memory.read("a") == b"xy"
    assert {name: listed.size for name, listed in memory.listed().items()} == {"c/b": 5, "a": 2}
    assert memory.below("c").read("b") == b"12345"
    memory.remove("a")
    memory.remove("a")
    assert memory.read("a") is None


def test_an_object_is_created_once(memory):
    assert memory.create("a", b"first")
    assert not memory.create("a", b"other")
    assert memory.read("a") == b"first"


def test_a_create_whose_answer_was_lost_counts(memory):
    assert memory.create("a", b"first")
    assert memory.create("a", b"first")


def test_a_name_that_begins_alike_is_not_below(memory):
    memory.write("run2/map", b"x")
    assert not memory.below("run").listed()


def test_a_token_changes_with_the_object(memory):
    memory.write("a", b"x")
    before = memory.listed()["a"]
    memory.write("a", b"y")
    assert memory.listed()["a"] != before


class Failing:
    """A store whose calls fail."""

    def __init__(self, failure):
        self._failure = failure

    def cat_file(self, path):
        raise self._failure


@pytest.mark.parametrize(
    ("failure", "says"),
    [
        (OSError("no route\nto host"), "s3://b/a: failed .no route to host.; check the network"),
        (PermissionError("Forbidden"), "Forbidden.; check the credentials"),
        (type("NoCredentialsError", (Exception,), {})("none found"), "none found.; check the cred"),
    ],
)
def test_what_fails_is_one_line(failure, says):
    with pytest.raises(ConfigError, match=says) as caught:
        RemoteFolder(Failing(failure), "b", "s3://b", "output=").read("a")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("ssh://host/x", "not in a supported store; choose a folder or s3://"),
        ("simplecache::s3://b/x", "not in a supported store"),
        ("http://host/x", "not in a supported store"),
        ("s3://", "not a path in a store"),
        ("s3://b//x", "not a path in a store"),
        ("s3://b/../x", "not a path in a store"),
        ("s3://b/x?versionId=3", "not a path in a store"),
        ("s3://b/\x1b]2J", "not a path in a store"),
        ("s3://key:secret@b/x", r"^output= s3://\.\.\.: is not a bucket name"),
        ("file:///data/runs", "not in a supported store"),
    ],
)
def test_what_is_no_place_is_refused(url, says):
    with pytest.raises(ConfigError, match=says):
        place_of(url, "output=")


def test_a_package_that_is_not_installed_is_named(monkeypatch):
    def absent(*_, **__):
        raise ImportError("Install gcsfs")

    monkeypatch.setattr("fsspec.core.url_to_fs", absent)
    with pytest.raises(ConfigError, match=r"output= gs://b/x: needs gcsfs, pip install it"):
        place_of("gs://b/x", "output=")


def test_s3_does_what_the_store_in_memory_does(s3, tmp_path):
    place = RemoteFolder.at("s3://bucket/place", "output=")
    assert not place.listed()
    test_what_was_put_is_read_listed_and_removed(place, tmp_path)
    test_an_object_is_created_once(place.below("once"))
    test_a_create_whose_answer_was_lost_counts(place.below("twice"))
    test_a_name_that_begins_alike_is_not_below(place)
    test_a_token_changes_with_the_object(place)


def test_a_bucket_that_is_not_there_is_told(s3):
    nowhere = RemoteFolder.at("s3://nowhere/results", "output=")
    for work in (nowhere.listed, lambda: nowhere.write("a", b"x"), lambda: nowhere.create("a", b"x")):
        with pytest.raises(ConfigError, match="no such bucket"):
            work()


def test_a_url_where_only_paths_are_written_is_told_and_not_made_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for write in (result_folder, whole_file):
        with (
            pytest.raises(ConfigError, match="URLs are allowed only as"),
            write(Path("s3://bucket/results")),
        ):
            pass
    assert not list(tmp_path.iterdir())
