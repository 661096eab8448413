"""Lines written one by one: to stdout, to a file that appears when it is complete, or to one that grows."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from v2hdm.errors import ConfigError, DriveError
from v2hdm.store.files import refuse_url, whole_file
from v2hdm.store.inputs import refuse_input

_BLOCK_BYTES = 1 << 16  # of a file that are looked at for its last line's end


@contextmanager
def lines_to(output: Path | None, first: bytes, content: str, grows: bool) -> Iterator[TextIO]:
    """A stream of lines to a file, or to stdout: the file appears when it is complete, or ``grows`` by line.

    Each line begins with ``first``: a file of other lines is no file of this ``content``, and is not touched.
    """
    try:
        if output is None:
            yield sys.stdout
            sys.stdout.flush()
            return
        refuse_url(output)
        refuse_input(output)
        if output.is_file():
            with output.open("rb") as earlier:
                if earlier.read(len(first)) not in (b"", first):
                    raise ConfigError(f"{output}: exists and holds no {content}; give another --output")
        if output.exists() and not output.is_file():  # a pipe, or /dev/null
            with output.open("w", encoding="utf-8") as stream:
                yield stream
        else:
            with (_growing if grows else _at_once)(output.resolve()) as stream:
                yield stream
    except OSError as error:
        if output is not None:
            line = f"{output}: cannot write there ({error.strerror}); give another --output"
        elif isinstance(error, BrokenPipeError):
            raise
        else:
            line = f"standard output: cannot be written ({error.strerror}); give an --output with room for it"
        raise DriveError(line) from error


@contextmanager
def _growing(path: Path) -> Iterator[TextIO]:
    """A file to add lines to, after those of earlier runs; half a line that a kill has left is dropped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as stream:
        end = stream.tell()
        while end > 0:
            begin = max(end - _BLOCK_BYTES, 0)
            stream.seek(begin)
            after_line = stream.read(end - begin).rfind(b"\n") + 1
            end = begin + after_line
            if after_line:
                break
        stream.truncate(end)
    with path.open("a", encoding="utf-8") as lines:
        yield lines


@contextmanager
def _at_once(path: Path) -> Iterator[TextIO]:
    """An unnamed file to write to; its content then replaces that of ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile("w+", encoding="utf-8", dir=path.parent) as stream:
        yield stream
        stream.seek(0)
        with whole_file(path) as partial, partial.open("w", encoding="utf-8") as copy:
            shutil.copyfileobj(stream, copy)
