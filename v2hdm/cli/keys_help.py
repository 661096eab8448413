"""``--help`` of the commands that Hydra configures: every key with its default, explained by its dataclass.

The docstrings are the only source: an entry of ``Attributes``, else the sentences that name the key.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

_USAGE = """\
Usage: {command} [key=value ...] [--config-dir FOLDER]

  +run=NAME           a run: what conf/run/NAME.yaml or FOLDER/run/NAME.yaml sets
  key=value           sets a key; null is nothing, lists are [1.0, 2.0], texts with blanks want quotes
  +key.name=value     adds an entry to a key that is a mapping
  --config-dir FOLDER adds a folder of your own; its runs lie in FOLDER/run and begin with
                      '# @package _global_'
  --cfg job           only prints the configuration
"""
_OFTEN = {
    "drive.path", "drive.format", "drive.cameras", "map.base", "mapping.max_range_m", "mapping.survey.file",
    "report.background",
}  # fmt: skip
"""Keys below others that are often set; the rest is for experts."""

_KINDS = {"str": "text", "int": "whole number", "float": "number", "bool": "true or false"}


class Key(NamedTuple):
    """A key as users write it: its type, its default and what it means."""

    name: str
    kind: str
    default: str
    meaning: str


def help_text(command: str, says: str, schema: type[Any], conf: Path) -> str:
    """The page that ``--help`` prints, of a command, a sentence about it, its dataclass and ``conf/``."""
    parts = [_USAGE.format(command=command), says, ""]
    if "drive" in {one.name for one in fields(schema)}:
        runs = ", ".join(sorted(path.stem for path in (conf / "run").glob("*.yaml")))
        parts += [f"Shipped runs: {runs}", ""]
    often: list[str] = ["Keys, as key (type, default):"]
    rest: list[str] = ["", "For experts:"]
    for key in keys_of(schema):
        page = often if key.name in _OFTEN or "." not in key.name else rest
        page.append(f"  {key.name} ({key.kind}{f', {key.default}' if key.default else ''})")
        page += textwrap.wrap(key.meaning, 100, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join([*parts, *often, *rest])


def keys_of(schema: type[Any], prefix: str = "") -> Iterator[Key]:
    """All keys below a dataclass, in order; those of an entry of a mapping stand under ``NAME``."""
    hints = get_type_hints(schema)
    for one in fields(schema):
        hint, name = hints[one.name], f"{prefix}{one.name}"
        below = next((kind for kind in (hint, *get_args(hint)) if _is_schema(kind)), None)
        is_mapping = hint is not below and "dict" in str(hint)
        if below is None or hint is not below:
            about = "" if below is None else " ".join((inspect.getdoc(below) or "").split("\n\n")[0].split())
            yield Key(name, _kind(hint), _default(one), meaning_of(schema, one.name) or about)
        if below is not None:
            yield from keys_of(below, f"{name}.NAME." if is_mapping else f"{name}.")


def meaning_of(schema: type[Any], name: str) -> str:
    """The meaning of a key by the docstring of its dataclass, or of one that this extends."""
    for owner in schema.__mro__:
        text = inspect.cleandoc(owner.__doc__ or "") if "__doc__" in vars(owner) else ""
        prose, _, attributes = text.partition("Attributes:\n")
        for entry in re.split(r"\n(?=    \w+: )", "\n" + attributes):
            key, found, meaning = entry.strip().partition(": ")
            if found and key == name:
                return _plain(" ".join(meaning.split("\n\n")[0].split()))
        sentences = re.split(r"(?<=[.;:])\s+(?=[`A-Z])", " ".join(prose.split()))
        naming = [sentence for sentence in sentences if f"``{name}``" in sentence]
        if naming:
            return _plain(" ".join(naming))
        for module, other in re.findall(r":class:`~?([\w.]+)\.(\w+)`", text):
            described = getattr(importlib.import_module(module), other)
            if _is_schema(described) and (meaning := meaning_of(described, name)):
                return meaning
    return ""


def _plain(text: str) -> str:
    """A docstring's sentence without its markup, in the words of YAML."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", text)
    return re.sub(r"\bNone\b", "null", text.replace("`", ""))


def _is_schema(kind: Any) -> bool:
    return isinstance(kind, type) and is_dataclass(kind)


def _kind(hint: Any) -> str:
    parts = [one for one in get_args(hint) if one is not type(None)]
    for word, kind in (("dict", "mapping"), ("list", "list")):
        if word in str(hint):
            return kind
    if parts:
        return f"{_kind(parts[0])} or null"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return " or ".join(str(one.value) for one in hint)
    return "mapping" if _is_schema(hint) else _KINDS.get(getattr(hint, "__name__", ""), "any")


def _default(one: Field[Any]) -> str:
    if one.default is MISSING and one.default_factory is MISSING:
        return "required"
    value = one.default if one.default_factory is MISSING else one.default_factory()
    if is_dataclass(value) or isinstance(value, dict):
        return ""
    text = str(value.value if isinstance(value, Enum) else value)
    text = {"None": "null", "True": "true", "False": "false"}.get(text, text)
    return text if len(text) <= 40 else f"{text[:37]}..."
