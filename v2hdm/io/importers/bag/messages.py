"""Messages of bags: images and video as image files, poses and headings as readings."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import DriveError, need, shown
from v2hdm.io.image_lists import has_time
from v2hdm.io.importers.readings import SIGMA_OF_QUALITY_M, Attitudes, Readings, TurnRates
from v2hdm.io.trajectory import checked_rotations, in_order
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.safe.pixels import AS_STORED, pixels_of, png

_log = logging.getLogger(__name__)

RAW = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
VIDEO = "foxglove_msgs/msg/CompressedVideo"
PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
IMAGE_KINDS = (RAW, COMPRESSED, VIDEO, PACKET)

_SUFFIXES: Mapping[bytes, str] = {
    b"\xff\xd8": ".jpg",
    b"\x89PNG\r\n\x1a\n": ".png",
    b"RIFF": ".webp",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"BM": ".bmp",
}
"""The suffix of a compressed image by its first bytes."""
_PNG_DEPTH = slice(24, 25)  # the place of the bits per channel in a PNG (third edition, section 11.2.1)
_BAYER = len("bayer_rggb")  # letters of a mosaic's encoding before its bits

# Channels, and OpenCV's conversion to BGR.
_ENCODINGS: Mapping[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUYV),
}
_HALF_COLOURS: Mapping[str, int] = {"nv12": cv2.COLOR_YUV2BGR_NV12, "nv21": cv2.COLOR_YUV2BGR_NV21}
"""OpenCV's conversion of encodings that state the colours of 2 x 2 px once, below the rows of brightness."""


def file_of(kind: str, fields: Any, where: str) -> tuple[str, bytes]:
    """Suffix and content of an image message's file: raw ones and mosaics as PNG, others as they are."""
    if kind == RAW:
        return ".png", png(_pixels(fields, where))
    data = fields.data.tobytes()
    suffix = next((suffix for begin, suffix in _SUFFIXES.items() if data.startswith(begin)), None)
    if suffix is None:
        raise DriveError(
            f"{where}: compressed as {shown(fields.format)}; record JPEG, PNG, TIFF, WebP or raw images"
        )
    if suffix == ".png" and data[_PNG_DEPTH] == b"\x10":
        raise DriveError(f"{where}: its PNG has 16 bits per channel; record 8 bits")
    return _coloured(fields.format, data, where) or (suffix, data)


def _coloured(form: str, data: bytes, where: str) -> tuple[str, bytes] | None:
    """Suffix and content of a compressed mosaic's file with colours; None of an image that is none.

    ``image_transport`` states the encoding before compression and, only if it made one of them, its colours.
    """
    encoding, _, compression = form.strip().partition(";")
    if not encoding.startswith("bayer_") or any(word in _ENCODINGS for word in compression.split()):
        return None
    pixels = pixels_of(data, Path(where), AS_STORED)
    if pixels.ndim > 2:
        return None
    _, to_bgr = _encoding_of(f"{encoding[:_BAYER]}8", where)
    assert to_bgr is not None
    return ".png", png(_turned(pixels, to_bgr, where))


def _encoding_of(name: str, where: str) -> tuple[int, int | None]:
    """Channels, and OpenCV's conversion to BGR, of the encoding ``name``."""
    if name not in _ENCODINGS:
        supported = ", ".join((*_ENCODINGS, *_HALF_COLOURS))
        raise DriveError(f"{where}: encoding {shown(name)} is not known; record one of {supported}")
    return _ENCODINGS[name]


def _pixels(fields: Any, where: str) -> np.ndarray:
    height = int(fields.height)
    width = int(fields.width)
    half = _HALF_COLOURS.get(fields.encoding)
    channels, to_bgr = _encoding_of(fields.encoding, where) if half is None else (1, half)
    height += 0 if half is None else height // 2
    row = width * channels
    step = int(fields.step) or row  # which some drivers leave open
    if not height or not width or step < row or len(fields.data) < step * (height - 1) + row:
        raise DriveError(
            f"{where}: {len(fields.data)} bytes are not an image of {width} x {height} in {fields.encoding} "
            f"with {step} bytes per row; record it again"
        )
    data = np.zeros(step * height, dtype=np.uint8)
    data[: len(fields.data)] = fields.data[: len(data)]
    pixels = data.reshape(height, step)[:, :row].reshape((height, width, channels)[: 2 + (channels > 1)])
    return pixels if to_bgr is None else _turned(pixels, to_bgr, where)


def _turned(pixels: np.ndarray, to_bgr: int, where: str) -> np.ndarray:
    """Pixels in BGR, by one of OpenCV's conversions."""
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), to_bgr), dtype=np.uint8)
    except cv2.error:
        raise DriveError(f"{where}: its size does not fit its encoding (odd?); record it again") from None


_FORMATS = ("h264", "h265", "vp9", "av1")
_FORMAT_OF_CODEC: Mapping[str, str] = {
    "264": "h264", "265": "h265", "hevc": "h265", "vp9": "vp9", "av1": "av1",
}  # fmt: skip
"""The format of video by a part of an encoder's name: libx264, h264_nvenc, hevc_vaapi."""
_CODECS = {"h265": "hevc"}  # FFmpeg's other names of formats


def video_format(kind: str, fields: Any) -> str:
    """The format of a message that is a packet of video; empty of one that is an image.

    Encoders on the vehicle (Isaac ROS, DepthAI) send packets as ``CompressedImage``, too.
    """
    if kind == VIDEO:
        return str(fields.format)
    if kind not in (COMPRESSED, PACKET):
        return ""
    stated = fields.encoding if kind == PACKET else fields.format
    codec = stated.partition(";")[0].strip().lower()
    formats = [form for letters, form in _FORMAT_OF_CODEC.items() if letters in codec]
    return formats[0] if formats else codec if kind == PACKET else ""


class VideoDecoder:
    """Decodes the packets of one topic in their order; ``form`` is their format as messages name it."""

    def __init__(self, form: str, where: str) -> None:
        self._av = need("av", "video", f"{where}: video in a bag", DriveError)
        if form not in _FORMATS:
            raise DriveError(
                f"{where}: video in the format {shown(form)}, supported are {', '.join(_FORMATS)}"
            )
        self._where = where
        self._context: Any = self._av.CodecContext.create(_CODECS.get(form, form), "r")
        self._begun = False
        self._context.thread_count = 1  # frames of several threads come late
        self._complained = False

    def frames(self, data: bytes | None, number: int) -> Iterator[tuple[int, np.ndarray]]:
        """The frames (H, W, 3) BGR that packet ``number`` completes, with their numbers; None ends the video.

        Frames before the first key frame never come. Raises DriveError on damage.
        """
        packet = None
        if data is not None:
            packet = self._av.Packet(data)
            packet.pts = number
        said = self._av.logging
        said.set_level(said.ERROR)
        try:
            with said.Capture(local=False) as complaints:
                frames = self._context.decode(packet)
            damaged = self._begun and (complaints or any(frame.is_corrupt for frame in frames))
            if damaged and not self._complained:
                self._complained = True
                _log.warning(
                    "%s: packet %d: decoder error (%s); is it damaged?",
                    self._where, number + 1, complaints[-1][2].strip() if complaints else "corrupt",
                )  # fmt: skip
            for frame in frames:
                self._begun = True
                yield int(frame.pts), frame.to_ndarray(format="bgr24")
        except self._av.error.FFmpegError as failure:
            if not self._begun:
                return  # parameters come with the first key frame
            raise DriveError(
                f"{self._where}: packet {number + 1} cannot be decoded ({' '.join(str(failure).split())}); "
                "leave it out, or record images"
            ) from None
        finally:
            said.set_level(None)


ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"
NMEA = "nmea_msgs/msg/Sentence"
_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_POSE = "geometry_msgs/msg/PoseStamped"
IMU = "sensor_msgs/msg/Imu"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"

POSE_KINDS = (ODOMETRY, _WITH_COVARIANCE, _POSE, FIX, NMEA, TF)
HEADING_KINDS = (IMU, QUATERNION, ODOMETRY, _WITH_COVARIANCE, _POSE)

_NO_FIX = -1  # the status of a NavSatFix without a position (sensor_msgs/NavSatStatus)
# Quality of NMEA's GGA by the status of a NavSatFix: plain, satellite-based and ground-based augmentation.
_QUALITY_OF_STATUS = {0: 1, 1: 2, 2: 4}
_GROUND_BASED = 2  # the status of a NavSatFix with ground-based augmentation, as RTK is
_FIXED_SIGMA_M = 0.1  # largest sigma of a position with fixed ambiguities, m: 0.02, and about 0.5 with float
_ATTITUDE = slice(4, 9)  # place of quaternion and sigma in a row
_NORM_TOLERANCE = 1e-2  # largest deviation of a recorded quaternion's norm from 1; chosen
_ANY_HEADING_RAD = np.pi / np.sqrt(3)  # standard deviation of an unknown heading
_YAW = 35  # place of the variance of yaw among the 36 numbers of a pose's covariance (REP-103)

Row = tuple[float, ...]


def position_row(kind: str, fields: Any) -> Row:
    """Position (3), sigma (1, nan if not stated), quaternion (4, nan if none), its sigma (1), status (1).

    The status is that of a NavSatFix, nan of other messages.
    """
    if kind == FIX:
        status = fields.status.status
        sigma_m = np.nan
        if fields.position_covariance_type:
            sigma_m = _sigma(fields.position_covariance[0], fields.position_covariance[4])
        if np.isnan(sigma_m):
            sigma_m = SIGMA_OF_QUALITY_M[_QUALITY_OF_STATUS.get(status, 0)]
        if status == _NO_FIX:
            sigma_m = np.inf
        return (fields.latitude, fields.longitude, fields.altitude, sigma_m, *([np.nan] * 5), float(status))
    row = _pose(fields.pose, None) if kind == _POSE else _pose(fields.pose.pose, fields.pose.covariance)
    return (*row, np.nan)


def heading_row(kind: str, fields: Any) -> Row:
    """Quaternion (4) and the standard deviation of its heading (1), nan if not stated."""
    if kind == IMU:
        if fields.orientation_covariance[0] < 0:  # sensor_msgs: this Imu measures no orientation
            return (np.nan,) * 5
        return (*_quaternion(fields.orientation), _heading_sigma(fields.orientation_covariance[8]))
    if kind == QUATERNION:
        return (*_quaternion(fields.quaternion), np.nan)
    return position_row(kind, fields)[_ATTITUDE]


def rate_row(fields: Any) -> Row:
    """Turn rates (3) about the axes of an Imu, rad/s."""
    if fields.angular_velocity_covariance[0] < 0:  # sensor_msgs: this Imu measures no rates
        return (np.nan,) * 3
    rate = fields.angular_velocity
    return (rate.x, rate.y, rate.z)


def rates_of(stamp_s: FloatArray, rates: FloatArray, where: str) -> TurnRates:
    """The turn rates (G, 3) of a gyro's stamps (G,); DriveError where none is measured."""
    is_measured = np.isfinite(rates).all(axis=1)
    if is_measured.sum() < 2:
        raise DriveError(f"{where}: it measures no turn rates (angular_velocity); choose another topic")
    order = _timed_order(stamp_s[is_measured], where, "message of the gyro")
    return TurnRates(stamp_s[is_measured][order], rates[is_measured][order])


def readings_of(
    kind: str,
    positions: tuple[FloatArray, FloatArray],
    headings: tuple[FloatArray, FloatArray] | None,
    where: str,
) -> Readings:
    """Readings of a topic's stamps (P,) and rows (P, 10), and of rows (A, 5) of a topic of headings."""
    stamp_s, rows = positions
    order = _timed_order(stamp_s, where, "message")
    stamp_s = stamp_s[order]
    rows = rows[order]
    geodetic = kind == FIX
    has_fix = ~np.isinf(rows[:, 3])
    if geodetic and has_fix.any() and np.isnan(rows[has_fix, 2]).all():  # sensor_msgs: nan if no altitude
        _log.warning("%s: its positions have no heights; taken as 0 m", where)
        rows[:, 2] = 0.0
    heading_s, turned = headings or (stamp_s, rows[:, _ATTITUDE])
    by_time = _timed_order(heading_s, where, "message of the heading")
    heading_s = heading_s[by_time]
    turned = turned[by_time]
    if (rows[:, 3] < 0).any() or (turned[:, 4] < 0).any():
        raise DriveError(f"{where}: a message states a negative variance; record it again with 0 for unknown")
    # A dual antenna writes nan where it has none, others leave all four numbers 0.
    is_measured = np.asarray(np.isfinite(turned[:, :4]).all(axis=1) & turned[:, :4].any(axis=1))
    attitudes = None
    advice = "it has no measured orientation: choose another topic for the heading"
    if headings is not None and not is_measured.any():
        raise DriveError(
            f"{where}: all quaternions of its heading are 0 or nan, or their covariance is -1; {advice}"
        )
    if not is_measured.all() and (headings is not None or not geodetic):
        lost = int((~is_measured).sum())
        _log.warning("%s: left out %d of %d orientations: not measured", where, lost, len(is_measured))
    if is_measured.any():
        rotation = checked_rotations(turned[is_measured, :4], lambda k: where, advice, _NORM_TOLERANCE)
        attitudes = Attitudes(heading_s[is_measured], rotation, turned[is_measured, 4])
    point = "an antenna's" if geodetic else ""
    is_fixed = _rtk_fixed(rows[:, 9], rows[:, 3]) if geodetic else None
    return Readings(stamp_s, rows[:, :3], geodetic, rows[:, 3], attitudes, point, is_fixed)


def _rtk_fixed(status: FloatArray, sigma_m: FloatArray) -> BoolArray | None:
    """Which positions (P,) RTK has fixed; None where the driver of the receiver does not tell.

    A NavSatFix has one status for fixed and float ambiguities, which its sigma tells apart. Some drivers
    write the status of a plain position whatever the receiver has: sigmas of centimetres give them away.
    """
    is_sure = sigma_m <= _FIXED_SIGMA_M
    is_rtk = status == _GROUND_BASED
    if (is_sure & ~is_rtk).sum() > (is_sure & is_rtk).sum():
        return None
    return np.asarray(is_rtk & is_sure)


def _timed_order(stamp_s: FloatArray, where: str, what: str) -> IntArray:
    """Rows (K,) that have a time, by it; those without one are counted."""
    rows = np.flatnonzero(has_time(stamp_s, where, what))
    if len(rows) < len(stamp_s):
        _log.warning("%s: left out %d of %d times that are 0", where, len(stamp_s) - len(rows), len(stamp_s))
    return np.asarray(rows[in_order(stamp_s[rows], where, what)])


def _pose(pose: Any, covariance: Any) -> Row:
    place = pose.position
    sigma_m = np.nan
    sigma_rad = np.nan
    if covariance is not None:
        sigma_m = _sigma(covariance[0], covariance[7])
        sigma_rad = _heading_sigma(covariance[_YAW])
    return (place.x, place.y, place.z, sigma_m, *_quaternion(pose.orientation), sigma_rad)


def _quaternion(orientation: Any) -> Row:
    return (orientation.x, orientation.y, orientation.z, orientation.w)


def _heading_sigma(variance: float) -> float:
    """The standard deviation of a heading, rad; nan where it says nothing: 1e6 rad2 stands for that."""
    sigma_rad = _sigma(variance)
    return np.nan if sigma_rad > _ANY_HEADING_RAD else sigma_rad


def _sigma(*variances: float) -> float:
    """Root of the mean of variances, nan where one is nan, 0 or -1, "not known"; a negative one as it is."""
    if (least := min(variances)) < 0 and least != -1:
        return least
    return float(np.sqrt(np.mean(variances))) if least >= 0 and max(variances) > 0 else np.nan
