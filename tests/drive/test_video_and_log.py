"""A video and a receiver's log are a drive by the command of the documents, as it is typed there."""

import shlex
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from tests.drive.example import make_drive
from tests.drive.test_nmea import bend, gga, hdt, rmc
from tests.drive.test_poses import place
from v2hdm.cli.main import run
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive import read_drive

ROOT = Path(__file__).parents[2]
RATE_HZ = 10


def command():
    """The arguments of the command of docs/bags.md on a video and a log, and its first frame's time, s."""
    text = (ROOT / "docs" / "bags.md").read_text(encoding="utf-8")
    block = next(block for block in text.split("```") if "check front.mp4" in block)
    arguments = shlex.split(block.split("\n", 2)[2].replace("\\\n", " "))
    (start,) = (word.partition("=")[2] for word in arguments if "start_s" in word)
    return arguments[1:], float(start)


def write_mp4(path, pictures):
    """The pictures as the H.264 that phones and action cameras write."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for number, pixels in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
            frame.pts, frame.time_base = number, Fraction(1, RATE_HZ)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def write_log(path, lever_arm_m):
    """The log of an antenna on a vehicle that drives bends; where it was, and its headings, rad from east."""
    stamp_s, points, yaw = bend()
    zeros = np.zeros(len(yaw))
    rotation = rotation_from_euler(zeros, zeros, yaw)
    places = place(points + rotation @ np.array(lever_arm_m))
    lines = [
        line
        for k in range(len(stamp_s))
        for line in (gga(stamp_s[k], places[k]), hdt(yaw[k]), rmc(stamp_s[k]))
    ]
    path.write_text("\r\n".join(lines) + "\r\n")
    return stamp_s, points, yaw


def test_a_video_and_a_log_are_a_drive_by_the_command_as_it_is_typed(tmp_path, monkeypatch, capsys, caplog):
    arguments, start_s = command()
    make_drive(tmp_path)
    rng = np.random.default_rng(7)
    pictures = [cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (64, 48)) for _ in range(20)]
    write_mp4(tmp_path / "front.mp4", pictures)
    stamp_s, points, yaw = write_log(tmp_path / "log.nmea", (1.2, 0.0, 1.8))
    monkeypatch.chdir(tmp_path)
    assert run([*arguments, "--no-ground", "--workers=1"]) in (0, 3), (
        capsys.readouterr().err
    )  # noise may fail what it likes
    assert "error" not in capsys.readouterr().err
    drive = read_drive(tmp_path / "drives" / "video")
    images = [image for image in drive.images if image.camera == "front"]
    np.testing.assert_allclose(
        [image.stamp_s for image in images], start_s + np.arange(20) / RATE_HZ, atol=1e-6
    )
    for image, pixels in zip(images, pictures, strict=True):
        off = cv2.absdiff(cv2.imread(str(image.path)), pixels).mean()
        assert off < 8
        at = np.array([np.interp(image.stamp_s, stamp_s, axis) for axis in points.T])
        first = drive.trajectory.map_from_vehicle[0, :3, 3] - points[0]
        np.testing.assert_allclose(image.map_from_vehicle[:3, 3] - first, at, atol=0.02)
        heading = np.arctan2(image.map_from_vehicle[1, 0], image.map_from_vehicle[0, 0])
        assert abs(heading - np.interp(image.stamp_s, stamp_s, yaw)) < 1e-3
    assert "no time" not in caplog.text
