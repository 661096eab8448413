"""One wrong input, and how a copy of a good drive is spoilt by it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.io.description import DRIVE_FILE, POSES_FILE
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import FloatArray, Trajectory
from v2hdm.store.files import dump_yaml, load_yaml, replace_text

CAMERAS = ("front", "rear")


@dataclass(frozen=True)
class Fault:
    """One wrong input.

    Attributes:
        name: of the fault.
        cause: pattern that the name or the sentence of a finding must match to name the cause right; None
            where the input is only unusual, and the map must be right.
        spoil: changes a drive folder.
        mapping: changes the settings of the mapping.
        hidden_on_straight: pattern of the check that must say that a straight drive cannot tell.
    """

    name: str
    cause: str | None
    spoil: Callable[[Path], None] = lambda folder: None
    mapping: Callable[[MappingOptions], MappingOptions] = lambda options: options
    hidden_on_straight: str | None = None


def copy_of(good: Path, folder: Path) -> Path:
    """A copy of a drive without its truth; its images are a link to those of the good one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    content = load_yaml(good / DRIVE_FILE, DriveError)
    content.pop("truth", None)
    replace_text(folder / DRIVE_FILE, dump_yaml(content))
    shutil.copy(good / POSES_FILE, folder / POSES_FILE)
    for camera in content["cameras"]:
        (folder / camera).mkdir()
        for name in ("camera_info.yaml", "images.txt"):
            shutil.copy(good / camera / name, folder / camera / name)
        (folder / camera / "images").symlink_to((good / camera / "images").resolve())
    return folder


def edit(folder: Path, change: Callable[[dict[str, Any]], None], name: str = DRIVE_FILE) -> None:
    """Change a YAML file of a drive."""
    content = load_yaml(folder / name, DriveError)
    change(content)
    replace_text(folder / name, dump_yaml(content))


def edit_cameras(change: Callable[[dict[str, Any]], None], folder: Path) -> None:
    """Change the entry of each camera in ``drive.yaml``."""
    edit(folder, lambda content: [change(entry) for entry in content["cameras"].values()])


def edit_lens(change: Callable[[dict[str, Any]], None], folder: Path) -> None:
    """Change the ``camera_info`` of each camera."""
    for camera in CAMERAS:
        edit(folder, change, f"{camera}/camera_info.yaml")


def edit_poses(
    change: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]], folder: Path
) -> None:
    """Change times (P,) and poses (P, 4, 4) of the trajectory."""
    recorded = read_tum(folder / POSES_FILE)
    stamp_s, poses = change(recorded.stamp_s.copy(), recorded.map_from_vehicle.copy())
    write_tum(Trajectory(stamp_s, poses), folder / POSES_FILE)
