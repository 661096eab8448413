"""Placeholders: small texts that a copy has left in the place of files.

Git LFS leaves pointers (https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md). Archives and file systems
without links leave the path that a link led to.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

_POINTER = b"version https://git-lfs.github.com/spec/"
_MOST_BYTES = 4096  # of a placeholder: Linux's longest path (PATH_MAX)


def placeholder_words(path: Path) -> str | None:
    """The kind of placeholder that a file is, and the remedy, for an error line; None for real files."""
    begin = b""
    with suppress(OSError), path.open("rb") as file:
        begin = file.read(_MOST_BYTES + 1)
    return words_of_content(begin, path)


def words_of_content(data: bytes, path: Path) -> str | None:
    """:func:`placeholder_words` of a file at ``path`` that begins with ``data``."""
    if data.startswith(_POINTER):
        return "only a pointer of Git LFS; fetch the file with 'git lfs pull'"
    if len(data) > _MOST_BYTES:
        return None
    with suppress(ValueError):
        target = data.decode()
        is_path = "/" in target and not any(letter.isspace() for letter in target)
        if is_path and path.suffix and target.lower().endswith(path.suffix.lower()):
            return f"only the text of a link to {target}; copy it again with what its links lead to"
    return None
