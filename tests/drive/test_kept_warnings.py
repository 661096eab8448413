"""Warnings of an import are told by every reading that takes it."""

from tests.drive.bags import FRONT, messages_of, read, topics_for, write_ros2
from tests.test_commands import run_command


def test_every_reading_of_a_bag_tells_what_its_import_left_out(folder, tmp_path, caplog):
    """The second drive takes the first one's import, and calls its camera by another name."""
    messages = messages_of(folder)
    empty, timeless, *_ = [row[2] for row in messages.rows if row[1] == FRONT]
    empty.data, empty.width, empty.height, empty.step = empty.data[:0], 0, 0, 0
    timeless.header = messages.header(0.0, "front")
    content = topics_for(folder, write_ros2(tmp_path / "site", messages))
    front = content["cameras"]["front"]
    for name in ("front", "bow"):
        caplog.clear()
        read(tmp_path / "drive", content | {"cameras": {name: front}})
        prefix = f"camera '{name}', images: topic {FRONT}: "
        assert caplog.text.count(prefix + "left out 1 of 3 images, which are empty") == 1
        assert caplog.text.count(prefix + "dropped images without a time: 1, of 2") == 1


def test_a_command_that_reads_a_recording_twice_tells_each_warning_once(folder, tmp_path):
    messages = messages_of(folder)
    empty = next(row[2] for row in messages.rows if row[1] == FRONT)
    empty.data, empty.width, empty.height, empty.step = empty.data[:0], 0, 0, 0
    write_ros2(tmp_path / "site", messages)
    process = run_command(tmp_path, "v2hdm", "check", "site", "--no-ground", "--write", "mysite")
    assert process.returncode in (0, 3), process.stderr
    assert process.stderr.count("left out 1 of 3 images, which are empty") == 1
