"""Reading a drive on disk, by one registry of formats, and that of a finished result again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from v2hdm.doors import check_types, checked
from v2hdm.errors import DriveError, MapFileError, shown
from v2hdm.geometry.rigid import with_clock_offsets
from v2hdm.io.description import DRIVE_FILE, is_folder_drive, name_of
from v2hdm.io.drive.images import KittiOptions, ReadOptions, part_of
from v2hdm.io.drive.join import join_drives
from v2hdm.records import Drive, Trajectory
from v2hdm.store.files import file_digest, load_yaml
from v2hdm.store.names import METRICS

__all__ = [
    "READERS", "KittiOptions", "ReadOptions", "Trajectory", "drive_name", "join_drives",
    "need_pictures", "read_drive", "with_clock_offsets",
]  # fmt: skip


# Each of these loads what reads its format, when a drive of it is looked at.


def _read_folder(path: Path, options: ReadOptions) -> Drive:
    from v2hdm.io.drive.folder import read_folder_drive

    return read_folder_drive(path, options)


def _is_kitti(path: Path) -> bool:
    from v2hdm.io.drive.kitti import is_kitti_drive

    return is_kitti_drive(path)


def _read_kitti(path: Path, options: ReadOptions) -> Drive:
    from v2hdm.io.drive.kitti import read_kitti_drive

    return read_kitti_drive(path, options)


def _is_bag(path: Path) -> bool:
    from v2hdm.io.importers.bag.reading import is_bag

    return is_bag(path)


def _read_bag(path: Path, options: ReadOptions) -> Drive:
    from v2hdm.io.drive.folder import read_description
    from v2hdm.io.importers.bag.describe import describe_bag

    path = path.resolve()
    content = describe_bag(path, Path(options.cache), options.cameras)
    return read_description(content, path.parent, str(path), options)


READERS: Mapping[str, tuple[Callable[[Path], bool], Callable[[Path, ReadOptions], Drive]]] = {
    "folder": (is_folder_drive, _read_folder),
    "kitti": (_is_kitti, _read_kitti),
    "bag": (_is_bag, _read_bag),
}
"""Formats by name: whether a path looks like one, and what makes a drive of it."""


@checked
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
    check_types(options, "drive.")
    if not path.exists():
        raise DriveError(f"{path}: no such drive folder or bag; check the path")
    if options.max_gap_s <= 0:
        raise DriveError(f"max_gap_s is {options.max_gap_s:g}; give a positive number of seconds")
    if options.format not in ("auto", *READERS):
        raise DriveError(
            f"unknown drive format {shown(options.format)}; choose from: auto, {', '.join(READERS)}"
        )
    for name, (accepts, read) in READERS.items():
        if options.format == name or (options.format == "auto" and accepts(path)):
            return part_of(read(path, options), options)
    format_names = ", ".join(READERS)
    raise DriveError(f"{path}: not a drive in any known format ({format_names}); see docs/drive-format.md")


def as_drive(drive: Drive | str | Path, options: ReadOptions | None = None) -> Drive:
    """The drive itself, or that in a folder, read."""
    drive = drive if isinstance(drive, Drive) else read_drive(drive, options)
    if not drive.images:
        raise DriveError(f"drive {drive.name}: has no image; give one with images that have poses")
    return drive


def need_pictures(drive: Drive, what: str) -> None:
    """Raise DriveError where a drive has detections in place of the pictures that ``what`` needs."""
    if not drive.has_pictures:
        raise DriveError(
            f"{drive.root}: has detections in place of pictures, which {what} needs; give one with pictures"
        )


def drive_name(path: Path) -> str:
    """The name of the drive at ``path``: that in its ``drive.yaml``, else its folder's."""
    if is_folder_drive(path):
        return name_of(load_yaml(path / DRIVE_FILE, DriveError), path)
    return path.resolve().stem if _is_bag(path) else path.resolve().name


_DIGEST = "images_sha256"  # in metrics.json, of :func:`images_digest`


def told_of(
    drive: Drive, paths: Sequence[Path], options: ReadOptions, digest_of: Callable[[Path], str] = file_digest
) -> dict[str, Any]:
    """The plain values that :func:`drive_of` needs; ``digest_of`` an image file is its SHA-256."""
    return {
        "name": drive.name,
        "paths": [str(path.resolve()) for path in paths],
        **{key: getattr(options, key) for key in ("format", "max_gap_s", "limit", "start_s", "end_s")},
        "cache": str(Path(options.cache).absolute()),
        **({"kitti": asdict(options.kitti)} if options.format == "kitti" else {}),
        "cameras": list(drive.cameras),
        "images": len(drive.images),
        _DIGEST: images_digest(drive, digest_of),
    }


def images_digest(drive: Drive, digest_of: Callable[[Path], str]) -> str:
    """One SHA-256 of all images of a drive: their cameras and ``digest_of`` each file, in their order."""
    lines = [f"{image.camera} {digest_of(image.path)}\n" for image in drive.images]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def drive_of(folder: Path, path: Path | None) -> Drive | None:
    """The drive of the result in ``folder``: at ``path``, else where it was; None where it is gone.

    Raises MapFileError when the folder is no result of a run, DriveError when the drive is no longer that,
    or its images are not those that were mapped.
    """
    from v2hdm.io.metrics import read_metrics  # loads what the map extra brings, as results are

    stated = read_metrics(folder).get("drive") or {}
    try:
        stated_paths = stated.get("paths") or [] if path is None else [path]
        paths = [Path(str(stated_path)) for stated_path in stated_paths]
        options = _options(stated)
    except (TypeError, ValueError) as failure:
        raise MapFileError(f"{folder / METRICS}: its data on the drive are damaged ({failure})") from None
    if path is None and not (paths and all(drive_path.exists() for drive_path in paths)):
        return None
    drive = join_drives([read_drive(drive_path, options) for drive_path in paths])
    expected = (stated.get("name", drive.name), stated.get("images", len(drive.images)))
    if expected != (drive.name, len(drive.images)):
        raise DriveError(
            f"{paths[0]}: drive {drive.name} of {len(drive.images)} images, but the result is of drive "
            f"{expected[0]} of {expected[1]}; give that drive with --drive"
        )
    mapped = stated.get(_DIGEST)  # none in results of earlier versions
    if mapped is not None and mapped != _digest_now(drive):
        raise DriveError(
            f"{paths[0]}: its images are not those that the result in {folder} was made of; give that "
            "drive with --drive, or map this one again"
        )
    return drive


def _digest_now(drive: Drive) -> str:
    try:
        return images_digest(drive, file_digest)
    except OSError as failure:
        raise DriveError(f"{failure.filename}: cannot be read ({failure.strerror})") from None


def single_drive_of(folder: Path, path: Path | None, what: str) -> Drive:
    """The drive of a result, as :func:`drive_of`; refused if gone or several, ``what`` being of one."""
    drive = drive_of(folder, path)
    if drive is None:
        raise DriveError(f"{folder}: its drive has moved; give its folder with --drive")
    if drive.joined:
        raise MapFileError(f"{folder} is of several drives; {what} of one: map them one by one")
    need_pictures(drive, what.removesuffix(" is").removesuffix(" are"))
    return drive


def _options(stated: Mapping[str, Any]) -> ReadOptions:
    import msgspec  # of the map extra, as results are

    names = [option.name for option in fields(ReadOptions)]
    stated_options = {name: stated[name] for name in names if name in stated}
    try:
        return msgspec.convert(stated_options, ReadOptions)
    except msgspec.ValidationError as failure:
        raise ValueError(str(failure)) from None
