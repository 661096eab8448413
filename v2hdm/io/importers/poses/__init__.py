"""Poses as people have them: one reader a format, one registry, the same readings out of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.drive.tum import read_tum
from v2hdm.io.importers.poses import kitti_rows, nmea, table
from v2hdm.io.importers.poses.assemble import Recorded, assemble
from v2hdm.io.importers.poses.readings import Attitudes, Readings
from v2hdm.io.importers.poses.settings import COMMON_KEYS, take_pose_settings
from v2hdm.records import GeodeticOrigin
from v2hdm.store.files import check_keys, take_mapping, take_text

__all__ = ["POSE_FORMATS", "PoseFormat", "Recorded", "read_poses"]


@dataclass(frozen=True)
class PoseFormat:
    """One format: ``read(path, entry, root, where)`` and the ``keys`` that it has of its own."""

    read: Callable[[Path, dict[str, Any], Path, str], Readings]
    keys: tuple[str, ...] = ()


def _read_tum(path: Path, entry: dict[str, Any], root: Path, where: str) -> Readings:
    trajectory = read_tum(path)
    unknown = np.full(len(trajectory.stamp_s), np.nan)
    poses = trajectory.map_from_vehicle
    attitudes = Attitudes(trajectory.stamp_s, poses[:, :3, :3], unknown)
    return Readings(trajectory.stamp_s, poses[:, :3, 3], False, unknown, attitudes)


POSE_FORMATS: Mapping[str, PoseFormat] = {
    "tum": PoseFormat(_read_tum),
    "kitti": PoseFormat(kitti_rows.read_kitti_rows, kitti_rows.KEYS),
    "csv": PoseFormat(table.read_table, table.KEYS),
    "nmea": PoseFormat(nmea.read_nmea, nmea.KEYS),
}
"""Formats of files by the key that names the file; ``topic`` names one of a bag instead."""

ReadTopic = Callable[[dict[str, Any], str], Readings]
TOPIC_KEYS = ("heading_topic", "frame", "vehicle", "stamps")


def read_poses(
    content: object,
    root: Path,
    origin: GeodeticOrigin | None,
    max_gap_s: float,
    where: str,
    read_topic: ReadTopic,
) -> Recorded:
    """The poses that ``poses`` in ``drive.yaml`` names.

    Args:
        content: a TUM file's name, or a mapping that begins with a format of ``POSE_FORMATS`` or a topic.
        root: folder that file names are relative to.
        origin: the map's place on the earth as the drive states it.
        max_gap_s: attitudes further apart are not interpolated across.
        where: the key, for errors.
        read_topic: reads a topic of the drive's bag.

    Raises:
        DriveError: of the file or of how it is described.
    """
    if isinstance(content, str):
        return Recorded(read_tum(root / content), {}, origin)
    entry = take_mapping(content, where, DriveError)
    named = [key for key in (*POSE_FORMATS, "topic") if key in entry]
    if len(named) != 1:
        raise DriveError(
            f"{where}: name one source, a file of poses by its format ({', '.join(POSE_FORMATS)}) or a topic "
            f"of the bag; got {', '.join(named) or 'none'}"
        )
    (kind,) = named
    keys = TOPIC_KEYS if kind == "topic" else POSE_FORMATS[kind].keys
    check_keys(entry, (kind,), (*keys, *COMMON_KEYS), where, DriveError)
    settings = take_pose_settings(entry, where)
    name = take_text(entry[kind], f"{where}, {kind}", DriveError)
    if kind == "topic":
        return assemble(read_topic(entry, where), settings, origin, max_gap_s, f"{where}, topic {name}")
    readings = POSE_FORMATS[kind].read(root / name, entry, root, where)
    return assemble(readings, settings, origin, max_gap_s, str(root / name))
