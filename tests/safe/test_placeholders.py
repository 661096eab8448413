"""A small text in the place of a file is named as what it is."""

from pathlib import Path

import pytest

from v2hdm.detection.network import open_session
from v2hdm.errors import DetectorError, DriveError
from v2hdm.io.importers.bag.reading import open_bag
from v2hdm.safe.pixels import read_header
from v2hdm.safe.texts import read_text

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


def _read_bag(path: Path) -> None:
    with open_bag(path):
        pass


READERS = {
    "image.jpg": (read_header, DriveError),
    "poses.tum": (lambda path: read_text(path, DriveError), DriveError),
    "drive.mcap": (_read_bag, DriveError),
    "drive.bag": (_read_bag, DriveError),
    "drive.db3": (_read_bag, DriveError),
    "model.onnx": (lambda path: open_session(path, 1), DetectorError),
}


@pytest.mark.parametrize("name", READERS)
def test_a_pointer_of_git_lfs_is_named_with_the_command_that_fetches_the_file(name, tmp_path):
    reader, error = READERS[name]
    path = tmp_path / name
    path.write_text(POINTER)
    with pytest.raises(error, match=f"{name}: only a pointer of Git LFS; .*'git lfs pull'"):
        reader(path)


@pytest.mark.parametrize("name", READERS)
def test_a_link_that_a_copy_turned_into_text_is_named_with_its_target(name, tmp_path):
    reader, error = READERS[name]
    path = tmp_path / name
    target = f"../data/original{path.suffix}"
    path.write_text(target)
    with pytest.raises(error, match=f"{name}: only the text of a link to {target}; copy it again"):
        reader(path)


@pytest.mark.parametrize("content", ["1 0 0 0 0 0 0 1\n", "days/a.txt\ndays/b.txt\n", "day: a/b.txt", ""])
def test_any_other_short_text_is_itself(content, tmp_path):
    path = tmp_path / "list.txt"
    path.write_text(content)
    assert read_text(path, DriveError) == content
