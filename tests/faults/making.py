"""Makers of bad inputs: changes of the example drive, and files as a user may give them."""

import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from tests.drive.example import make_drive
from tests.faults.judge import Case, Prepare

CHECK = "v2hdm check"
CHECKED = ("drive", "--no-ground", "--workers", "1", "--output", "out")
Change = Callable[[Path], object]


def both(*steps: Change) -> Prepare:
    """All of these, one after the other."""

    def prepare(root: Path) -> None:
        for step in steps:
            step(root)

    return prepare


def drive(*changes: Change) -> Prepare:
    """The example drive in the folder ``drive``, changed."""

    def prepare(root: Path) -> None:
        write_example(root / "drive")
        for change in changes:
            change(root / "drive")

    return prepare


def write_example(folder: Path) -> None:
    """The example drive, which is made once a process."""
    for name, data in _example():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


@lru_cache
def _example() -> tuple[tuple[str, bytes], ...]:
    with TemporaryDirectory() as folder:
        make_drive(Path(folder))
        files = (path for path in sorted(Path(folder).rglob("*")) if path.is_file())
        return tuple((path.relative_to(folder).as_posix(), path.read_bytes()) for path in files)


def checked(name: str, says: str, *changes: Change, **more: object) -> Case:
    """The check of the example drive, changed."""
    return Case(name, CHECK, CHECKED, drive(*changes), says, **more)  # type: ignore[arg-type]


def write(name: str, data: str | bytes) -> Change:
    """Put this into a file."""
    return lambda root: (root / name).write_bytes(data.encode() if isinstance(data, str) else data)


def edit(name: str, pattern: str, new: str) -> Change:
    """Change the first match in a file."""

    def change(root: Path) -> None:
        text = (root / name).read_text()
        assert re.search(pattern, text, re.MULTILINE), (name, pattern)
        (root / name).write_text(re.sub(pattern, new, text, count=1, flags=re.MULTILINE))

    return change


def described(change: Callable[[dict], object]) -> Change:
    """Change the content of ``drive.yaml``."""

    def apply(root: Path) -> None:
        content = yaml.safe_load((root / "drive.yaml").read_text())
        change(content)
        (root / "drive.yaml").write_text(yaml.safe_dump(content, allow_unicode=True))

    return apply


def front(**changes: object) -> Change:
    """Change entries of the front camera in ``drive.yaml``; None removes one."""

    def change(content: dict) -> None:
        entry = content["cameras"]["front"]
        for key, value in changes.items():
            entry.pop(key, None)
            if value is not None:
                entry[key] = value

    return described(change)


def remove(name: str) -> Change:
    """Leave a file out."""
    return lambda root: (root / name).unlink()


def cut(name: str, size: int) -> Change:
    """End a file after so many bytes."""
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:size])
