"""Hydra, for commands only: a configuration composed, checked against its schema, turned into dataclasses.

Below the commands only dataclasses travel. Every key of ``conf/`` is checked, so that a typo stops a run
before anything is read.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_args

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from v2hdm.cli.command import Command
from v2hdm.cli.old_names import renamed_file, renamed_overrides
from v2hdm.errors import ConfigError, V2hdmError, masked, shown
from v2hdm.io.description import DRIVE_FILE
from v2hdm.safe.texts import read_yaml
from v2hdm.settings import NO_KEY, settings_of

_PACKAGE = Path(__file__).resolve().parents[1]  # the folder of v2hdm
_Schema = TypeVar("_Schema")


def conf_dir() -> Path:
    """Folder of the shipped configuration: inside the package when installed, else the checkout's."""
    packaged = _PACKAGE / "conf"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "conf"


def register(name: str, schema: type[Any]) -> None:
    """Make a dataclass the schema that ``conf/<name>.yaml`` builds on."""
    ConfigStore.instance().store(name=f"{name}_schema", node=schema)


class Job(NamedTuple):
    """One configuration to work on: ``settings``, and the same as text with all references resolved."""

    settings: Any
    yaml: str


@dataclass(frozen=True)
class Door:
    """The settings that a command takes: overrides of ``conf/<name>.yaml``, which ``schema`` checks.

    Attributes:
        name: of the configuration.
        schema: the dataclass that it fills.
        advice: on values that are missing.
        lists: whether ``--help`` lists a key, by its name.
        further: a line on keys that it does not list.
    """

    name: str
    schema: type[Any]
    advice: str
    lists: Callable[[str], bool] = lambda key: True
    further: str = ""


def work_on(command: Command, door: Door, work: Callable[[Job], int | None], arguments: Sequence[str]) -> int:
    """Compose the configuration with the command line and work on it; returns the exit code.

    Raises:
        ConfigError: a key or value is wrong.
    """
    parser = argparse.ArgumentParser(command.name, add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--help", "-h", action="store_true")
    parser.add_argument("--config-dir", "-cd", type=Path, action="append", default=[])
    parser.add_argument("--cfg", "-c", choices=["job"])
    parsed, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        raise ConfigError(f"there is no option {unknown[0]}; {command.name} --help lists them")
    if parsed.help:
        print(help_text(command, door))
        return 0
    overrides = [_quoted(override) for override in renamed_overrides(parsed.overrides)]
    try:
        _check_own_files(parsed.config_dir, overrides)
        with tempfile.TemporaryDirectory(prefix="v2hdm-") as folder:
            renamed = _renamed_files(parsed.config_dir, overrides, Path(folder))
            composed = _compose(door.name, door.schema, overrides, [*renamed, *parsed.config_dir])
    except V2hdmError:
        raise
    except Exception as error:  # whatever Hydra, OmegaConf and PyYAML raise about texts that users wrote
        raise explain(error, door.schema, overrides) from error
    if parsed.cfg:
        print(masked(OmegaConf.to_yaml(composed)))
        return 0
    return work(Job(to_dataclass(composed, door.schema, door.advice), to_yaml(composed))) or 0


def _quoted(override: str) -> str:
    """An override whose value is the path of something that exists, so that Hydra takes it as it is.

    Names of people's folders have umlauts, brackets and dates, which Hydra's grammar has other uses for.
    """
    key, equals, value = override.partition("=")
    is_plain = not _HYDRAS.search(value) and not (key == "drive.path" and _NUMBER.fullmatch(value))
    if not equals or is_plain or value[0] in "'\"[{":
        return override
    if not os.path.exists(value):  # noqa: PTH110, for names that are too long for a file are none
        return override
    return f"{key}='" + value.replace("'", "\\'") + "'"


# Letters that Hydra's grammar wants quotes around.
_HYDRAS = re.compile(r"[^\w./+:%@*-]|[^\x00-\x7f]")
_NUMBER = re.compile(r"[\d.]+")


def _compose(
    name: str, schema: type[Any], overrides: Sequence[str], folders: Sequence[Path] = ()
) -> DictConfig:
    """``conf/<name>.yaml`` with overrides; groups are looked for in further folders, too."""
    register(name, schema)
    places = ",".join("'file://" + str(folder.resolve()).replace("'", "\\'") + "'" for folder in folders)
    searching = [f"hydra.searchpath=[{places}]"] if places else []
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra.compose(name, [*searching, *overrides])


def compose_run_file(path: Path, name: str, schema: type[Any], overrides: Sequence[str] = ()) -> DictConfig:
    """Compose ``conf/<name>.yaml`` with a run file, as ``--config-dir`` and ``+run=`` do, and overrides.

    What its own ``defaults`` name is looked for beside it, in a folder ``run``, and among the shipped ones.
    """
    if not isinstance(read_yaml(path, ConfigError), dict):  # OmegaConf would expand whatever aliases repeat
        raise ConfigError(f"{path}: expected 'key: value' entries, as in conf/run/*.yaml")
    _refuse_headless(path)
    searched = [path.resolve().parent.parent] if path.resolve().parent.name == "run" else []
    with tempfile.TemporaryDirectory(prefix="v2hdm-") as folder:
        # Under a name of ours: Hydra takes no others than those of identifiers.
        run = Path(folder) / "run" / "chosen_run_file.yaml"
        run.parent.mkdir()
        text = renamed_file(path)
        if text is None:
            shutil.copyfile(path, run)
        else:
            run.write_text(text, encoding="utf-8")
        words = [f"+run={run.stem}", *renamed_overrides(overrides)]
        try:
            return _compose(name, schema, words, [Path(folder), *searched])
        except Exception as error:  # as in work_on
            # What the line does not name is the file's.
            of_line = [
                override for override in overrides if override.lstrip("+~").split("=")[0] in str(error)
            ]
            line = _OF_COPY.sub("", str(explain(error, schema, of_line)))
            raise ConfigError(f"{path}: {line}") from error


_OF_COPY = re.compile(r"In 'run/chosen_run_file': \w+ raised while composing config:;? ")


def _check_own_files(folders: Sequence[Path], overrides: Sequence[str]) -> None:
    """Read the user's own files that a command line has chosen: OmegaConf would expand their aliases."""
    for path in sorted((conf_dir() / "local").glob("*.yaml")):
        read_yaml(path, ConfigError)
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"--config-dir {folder}: no such folder")
        for group, _, chosen in (override.lstrip("+").partition("=") for override in overrides):
            if (path := folder / group / f"{chosen}.yaml").is_file():
                read_yaml(path, ConfigError)
                if group == "run":
                    _refuse_headless(path)


def _renamed_files(folders: Sequence[Path], overrides: Sequence[str], scratch: Path) -> list[Path]:
    """A folder with the chosen run files that have names of 1.0, by those of now; none where no file has."""
    for group, _, chosen in (override.lstrip("+").partition("=") for override in overrides):
        for path in (folder / group / f"{chosen}.yaml" for folder in folders if group == "run"):
            if path.is_file() and (text := renamed_file(path)) is not None:
                (scratch / group).mkdir(exist_ok=True)
                (scratch / group / path.name).write_text(text, encoding="utf-8")
    return [scratch] if (scratch / "run").is_dir() else []


def _refuse_headless(path: Path) -> None:
    if not re.search(r"^#\s*@package\s+_global_\s*$", path.read_text(encoding="utf-8-sig"), re.MULTILINE):
        if path.name == DRIVE_FILE:
            raise ConfigError(f"{path}: a drive; give a run file that names its folder (docs/fleet.md)")
        raise ConfigError(f"{path}: its first line must be '# @package _global_'; add it")


def to_dataclass(composed: DictConfig, schema: type[_Schema], advice: str) -> _Schema:
    """The composed configuration as ``schema``; ConfigError, with ``advice``, where a value is missing."""
    try:
        missing = sorted(OmegaConf.missing_keys(composed))
        if missing:
            raise ConfigError(f"configuration: no value for {', '.join(missing)}; {advice}")
        config = OmegaConf.to_object(composed)
    except OmegaConfBaseException as error:
        raise explain(error, schema, sys.argv[1:]) from error
    assert isinstance(config, schema)
    return config


def to_yaml(composed: DictConfig) -> str:
    """The composed configuration with all references resolved, to be kept beside the results."""
    return OmegaConf.to_yaml(composed, resolve=True)


def explain(error: Exception, schema: type[Any], overrides: list[str]) -> ConfigError:
    """One line for an error of Hydra or OmegaConf: what is wrong, with the nearest valid key."""
    root: BaseException = error
    while root.__cause__ is not None:
        root = root.__cause__
    lines = [line.strip().rstrip(".") for line in f"{error}\n{root}".splitlines() if line.strip()]
    message = "; ".join(dict.fromkeys(line for line in lines if not _NOISE.match(line)))
    key = re.search(r"full_key: (\S+)", f"{error}\n{root}")
    place = f" of {key.group(1)}" if key and key.group(1) not in message else ""
    bare = [override for override in overrides if "=" not in override and not override.startswith(("-", "~"))]
    if "missing EQUAL" in message or (bare and _UNQUOTED.search(message)):
        word = " ".join(bare[-1:]) or "an argument"
        return ConfigError(
            f"configuration: {shown(word)} is not key=value; write drive.path={word}, see --help"
        )
    # Of a long command line only what the message is about: the override that has the key it names.
    relevant = [override for override in overrides if override.lstrip("+~").split("=")[0] in message + place]
    repeated = relevant or overrides
    where = f" (in {' '.join(repeated)})" if 0 < len(repeated) <= _FEW_OVERRIDES else ""
    return ConfigError(f"configuration{where}: {message}{place}; {_advice(message, schema)}")


_FEW_OVERRIDES = 3  # an error repeats the command line up to so many overrides

_NOISE = re.compile(
    r"(\^$|full_key|To append to your config|reference_type|object_type|Config search path|provider="
    r"|Set the environment variable|See https?:|\d\. To sweep over)"
)

_UNQUOTED = re.compile(r"Lexer|no viable alternative|mismatched input|extraneous input|Unknown function")


def _advice(message: str, schema: type[Any]) -> str:
    if _UNQUOTED.search(message):
        return "a value with special characters needs quotes: \"drive.path='müll (1)'\""
    whole = re.search(r"Value (-?\d+) \(int\) is incompatible with type hint 'float'", message)
    if whole:  # OmegaConf turns whole numbers into fractions, but not inside of lists
        return f"write {whole.group(1)}.0"
    listed = re.search(r"override ([\w.]+)=(.*); Invalid value assigned: \w+ is not a ListConfig", message)
    if listed:
        return f"write {listed.group(1)}=[{listed.group(2)}]"
    unknown = re.search(r"[Kk]ey '([\w.]+)' (?:not in|is not in)", message)
    if unknown:
        leaves = [key.name.split(".") for key in keys_of(schema)]
        keys = dict.fromkeys(".".join(parts[:end]) for parts in leaves for end in range(1, len(parts) + 1))
        leaf = unknown.group(1).split(".")[-1]
        similar = difflib.get_close_matches(leaf, {key.split(".")[-1] for key in keys}, n=1)
        names = [key for key in keys if similar and key.split(".")[-1] == similar[0]]
        if names:
            return f"did you mean {' or '.join(names[:3])}?"
    return "--help lists the keys"


_USAGE = """\
Usage: {command} [key=value ...] [--config-dir FOLDER]

  +run=NAME           use the settings in conf/run/NAME.yaml or FOLDER/run/NAME.yaml
  key=value           set a key; null means none, lists are [1.0, 2.0], texts with spaces need quotes
  +key.name=value     add an entry to a key that is a mapping
  --config-dir FOLDER add a folder of your own; its runs are in FOLDER/run and begin with
                      '# @package _global_'
  --cfg job           only print the configuration
"""
_OFTEN = {
    "drive.path", "drive.format", "drive.cameras", "map.base", "mapping.max_range_m", "mapping.survey.file",
    "report.background", "simulate.name", "simulate.seed", "simulate.session", "simulate.initial_ipm",
}  # fmt: skip
"""Keys below others that are often set; the rest is for experts."""

_KINDS = {"str": "text", "int": "whole number", "float": "number", "bool": "true or false"}


class Key(NamedTuple):
    """A key as users write it: its type, its default and what it means."""

    name: str
    kind: str
    default: str
    meaning: str


def help_text(command: Command, door: Door) -> str:
    """The page that ``--help`` prints."""
    head = [_USAGE.format(command=command.name), command.says, ""]
    if "drive" in settings_of(door.schema):
        runs = ", ".join(sorted(path.stem for path in (conf_dir() / "run").glob("*.yaml")))
        head += [f"Shipped runs: {runs}", ""]
    often = ["Keys, as key (type, default):"]
    for_experts = ["", "For experts:"]
    for key in keys_of(door.schema):
        if door.lists(key.name):
            page = often if key.name in _OFTEN or "." not in key.name else for_experts
            page.append(f"  {key.name} ({key.kind}{f', {key.default}' if key.default else ''})")
            page += textwrap.wrap(key.meaning, 100, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join([*head, *often, *for_experts, *([door.further] if door.further else [])])


def keys_of(schema: type[Any], prefix: str = "") -> Iterator[Key]:
    """All keys below a dataclass, in order; those of an entry of a mapping stand under ``NAME``.

    Entries of a list have no keys: a list is set as a whole.
    """
    settings = settings_of(schema)
    for field in fields(schema):
        if field.metadata == NO_KEY:
            continue
        setting = settings[field.name]
        hint = setting.hint
        name = f"{prefix}{field.name}"
        below = schema_in(hint)
        is_mapping = hint is not below and "dict" in str(hint)
        is_list = hint is not below and _kind(hint) == "list"
        if hint is not below or below is None:
            yield Key(name, _kind(hint), _default(field), setting.meaning)
        if below is not None and not is_list:
            yield from keys_of(below, f"{name}.NAME." if is_mapping else f"{name}.")


def schema_in(hint: Any) -> type[Any] | None:
    """The dataclass that a type is, or that its entries are; None for plain values."""
    return next((kind for kind in (hint, *get_args(hint)) if _is_schema(kind)), None)


def _is_schema(kind: Any) -> bool:
    return isinstance(kind, type) and is_dataclass(kind)


def _kind(hint: Any) -> str:
    parts = [part for part in get_args(hint) if part is not type(None)]
    for word, kind in (("dict", "mapping"), ("list", "list")):
        if word in str(hint):
            return kind
    if parts:
        return f"{_kind(parts[0])} or null"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return " or ".join(str(choice.value) for choice in hint)
    return "mapping" if _is_schema(hint) else _KINDS.get(getattr(hint, "__name__", ""), "any")


def _default(field: Field[Any]) -> str:
    if field.default is MISSING and field.default_factory is MISSING:
        return "required"
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if is_dataclass(value) or isinstance(value, dict):
        return ""
    text = str(value.value if isinstance(value, Enum) else value)
    text = {"None": "null", "True": "true", "False": "false"}.get(text, text)
    return text if len(text) <= 40 else f"{text[:37]}..."
