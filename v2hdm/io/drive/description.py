"""What a ``drive.yaml`` says (docs/drive-format.md): its keys, their meanings, and names of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.safe.texts import take_name

DRIVE_FILE = "drive.yaml"
POSES_FILE = "poses.tum"
TRUTH_FOLDER = "truth"


def is_folder_drive(path: Path) -> bool:
    """Whether ``path`` looks like a drive in this format."""
    return (path / DRIVE_FILE).is_file()


def name_of(content: dict[str, Any], path: Path) -> str:
    """The name that the ``content`` of a ``drive.yaml`` at ``path`` gives the drive, else its folder's."""
    return take_name(content.get("name", path.resolve().name), f"{path / DRIVE_FILE}: name", DriveError)
