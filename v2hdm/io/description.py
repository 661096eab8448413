"""The keys of a ``drive.yaml`` (docs/drive-format.md) with their meanings, and names of files.

The readers take their keys from here, and so does the schema with which editors complete the file.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from v2hdm.errors import DriveError
from v2hdm.records import GeodeticOrigin, PoseNoise
from v2hdm.safe.texts import take_name
from v2hdm.settings import NOT_NEGATIVE, POSITIVE

DRIVE_FILE = "drive.yaml"
POSES_FILE = "poses.tum"
TRUTH_FOLDER = "truth"


@dataclass(kw_only=True)
class InfoFile:
    """Intrinsics in a file."""

    file: Annotated[str, "file of ROS, Kalibr, OpenCV or COLMAP."]
    camera: Annotated[str | int | None, "the camera to use if the file has several."] = None
    rectified: Annotated[
        bool | None, "whether the images are rectified: P counts; default: as their topic's name says."
    ] = None


@dataclass(kw_only=True)
class InfoTopic:
    """Intrinsics in the bag."""

    topic: Annotated[str, "topic of sensor_msgs/CameraInfo."]
    rectified: Annotated[
        bool | None, "whether the images are rectified: P counts; default: as their topic's name says."
    ] = None


@dataclass(kw_only=True)
class FolderImages:
    """Images of a folder, by the numbers or times in their names."""

    folder: Annotated[str, "folder of the images."]
    stamps: Annotated[str | None, "file with one time in s per line; without it, names are times."] = None
    unit: Annotated[
        str | None, "of times that are names: s, ms, us, ns, utc or utc+hh:mm; default: as their digits tell."
    ] = None


@dataclass(kw_only=True)
class VideoImages:
    """Frames of a video; one of ``start_s`` and ``stamps`` is needed."""

    video: Annotated[str, "the video."]
    start_s: Annotated[float | None, "time of the first frame on the clock of the poses."] = None
    stamps: Annotated[str | None, "file with one time in s per frame."] = None


@dataclass(kw_only=True)
class TopicImages:
    """Images in the bag."""

    topic: Annotated[str, "topic of Image, CompressedImage or CompressedVideo."]
    stamps: Annotated[str, "times to take: header or received."] = "header"


@dataclass(kw_only=True)
class PoseKeys:
    """Keys that every source of poses has."""

    crs: Annotated[str | int | None, "system of x and y, or datum of latitudes, such as EPSG:4258."] = None
    heading: Annotated[
        str | None, "north that headings count from, true or grid; course: there are none, but one antenna."
    ] = None
    gyro_file: Annotated[
        Any, "yaw rates or wheel speeds beside heading: course, such as {csv: imu.csv, offset_s: 0.02}."
    ] = None
    starts: Annotated[str | None, "with heading: course, whether it begins forward or backward."] = None
    lever_arm_m: Annotated[list[float] | None, "the antenna in the vehicle frame: forward, left, up."] = None
    mounting_rpy_deg: Annotated[list[float] | None, "roll, pitch, yaw of the attitude's sensor."] = None
    max_sigma_m: Annotated[float, POSITIVE, "positions with a larger sigma are dropped."] = 0.1
    geoid_m: Annotated[float | None, "geoid above the ellipsoid, for heights above sea level."] = None
    epoch: Annotated[float | None, "of the coordinates, in years."] = None
    offset_s: Annotated[float, "added to the times of the poses."] = 0.0
    heading_file: Annotated[
        Any, "headings in a second file, by its format, such as {csv: imu.csv}; TUM's by its name."
    ] = None


@dataclass(kw_only=True)
class TumPoses(PoseKeys):
    """Poses in the format of TUM."""

    tum: Annotated[str, "the file."]


@dataclass(kw_only=True)
class TablePoses(PoseKeys):
    """Poses in a table."""

    csv: Annotated[str, "the file."]
    columns: Annotated[dict[str, str], "our names of columns, and the file's."] = field(default_factory=dict)


@dataclass(kw_only=True)
class NmeaPoses(PoseKeys):
    """Poses in an NMEA log."""

    nmea: Annotated[str, "the file."]
    date: Annotated[Any, "of the first sentence, such as 2024-05-17, if no sentence has it."] = None
    talker: Annotated[str | None, "the receiver to take of several, such as GN."] = None


@dataclass(kw_only=True)
class SbetPoses(PoseKeys):
    """Poses of Applanix POSPac."""

    sbet: Annotated[str, "the file."]
    rms: Annotated[str | None, "its RMS file (smrmsg), for the sigmas."] = None
    date: Annotated[Any, "a day of the recording, if the images' times are no dates."] = None
    clock: Annotated[str, "of its seconds of the week: gps, or utc with leap seconds."] = "gps"


@dataclass(kw_only=True)
class PosPoses(PoseKeys):
    """Positions of RTKLIB."""

    pos: Annotated[str, "the file."]


@dataclass(kw_only=True)
class UbxPoses(PoseKeys):
    """Poses of a u-blox receiver."""

    ubx: Annotated[str, "the log: pyubx2's text or JSON lines, or raw."]
    date: Annotated[Any, "a day of the recording, if no NAV-PVT has it."] = None


@dataclass(kw_only=True)
class TopicPoses(PoseKeys):
    """Poses in the bag."""

    topic: Annotated[str, "topic of poses, fixes, sentences or transforms."]
    heading_topic: Annotated[str | None, "topic of Imu or QuaternionStamped, for fixes."] = None
    frame: Annotated[str | None, "the map's frame, for /tf."] = None
    vehicle: Annotated[str | None, "the vehicle's frame, for /tf."] = None
    gyro_topic: Annotated[str | None, "topic of Imu, with heading: course."] = None
    stamps: Annotated[str, "times to take: header or received."] = "header"


@dataclass(kw_only=True)
class MountingGuess:
    """A guessed mounting, all angles 0 for a camera that looks ahead."""

    xyz_m: Annotated[list[float], "centre in the vehicle frame: forward, left, up."]
    rpy_deg: Annotated[list[float], "roll, pitch (down), yaw (left)."]


@dataclass(kw_only=True)
class SurveyedCentre:
    """A survey of a camera's centre."""

    xyz: Annotated[list[float], "in the vehicle frame: forward, left, up, m."]
    sigma_m: Annotated[float | list[float], POSITIVE, "standard deviation, one or one per axis."]


@dataclass(kw_only=True)
class CameraEntry:
    """A camera; one of ``mounting``, ``cam_from_vehicle`` and ``ipm`` is needed."""

    camera_info: Annotated[str | InfoFile | InfoTopic, "intrinsics: a file, or a topic of the bag."]
    images: Annotated[
        str | FolderImages | VideoImages | TopicImages,
        "a list, one line 'timestamp filename' per image, a folder, a video, or a topic of the bag.",
    ]
    mounting: Annotated[MountingGuess | None, "guessed place and direction in the vehicle."] = None
    cam_from_vehicle: Annotated[list[list[float]] | None, "the same as a 4 x 4 matrix."] = None
    ipm: Annotated[
        dict[str, list[list[float]]] | None,
        "up to two 3 x 3 homographies vehicle_from_pinhole_px: calibrated and estimated.",
    ] = None
    initial_ipm: Annotated[str | None, "the IPM that the mapping starts from, where there are two."] = None
    roi_vehicle: Annotated[
        list[list[float]] | None, "convex polygon on the ground, m, in which the IPM is trusted."
    ] = None
    centre_prior: Annotated[SurveyedCentre | None, "survey of the camera's centre."] = None
    linear_response: Annotated[bool, "whether grey values are proportional to light; else sRGB."] = False
    mask: Annotated[str | None, "image, white where the vehicle itself is visible."] = None
    read_out_s: Annotated[float, NOT_NEGATIVE, "read-out time of a rolling shutter."] = 0.0
    frame: Annotated[str | None, "the vehicle's name for the frame of the images, x right, z ahead."] = None


@dataclass(kw_only=True)
class DriveDescription:
    """A ``drive.yaml``; names of files are relative to it."""

    cameras: Annotated[dict[str, CameraEntry], "the cameras by name."]
    name: Annotated[str | None, "the drive's name; default: the folder's."] = None
    bag: Annotated[str | None, "the bag whose topics are named."] = None
    poses: Annotated[
        str | TumPoses | TablePoses | NmeaPoses | SbetPoses | PosPoses | UbxPoses | TopicPoses,
        "the vehicle's poses: a file, or a topic.",
    ] = POSES_FILE
    pose_noise: Annotated[
        PoseNoise | None, "standard deviations from the receiver's data sheet, and their drifts."
    ] = None
    origin: Annotated[GeodeticOrigin | None, "the place of the map's origin on the earth."] = None
    vehicle_frame: Annotated[
        str | None, "the vehicle's name for the frame that positions on it count from."
    ] = None
    vehicle_frame_height_m: Annotated[float, "height of that frame's origin above the ground, m."] = 0.0
    truth: Annotated[str | None, "folder of the ground truth; only rendered drives have it."] = None


class Keys(NamedTuple):
    """The keys of a mapping."""

    required: tuple[str, ...]
    optional: tuple[str, ...]


def keys_in(entry: type[Any], shared: type[Any] | None = None) -> Keys:
    """The keys that a dataclass declares, without those of one that it ``shared`` with others."""
    declared = [key for key in fields(entry) if shared is None or key not in fields(shared)]
    is_required = [key.default is MISSING and key.default_factory is MISSING for key in declared]
    return Keys(
        tuple(key.name for key, needed in zip(declared, is_required, strict=True) if needed),
        tuple(key.name for key, needed in zip(declared, is_required, strict=True) if not needed),
    )


def is_folder_drive(path: Path) -> bool:
    """Whether ``path`` looks like a drive in this format."""
    return (path / DRIVE_FILE).is_file()


def name_of(content: dict[str, Any], path: Path) -> str:
    """The name that the ``content`` of a ``drive.yaml`` at ``path`` gives the drive, else its folder's."""
    return take_name(content.get("name", path.resolve().name), f"{path / DRIVE_FILE}: name", DriveError)
