"""Run files of fleets."""

from __future__ import annotations

from pathlib import Path


def written(folder: Path, name: str, drive: object) -> Path:
    """The run file of one drive."""
    path = folder / f"{name}.yaml"
    path.write_text(f"# @package _global_\nname: {name}\ndrive:\n  path: {drive}\n")
    return path
