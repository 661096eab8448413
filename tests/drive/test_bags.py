"""One drive in every container is the same drive; damaged containers end in one line."""

import json
import logging
import re
import shutil
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml
from backports import zstd
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.drive.bags import (
    FFMPEG,
    VIDEO,
    Messages,
    assert_mounted,
    assert_same_drive,
    assert_same_poses,
    messages_of,
    mountings,
    topics_for,
    write_ros1,
    write_ros2,
)
from tests.drive.example import make_drive
from tests.faults.again import list_again
from v2hdm.cli.main import run
from v2hdm.detection.frames import video_frames
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.drive import ReadOptions, drive_name, read_drive
from v2hdm.io.drive.sources import _import_video
from v2hdm.io.importers.bag import reading
from v2hdm.io.importers.bag.messages import file_of
from v2hdm.io.importers.bag.streams import ImageStream, TfStream, import_streams, write_streams
from v2hdm.safe import child
from v2hdm.safe.databases import opened
from v2hdm.store.files import replace_text
from v2hdm.store.inputs import protected_inputs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive with a picture in its images, so that a wrong channel or row would be seen."""
    root = tmp_path_factory.mktemp("folder")
    drive = make_drive(root)
    rng = np.random.default_rng(5)
    for image in drive.images:
        cv2.imwrite(str(image.path), rng.integers(0, 255, (48, 64, 3), np.uint8))
    return root


def _ros2(storage, compression):
    return lambda path, folder: write_ros2(path, messages_of(folder), storage, compression)


SQLITE3, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
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


def read(root, content):
    root.mkdir(exist_ok=True)
    (root / "drive.yaml").write_text(yaml.safe_dump(content))
    return read_drive(root, ReadOptions(cache=str(root / "cache")))


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
    asked = re.findall(r"--set (\S+)=", capsys.readouterr().err)
    assert sorted(asked) == ["cameras.front.mounting", "cameras.rear.mounting"]
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
    made = messages_of(folder, ros1=True)
    last_s = max(row[0] for row in made.rows if "image" in row[1])
    made.rows = [row for row in made.rows if row[0] < last_s or "image" not in row[1]]
    write_ros1(tmp_path / "site", made)
    assert len(read(tmp_path / "drive", topics_for(folder, bag)).images) == count - 2


def test_a_bag_in_parts_is_read_through(folder, tmp_path):
    made = messages_of(folder)
    parts = tmp_path / "parts"
    parts.mkdir()
    for number in range(2):
        half = Messages(rows=[row for row in made.rows if (row[0] > 101.0) == bool(number)])
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
        ("/sensing/front/camera_info", r"is of type sensor_msgs/msg/CameraInfo, expected .*Odometry"),
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
    made = messages_of(folder)
    headers = [row[2].header for row in made.rows if row[1] == topic]
    for number, stamp_s in stamp_of_number.items():
        stamp = headers[number].stamp
        stamp.sec, stamp.nanosec = int(stamp_s), round(stamp_s % 1 * 1e9)
    return made


FRONT = "/sensing/front/image_raw"


def _front_times(drive):
    return [image.stamp_s for image in drive.images if image.camera == "front"]


def test_images_on_two_clocks_are_named(folder, tmp_path):
    bag = write_ros2(tmp_path / "clocks", _restamped(folder, FRONT, {2: 7}))
    with pytest.raises(DriveError, match=r"image_raw: image 3: its time 7\.000000 s .* two clocks"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_images_that_come_late_or_twice_or_have_no_time_are_sorted_or_dropped_and_counted(
    folder, tmp_path, caplog
):
    expected = read_drive(folder)
    times = _front_times(expected)
    pixels = {(image.camera, image.stamp_s): cv2.imread(str(image.path)) for image in expected.images}
    for name, made, kept in (
        ("late", messages_of(folder), times),
        ("twice", messages_of(folder), times),
        ("zero", _restamped(folder, FRONT, {0: 0}), times[1:]),
    ):
        places = [place for place, row in enumerate(made.rows) if row[1] == FRONT]
        if name == "late":
            first, second = (made.rows[place] for place in places[:2])
            made.rows[places[0]] = (first[0], FRONT, second[2])
            made.rows[places[1]] = (second[0], FRONT, first[2])
        if name == "twice":
            made.rows.insert(places[0], made.rows[places[0]])
        got = read(tmp_path / name, topics_for(folder, write_ros2(tmp_path / f"bag_{name}", made)))
        assert _front_times(got) == kept
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


@pytest.mark.parametrize(
    ("encoding", "channels"), [("mono8", 1), ("bgr8", 3), ("rgb8", 3), ("bgra8", 4), ("rgba8", 4)]
)
def test_raw_images_keep_every_bit(encoding, channels):
    made = Messages()
    pixels = np.random.default_rng(1).integers(0, 255, (6, 7, channels), np.uint8)
    suffix, data = file_of(
        "sensor_msgs/msg/Image", made.raw_image(1.0, pixels, encoding, "cam", pad=3), "here"
    )
    got = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    colour = pixels[..., :3] if channels > 1 else np.repeat(pixels, 3, axis=2)
    assert suffix == ".png"
    np.testing.assert_array_equal(got, colour[..., ::-1] if encoding.startswith("rgb") else colour)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_is_read_as_ros_names_it(pattern):
    """A plane of one colour: behind every filter its own channel's value."""
    value = {"r": 200, "g": 120, "b": 30}
    tile = np.array([value[letter] for letter in pattern], np.uint8).reshape(2, 2)
    made = Messages().raw_image(1.0, np.tile(tile, (4, 4))[..., None], f"bayer_{pattern}8", "cam")
    got = cv2.imdecode(np.frombuffer(file_of("sensor_msgs/msg/Image", made, "here")[1], np.uint8), 1)
    np.testing.assert_array_equal(got, np.broadcast_to([30, 120, 200], got.shape))


COMPRESSED = "sensor_msgs/msg/CompressedImage"
TILE = np.array([[200, 120], [120, 30]], np.uint8)  # red, green; green, blue


def _unpacked(form, data):
    suffix, content = file_of(COMPRESSED, Messages().compressed(1.0, data, form, "cam"), "here")
    return suffix, cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(
    "form",
    ["bayer_rggb8; jpeg compressed ", "bayer_rggb8; jpeg compressed", "bayer_rggb8;png", "bayer_rggb8"],
)
@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_a_mosaic_that_was_compressed_as_it_is_gets_its_colours(form, ending):
    mosaic = np.tile(TILE, (16, 16))
    suffix, got = _unpacked(form, cv2.imencode(ending, mosaic, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes())
    assert suffix == ".png"
    np.testing.assert_allclose(got, np.broadcast_to([30, 120, 200], got.shape), atol=3)


@pytest.mark.parametrize(
    ("form", "shape"),
    [
        ("bayer_rggb8; jpeg compressed bgr8", (32, 32, 3)),
        ("bayer_rggb8; jpeg compressed mono8", (32, 32)),
        ("mono8; jpeg compressed ", (32, 32)),
        ("bayer_rggb8; jpeg compressed ", (32, 32, 3)),  # whatever it says, it has colours
        ("jpeg", (32, 32, 3)),
        ("", (32, 32)),
    ],
)
@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp", ".tif", ".bmp"])
def test_other_compressed_images_are_kept_as_they_are(form, shape, ending):
    pixels = np.random.default_rng(2).integers(0, 255, shape, np.uint8)
    data = cv2.imencode(ending, pixels)[1].tobytes()
    suffix, content = file_of(COMPRESSED, Messages().compressed(1.0, data, form, "cam"), "here")
    assert (suffix, content) == (ending, data)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_colours_of_half_a_size_stand_below_the_brightness(encoding):
    planes = np.full((12, 8, 1), 128, np.uint8)
    planes[:8, :, 0] = 90
    planes[8:, 1::2, 0] = 180  # V of NV12, U of NV21: much red, or much blue
    message = Messages().raw_image(1.0, planes, encoding, "cam")
    message.height = 8
    got = cv2.imdecode(np.frombuffer(file_of("sensor_msgs/msg/Image", message, "here")[1], np.uint8), 1)
    assert got.shape == (8, 8, 3)
    strongest = got[0, 0].argmax()
    assert strongest == (2 if encoding == "nv12" else 0)


@pytest.mark.parametrize(("encoding", "width"), [("yuv422", 5), ("nv12", 5)])
def test_sizes_that_an_encoding_cannot_have_are_named(encoding, width):
    channels = 2 if encoding == "yuv422" else 1
    message = Messages().raw_image(1.0, np.zeros((9, width, channels), np.uint8), encoding, "cam")
    message.height = 6
    with pytest.raises(DriveError, match="here: "):
        file_of("sensor_msgs/msg/Image", message, "here")


def test_compressed_images_of_16_bits_or_of_depth_are_named():
    sixteen = cv2.imencode(".png", np.zeros((20, 20), np.uint16))[1].tobytes()
    with pytest.raises(DriveError, match="here: its PNG has 16 bits per channel"):
        _unpacked("mono16; png compressed ", sixteen)
    with pytest.raises(DriveError, match=r"compressed as '16UC1; compressedDepth png'; record JPEG"):
        _unpacked("16UC1; compressedDepth png", bytes(12) + sixteen)


def test_messages_without_an_image_are_left_out_and_counted(folder, tmp_path, caplog):
    made = messages_of(folder)
    empty = next(row[2] for row in made.rows if row[1] == FRONT)
    empty.data, empty.width, empty.height, empty.step = empty.data[:0], 0, 0, 0
    got = read(tmp_path / "drive", topics_for(folder, write_ros2(tmp_path / "site", made)))
    assert _front_times(got) == _front_times(read_drive(folder))[1:]
    assert "left out 1 of 3 images, which are empty" in caplog.text


def test_images_of_an_unknown_encoding_are_named(folder, tmp_path):
    made = messages_of(folder)
    for _, name, message in made.rows:
        if name == "/sensing/front/image_raw":
            message.encoding = "16UC1"
    with pytest.raises(DriveError, match="image 1: encoding '16UC1' is not known; record one of mono8"):
        read(tmp_path / "drive", topics_for(folder, write_ros2(tmp_path / "site", made)))


H265 = "lossless=1:bframes=0:keyint=2:min-keyint=2:repeat-headers=1:log-level=0"
LOSSLESS: dict[str, Any] = {
    "libx264rgb": ("rgb24", {"crf": "0", "bf": "0", "preset": "ultrafast", "g": "2"}),
    "libx265": ("gbrp", {"x265-params": H265}),
}


@pytest.mark.parametrize(
    ("codec", "kind", "stated"),
    [
        ("libx264rgb", VIDEO, "h264"),
        ("libx265", VIDEO, "h265"),
        ("libx264rgb", COMPRESSED, "h264"),
        ("libx265", COMPRESSED, "hevc"),
        ("libx264rgb", FFMPEG, "h264_nvenc"),
        ("libx265", FFMPEG, "hevc;yuv420p;bgr8;bgr8"),
    ],
)
def test_video_in_a_bag_is_decoded_from_its_first_key_frame_on(codec, kind, stated, folder, tmp_path, caplog):
    """A packet a message without loss; the recording began two packets too late."""
    expected = read_drive(folder)
    pictures = [cv2.imread(str(image.path)) for image in expected.images if image.camera == "front"]
    pictures = [pictures[0], pictures[1], *pictures]
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.time_base = 64, 48, Fraction(1, 10)
    encoder.pix_fmt, encoder.options = LOSSLESS[codec]
    packets: list[bytes] = []
    for number, pixels in enumerate([*pictures, None]):
        frame = None if pixels is None else av.VideoFrame.from_ndarray(pixels, format="bgr24")
        if frame is not None:
            frame = frame.reformat(format=encoder.pix_fmt)
            frame.pts = number
        packets += [bytes(packet) for packet in encoder.encode(frame)]
    made = messages_of(folder)
    rows = [row for row in made.rows if row[1] == "/sensing/front/image_raw"]
    made.rows = [row for row in made.rows if row[1] != "/sensing/front/image_raw"]
    # The first packet of all is a key frame: leave it out, and the one after it has none.
    begin_s = rows[0][0] - 0.04
    for stamp_s, packet in zip([begin_s, *(row[0] for row in rows)], packets[1:], strict=True):
        message = made.packet(kind, stamp_s, packet, stated, "front_optical")
        made.add(stamp_s, "/sensing/front/image_raw", message)
    made.rows.sort(key=lambda row: row[0])
    bag = write_ros2(tmp_path / "site", made)
    with caplog.at_level(logging.WARNING):
        assert_same_drive(read(tmp_path / "drive", topics_for(folder, bag)), expected)
    assert "left out 1 of 4 packets of video: no key frame before them" in caplog.text


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_memory_does_not_grow_with_the_bag(kind, folder, tmp_path):
    large = np.random.default_rng(1).integers(0, 255, (240, 320, 3), np.uint8)
    peaks = []
    for count in (10, 40):
        made = Messages(ros1=kind == "ros1")
        for k in range(count):
            made.add(1.0 + k, "/image", made.raw_image(1.0 + k, large, "bgr8", "cam"))
        path, storage = tmp_path / f"site_{count}", MCAP if kind == "mcap" else SQLITE3
        path = write_ros1(path, made) if made.ros1 else write_ros2(path, made, storage)
        del made
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


HOSTILE = {
    "a constant in parentheses": "module a { module msg { const long X = (1); struct B { long x; }; }; };",
    "nested parentheses": "@a(b((1))) struct B { long x; };",
    "a trillion texts": "string[1000000000000] names",
    "a trillion texts at most": "string[<=1000000000000] names",
    "more digits than a number has": f"uint8[{'9' * 5000}] data",
    "nested brackets": "uint8" + "[" * 3000,
    "four million letters": "uint8 a\n" * 500_000,
    "thousands of no bytes": f"a_msgs/B[9999] x\n{'=' * 80}\nMSG: a_msgs/B\n",
    "thousands of none each": f"a_msgs/B[9999] x\n{'=' * 80}\nMSG: a_msgs/B\nuint8[0] y\n",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_definition_that_would_be_parsed_for_ever_is_refused(name, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        values = ("ros2idl" if "struct" in HOSTILE[name] else "ros2msg", HOSTILE[name])
        database.execute(
            "UPDATE message_definitions SET encoding = ?, encoded_message_definition = ?", values
        )
    database.close()
    with pytest.raises(DriveError, match="its definition is not from a recording"):
        read(tmp_path / "drive", topics_for(folder, bag))


COMPUTED = {
    "a view": "DROP TABLE schema; CREATE VIEW schema AS SELECT 4 AS schema_version",  # it might be endless
    "a virtual table": "DROP TABLE schema; CREATE VIRTUAL TABLE schema USING rtree(schema_version, a, b)",
    "a computed column": "ALTER TABLE messages ADD more AS (zeroblob(1000000000))",
    "an index of definitions": "CREATE INDEX again ON message_definitions (id)",
}


@pytest.mark.parametrize("sql", COMPUTED.values(), ids=COMPUTED)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE])
def test_a_database_that_computes_its_rows_is_refused(mode, sql, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3, mode)
    (file,) = bag.glob("*.db3*")
    plain = tmp_path / "plain.db3"
    plain.write_bytes(
        zstd.decompress(file.read_bytes()) if mode == CompressionMode.FILE else file.read_bytes()
    )
    with closing(sqlite3.connect(plain)) as database:
        database.executescript(sql)
    data = plain.read_bytes()
    file.write_bytes(zstd.compress(data) if mode == CompressionMode.FILE else data)
    with pytest.raises(DriveError, match="is no plain table of a recording"):
        read(tmp_path / "drive", topics_for(folder, bag))


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_zeros_that_would_unpack_to_all_of_the_memory_are_refused(mode, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3, mode)
    bomb = zstd.compress(bytes(260_000_000))
    if mode == CompressionMode.FILE:
        (file,) = bag.glob("*.zstd")
        file.write_bytes(bomb)
    else:
        (file,) = bag.glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute("UPDATE messages SET data = ?", (bomb,))
        database.close()
    with pytest.raises(DriveError, match="unpacks to more than a recording could"):
        read(tmp_path / "drive", topics_for(folder, bag))


DATA = """CREATE TABLE bare (id INTEGER PRIMARY KEY, topic_id, timestamp);
INSERT INTO bare SELECT id, topic_id, timestamp FROM messages; DROP TABLE messages;
ALTER TABLE bare RENAME TO messages; ALTER TABLE messages ADD data DEFAULT '{}'"""
MANY: dict[str, Callable[[Path], None]] = {
    "messages": lambda file: list_again(file, "messages"),
    "topics": lambda file: list_again(file, "topics"),
    "definitions": lambda file: list_again(file, "message_definitions"),
    "definitions that are one default": lambda file: executed(
        file, f"ALTER TABLE message_definitions ADD more DEFAULT '{'x' * 100_000}'"
    ),
    "messages that are one default": lambda file: executed(file, DATA.format("x" * 100_000)),
}


def executed(file, sql):
    with closing(sqlite3.connect(file)) as database:
        database.executescript(sql)


@pytest.mark.parametrize("name", MANY)
def test_more_rows_than_a_database_has_bytes_are_refused(name, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    MANY[name](next(bag.glob("*.db3")))
    with pytest.raises(DriveError, match=r"interrupted|more rows than bytes|more bytes than it"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_no_query_of_a_database_takes_longer_than_its_bytes_need(tmp_path):
    """Whoever asks, be it of the schema alone, which is read again and again if its pages say so."""
    path, upward = tmp_path / "a.db3", "SELECT 1 UNION ALL SELECT k + 1 FROM n LIMIT 3000000"
    executed(path, "CREATE TABLE a (b)")
    with opened(path, "mode=ro") as data, pytest.raises(sqlite3.OperationalError, match="interrupt"):
        data.execute(f"WITH RECURSIVE n(k) AS ({upward}) SELECT max(k) FROM n").fetchall()


def test_profiles_of_service_that_would_be_parsed_for_ever_end_in_one_line(folder, tmp_path, monkeypatch):
    """In YAML, some thousand bytes that merge mappings take for ever."""
    monkeypatch.setattr(child, "_STEP_S", 2.0)
    bomb = "- &a0 {history: 1}\n" + "".join(f"- &a{k + 1} {{<<: [*a{k}, *a{k}]}}\n" for k in range(40))
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    (file,) = bag.glob("*.db3")
    executed(file, f"UPDATE topics SET offered_qos_profiles = '{bomb}'")
    with pytest.raises(DriveError, match=r"bag: takes more than 2 s of a processor for one piece"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_a_chunk_that_the_index_lists_many_times_is_refused(folder, tmp_path):
    """All of them are held at once, for they are of one time."""
    bag = write_ros2(tmp_path / "bag", messages_of(folder))
    (file,) = bag.glob("*.mcap")
    data, summary, at = file.read_bytes(), b"", 0
    (begin,) = struct.unpack("<Q", data[-28:-20])  # in the footer, see https://mcap.dev/spec
    at = begin
    while at < len(data) - 37:
        end = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
        summary += data[at:end] * (50 if data[at] == 8 else 1)
        at = end
    file.write_bytes(data[:begin] + summary + data[-37:-20] + bytes(12) + data[-8:])
    with pytest.raises(DriveError, match="its index lists a chunk twice"):
        read(tmp_path / "drive", topics_for(folder, bag))


PACKED: dict[str, Callable[[Path, Messages], Path]] = {
    "ros1 lz4": lambda path, made: write_ros1(path, made, "lz4"),
    "ros1 bz2": lambda path, made: write_ros1(path, made, "bz2"),
    "mcap zstd chunks": lambda path, made: write_ros2(path, made, MCAP, CompressionMode.STORAGE),
}


@pytest.mark.parametrize("kind", PACKED)
def test_chunks_of_zeros_are_refused_together_though_none_is_alone(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "_SPARE_BYTES", 4_000_000)
    made = Messages(kind.startswith("ros1"))
    for number in range(10):
        zeros = made.raw_image(1.0 + number, np.zeros((600, 1000, 3), np.uint8), "rgb8", "front")
        made.add(1.0 + number, "/image", zeros)
    bag = PACKED[kind](tmp_path / "bag", made)
    images = {tmp_path: ImageStream("/image", "header", "here")}
    with pytest.raises(DriveError, match="unpacks to more than a recording could"):
        write_streams(bag, images)
    made.rows = made.rows[:1]
    write_streams(PACKED[kind](tmp_path / "one", made), images)


@pytest.mark.parametrize("kind", PACKED)
def test_a_message_of_zeros_is_refused(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "_SPARE_BYTES", 1_000_000)
    made = Messages(kind.startswith("ros1"))
    zeros = np.zeros((2000, 4000, 3), dtype=np.uint8)
    made.add(1.0, "/image", made.raw_image(1.0, zeros, "rgb8", "front"))
    bag = PACKED[kind](tmp_path / "bag", made)
    (file,) = [bag] if bag.is_file() else bag.glob("*.mcap")
    assert file.stat().st_size < 200_000
    with pytest.raises(DriveError, match="unpacks to more than a recording could") as refused:
        write_streams(bag, {tmp_path: ImageStream("/image", "header", "here")})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", ["ros1 lz4", "mcap zstd chunks"])  # bz2 takes seconds
def test_zeros_that_do_not_fit_in_the_childs_memory_are_refused(kind, tmp_path, monkeypatch):
    """Wherever rosbags unpacks them, and by whatever."""
    monkeypatch.setattr(child, "_SPARE_BYTES", 300_000_000)
    made = Messages(kind.startswith("ros1"))
    zeros = np.zeros((10_000, 10_000, 3), dtype=np.uint8)
    made.add(1.0, "/image", made.raw_image(1.0, zeros, "rgb8", "front"))
    bag = PACKED[kind](tmp_path / "bag", made)
    with pytest.raises(DriveError, match="unpacks to more than a recording could") as refused:
        import_streams(bag, [ImageStream("/image", "header", "here")], tmp_path / "cache")
    assert "\n" not in str(refused.value)
    assert not list((tmp_path / "cache").glob("*"))


def test_a_frame_whose_name_has_a_tab_is_refused(folder, tmp_path):
    made = messages_of(folder, mounted={**mountings(), "a\tb": mountings()["front"]})
    bag = write_ros2(tmp_path / "bag", made)
    with pytest.raises(DriveError, match="a frame is named") as refused:
        import_streams(bag, [TfStream("here")], tmp_path / "cache")
    assert "\t" not in str(refused.value)


def _video(path, frames=20, codec="mpeg4", **options):
    with av.open(str(path), "w") as container:
        track = container.add_stream(codec, rate=10, options=options)
        track.width, track.height = 320, 240
        rng = np.random.default_rng(1)
        for _ in range(frames):
            pixels = cv2.resize(rng.integers(0, 255, (24, 32, 3)).astype(np.uint8), (320, 240))
            container.mux(track.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        container.mux(track.encode(None))
    return path.read_bytes()


def test_a_flipped_bit_in_a_video_whose_pictures_carry_hashes_is_reported(tmp_path, caplog):
    """The decoder of H.265 conceals it without a word."""
    path, params = tmp_path / "a.mkv", {"x265-params": "hash=1:log-level=none:keyint=10"}
    flipped = bytearray(_video(path, codec="libx265", **params))
    _import_video(path, tmp_path / "whole", "here")
    assert "decoder error" not in caplog.text
    flipped[len(flipped) // 2] ^= 16
    path.write_bytes(flipped)
    for _ in range(2):  # the second time it is not decoded again
        caplog.clear()
        _import_video(path, tmp_path / "flipped", "here")
        assert len(re.findall(r"a\.mkv: frame \d+: decoder error", caplog.text)) == 1


def test_damage_that_the_decoder_of_a_topics_video_conceals_is_reported_once(tmp_path, caplog):
    path, made = tmp_path / "a.mkv", Messages()
    _video(path, codec="libx264", bf="0")
    with av.open(str(path)) as container:
        start = av.BitStreamFilterContext("h264_mp4toannexb", container.streams.video[0])
        packets = [bytes(one) for packet in container.demux(video=0) for one in start.filter(packet)]
    for number, packet in enumerate(filter(None, packets)):
        damaged = bytearray(packet)
        if number > 5:
            damaged[len(packet) // 2 :] = bytes(len(packet) - len(packet) // 2)
        stamp, data = made.header(1.0 + number, "cam").stamp, np.frombuffer(damaged, np.uint8)
        fields = {"timestamp": stamp, "frame_id": "cam", "data": data, "format": "h264"}
        made.add(1.0 + number, "/video", made.make(VIDEO, **fields))
    stream = ImageStream("/video", "header", "here")
    import_streams(write_ros2(tmp_path / "bag", made), [stream], tmp_path / "cache")
    assert re.search(r"/video: packet 7: decoder error", caplog.text)
    assert caplog.text.count("decoder error") == 1


def test_a_video_that_is_cut_off_turned_or_a_playlist_is_reported(tmp_path, caplog):
    path = tmp_path / "a.mkv"
    whole = _video(path)
    assert len(list(_import_video(path, tmp_path / "whole", "here").glob("*.png"))) == 20
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    path.write_bytes(whole[: len(whole) * 6 // 10])
    assert len(list(_import_video(path, tmp_path / "cut", "here").glob("*.png"))) < 20
    assert "is it cut off?" in caplog.text
    path = tmp_path / "a.mp4"
    turned = bytearray(_video(path))
    matrix = turned.index(b"tkhd") + 44  # ISO/IEC 14496-12, 8.3.2
    turned[matrix : matrix + 36] = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 240 << 16, 0, 1 << 30)
    path.write_bytes(turned)
    with pytest.raises(DriveError, match="frame 1 asks for a rotation"):
        _import_video(path, tmp_path / "turned", "here")
    assert len(list(video_frames(path))) == 20
    assert "rotated by 90 degrees" in caplog.text
    path.write_text("ffconcat version 1.0\nfile a.mkv\n")
    with pytest.raises(DriveError, match="not readable as a video"):
        _import_video(path, tmp_path / "list", "here")
