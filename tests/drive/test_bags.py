"""One drive in every container is the same drive; damaged containers end in one line."""

import json
import logging
import re
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import CompressionMode

from tests.drive.bags import (
    FRONT,
    MCAP,
    SQLITE3,
    Messages,
    assert_mounted,
    assert_same_drive,
    assert_same_poses,
    front_times,
    make_pictured_drive,
    messages_of,
    mountings,
    read,
    topics_for,
    write_ros1,
    write_ros2,
)
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.drive import ReadOptions, drive_name, read_drive
from v2hdm.io.importers.bag.streams import ImageStream, write_streams
from v2hdm.store.files import replace_text
from v2hdm.store.inputs import protected_inputs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive with a picture in its images."""
    return make_pictured_drive(tmp_path_factory.mktemp("folder"))


def _ros2(storage, compression):
    return lambda path, folder: write_ros2(path, messages_of(folder), storage, compression)


CONTAINERS: dict[str, Callable[[Path, Path], Path]] = {
    "ros1": lambda path, folder: write_ros1(path, messages_of(folder, ros1=True)),
    "ros1 lz4": lambda path, folder: write_ros1(path, messages_of(folder, ros1=True), "lz4"),
    "sqlite3": _ros2(SQLITE3, CompressionMode.NONE),
    "sqlite3 zstd file": _ros2(SQLITE3, CompressionMode.FILE),
    "sqlite3 zstd message": _ros2(SQLITE3, CompressionMode.MESSAGE),
    "mcap": _ros2(MCAP, CompressionMode.NONE),
    "mcap zstd chunks": _ros2(MCAP, CompressionMode.STORAGE),
    "mcap zstd messages": _ros2(MCAP, CompressionMode.MESSAGE),
}


@pytest.fixture(scope="module")
def bags(tmp_path_factory, folder):
    target = tmp_path_factory.mktemp("bags")
    return {kind: write(target / kind.replace(" ", "_"), folder) for kind, write in CONTAINERS.items()}


@pytest.mark.parametrize("kind", CONTAINERS)
def test_a_bag_is_the_same_drive_as_its_folder(kind, folder, bags, tmp_path):
    got = read(tmp_path / "drive", topics_for(folder, bags[kind]))
    assert_same_drive(got, read_drive(folder))
    # The rear camera's JPEG files are those that were recorded, byte by byte.
    rear = [image.path for image in got.images if image.camera == "rear"]
    recorded = sorted((folder / "rear" / "images").iterdir())
    assert [path.read_bytes() for path in rear] == [path.read_bytes() for path in recorded]


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_without_description_is_a_drive_where_its_frames_tell_the_mounting(
    kind, folder, bags, tmp_path
):
    assert drive_name(bags[kind]) == bags[kind].stem
    got = read_drive(bags[kind], ReadOptions(cache=str(tmp_path)))
    assert_same_poses(got, read_drive(folder))
    assert_mounted(got)


def test_a_bag_and_the_drive_written_of_it_have_one_check(folder, bags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    bag = Path(shutil.copytree(bags["mcap"], tmp_path / "site"))
    check = ["check", "--no-ground"]
    assert run([*check, "site"]) in (0, 3)
    assert run([*check, "site", "--write", "drives/site"]) in (0, 3), capsys.readouterr().err
    (tmp_path / "other").mkdir()
    shutil.copytree(bag, tmp_path / "other" / "site")
    assert run([*check, "other/site"]) == 2, "another recording's check stays"
    assert "move it" in capsys.readouterr().err


def test_a_bag_without_mounting_asks_for_it_and_becomes_a_drive(folder, tmp_path, monkeypatch, capsys):
    """Two commands: the first says what the bag does not, the second writes a drive.yaml that is read."""
    monkeypatch.chdir(tmp_path)
    bag = write_ros2(tmp_path / "site", messages_of(folder, fixed_frames=False))
    with pytest.raises(DriveError, match=r"cameras\.front\.mounting.*--write FOLDER") as caught:
        read_drive(bag)
    assert "\n" not in str(caught.value)
    first = ["check", "site", "--no-ground", "--write", "mysite"]
    assert run(first) == 2
    questions = re.findall(r"--set (\S+)=", capsys.readouterr().err)
    assert sorted(questions) == ["cameras.front.mounting", "cameras.rear.mounting"]
    assert not Path("mysite").exists()
    (tmp_path / "lens.yaml").write_bytes((folder / "front" / "camera_info.yaml").read_bytes())
    said = {"cameras.front.camera_info": "lens.yaml"}
    for name, cam_from_vehicle in mountings().items():
        angles = np.degrees(mounting_angles(cam_from_vehicle)).round(9).tolist()
        said[f"cameras.{name}.mounting"] = {
            "xyz_m": camera_centre(cam_from_vehicle).tolist(),
            "rpy_deg": angles,
        }
    assert run([*first, "--set", *(f"{key}={json.dumps(value)}" for key, value in said.items())]) in (0, 3)
    got = read_drive("mysite")
    assert_same_poses(got, read_drive(folder))
    assert_mounted(got)
    assert (
        yaml.safe_load(Path("mysite/drive.yaml").read_text())["cameras"]["front"]["camera_info"]
        == "../lens.yaml"
    )
    written = Path("mysite/drive.yaml").read_bytes()
    assert run(first) == 2
    assert "exists; edit it" in capsys.readouterr().err
    assert Path("mysite/drive.yaml").read_bytes() == written


def test_a_drive_that_cannot_be_read_leaves_no_description(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "front").mkdir()
    for number, image in enumerate(sorted((folder / "front" / "images").iterdir())):
        (tmp_path / "front" / f"{1715934630 + number}.jpg").write_bytes(image.read_bytes())
    lens = folder / "front" / "camera_info.yaml"
    said = [
        f"cameras.front.camera_info={lens}",
        "cameras.front.mounting={xyz_m: [0, 0, 2], rpy_deg: [0, 30, 0]}",
        "poses.tum=nowhere.tum",
    ]
    assert run(["check", "front", "--write", "mysite", "--set", *said]) == 2
    assert "nowhere.tum" in capsys.readouterr().err
    assert not Path("mysite/drive.yaml").exists()


def test_a_second_reading_decodes_nothing_and_mends_what_was_damaged(folder, bags, tmp_path, caplog):
    content = topics_for(folder, bags["mcap"])
    with caplog.at_level(logging.INFO, "v2hdm"):
        first = read(tmp_path / "drive", content)
        assert caplog.text.count(", once") == 1
        changed = {image.path: image.path.stat().st_mtime_ns for image in first.images}
        second = read(tmp_path / "drive", content)
        assert caplog.text.count(", once") == 1
        assert {image.path: image.path.stat().st_mtime_ns for image in second.images} == changed
        content["poses"]["lever_arm_m"] = [1.0, 0.0, 0.5]  # how poses are understood needs no new import
        read(tmp_path / "drive", content)
        assert caplog.text.count(", once") == 1
        first.images[0].path.write_bytes(b"cut")
        content["poses"].pop("lever_arm_m")
        mended = read(tmp_path / "drive", content)
        assert caplog.text.count(", once") == 2
        (poses,) = (tmp_path / "drive" / "cache").glob("*/positions.txt")
        poses.write_text(poses.read_text().replace("1", "2", 1))
        mended = read(tmp_path / "drive", content)
        assert caplog.text.count(", once") == 3
    assert_same_drive(mended, read_drive(folder))
    assert not list((tmp_path / "drive" / "cache").glob(".*"))


def test_another_recording_under_the_same_name_is_imported_anew(folder, tmp_path):
    bag = write_ros1(tmp_path / "site", messages_of(folder, ros1=True))
    count = len(read(tmp_path / "drive", topics_for(folder, bag)).images)
    bag.unlink()
    messages = messages_of(folder, ros1=True)
    last_s = max(row[0] for row in messages.rows if "image" in row[1])
    messages.rows = [row for row in messages.rows if row[0] < last_s or "image" not in row[1]]
    write_ros1(tmp_path / "site", messages)
    assert len(read(tmp_path / "drive", topics_for(folder, bag)).images) == count - 2


def test_a_bag_in_parts_is_read_through(folder, tmp_path):
    messages = messages_of(folder)
    parts = tmp_path / "parts"
    parts.mkdir()
    for number in range(2):
        half = Messages(rows=[row for row in messages.rows if (row[0] > 101.0) == bool(number)])
        (file,) = write_ros2(tmp_path / f"part_{number}", half).glob("*.mcap")
        file.rename(parts / f"wbag_{number}.mcap")
    assert_same_drive(read(tmp_path / "drive", topics_for(folder, parts)), read_drive(folder))


def cut(path, share):
    file = path if path.is_file() else next(path.glob("*[!l]"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    return path


@pytest.mark.parametrize("share", [0.0, 0.4, 0.999])
@pytest.mark.parametrize("kind", CONTAINERS)
def test_a_bag_that_is_cut_off_is_one_line(kind, share, folder, tmp_path):
    bag = cut(CONTAINERS[kind](tmp_path / "site", folder), share)
    with pytest.raises(DriveError, match=r"copy it again") as caught:
        read(tmp_path / "drive", topics_for(folder, bag))
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "drive").glob("cache/*"))


def test_a_topic_that_is_not_there_or_of_another_type_is_named(folder, bags, tmp_path):
    for name, message in (
        ("/nowhere", r"no topic /nowhere; topics of type .*: /odom"),
        ("/sensing/front/camera_info", r"has type sensor_msgs/msg/CameraInfo, expected .*Odometry"),
    ):
        with pytest.raises(DriveError, match=message):
            read(tmp_path / "drive", topics_for(folder, bags["mcap"], poses={"topic": name}))
    content = topics_for(folder, bags["mcap"])
    content["cameras"]["front"]["images"] = {"topic": "/odom"}
    with pytest.raises(DriveError, match=r"camera 'front', images: topic /odom .*it has: /sensing/front"):
        read(tmp_path / "drive", content)
    content.pop("bag")
    with pytest.raises(DriveError, match="the drive has no bag"):
        read(tmp_path / "drive", content)


def test_a_type_that_the_bag_does_not_define_is_named_only_if_it_is_wanted(folder, tmp_path):
    bag = write_ros2(tmp_path / "own", messages_of(folder), SQLITE3)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE topics SET type = 'own_msgs/msg/Odd' WHERE name = '/tf_static'")
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert_same_drive(read(tmp_path / "drive", topics_for(folder, bag)), read_drive(folder))
    poses = {"topic": "/tf", "frame": "map", "vehicle": "base_link"}
    with pytest.raises(DriveError, match=r"topic /tf_static .*own_msgs/msg/Odd, expected TFMessage"):
        read(tmp_path / "drive", topics_for(folder, bag, poses=poses))


def _restamped(folder, topic, stamp_of_number):
    """The messages of ``folder`` whose headers on ``topic`` have other times, s, by their numbers from 0."""
    messages = messages_of(folder)
    headers = [row[2].header for row in messages.rows if row[1] == topic]
    for number, stamp_s in stamp_of_number.items():
        stamp = headers[number].stamp
        stamp.sec, stamp.nanosec = int(stamp_s), round(stamp_s % 1 * 1e9)
    return messages


def test_images_on_two_clocks_are_named(folder, tmp_path):
    bag = write_ros2(tmp_path / "clocks", _restamped(folder, FRONT, {2: 7}))
    with pytest.raises(DriveError, match=r"image_raw: image 3: its time 7\.000000 s .* two clocks"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_images_that_come_late_or_twice_or_have_no_time_are_sorted_or_dropped_and_counted(
    folder, tmp_path, caplog
):
    expected = read_drive(folder)
    times = front_times(expected)
    pixels = {(image.camera, image.stamp_s): cv2.imread(str(image.path)) for image in expected.images}
    for name, messages, expected_times in (
        ("late", messages_of(folder), times),
        ("twice", messages_of(folder), times),
        ("zero", _restamped(folder, FRONT, {0: 0}), times[1:]),
    ):
        places = [place for place, row in enumerate(messages.rows) if row[1] == FRONT]
        if name == "late":
            first, second = (messages.rows[place] for place in places[:2])
            messages.rows[places[0]] = (first[0], FRONT, second[2])
            messages.rows[places[1]] = (second[0], FRONT, first[2])
        if name == "twice":
            messages.rows.insert(places[0], messages.rows[places[0]])
        got = read(tmp_path / name, topics_for(folder, write_ros2(tmp_path / f"bag_{name}", messages)))
        assert front_times(got) == expected_times
        for image in got.images:
            np.testing.assert_array_equal(cv2.imread(str(image.path)), pixels[image.camera, image.stamp_s])
    for words in ("sorted images that were late: 1", "whose time repeats: 1", "without a time: 1"):
        assert words in caplog.text


def test_poses_without_a_time_are_dropped_and_counted_or_refused(folder, tmp_path, caplog):
    drive = read_drive(folder)
    bag = write_ros2(tmp_path / "one", _restamped(folder, "/odom", {0: 0}))
    got = read(tmp_path / "drive", topics_for(folder, bag))
    np.testing.assert_array_equal(got.trajectory.stamp_s, drive.trajectory.stamp_s[1:])
    assert "left out 1 of" in caplog.text
    bag = write_ros2(
        tmp_path / "all", _restamped(folder, "/odom", dict.fromkeys(range(len(drive.trajectory.stamp_s)), 0))
    )
    with pytest.raises(
        DriveError, match=r"/odom: \d+ of \d+ messages have no time \(0\); .*stamps: received"
    ):
        read(tmp_path / "again", topics_for(folder, bag))


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_memory_does_not_grow_with_the_bag(kind, folder, tmp_path):
    large = np.random.default_rng(1).integers(0, 255, (240, 320, 3), np.uint8)
    peaks = []
    for count in (10, 40):
        messages = Messages(ros1=kind == "ros1")
        for k in range(count):
            messages.add(1.0 + k, "/image", messages.raw_image(1.0 + k, large, "bgr8", "cam"))
        path, storage = tmp_path / f"site_{count}", MCAP if kind == "mcap" else SQLITE3
        path = write_ros1(path, messages) if messages.ros1 else write_ros2(path, messages, storage)
        del messages
        (tmp_path / f"images_{count}").mkdir()
        tracemalloc.start()
        write_streams(path, {tmp_path / f"images_{count}": ImageStream("/image", "header", "here")})
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 100_000


def test_a_bag_is_not_written_over_whether_it_is_imported_or_was(folder, bags, tmp_path):
    (bag,) = bags["mcap"].glob("*.mcap")
    before = bag.read_bytes()
    for _ in ("imported", "as it was imported"):
        with protected_inputs():
            read(tmp_path / "drive", topics_for(folder, bags["mcap"]))
            with pytest.raises(ConfigError, match="is one of the inputs"):
                replace_text(bag, "ours")
    assert bag.read_bytes() == before


def test_notes_beside_an_import_stay_when_it_is_made_anew(folder, bags, tmp_path):
    content = topics_for(folder, bags["mcap"])
    image = read(tmp_path / "drive", content).images[0].path
    notes = [image.parent / "notes.md", image.parent / "photos" / "a.txt"]
    for path in notes:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    image.write_bytes(b"damaged")
    assert read(tmp_path / "drive", content).images[0].path.read_bytes() != b"damaged"
    assert [path.read_text() for path in notes] == ["mine", "mine"]
    assert len(list(image.parent.glob("*kept*"))) == 0


def test_an_image_of_a_bag_has_one_name_from_wherever_the_cache_is_named(folder, bags, tmp_path, monkeypatch):
    """Or else the pictures of a report that is made again are those of no image."""
    root = tmp_path / "drive"
    root.mkdir()
    (root / "drive.yaml").write_text(yaml.safe_dump(topics_for(folder, bags["mcap"])))
    names = []
    for here, path, cache in ((tmp_path, "drive", "cache"), (root, str(root), str(tmp_path / "cache"))):
        monkeypatch.chdir(here)
        drive = read_drive(Path(path), ReadOptions(cache=cache))
        names.append([drive.name_of(image.path) for image in drive.images])
    assert names[0] == names[1]
