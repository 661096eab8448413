"""Reading and writing files so that a user can correct what is wrong with them.

Every reader takes the :class:`~v2hdm.errors.V2hdmError` child to raise, so that a damaged drive and a damaged
map report as what they are; ``where`` names the place in its message. Writers never leave half a file behind.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import io
import json
import math
import os
import re
import secrets
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.records import FloatArray
from v2hdm.safe.texts import read_json, read_yaml, shown
from v2hdm.safe.texts import read_text as read_text
from v2hdm.store.inputs import refuse_input

_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
_BOUND = re.compile(r"Expected float [<>]=")  # what msgspec says of a number that is not finite
_LARGEST = sys.float_info.max  # a number beyond it is infinite as a float

Observer = Callable[[Path, Path], None]
_observer: ContextVar[Observer | None] = ContextVar("sees each file before it is there", default=None)


@contextmanager
def observed_writes(observer: Observer) -> Iterator[None]:
    """Within, ``observer`` is given each new file and the path that it is about to take; it may refuse."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden name beside ``path`` to write to, which takes its place when the block succeeds.

    Readers see the old file or the whole new one. After an error nothing new is left. The folder is created
    when absent. Raises ConfigError where ``path`` is an input of this command, or no plain file, OSError,
    which names it, where it cannot be written.
    """
    refuse_url(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: is not a regular file and is not replaced; choose another output")
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        yield partial
        refuse_input(path)
        if (observer := _observer.get()) is not None:
            observer(partial, path)
        partial.replace(path)
    except OSError as failure:
        # Calls on an open file name none, and the hidden name is of no use to anybody.
        if failure.errno is not None and failure.filename in (None, str(partial)):
            failure.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def refuse_unwritable(path: Path) -> None:
    """Raise ConfigError where :func:`whole_file` could not write ``path``; nothing is left by the trial."""
    refuse_url(path)
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is not a regular file and is not replaced; choose another output")
        folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
        trial = folder / f".{path.name}.{secrets.token_hex(8)}.part"
        try:
            trial.touch(exist_ok=False)
        finally:
            with suppress(OSError):
                trial.unlink()
    except OSError as failure:
        raise ConfigError(f"{path}: cannot be written ({failure.strerror}); choose another output") from None


def refuse_url(path: Path) -> None:
    """Raise ConfigError for a URL that was taken for a path: it would be a folder called ``s3:``."""
    if _URL.match(str(path)):
        raise ConfigError(
            f"{path}: URLs are allowed only as output= of v2hdm map and v2hdm fleet; "
            "give a path on this machine"
        )


def replace_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as :func:`whole_file` does."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Letters that no XML file can hold, escaped or not (XML 1.0, 2.2)."""


def xml_text(root: ET.Element, blanks: str = " ", before: str = "") -> str:
    """An XML file of ``root``, indented by ``blanks`` a level; ``before`` stands in front of it.

    Letters that XML cannot hold, such as those that move a terminal's cursor, become U+FFFD.
    """
    ET.indent(root, blanks)
    for element in root.iter():
        element.text = element.text and _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", element.text)
        for key, value in element.items():
            element.set(key, _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", value))
    before = _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", before)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{before}{ET.tostring(root, encoding="unicode")}\n'


def replace_csv(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """Write ``rows`` to ``path`` as CSV, as :func:`whole_file` does."""
    replace_text(path, csv_text(rows))


_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # what begins a cell that a spreadsheet would compute


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """``rows`` as CSV; a text that a spreadsheet would compute begins with the apostrophe of its texts."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    return (
        f"'{value}" if isinstance(value, str) and _FORMULA.match(value) and not _is_number(value) else value
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.isprintable()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write strict JSON, whole; figures that do not exist (nan) are left out of their object."""
    replace_text(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items() if not _is_nan(item)}
    if isinstance(value, (list, tuple)):
        return [None if _is_nan(item) else _finite(item) for item in value]
    return value.item() if hasattr(value, "item") else value


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def load_yaml(path: Path, error: type[V2hdmError]) -> dict[str, Any]:
    """The mapping at the top of a YAML file, whose keys are texts; else raises ``error``, with the line."""
    return take_mapping(read_yaml(path, error), str(path), error)


def read_csv(path: Path, error: type[V2hdmError]) -> list[list[str]]:
    """The rows of a CSV file, texts as :func:`csv_text` was given them; else ``error``, with the line."""
    reader = csv.reader(io.StringIO(read_text(path, error)))
    try:
        return [
            [cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell for cell in row] for row in reader
        ]
    except csv.Error as failure:
        raise error(f"{path}: line {reader.line_num}: {failure}; fix that line") from None


def dump_yaml(content: Mapping[str, Any]) -> str:
    """YAML text of ``content``, keys in the order given, short lists on one line."""
    return yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None, width=120)


def load_json(path: Path, error: type[V2hdmError]) -> dict[str, Any]:
    """The object at the top of a JSON file; errors as in :func:`load_yaml`."""
    content = read_json(path, error)
    if not isinstance(content, dict):
        raise error(f"{path}: expected a JSON object, got {shown(content)}")
    return content


def take_typed(content: object, kind: Any, where: str, error: type[V2hdmError]) -> Any:
    """``content`` itself if it has the types of ``kind``, else an ``error`` that names the place."""
    import msgspec  # of the map extra, as are the commands that read what they have written

    try:
        msgspec.convert(content, kind)
    except msgspec.ValidationError as failure:
        problem, _, place = str(failure).replace("`", "").partition(" - at $")
        at = f"{where}: {place.lstrip('.')}" if place else where
        said = "expected a finite number" if _BOUND.search(problem) else f"{problem[:1].lower()}{problem[1:]}"
        raise error(f"{at}: {said}; restore the file, or make it again") from None
    return content


def take_mapping(content: object, where: str, error: type[V2hdmError]) -> dict[str, Any]:
    """``content`` itself if it is a mapping, else an ``error`` that names ``where``."""
    if not isinstance(content, dict):
        raise error(f"{where}: expected 'key: value' entries, got {shown(content)}")
    return content


def check_keys(
    content: Mapping[str, Any],
    required: Collection[str],
    optional: Collection[str],
    where: str,
    error: type[V2hdmError],
) -> None:
    """Refuse unknown and missing keys; an unknown key is reported with the nearest valid one."""
    valid = [*required, *optional]
    for key in content:
        if key not in valid:
            matches = difflib.get_close_matches(str(key), valid, n=1, cutoff=0.5)
            advice = f"did you mean '{matches[0]}'?" if matches else f"valid keys: {', '.join(valid)}"
            raise error(f"{where}: unknown key {shown(key)}; {advice}")
    missing = [key for key in required if key not in content]
    if missing:
        raise error(f"{where}: missing key '{missing[0]}'; add it")


def take_array(content: object, shape: tuple[int, ...], where: str, error: type[V2hdmError]) -> FloatArray:
    """``content`` as a finite float64 array of ``shape``, in which -1 is any length, else an ``error``."""
    expected = " x ".join("N" if length < 0 else str(length) for length in shape)
    try:
        raw = np.array(content)
        if raw.dtype.kind not in "iuf" and raw.size:  # NumPy would make numbers of texts
            raise TypeError
        array = raw.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{where}: expected {expected} numbers, got {shown(content)}") from None
    if array.ndim != len(shape) or any(
        length not in (-1, actual) for length, actual in zip(shape, array.shape, strict=True)
    ):
        got = " x ".join(map(str, array.shape)) or "a single number"
        raise error(f"{where}: expected {expected} numbers, got {got}")
    if not np.isfinite(array).all():
        raise error(f"{where}: holds a number that is not finite; replace it")
    return array


def take_number(content: object, where: str, error: type[V2hdmError]) -> float:
    """``content`` as a finite float, else an ``error`` that names ``where``."""
    if isinstance(content, int | float) and not isinstance(content, bool) and abs(content) <= _LARGEST:
        return float(content)
    raise error(f"{where}: expected a finite number, got {shown(content)}")


def take_text(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as a string that is not empty, else an ``error`` that names ``where``."""
    if not isinstance(content, str) or not content:
        raise error(f"{where}: expected a text, got {shown(content)}")
    return content


def take_choice(content: object, choices: Collection[str], where: str, error: type[V2hdmError]) -> str:
    """``content`` as one of a few texts, else an ``error`` that names them."""
    if not isinstance(content, str) or content not in choices:
        raise error(f"{where}: expected one of {', '.join(choices)}, got {shown(content)}")
    return content
