"""Reading a drive on disk: one registry of formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from v2hdm.errors import DriveError
from v2hdm.geometry.trajectory import with_clock_offsets
from v2hdm.io.drive.folder import folder_drive_name, is_folder_drive, read_description, read_folder_drive
from v2hdm.io.drive.images import KittiOptions, ReadOptions, part_of
from v2hdm.io.drive.join import join_drives
from v2hdm.io.drive.kitti import is_kitti_drive, read_kitti_drive
from v2hdm.io.importers.bag.describe import describe_bag
from v2hdm.io.importers.bag.reading import is_bag
from v2hdm.records import Drive, Trajectory

__all__ = [
    "READERS", "KittiOptions", "ReadOptions", "Trajectory", "drive_name", "join_drives",
    "read_drive", "with_clock_offsets",
]  # fmt: skip


def _read_bag(path: Path, options: ReadOptions) -> Drive:
    path = path.resolve()
    return read_description(describe_bag(path, Path(options.cache)), path.parent, str(path), options)


READERS: Mapping[str, tuple[Callable[[Path], bool], Callable[[Path, ReadOptions], Drive]]] = {
    "folder": (is_folder_drive, read_folder_drive),
    "kitti": (is_kitti_drive, read_kitti_drive),
    "bag": (is_bag, _read_bag),
}
"""Formats by name: whether a path looks like one, and what makes a drive of it."""


def read_drive(path: str | Path, options: ReadOptions | None = None) -> Drive:
    """Read a drive: a folder with ``drive.yaml``, KITTI raw or a bag.

    Every image gets the vehicle's pose at its time, ``map_from_vehicle`` (4, 4): position linear, rotation
    slerp, never extrapolated, not across a gap longer than ``options.max_gap_s``; images without a pose are
    dropped with a logged count. The frame ``map`` is east, north, up, m; a sloping road is laid flat. All
    image files are checked for presence, completeness and size, then ``options.start_s``, ``end_s`` and
    ``limit`` select some of them.

    Raises:
        DriveError: names what is wrong, where, and what to do about it.

    >>> drive = read_drive(port.root)
    >>> list(drive.cameras), drive.images[0].map_from_vehicle.shape
    (['front'], (4, 4))
    """
    path = Path(path)
    options = options or ReadOptions()
    if not path.exists():
        raise DriveError(f"{path}: no such drive folder or bag; check drive.path")
    if options.max_gap_s <= 0:
        raise DriveError(f"max_gap_s is {options.max_gap_s:g}; give a positive number of seconds")
    if options.format not in ("auto", *READERS):
        raise DriveError(f"unknown drive format '{options.format}'; choose from: auto, {', '.join(READERS)}")
    for name, (accepts, read) in READERS.items():
        if options.format == name or (options.format == "auto" and accepts(path)):
            return part_of(read(path, options), options)
    known = ", ".join(READERS)
    raise DriveError(f"{path}: not a drive in any known format ({known}); see docs/drive-format.md")


def as_drive(drive: Drive | str | Path, options: ReadOptions | None = None) -> Drive:
    """The drive itself, or that in a folder, read."""
    return drive if isinstance(drive, Drive) else read_drive(drive, options)


def drive_name(path: Path) -> str:
    """The name of the drive at ``path``: that in its ``drive.yaml``, else its folder's."""
    if is_folder_drive(path):
        return folder_drive_name(path)
    return path.resolve().stem if is_bag(path) else path.resolve().name
