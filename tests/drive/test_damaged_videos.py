"""Damage of videos is reported, in a file and in a bag."""

import logging
import re
import struct

import av
import cv2
import numpy as np
import pytest

from tests.drive.bags import (
    VIDEO,
    Messages,
    write_ros2,
)
from v2hdm.detection.frames import video_frames
from v2hdm.errors import DriveError
from v2hdm.io.drive.sources import _import_video
from v2hdm.io.importers.bag.streams import ImageStream, import_streams


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
    path, messages = tmp_path / "a.mkv", Messages()
    _video(path, codec="libx264", bf="0")
    with av.open(str(path)) as container:
        start = av.BitStreamFilterContext("h264_mp4toannexb", container.streams.video[0])
        packets = [bytes(part) for packet in container.demux(video=0) for part in start.filter(packet)]
    for number, packet in enumerate(filter(None, packets)):
        damaged = bytearray(packet)
        if number > 5:
            damaged[len(packet) // 2 :] = bytes(len(packet) - len(packet) // 2)
        stamp, data = messages.header(1.0 + number, "cam").stamp, np.frombuffer(damaged, np.uint8)
        fields = {"timestamp": stamp, "frame_id": "cam", "data": data, "format": "h264"}
        messages.add(1.0 + number, "/video", messages.make(VIDEO, **fields))
    stream = ImageStream("/video", "header", "here")
    import_streams(write_ros2(tmp_path / "bag", messages), [stream], tmp_path / "cache")
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
