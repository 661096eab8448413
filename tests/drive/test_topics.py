"""Which topics of a bag are its cameras, its poses and headings, whatever else was recorded."""

import numpy as np
import pytest
import yaml

from tests.drive.bags import messages_of, write_ros2
from v2hdm.cli.main import run
from v2hdm.errors import DriveError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.importers.bag.cameras import choose_cameras
from v2hdm.io.importers.bag.frames import ROW, Frames
from v2hdm.io.importers.bag.samples import ImageSample, InfoSample, Samples

pytestmark = pytest.mark.usefixtures("working_directory")

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TIMES = [10.0 + 0.1 * k for k in range(30)]
LENS = [900.0, 0, 640, 0, 900, 360, 0, 0, 1, *np.eye(3).ravel(), 900, 0, 640, 0, 0, 900, 360, 0, 0, 0, 1, 0]
TREE = Frames(
    {("base_link", frame): np.array([[0, 0, 0, 1, 0, 0, 0, 1, 1.0]]) for frame in ("front", "left")}
)
assert next(iter(TREE._rows.values())).shape == (1, ROW)


def image(name, frame="front", form="bgr8", size=(1280, 720), times=TIMES, **more):
    kind = COMPRESSED if name.endswith(("compressed", "compressedDepth")) else IMAGE
    return ImageSample(
        name=name, kind=kind, messages=len(times), frame=frame, stamp_s=list(times),
        form="jpeg" if kind == COMPRESSED and form == "bgr8" else form, size_px=list(size), **more,
    )  # fmt: skip


def info(name, frame="front", size=(1280, 720), lens=LENS):
    return InfoSample(
        name=name, kind="", messages=30, frame=frame, stamp_s=TIMES, size_px=list(size), lens=list(lens)
    )


def right_of_stereo(name, lens=LENS):
    """Intrinsics of a pair's second camera: P has -f times its baseline."""
    return info(name, lens=[*lens[:21], -108.0, *lens[22:]])


def chosen(*samples):
    images = {sample.name: sample for sample in samples if isinstance(sample, ImageSample)}
    infos = {sample.name: sample for sample in samples if isinstance(sample, InfoSample)}
    return choose_cameras(Samples({}, images, infos, {}, {}), TREE)


LATER = [stamp_s + 0.03 for stamp_s in TIMES]
SAMPLES = {
    "depth": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), info("/c/depth/camera_info", "depth", (640, 480)),
        image("/c/depth/image_rect_raw", "depth", "16UC1", (640, 480)),
        image("/c/aligned_depth/image_raw", form="16UC1"),
    ]),
    "depth in metres": (["/c/image_raw"], [image("/c/image_raw"), image("/c/depth", "left", "32FC1")]),
    "compressed depth": (["/c/image_raw/compressed"], [
        image("/c/image_raw/compressed"),
        image("/c/depth/image_raw/compressedDepth", "left", "16UC1; compressedDepth png"),
        image("/c/depth/image_raw/compressed", "left", "16UC1; png compressed ", is_wide=True),
    ]),
    "thermal": (["/c/image_raw"], [image("/c/image_raw"), image("/flir/image_raw", "left", "mono16")]),
    "labels": (["/c/image_raw"], [image("/c/image_raw"), image("/net/ids", form="32SC1")]),
    "drawn over": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), image("/net/lanes", size=(640, 360)),
    ]),
    "drawn over without a frame": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), image("/net/lanes", "", times=TIMES[::5]),
    ]),
    "drawn over later": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), image("/net/lanes", times=LATER),
    ]),
    "drawn over beside the images": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), image("/c/image_annotated", size=(1920, 1080)),
    ]),
    "raw and rectified": (["/c/image_raw"], [
        image("/c/image_raw"), image("/c/image_rect_color"), info("/c/camera_info"),
    ]),
    "rectified elsewhere": (["/c/image_raw"], [
        image("/c/image_raw"), info("/c/camera_info"), image("/c_rect/image"),
        info("/c_rect/camera_info", lens=[800.0, *LENS[1:]]),
    ]),
    "raw and rectified without intrinsics": (["/c/image_raw"], [
        image("/c/image_raw"), image("/c/image_rect"),
    ]),
    "drawn over as if raw": (["/c/image_rect"], [
        image("/c/image_rect"), info("/c/camera_info"), image("/net/image_raw"),
    ]),
    "rectified alone": (["/c/image_rect"], [image("/c/image_rect"), info("/c/camera_info")]),
    "raw and compressed": (["/c/image_raw"], [image("/c/image_raw"), image("/c/image_raw/compressed")]),
    "raw now and then": (["/c/image_raw/compressed"], [
        image("/c/image_raw", times=TIMES[::10]), image("/c/image_raw/compressed"),
    ]),
    "raw that nothing reads": (["/c/image_raw/compressed"], [
        image("/c/image_raw", form="bayer_rggb16", refusal="16 bits"), image("/c/image_raw/compressed"),
    ]),
    "grey and colour": (["/c/image_color"], [
        image("/c/image_mono", form="mono8"), image("/c/image_color"), info("/c/camera_info"),
    ]),
    "twice by a driver": (["/z/left/image_raw"], [
        image("/z/left/image_raw"), info("/z/left/camera_info"), image("/z/rgb/image_raw"),
        info("/z/rgb/camera_info"),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("name", SAMPLES)
def test_one_sensor_is_one_camera_and_what_is_no_picture_is_none(name):
    topics, samples = SAMPLES[name]
    choice = chosen(*samples)
    assert [camera.image.name for camera in choice.cameras.values()] == topics
    images = [sample for sample in samples if isinstance(sample, ImageSample)]
    assert len(choice.left_out) == len(images) - 1
    assert not set(choice.left_out) & set(choice.cameras)
    # The order in which a bag lists its topics decides nothing.
    again = chosen(*reversed(samples))
    assert again.cameras == choice.cameras


PAIRS = {
    "two frames": [image("/a/image_raw"), image("/b/image_raw", "left")],
    "two frames at one time": [image("/a/image_raw"), info("/a/camera_info"), image("/b/image_raw", "left")],
    "stereo in one frame": [
        image("/s/left/image_rect"), info("/s/left/camera_info"), image("/s/right/image_rect"),
        right_of_stereo("/s/right/camera_info"),
    ],
    "stereo in one frame, raw": [
        image("/s/left/image_raw"), info("/s/left/camera_info"), image("/s/right/image_raw"),
        right_of_stereo("/s/right/camera_info", [905.0, *LENS[1:]]),
    ],
    "one frame by default, without intrinsics": [
        image("/a/image_raw", "camera"), image("/b/image_raw", "camera", times=LATER),
    ],
    "one frame by default, at one time": [image("/a/image_raw", "camera"), image("/b/image_raw", "camera")],
    "one frame by default, one calibrated": [
        image("/a/image_raw"), info("/a/camera_info"), image("/b/image_raw"),
    ],
    "no frames, two clocks": [image("/a/image_raw", ""), image("/b/image_raw", "", times=LATER)],
}  # fmt: skip


@pytest.mark.parametrize("name", PAIRS)
def test_two_sensors_are_two_cameras(name):
    choice = chosen(*PAIRS[name])
    assert len(choice.cameras) == 2
    assert not choice.left_out


def test_intrinsics_elsewhere_are_a_camera_s_if_they_are_of_its_frame_and_size():
    images = image("/front/image_raw")
    choice = chosen(images, info("/calibration/front"), info("/calibration/left", "left"))
    assert choice.cameras["front"].info.name == "/calibration/front"
    assert chosen(images, info("/calibration/front", size=(640, 360))).cameras["front"].info is None


def read(path, **options):
    return read_drive(path, ReadOptions(cache="cache", **options))


def with_decoys(folder, encoding="16UC1", ros1=False):
    """The drive in ``folder`` with a camera of depth that has a frame of its own, and images with lanes."""
    messages = messages_of(folder, ros1=ros1)
    for stamp_s, topic, message in list(messages.rows):
        if topic == "/sensing/front/camera_info":
            depth = np.zeros((12, 16), np.float32 if encoding == "32FC1" else np.uint16)
            rows = depth.view(np.uint8).reshape(12, -1)
            picture = messages.raw_image(stamp_s, rows, encoding, "depth_optical")
            picture.width = 16
            messages.add(stamp_s, "/sensing/depth/image_raw", picture)
            messages.add(stamp_s, "/sensing/depth/camera_info", message)
            drawn = messages.raw_image(stamp_s, np.zeros((48, 64, 3), np.uint8), "bgr8", "front_optical")
            messages.add(stamp_s, "/lanes/debug", drawn)
    messages.rows.sort(key=lambda row: row[0])
    return messages


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16"])
def test_a_bag_with_depth_and_drawn_images_has_the_cameras_alone(encoding, folder, tmp_path, caplog):
    caplog.set_level("INFO", "v2hdm.io")
    drive = read(write_ros2(tmp_path / "site", with_decoys(folder, encoding)))
    assert list(drive.cameras) == ["front", "rear"]
    assert f"/sensing/depth/image_raw left out: its images are '{encoding}'" in caplog.text
    assert "/lanes/debug left out" in caplog.text


def test_a_camera_is_left_out_by_null_or_by_naming_the_others(folder, tmp_path, capsys):
    bag = write_ros2(tmp_path / "site", with_decoys(folder))
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write"]
    assert run([*check, "null", "--set", "cameras.rear=null", "cameras.depth=null"]) in (0, 3)
    assert run([*check, "named", "--camera", "front"]) in (0, 3)
    for name in ("null", "named"):
        assert list(yaml.safe_load((tmp_path / name / "drive.yaml").read_text())["cameras"]) == ["front"]
    assert list(read(bag, cameras=["front"]).cameras) == ["front"]
    for said, message in {
        "cameras.raer=null": "cameras.raer: no camera of that name; choose from: front, rear",
        "cameras.depth.camera_info=a.yaml": "cameras.depth: /sensing/depth/image_raw is left out: its",
        "cameras.debug.camera_info=a.yaml": "cameras.debug.images.topic=/lanes/debug takes it in",
        "cameras.x.images.topic=/none": "no images on /none; on /lanes/debug, /sensing/depth/image_raw",
    }.items():
        capsys.readouterr()
        assert run([*check, "wrong", "--set", said]) == 2
        error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
        assert len(error) == 1
        assert message in error[0]
    settings = ["--set", "cameras.rear=null", "cameras.front=null"]
    assert run([*check, "wrong", *settings]) == 2
    assert "no camera is left" in capsys.readouterr().err
    assert not (tmp_path / "wrong").exists()


def test_a_topic_that_was_left_out_is_taken_in_by_its_name(folder, tmp_path):
    bag = write_ros2(tmp_path / "site", with_decoys(folder))
    said = ["images.topic=/lanes/debug", "camera_info.topic=/sensing/front/camera_info"]
    settings = [f"cameras.lanes.{setting}" for setting in said]
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write", "d", "--set", *settings]
    assert run(check) in (0, 3)
    cameras = yaml.safe_load((tmp_path / "d" / "drive.yaml").read_text())["cameras"]
    assert list(cameras) == ["front", "rear", "lanes"]
    assert cameras["lanes"]["mounting"] == cameras["front"]["mounting"]


def test_a_bag_of_depth_alone_has_no_camera(folder, tmp_path):
    messages = with_decoys(folder)
    messages.rows = [
        row
        for row in messages.rows
        if "front" not in row[1] and "rear" not in row[1] and row[1] != "/lanes/debug"
    ]
    with pytest.raises(DriveError, match=r"no camera is left; .*'16UC1'"):
        read(write_ros2(tmp_path / "site", messages))
