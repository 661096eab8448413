"""``--help`` of the commands that Hydra configures: every key with its default, explained by its dataclass.

The docstrings are the only source: an entry of ``Attributes``, else the sentences that name the key.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_type_hints

_WIDTH = 100
_USAGE = """\
Usage: {command} [key=value ...] [--config-dir FOLDER] [--multirun]

  +run=NAME           a run: what conf/run/NAME.yaml or FOLDER/run/NAME.yaml sets
  key=value           sets a key; null is nothing, lists are [1.0, 2.0], texts with blanks want quotes
  +key.name=value     adds an entry to a key that is a mapping
  --config-dir FOLDER adds a folder of your own; its runs lie in FOLDER/run and begin with
                      '# @package _global_'
  --multirun          one job for each of several values: key=1,2,3; each has its own folder of results
  --cfg job           only prints the configuration
  --hydra-help        what else Hydra knows
"""


@dataclass(frozen=True)
class Key:
    """A key as users write it: its type, its default and what it means."""

    name: str
    kind: str
    default: str
    meaning: str


def help_text(command: str, says: str, schema: type[Any], conf: Path) -> str:
    """The page that ``--help`` prints.

    Args:
        command: as users type it.
        says: a sentence about it.
        schema: the dataclass of its configuration.
        conf: the folder of the shipped configuration.
    """
    parts = [_USAGE.format(command=command), says, ""]
    names = {one.name for one in fields(schema)}
    if "drive" in names:
        parts += [
            f"Shipped runs: {', '.join(sorted(path.stem for path in (conf / 'run').glob('*.yaml')))}",
            "",
        ]
    parts.append("Keys, as key (type, default):")
    for key in keys_of(schema):
        default = f", {key.default}" if key.default else ""
        parts.append(f"  {key.name} ({key.kind}{default})")
        if key.meaning:
            parts += textwrap.wrap(key.meaning, _WIDTH, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(parts)


def keys_of(schema: type[Any], prefix: str = "") -> Iterator[Key]:
    """All keys below a dataclass, in order; those of an entry of a mapping stand under ``NAME``."""
    hints = get_type_hints(schema)
    for one in fields(schema):
        hint = hints[one.name]
        below = next((kind for kind in (hint, *get_args(hint)) if _is_schema(kind)), None)
        name = f"{prefix}{one.name}"
        if below is None:
            yield Key(name, _kind(hint), _default(one), meaning_of(schema, one.name))
            continue
        entries = f"{name}.NAME." if hint is not below and dict in _origins(hint) else f"{name}."
        if "NAME" in entries or hint is not below:
            about = " ".join((inspect.getdoc(below) or "").split("\n\n")[0].split())
            yield Key(name, _kind(hint), _default(one), meaning_of(schema, one.name) or about)
        yield from keys_of(below, entries)


def meaning_of(schema: type[Any], name: str) -> str:
    """What the docstring of a dataclass, or of what it extends, says about one of its keys."""
    for owner in schema.__mro__:
        text = inspect.cleandoc(owner.__doc__ or "") if "__doc__" in vars(owner) else ""
        prose, _, attributes = text.partition("Attributes:\n")
        for entry in re.split(r"\n(?=    \w+: )", "\n" + attributes):
            key, found, meaning = entry.strip().partition(": ")
            if found and key == name:
                return _plain(" ".join(meaning.split("\n\n")[0].split()))
        sentences = re.split(r"(?<=[.;:])\s+(?=[`A-Z])", " ".join(prose.split()))
        told = [sentence for sentence in sentences if f"``{name}``" in sentence]
        if told:
            return _plain(" ".join(told))
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


def _origins(hint: Any) -> tuple[Any, ...]:
    return (getattr(hint, "__origin__", None), *(getattr(one, "__origin__", None) for one in get_args(hint)))


def _kind(hint: Any) -> str:
    if isinstance(hint, type) and not get_args(hint):
        if issubclass(hint, Enum):
            return " or ".join(str(one.value) for one in hint)
        plain = {"str": "text", "int": "whole number", "float": "number", "bool": "true or false"}
        return plain.get(hint.__name__, "mapping" if is_dataclass(hint) else hint.__name__)
    parts = [one for one in get_args(hint) if one is not type(None)]
    if dict in _origins(hint):
        return "mapping"
    if list in _origins(hint):
        return "list"
    return f"{_kind(parts[0])} or null" if parts else str(hint)


def _default(one: Field[Any]) -> str:
    if one.default is not MISSING:
        value = one.default
    elif one.default_factory is not MISSING:
        value = one.default_factory()
    else:
        return "required"
    if value is None:
        return "null"
    if is_dataclass(value) or isinstance(value, dict):
        return ""
    if isinstance(value, Enum):
        return str(value.value)
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
