"""Reading and writing files so that a user can mend what is wrong with them.

Every reader takes the :class:`~v2hdm.errors.V2hdmError` child to raise, so that a damaged drive
and a damaged map report as what they are. Writers never leave half a file behind.
"""

from __future__ import annotations

import difflib
import json
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from v2hdm.errors import V2hdmError
from v2hdm.records import FloatArray

_LARGEST = sys.float_info.max


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden name beside ``path`` to write to: readers see the old file or the whole new one.

    What was written takes the place of ``path`` when the block succeeds; else nothing of it is left. The
    folder is created when absent.

    Raises:
        OSError: it cannot be written there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as :func:`whole_file` does."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def read_text(path: Path, error: type[V2hdmError]) -> str:
    """The text of ``path``.

    Raises:
        V2hdmError: of type ``error``, when the file is missing, unreadable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise error(f"{path}: no such file; check the path or restore it") from None
    except UnicodeDecodeError:
        raise error(f"{path}: not a UTF-8 text file; replace it by a text file") from None
    except OSError as failure:
        raise error(
            f"{path}: cannot be read ({failure.strerror}); check the path and its permissions"
        ) from None


def load_yaml(path: Path, error: type[V2hdmError]) -> dict[str, Any]:
    """The mapping at the top of a YAML file.

    Raises:
        V2hdmError: of type ``error``, when the file is missing, has a syntax error (with its line)
            or holds anything but a mapping.
    """
    try:
        # OpenCV and old ROS tools begin their files with a directive that YAML 1.1 refuses.
        content = yaml.safe_load(read_text(path, error).removeprefix("%YAML:1.0"))
    except yaml.YAMLError as failure:
        mark = getattr(failure, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(failure, "problem", None) or "not readable"
        raise error(f"{path}:{line} YAML syntax error: {problem}; mend that line") from None
    if not isinstance(content, dict):
        raise error(
            f"{path}: expected 'key: value' entries, got {_describe(content)}; see the format's description"
        )
    return content


def dump_yaml(content: Mapping[str, Any]) -> str:
    """YAML text of ``content``, keys in the order given, short lists on one line."""
    return yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None, width=120)


def load_json(path: Path, error: type[V2hdmError]) -> dict[str, Any]:
    """The object at the top of a JSON file; errors as in :func:`load_yaml`."""
    try:
        content = json.loads(read_text(path, error))
    except json.JSONDecodeError as failure:
        raise error(
            f"{path}: line {failure.lineno} JSON syntax error: {failure.msg}; mend that line"
        ) from None
    if not isinstance(content, dict):
        raise error(f"{path}: expected a JSON object, got {_describe(content)}")
    return content


def take_mapping(content: object, where: str, error: type[V2hdmError]) -> dict[str, Any]:
    """``content`` itself if it is a mapping, else an ``error`` that names ``where``."""
    if not isinstance(content, dict):
        raise error(f"{where}: expected 'key: value' entries, got {_describe(content)}")
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
            near = difflib.get_close_matches(str(key), valid, n=1, cutoff=0.5)
            advice = f"did you mean '{near[0]}'?" if near else f"valid keys: {', '.join(valid)}"
            raise error(f"{where}: unknown key '{key}'; {advice}")
    missing = [key for key in required if key not in content]
    if missing:
        raise error(f"{where}: missing key '{missing[0]}'; add it")


def take_array(content: object, shape: tuple[int, ...], where: str, error: type[V2hdmError]) -> FloatArray:
    """``content`` as a finite float64 array of ``shape``, in which -1 stands for any length.

    Raises:
        V2hdmError: of type ``error``, when it is not numeric, not finite or shaped otherwise.
    """
    wanted = " x ".join("N" if length < 0 else str(length) for length in shape)
    try:
        array = np.array(content, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{where}: expected {wanted} numbers, got {_describe(content)}") from None
    fits = array.ndim == len(shape) and all(w in (-1, n) for w, n in zip(shape, array.shape, strict=True))
    if not fits:
        got = " x ".join(map(str, array.shape)) or "a single number"
        raise error(f"{where}: expected {wanted} numbers, got {got}")
    if not np.isfinite(array).all():
        raise error(f"{where}: holds a number that is not finite; replace it")
    return array


def take_number(content: object, where: str, error: type[V2hdmError]) -> float:
    """``content`` as a finite float, else an ``error`` that names ``where``."""
    if isinstance(content, int | float) and not isinstance(content, bool) and abs(content) <= _LARGEST:
        return float(content)
    raise error(f"{where}: expected a finite number, got {_describe(content)}")


def take_text(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as a string that is not empty, else an ``error`` that names ``where``."""
    if not isinstance(content, str) or not content:
        raise error(f"{where}: expected a text, got {_describe(content)}")
    return content


def _describe(content: object) -> str:
    text = repr(content)
    return "nothing" if content is None else text if len(text) <= 60 else f"{text[:57]}..."


def forget_stdout() -> None:
    """Keep Python from writing at its end what could not be written before."""
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
