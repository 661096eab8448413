"""Image folders and videos are the same drive as a list of images."""

import shutil
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from tests.drive.bags import assert_same_drive
from tests.drive.example import description, make_drive
from v2hdm.detection.frames import list_images
from v2hdm.errors import DriveError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.draft import draft_drive

STAMPS = tuple(100.05 + 0.1 * n for n in range(6))


@pytest.fixture
def folder(tmp_path):
    """A drive with pictures without loss at 10 Hz."""
    root = tmp_path / "folder"
    root.mkdir()
    drive = make_drive(root, STAMPS)
    rng = np.random.default_rng(5)
    for image in drive.images:
        cv2.imwrite(str(image.path.with_suffix(".png")), rng.integers(0, 255, (48, 64, 3), np.uint8))
        image.path.unlink()
    for name in drive.cameras:
        listed = root / name / "images.txt"
        listed.write_text(listed.read_text().replace(".jpg", ".png"))
    return root


def write_video(folder, path, codec="ffv1", keep=None):
    """The images of the front camera as a video without loss, its first frame not at zero."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr0" if codec == "ffv1" else "rgb24"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(sorted((folder / "front" / "images").iterdir())[:keep]):
            frame = av.VideoFrame.from_ndarray(cv2.imread(str(image)), format="bgr24")
            frame.pts, frame.time_base = 700 + 100 * number, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def read(root, images):
    with description(root) as content:
        content["cameras"]["front"]["images"] = images
    return read_drive(root, ReadOptions(cache=str(root / "cache")))


def by_camera(drive):
    return sorted(drive.images, key=lambda image: (image.camera, image.stamp_s))


def test_a_video_with_poses_is_the_same_drive(folder):
    expected = read_drive(folder)
    write_video(folder, folder / "front.mkv")
    got = read(folder, {"video": "front.mkv", "start_s": 100.05})
    for image, other in zip(by_camera(got), by_camera(expected), strict=True):
        assert image.camera == other.camera
        assert image.stamp_s == pytest.approx(other.stamp_s, abs=1e-7)
        np.testing.assert_allclose(image.map_from_vehicle, other.map_from_vehicle, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(cv2.imread(str(image.path)), cv2.imread(str(other.path)))
    decoded = [(image.path, image.path.stat().st_mtime_ns) for image in by_camera(got)]
    # Another start needs no decoding; neither does a second reading.
    later = read(folder, {"video": "front.mkv", "start_s": 100.06})
    assert by_camera(later)[0].stamp_s == pytest.approx(100.06)
    assert [(image.path, image.path.stat().st_mtime_ns) for image in by_camera(later)] == decoded
    np.savetxt(folder / "times.txt", STAMPS, fmt="%.9f")
    assert_same_drive(read(folder, {"video": "front.mkv", "stamps": "times.txt"}), expected)


def test_an_image_folder_with_a_file_of_times_or_named_by_them(folder):
    expected = read_drive(folder)
    np.savetxt(folder / "times.txt", STAMPS, fmt="%.9f")
    assert_same_drive(read(folder, {"folder": "front/images", "stamps": "times.txt"}), expected)
    named = folder / "front" / "named"
    named.mkdir()
    for stamp_s, image in zip(STAMPS, sorted((folder / "front" / "images").iterdir()), strict=True):
        shutil.copy(image, named / f"{stamp_s * 1e3:.0f}.png")
    assert_same_drive(read(folder, {"folder": "front/named", "unit": "ms"}), expected)


def test_images_numbered_without_zeros_get_their_own_times_and_hidden_files_none(folder, caplog):
    images = sorted((folder / "front" / "images").iterdir())
    numbered = folder / "front" / "numbered"
    numbered.mkdir()
    for number, image in enumerate(images):
        shutil.copy(image, numbered / f"frame{number + 7}.png")
        (numbered / f"._frame{number + 7}.png").write_bytes(b"\0\5\x16\7Mac OS X")
    (numbered / ".DS_Store").write_bytes(b"\0")
    (numbered / "Thumbs.db").write_bytes(b"\0")
    np.savetxt(folder / "times.txt", STAMPS, fmt="%.9f")
    expected = read_drive(folder)
    assert_same_drive(read(folder, {"folder": "front/numbered", "stamps": "times.txt"}), expected)
    assert [path.stem for path in list_images(numbered)] == [f"frame{number + 7}" for number in range(6)]
    listed = (folder / "front" / "images.txt").read_text()
    lines = [line.replace("images/", "numbered/._") for line in listed.splitlines()[1:]]
    (folder / "front" / "images.txt").write_text("\n".join([*lines, listed]))
    assert_same_drive(read(folder, "front/images.txt"), expected)
    assert "left out 6 files of macOS" in caplog.text
    by_letters = sorted(range(6), key=lambda number: f"frame{number + 7}")
    np.savetxt(folder / "times.txt", [STAMPS[number] for number in by_letters], fmt="%.9f")
    with pytest.raises(DriveError, match=r"in the order of letters, in which 'frame11' comes second"):
        read(folder, {"folder": "front/numbered", "stamps": "times.txt"})


@pytest.mark.parametrize(("codec", "suffix"), [("libx264", "h264"), ("libx265", "hevc")])
def test_a_raw_stream_has_the_times_of_its_file_frame_by_frame(codec, suffix, folder):
    """With B-frames, whose order in the file is not that of the pictures."""
    raw = folder / f"front.{suffix}"
    grey = [40 * number for number in range(6)]
    with av.open(str(raw), "w", format=suffix) as container:
        options = {"bf": "2", "b-adapt": "0", "x265-params": "bframes=2:b-adapt=0:log-level=none"}
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for value in grey:
            picture = np.full((48, 64, 3), value, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    np.savetxt(folder / "times.txt", STAMPS, fmt="%.9f")
    drive = read(folder, {"video": raw.name, "stamps": "times.txt"})
    images = [image for image in by_camera(drive) if image.camera == "front"]
    assert [image.stamp_s for image in images] == pytest.approx(STAMPS, abs=1e-9)
    means = [float(cv2.imread(str(image.path)).mean()) for image in images]
    np.testing.assert_allclose(means, grey, atol=6)
    with pytest.raises(DriveError, match=r"is a raw stream, whose frames have no times.*give stamps"):
        read(folder, {"video": raw.name, "start_s": 100.05})
    np.savetxt(folder / "times.txt", STAMPS[:-1], fmt="%.9f")
    with pytest.raises(DriveError, match=f"5 times for 6 frames of .*{suffix}"):
        read(folder, {"video": raw.name, "stamps": "times.txt"})


def test_a_frame_whose_time_is_late_or_repeats_is_sorted_dropped_and_counted(folder, caplog):
    write_video(folder, folder / "front.mkv")
    times = [*STAMPS[:2], STAMPS[3], STAMPS[2], STAMPS[2], STAMPS[5]]
    np.savetxt(folder / "times.txt", times, fmt="%.9f")
    drive = read(folder, {"video": "front.mkv", "stamps": "times.txt"})
    images = [image for image in by_camera(drive) if image.camera == "front"]
    assert [image.stamp_s for image in images] == pytest.approx([*STAMPS[:4], STAMPS[5]], abs=1e-9)
    assert [image.path.stem for image in images] == ["000000", "000001", "000003", "000002", "000005"]
    assert "sorted frames that were late: 2, dropped frames whose time repeats: 1, of 6" in caplog.text


def test_a_folder_asks_for_what_its_names_leave_open(folder, tmp_path):
    for number, image in enumerate(sorted((folder / "front" / "images").iterdir())):
        for name, stem in (("dates", f"20240131_1015{number:02d}_125"), ("counts", f"{number:06d}")):
            (tmp_path / name).mkdir(exist_ok=True)
            shutil.copy(image, tmp_path / name / f"{stem}.png")
    questions = draft_drive(tmp_path / "dates", tmp_path / "d", [])
    assert "utc, or utc+01:00" in questions["cameras.dates.images.unit"]
    questions = draft_drive(tmp_path / "counts", tmp_path / "d", [])
    assert "a file with a time in s per image" in questions["cameras.counts.images.stamps"]
    questions = draft_drive(tmp_path / "counts", tmp_path / "d", ["cameras.counts.images.unit=s"])
    assert not [key for key in questions if "images" in key]
    (tmp_path / "front.h264").write_bytes(b"")
    assert "cameras.front.images.stamps" in draft_drive(tmp_path / "front.h264", tmp_path / "d", [])
    (tmp_path / "front.mp4").write_bytes(b"")
    questions = draft_drive(tmp_path / "front.mp4", tmp_path / "d", ["cameras.front.images.stamps=a"])
    assert not [key for key in questions if "images" in key]


def test_a_source_that_does_not_fit_is_named(folder):
    write_video(folder, folder / "front.mkv")
    (folder / "times.txt").write_text("1.0\n2.0\n")
    (folder / "text.mp4").write_text("no video")
    (folder / "front" / "images" / "first.png").write_bytes(b"")
    for images, message in (
        ({"video": "front.mkv"}, "add start_s, the time of the first frame"),
        ({"video": "front.mkv", "start_s": "now"}, "start_s: expected a finite number"),
        ({"video": "front.mkv", "stamps": "times.txt"}, "2 times for 6 frames of .*front.mkv"),
        ({"video": "rear.mkv", "start_s": 1}, "rear.mkv: no such video"),
        ({"video": "text.mp4", "start_s": 1}, "text.mp4: not readable as a video"),
        ({"video": "front.mkv", "start": 1}, "unknown key 'start'; did you mean 'start_s'"),
        ({"folder": "front/images"}, "not named by their times; add stamps"),
        ({"folder": "front/images", "stamps": "times.txt"}, "2 times for 7 images in"),
        ({"folder": "front/images", "unit": "h"}, "unit: expected one of s, ms, us, ns"),
        ({"folder": "nowhere"}, "no such folder"),
        ({"folder": "front"}, "no images .* in this folder"),
        ({"list": "a"}, "name one source"),
        ({"topic": "/image"}, "the drive has no bag; add the key bag"),
        (7, "images: expected a text, got 7|expected 'key: value' entries"),
    ):
        with pytest.raises(DriveError, match=message) as caught:
            read(folder, images)
        assert "\n" not in str(caught.value)
    assert not list((folder / "cache").glob(".*"))


@pytest.mark.parametrize("module", ["rosbags", "av", "pyproj"])
def test_a_library_that_is_not_installed_is_named_with_its_extra(module, folder, monkeypatch):
    extra, images = {"rosbags": "ros", "av": "video", "pyproj": "map"}[module], "front/images.txt"
    with description(folder) as content:
        if module == "rosbags":
            (folder / "site.bag").write_bytes(b"#ROSBAG")
            content["bag"] = "site.bag"
            images = {"topic": "/image"}
        elif module == "av":
            images = {"video": str(write_video(folder, folder / "front.mkv")), "start_s": 100.05}
        else:
            (folder / "route.csv").write_text("stamp_s,x_m,y_m,yaw_deg\n100,1,2,3\n103,1,2,3\n")
            content["poses"] = {"csv": "route.csv", "crs": "EPSG:25832", "heading": "true"}
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(
        DriveError, match=rf"needs {module}: install the {extra} extra, pip install 'v2hdm\[{extra}\]'"
    ):
        read(folder, images)
