"""The gate for texts from outside: every YAML, JSON and plain text file that others wrote comes through here.

What a reader takes from it has a bounded size, depth and number of entries, holds plain values only (texts,
numbers, true and false, lists, mappings with texts for keys), and says nothing twice. Anything else is one
line of the caller's own error, which names the file and, where there is one, the line.
"""

from __future__ import annotations

import codecs
import json
import re
import stat
from collections.abc import Hashable
from pathlib import Path
from typing import Any, Never

import numpy as np
import yaml

from v2hdm.errors import V2hdmError
from v2hdm.store.inputs import note_input, warn_if_changed

MOST_BYTES = 1 << 30
"""Largest text file that is read; an hour of poses at 100 Hz is 30 MB."""

MOST_YAML_BYTES = 1 << 24
"""Largest YAML file; ours have kilobytes, and PyYAML takes a second for half a megabyte."""

MOST_DEPTH = 64
"""Deepest nesting of lists and mappings; ours are 8 deep."""

MOST_ENTRIES = 1_000_000
"""Values in a YAML file, with everything that an alias repeats."""

MOST_DIGITS = 64
"""Longest whole number; doubles end at 309 digits, and nothing here counts beyond 2**64."""

MOST_NAME_LETTERS = 64
_MOST_NAME_BYTES = 200
"""File systems end at 255 bytes, and a file's name has more than its camera's in it."""

_SHORT, _FEW = 60, 4


def read_bytes(path: Path, error: type[V2hdmError], most: int = MOST_BYTES) -> bytes:
    """The bytes of the plain file at ``path``; a warning says so where it is ours and was changed.

    Raises:
        V2hdmError: of type ``error``, when it is missing, no plain file (a pipe would be waited for),
            unreadable or larger than ``most`` bytes.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            kind = "a folder" if stat.S_ISDIR(about.st_mode) else "a pipe or a device"
            raise error(f"{path}: is {kind}, not a file; check the path")
        if about.st_size > most:
            raise error(
                f"{path}: has {about.st_size / 1e6:.0f} MB, {most / 1e6:.0f} MB at most; check the path"
            )
        note_input(path)
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise error(f"{path}: no such file; check the path or restore it") from None
    except (OSError, ValueError) as failure:  # ValueError: a path with a zero byte
        reason = getattr(failure, "strerror", None) or failure
        raise error(f"{path}: cannot be read ({reason}); check the path and its permissions") from None
    warn_if_changed(path, data)
    return data


def read_text(path: Path, error: type[V2hdmError], most: int = MOST_BYTES) -> str:
    """The text of ``path``, without a byte order mark.

    Raises:
        V2hdmError: of type ``error``, when :func:`read_bytes` fails or the file is not UTF-8.
    """
    data = read_bytes(path, error, most)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise error(f"{path}: not a UTF-8 text file but UTF-16; save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        line = data.count(b"\n", 0, failure.start) + 1
        raise error(f"{path}: line {line}: not a UTF-8 text file; save it as UTF-8, or restore it") from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise error(f"{path}: line {line}: a zero byte, so that it is no text; restore the file")
    return text


def read_yaml(path: Path, error: type[V2hdmError]) -> Any:
    """What the YAML file at ``path`` holds.

    Keys are texts as they are written (``1``, ``no``), dates are texts, and tags are refused.

    Raises:
        V2hdmError: of type ``error``, with the line.
    """
    # OpenCV and old ROS tools begin their files with a directive that YAML 1.1 refuses.
    return parse_yaml(read_text(path, error, MOST_YAML_BYTES).removeprefix("%YAML:1.0"), str(path), error)


def parse_yaml(text: str, where: str, error: type[V2hdmError]) -> Any:
    """What a YAML text holds, as :func:`read_yaml`; ``where`` it is from, for errors."""
    try:
        return _Loader(text).get_single_data()  # looks for letters that are none at once
    except yaml.YAMLError as failure:
        mark, at = getattr(failure, "problem_mark", None), getattr(failure, "position", None)
        row = mark.line if mark is not None else None if at is None else text.count("\n", 0, at)
        line = "" if row is None else f" line {row + 1}"
        problem = getattr(failure, "problem", None) or getattr(failure, "reason", None) or "not readable"
        if "'\\t'" in problem:
            problem = "a tab where blanks must be"
        raise error(f"{where}:{line} YAML syntax error: {_one_line(problem)}; mend that line") from None
    except RecursionError:  # the scanner's own
        raise error(f"{where}: YAML nested deeper than {MOST_DEPTH} levels; mend it") from None


def read_json(path: Path, error: type[V2hdmError]) -> Any:
    """What the JSON file at ``path`` holds.

    Raises:
        V2hdmError: of type ``error``, with the line.
    """
    return parse_json(read_text(path, error), str(path), error)


def parse_json(text: str, where: str, error: type[V2hdmError]) -> Any:
    """What a JSON text holds, as :func:`read_json`; ``where`` it is from, for errors."""
    if json_depth(text) > MOST_DEPTH:
        raise error(f"{where}: JSON nested deeper than {MOST_DEPTH} levels; mend it")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entries = dict(pairs)
        if len(entries) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for n, name in enumerate(names) if name in names[:n])
            raise error(f"{where}: {shown(twice)} is there twice in one JSON object; keep one")
        return entries

    def whole(digits: str) -> int | float:
        # Not finite: whoever takes it refuses it, and says where it stands.
        return int(digits) if len(digits) <= MOST_DIGITS else float("inf")

    try:
        return json.loads(text, object_pairs_hook=once, parse_int=whole)
    except RecursionError:
        raise error(f"{where}: JSON nested too deep; mend it") from None
    except json.JSONDecodeError as failure:
        raise error(
            f"{where}: line {failure.lineno} JSON syntax error: {failure.msg}; mend that line"
        ) from None


def json_depth(text: str) -> int:
    """How deep lists and objects are nested in a JSON text."""
    letters = np.frombuffer(_QUOTED.sub("", text).encode("utf-8", "replace"), dtype=np.uint8)
    steps = np.isin(letters, _OPENING).astype(np.int32) - np.isin(letters, _CLOSING)
    return int(np.cumsum(steps).max(initial=0))


_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"')
_OPENING, _CLOSING = [ord("["), ord("{")], [ord("]"), ord("}")]


def take_name(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as a name that files, lines of a log and lists may be called by.

    Names of cameras, runs, drives and classes become parts of file names, whoever wrote them.

    Raises:
        V2hdmError: of type ``error``, when it is no text or number, is empty or too long, begins with a dot
            or has a separator of folders, a letter that does not show, or a blank at an end.
    """
    if isinstance(content, int | float) and not isinstance(content, bool):
        content = f"{content}"
    if not isinstance(content, str):
        raise error(f"{where}: expected a text as name, got {shown(content)}")
    if not content:
        raise error(f"{where}: a name is empty; give one")
    fault = None
    if set(content) & set("/\\"):
        fault = "has a separator of folders"
    elif not content.isprintable():
        fault = "has a letter that does not show, such as a line's end"
    elif content.startswith("."):
        fault = "begins with a dot"
    elif content != content.strip():
        fault = "begins or ends with a blank"
    elif len(content) > MOST_NAME_LETTERS or len(content.encode()) > _MOST_NAME_BYTES:
        fault = f"is longer than {MOST_NAME_LETTERS} letters"
    if fault is not None:
        raise error(f"{where}: the name {shown(content)} {fault}; choose another")
    return content


def take_camera_name(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as the name of a camera: none that results of several cameras bear."""
    name = take_name(content, where, error)
    if name.lower() in ALL_CAMERAS:
        raise error(
            f"{where}: a camera is called {shown(name)}, as results of all of them are; choose another"
        )
    return name


ALL_CAMERAS = ("both", "all")
"""What results of all cameras together are called."""


def shown(content: object) -> str:
    """``content`` as a short piece of one line: what a user wrote, quoted where it is a text."""
    if content is None:
        return "nothing"
    if isinstance(content, bool):
        return str(content).lower()
    if isinstance(content, dict):
        return "a mapping with " + shown(next(iter(content))) if content else "an empty mapping"
    if isinstance(content, list | tuple) and 1 < len(content) <= _FEW and not any(map(_has_parts, content)):
        return f"[{', '.join(map(shown, content))}]"
    if isinstance(content, list | tuple):
        return f"a list of {len(content)}" if len(content) != 1 else "a list of one"
    if isinstance(content, int) and abs(content) >= 10**MOST_DIGITS:
        return "a number of very many digits"
    text = "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}"
        for letter in str(content)[: _SHORT + 1]
    )
    if len(text) > _SHORT:
        text = f"{text[: _SHORT - 3]}..."
    return f"'{text}'" if isinstance(content, str) else text


def _has_parts(content: object) -> bool:
    return isinstance(content, dict | list | tuple)


class _Loader(yaml.SafeLoader):
    """PyYAML's own, for plain values: it counts what it makes and refuses what hides more than it shows."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._entries = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """The next node, with all that is in it."""
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        self._depth += 1
        if self._depth > MOST_DEPTH:
            _refuse(f"nested deeper than {MOST_DEPTH} levels", event.start_mark)
        begun = self._entries
        self._entries += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._sizes:
                _refuse("an alias of what it is part of", event.start_mark)
            self._entries += self._sizes[id(node)]
        if self._entries > MOST_ENTRIES:
            _refuse(f"more than {MOST_ENTRIES} values, with what aliases repeat", event.start_mark)
        self._sizes.setdefault(id(node), self._entries - begun)
        return node

    def construct_scalar(self, node: Any) -> Any:
        """The text of a scalar."""
        value = super().construct_scalar(node)
        if node.tag == _INT and len(value) > MOST_DIGITS:
            _refuse(f"a number of {len(value)} digits", node.start_mark)
        return value

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """The value of a node."""
        if node.tag not in _PLAIN:
            _refuse(f"the tag {shown(node.tag)}, where only plain values may be", node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, TypeError, LookupError):
            _refuse(f"{shown(node.value)} is not what its tag says", node.start_mark)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping, whose keys are the texts that are written there."""
        if not isinstance(node, yaml.MappingNode):
            _refuse("not the mapping that its tag says", node.start_mark)
        written = {}
        for key, _ in node.value:
            if key.tag == _MERGE:
                continue
            if not isinstance(key, yaml.ScalarNode):
                _refuse("a key that is a list or a mapping", key.start_mark)
            if key.value in written:
                _refuse(f"the key {shown(key.value)} is there twice", key.start_mark)
            written[key.value] = key
            key.tag = _TEXT
        return super().construct_mapping(node, deep)


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _refuse(problem: str, mark: Any) -> Never:
    raise yaml.constructor.ConstructorError(None, None, problem, mark)


_TEXT, _INT = "tag:yaml.org,2002:str", "tag:yaml.org,2002:int"
_MERGE = "tag:yaml.org,2002:merge"
_DATE = "tag:yaml.org,2002:timestamp"
_PLAIN = frozenset(
    f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map")
)
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _DATE]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
