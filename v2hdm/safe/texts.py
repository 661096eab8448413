"""Validation of texts from outside: every YAML, JSON and plain text file that others wrote is read here.

Readers get plain values (texts, numbers, booleans, lists, mappings with texts for keys) of bounded size and
depth, without duplicate keys. Anything else is one line of the caller's own error, with file and line.
"""

from __future__ import annotations

import codecs
import json
import re
import stat
from collections.abc import Callable, Hashable
from contextlib import suppress
from pathlib import Path
from typing import Any, Never

import numpy as np
import yaml

from v2hdm.errors import MOST_DIGITS, V2hdmError
from v2hdm.errors import shown as shown
from v2hdm.safe.placeholders import words_of_content
from v2hdm.store.inputs import note_input, warn_if_changed

MOST_BYTES = 1 << 30  # of a text file; an hour of poses at 100 Hz is 30 MB
MOST_YAML_BYTES = 1 << 24  # ours have kilobytes, and PyYAML takes a second for half a megabyte
MOST_DEPTH = 64  # of nested lists and mappings; ours are 8 deep
MOST_ENTRIES = 1_000_000  # values in a YAML file, with everything that an alias repeats
MOST_NAME_LETTERS = 64  # of a camera, run, drive or class; chosen
_MOST_NAME_BYTES = 200  # file systems end at 255 bytes
ALL_CAMERAS = ("both", "all")  # names of results of all cameras together
_NUMBERS = re.compile("([0-9]+)")
_HALF = "half a character (a lone surrogate)"
_ESCAPED_HALF = re.compile(r"\\u[dD][89a-fA-F]")
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"')
_READ_OTHERWISE = re.compile("[\\t?!\ufeff]|[|>]#")
"""Texts that libyaml reads and PyYAML refuses, or reads as something else (from mutated files)."""
_OPENING = [ord("["), ord("{")]
_CLOSING = [ord("]"), ord("}")]


def read_bytes(path: Path, error: type[V2hdmError], most: int = MOST_BYTES) -> bytes:
    """The bytes of a plain file, with a warning if we wrote it and it was changed; else raises ``error``."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            kind = "a folder" if stat.S_ISDIR(about.st_mode) else "a pipe or a device"
            raise error(f"{path}: is {kind}, not a file; check the path")
        if about.st_size > most:
            size = f"{about.st_size / 1e6:.0f} MB"
            largest = f"{most / 1e6:.0f} MB"
            raise error(f"{path}: has {size}, {largest} at most; check the path")
        note_input(path)
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise error(f"{path}: no such file; check the path or restore it") from None
    except (OSError, ValueError) as failure:  # ValueError: a path with a zero byte
        reason = getattr(failure, "strerror", None) or failure
        raise error(f"{path}: cannot be read ({reason}); check the path and its permissions") from None
    if words := words_of_content(data, path):
        raise error(f"{path}: {words}")
    warn_if_changed(path, data)
    return data


def read_text(path: Path, error: type[V2hdmError], most: int = MOST_BYTES) -> str:
    """The UTF-8 text of ``path`` without a byte order mark; errors as :func:`read_bytes`."""
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
        raise error(f"{path}: line {line}: a zero byte, so it is not text; restore the file")
    return text


def read_yaml(path: Path, error: type[V2hdmError]) -> Any:
    """The content of a YAML file; keys (``1``, ``no``) and dates are texts, and tags are refused."""
    # OpenCV and old ROS tools begin their files with a directive that YAML 1.1 refuses.
    return parse_yaml(read_text(path, error, MOST_YAML_BYTES).removeprefix("%YAML:1.0"), str(path), error)


def parse_yaml(text: str, where: str, error: type[V2hdmError]) -> Any:
    """The content of a YAML text from ``where``, as :func:`read_yaml`."""
    if _BY_LIBYAML is not None and not _READ_OTHERWISE.search(text):
        # What it refuses is read once more, by the loader whose errors name the line.
        with suppress(yaml.YAMLError, UnicodeError, RecursionError):
            return _BY_LIBYAML(text).get_single_data()
    try:
        return _Loader(text).get_single_data()  # looks for letters that are none at once
    except yaml.YAMLError as failure:
        mark = getattr(failure, "problem_mark", None)
        at = getattr(failure, "position", None)
        row = mark.line if mark is not None else None if at is None else text.count("\n", 0, at)
        line = "" if row is None else f" line {row + 1}"
        problem = getattr(failure, "problem", None) or getattr(failure, "reason", None) or "not readable"
        if "'\\t'" in problem:
            problem = "a tab instead of spaces"
        reason = " ".join(str(problem).split())
        raise error(f"{where}:{line} YAML syntax error: {reason}; fix that line") from None
    except RecursionError:  # the scanner's own
        raise error(f"{where}: YAML nested deeper than {MOST_DEPTH} levels; fix it") from None


def read_json(path: Path, error: type[V2hdmError]) -> Any:
    """The content of the JSON file at ``path``."""
    return parse_json(read_text(path, error), str(path), error)


def parse_json(text: str, where: str, error: type[V2hdmError]) -> Any:
    """The content of a JSON text from ``where``."""
    letters = np.frombuffer(_QUOTED.sub("", text).encode("utf-8", "replace"), dtype=np.uint8)
    steps = np.isin(letters, _OPENING).astype(np.int32) - np.isin(letters, _CLOSING)
    if np.cumsum(steps).max(initial=0) > MOST_DEPTH:
        raise error(f"{where}: JSON nested deeper than {MOST_DEPTH} levels; fix it")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entries = dict(pairs)
        if len(entries) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for n, name in enumerate(names) if name in names[:n])
            raise error(f"{where}: {shown(twice)} appears twice in one JSON object; keep one")
        return entries

    def whole(digits: str) -> int | float:
        # Not finite: whoever takes it refuses it, and says where it stands.
        return int(digits) if len(digits) <= MOST_DIGITS else float("inf")

    try:
        content = json.loads(text, object_pairs_hook=once, parse_int=whole)
        if _ESCAPED_HALF.search(text):  # of a pair of UTF-16, unless the other is there, too
            json.dumps(content, ensure_ascii=False).encode()
        return content
    except UnicodeEncodeError:
        raise error(f"{where}: {_HALF} instead of a text; fix it") from None
    except RecursionError:
        raise error(f"{where}: JSON nested too deep; fix it") from None
    except json.JSONDecodeError as failure:
        at = f"{where}: line {failure.lineno}"
        raise error(f"{at} JSON syntax error: {failure.msg}; fix that line") from None


def take_name(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as the name of a camera, run, drive or class, which becomes part of file names."""
    if isinstance(content, int | float) and not isinstance(content, bool):
        content = f"{content}"
    if not isinstance(content, str):
        raise error(f"{where}: expected a text as name, got {shown(content)}")
    if not content:
        raise error(f"{where}: a name is empty; give one")
    fault = None
    if set(content) & set("/\\"):
        fault = "has a path separator"
    elif not content.isprintable():
        fault = "has a letter that does not show, such as a line's end"
    elif content.startswith("."):
        fault = "begins with a dot"
    elif content != content.strip():
        fault = "begins or ends with a space"
    elif len(content) > MOST_NAME_LETTERS or len(content.encode()) > _MOST_NAME_BYTES:
        fault = f"is longer than {MOST_NAME_LETTERS} letters"
    if fault is not None:
        raise error(f"{where}: the name {shown(content)} {fault}; choose another")
    return content


def take_camera_name(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as the name of a camera, which none of :data:`ALL_CAMERAS` is."""
    name = take_name(content, where, error)
    if name.lower() in ALL_CAMERAS:
        raise error(f"{where}: a camera is called {shown(name)}, as results of all are; choose another")
    return name


def number_key(name: str) -> tuple[list[str | int], str]:
    """A key that sorts names by the numbers in them, as numbers; names of equal numbers by their letters."""
    parts: list[str | int] = [*_NUMBERS.split(name)]
    parts[1::2] = [int(digits) for digits in _NUMBERS.findall(name)]
    return parts, name


class _Plain(yaml.composer.Composer, yaml.constructor.SafeConstructor, yaml.resolver.Resolver):
    """A loader's half that makes plain values: it counts nodes and refuses tags, duplicates and bombs."""

    def __init__(self) -> None:
        yaml.composer.Composer.__init__(self)
        yaml.constructor.SafeConstructor.__init__(self)
        yaml.resolver.Resolver.__init__(self)
        self._depth = self._entries = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: yaml.Event = self.peek_event()  # type: ignore[attr-defined]  # of the other half
        self._depth += 1
        if self._depth > MOST_DEPTH:
            _refuse(f"nested deeper than {MOST_DEPTH} levels", event.start_mark)
        entries_before = self._entries
        self._entries += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._sizes:
                _refuse("an alias of something that contains it", event.start_mark)
            self._entries += self._sizes[id(node)]
        if self._entries > MOST_ENTRIES:
            _refuse(f"more than {MOST_ENTRIES} values, including aliases", event.start_mark)
        self._sizes.setdefault(id(node), self._entries - entries_before)
        return node

    def construct_scalar(self, node: Any) -> Any:
        value = super().construct_scalar(node)
        if node.tag == _INT and len(value) > MOST_DIGITS:
            _refuse(f"a number with {len(value)} digits", node.start_mark)
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            _refuse(_HALF, node.start_mark)
        return value

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        if node.tag not in _PLAIN:
            _refuse(f"the tag {shown(node.tag)}, but only plain values are allowed", node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, TypeError, LookupError):
            _refuse(f"{shown(node.value)} does not match its tag", node.start_mark)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        if not isinstance(node, yaml.MappingNode):
            _refuse("not a mapping, as its tag states", node.start_mark)
        written = {}
        for key, _ in node.value:
            if key.tag == _MERGE:
                continue
            if not isinstance(key, yaml.ScalarNode):
                _refuse("a key that is a list or a mapping", key.start_mark)
            if key.value in written:
                _refuse(f"the key {shown(key.value)} appears twice", key.start_mark)
            written[key.value] = key
            key.tag = _TEXT
        return super().construct_mapping(node, deep)


def _refuse(problem: str, mark: Any) -> Never:
    raise yaml.constructor.ConstructorError(None, None, problem, mark)


_TAG = "tag:yaml.org,2002:"
_TEXT, _INT, _MERGE, _DATE = (f"{_TAG}{kind}" for kind in ("str", "int", "merge", "timestamp"))
_PLAIN = frozenset(f"{_TAG}{kind}" for kind in ("null", "bool", "int", "float", "str", "seq", "map"))
_Plain.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _DATE]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


class _Loader(_Plain, yaml.reader.Reader, yaml.scanner.Scanner, yaml.parser.Parser):
    """PyYAML in Python alone."""

    def __init__(self, text: str) -> None:
        yaml.reader.Reader.__init__(self, text)
        yaml.scanner.Scanner.__init__(self)
        yaml.parser.Parser.__init__(self)
        _Plain.__init__(self)


def _by_libyaml() -> Callable[[str], Any] | None:
    """The loader whose parser is libyaml, four times as quick; None where PyYAML was built without it."""
    if not yaml.__with_libyaml__:
        return None

    class Loader(_Plain, yaml.cyaml.CParser):  # type: ignore[misc, name-defined]
        def __init__(self, text: str) -> None:
            yaml.cyaml.CParser.__init__(self, text)  # type: ignore[attr-defined]
            _Plain.__init__(self)

    return Loader


_BY_LIBYAML = _by_libyaml()
