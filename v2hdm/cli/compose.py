"""Hydra, for commands only: a configuration composed, checked against its schema, turned into dataclasses.

Below the commands only dataclasses travel. Every key of ``conf/`` is checked, so that a typo stops a run
before anything is read.
"""

from __future__ import annotations

import difflib
import itertools
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from v2hdm.cli.main import Command
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.io.safe.texts import read_yaml

_PACKAGE = Path(__file__).resolve().parents[1]
_Schema = TypeVar("_Schema")


def conf_dir() -> Path:
    """Folder of the shipped configuration: inside the package when installed, else the checkout's."""
    packaged = _PACKAGE / "conf"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "conf"


def register(name: str, schema: type[Any]) -> None:
    """Make a dataclass the schema that ``conf/<name>.yaml`` builds on."""
    ConfigStore.instance().store(name=f"{name}_schema", node=schema)


@dataclass(frozen=True)
class Job:
    """One configuration to work on.

    Attributes:
        composed: the configuration.
        label: of a sweep (``--multirun``) the job's number and what it sets, as part of a file's name; None
            where there is one job only.
    """

    composed: DictConfig
    label: str | None

    def folder(self, output: str) -> str:
        """The folder ``output``, of a sweep one within it for this job.

        Raises:
            ConfigError: a sweep is to write to a URL.
        """
        if self.label is not None:
            _refuse_url(output)
        return output if self.label is None else str(Path(output) / self.label)


def work_on(
    command: Command,
    name: str,
    schema: type[Any],
    work: Callable[[Job], int | None],
    arguments: Sequence[str],
) -> int:
    """Compose ``conf/<name>.yaml`` with the command line and work on it, once as a rule.

    Nothing is done after ``--help``. A sweep (``--multirun``) works on each of its configurations, perhaps in
    other processes, and ends with the code of the first that failed.

    Args:
        command: whose work it is; a job of a sweep that fails is one line, as the command's own failure.
        name: of the configuration.
        schema: the dataclass that it builds on.
        work: what to do; returns an exit code, or None for 0.
        arguments: the command line.

    Raises:
        ConfigError: A key or value is wrong, or Hydra cannot make the output folder.
    """
    # Hydra prints composition errors its own way and exits with 1 unless it is asked to raise them.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    if {"--help", "-h"} & set(arguments):
        from v2hdm.cli.keys_help import help_text

        print(help_text(command.name, command.says, schema, conf_dir()))
        return 0
    if {"--multirun", "-m"} & set(arguments):  # Hydra would make folders that are called like URLs
        for one in arguments:
            if one.startswith("output="):
                _refuse_url(one.removeprefix("output="))
    for path in _own_files(arguments):
        read_yaml(path, ConfigError)  # OmegaConf would expand whatever aliases repeat
    register(name, schema)
    task = _Task(work, command, tuple(arguments))
    compose = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=name)(task)
    given = sys.argv
    sys.argv = [command.name, *_options_first(arguments)]
    try:
        compose()
    except _JobFailed as failure:
        return failure.code
    except BrokenPipeError:  # --hydra-help has met a reader who has had enough
        raise
    except Exception as error:  # whatever Hydra, OmegaConf and PyYAML raise about texts that users wrote
        if _OF_WORK in getattr(error, "__notes__", ()):
            raise
        raise _composition_error(error, schema, list(arguments)) from error
    finally:
        sys.argv = given
    if task.failure:
        raise task.failure[0]
    return task.codes[0] if task.codes else 0


def _refuse_url(output: str) -> None:
    if "://" in output:
        raise ConfigError(
            f"output={output}: a sweep writes to folders of this machine; give one, or map with one setting "
            "at a time"
        )


def compose_run_file(path: Path, name: str, schema: type[Any], overrides: Sequence[str] = ()) -> DictConfig:
    """Compose ``conf/<name>.yaml`` with a run file, as ``--config-dir`` and ``+run=`` do, and overrides.

    What the run file names in a ``defaults`` list of its own is looked for beside it, where its folder is
    called ``run``, and among the shipped ones.

    Raises:
        ConfigError: the file is missing or damaged, or a key or value is wrong.
    """
    text = read_yaml(path, ConfigError)  # OmegaConf would expand whatever aliases repeat
    if not isinstance(text, dict):
        raise ConfigError(f"{path}: expected 'key: value' entries; write it as conf/run/*.yaml are")
    _refuse_headless(path)
    register(name, schema)
    searched = [path.resolve().parent.parent] if path.resolve().parent.name == "run" else []
    with tempfile.TemporaryDirectory(prefix="v2hdm-") as folder:
        # Under a name of ours: Hydra takes no others than those of identifiers.
        run = Path(folder) / "run" / "chosen_run_file.yaml"
        run.parent.mkdir()
        shutil.copyfile(path, run)
        places = ",".join(
            "'file://" + str(one).replace("'", "\\'") + "'" for one in [Path(folder), *searched]
        )
        chosen = [f"hydra.searchpath=[{places}]", f"+run={run.stem}", *overrides]
        GlobalHydra.instance().clear()
        try:
            with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
                return hydra.compose(name, chosen)
        except Exception as error:  # as in work_on
            # What the line does not name is the file's.
            named = [one for one in overrides if one.lstrip("+~").split("=")[0] in str(error)]
            line = _OF_COPY.sub("", str(explain(error, schema, named)))
            raise ConfigError(f"{path}: {line}") from error


_OF_COPY = re.compile(r"In 'run/chosen_run_file': \w+ raised while composing config:;? ")


class _JobFailed(Exception):  # noqa: N818  # reported already: it only carries a code between processes
    """A job of a sweep did not end well."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


_OF_WORK = "while working, after the configuration was composed"


@dataclass
class _Task:
    """The work that Hydra calls with each composed configuration; launchers take it into other processes."""

    work: Callable[[Job], int | None]
    command: Command
    arguments: tuple[str, ...]
    codes: list[int] = field(default_factory=list)
    failure: list[BaseException] = field(default_factory=list)

    def __call__(self, composed: DictConfig) -> int:
        running = HydraConfig.get()
        if running.mode is not RunMode.MULTIRUN:
            try:
                self.codes.append(self.work(Job(composed, None)) or 0)
            except Exception as error:  # Hydra would take it for one of its own
                self.failure.append(error)
            return 0
        swept = [one for one in running.overrides.task if one not in self.arguments]
        label = re.sub(r"[^\w.=,+-]+", "_", f"{running.job.num}-{','.join(swept)}")[:_LABEL_LETTERS]
        try:
            code = self.command.guard(lambda: self._labelled(Job(composed, label.rstrip("-."))))
        except Exception as error:
            error.add_note(_OF_WORK)
            raise
        if code:
            raise _JobFailed(code)
        return 0

    def _labelled(self, job: Job) -> int | None:
        try:
            return self.work(job)
        except V2hdmError as error:
            raise type(error)(f"job {job.label}: {error}") from error


_LABEL_LETTERS = 100

_WITH_VALUE = {
    "--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--package", "-p", "--cfg", "-c",
    "--experimental-rerun",
}  # fmt: skip
"""Options of Hydra that are followed by a value."""


def _options_first(arguments: Sequence[str]) -> list[str]:
    """The arguments with Hydra's options before all overrides: it takes no override after an option."""
    options, overrides = [], []
    rest = iter(arguments)
    for argument in rest:
        if argument.startswith("-"):
            options.append(argument)
            if argument in _WITH_VALUE:
                options += [value for value in [next(rest, None)] if value is not None]
        else:
            overrides.append(argument)
    return [*options, *overrides]


def _composition_error(error: Exception, schema: type[Any], arguments: list[str]) -> ConfigError:
    """One line for what is wrong with a configuration, and in which file where it is one."""
    if isinstance(error, OSError) and error.filename:
        return ConfigError(
            f"{error.filename}: no folder can be made there ({error.strerror}); set another output="
        )
    for path in _own_files(arguments):
        if path.parent.name == "run":
            _refuse_headless(path)
    return explain(error, schema, arguments)


def _refuse_headless(path: Path) -> None:
    if not _GLOBAL.search(path.read_text(encoding="utf-8-sig")):
        raise ConfigError(f"{path}: its first line must be '# @package _global_'; add it")


_GLOBAL = re.compile(r"^#\s*@package\s+_global_\s*$", re.MULTILINE)


def _own_files(arguments: Sequence[str]) -> list[Path]:
    """The configuration files of the user's own that a command line has chosen."""
    files = sorted((conf_dir() / "local").glob("*.yaml"))
    for argument, value in itertools.pairwise([*arguments, ""]):
        name, _, rest = argument.partition("=")
        if name in ("--config-dir", "-cd"):
            folder = Path(rest or value)
            for choice in (one.lstrip("+") for one in arguments if not one.startswith("-")):
                group, _, names = choice.partition("=")
                files += [folder / group / f"{one}.yaml" for one in names.split(",")]
    return [path for path in files if path.is_file()]


def to_dataclass(composed: DictConfig, schema: type[_Schema], advice: str) -> _Schema:
    """The composed configuration as the dataclass ``schema``.

    Raises:
        ConfigError: A required value is missing, for which there is ``advice``, or one is wrong.
    """
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
    if "missing EQUAL" in message:
        bare = [one for one in overrides if "=" not in one and not one.startswith(("-", "~"))]
        named = " ".join(bare[:1]) or "an argument"
        return ConfigError(
            f"configuration: '{named}' is no key=value; write drive.path={named}, or see --help"
        )
    # Of a long command line only what the message is about: the override that has the key it names.
    about = [one for one in overrides if one.lstrip("+~").split("=")[0] in message + place]
    where = f" (in {' '.join(about or overrides)})" if 0 < len(about or overrides) <= _FEW_OVERRIDES else ""
    return ConfigError(f"configuration{where}: {message}{place}; {_advice(message, schema)}")


_FEW_OVERRIDES = 3

_NOISE = re.compile(
    r"(\^$|full_key|To append to your config|reference_type|object_type|Config search path|provider="
    r"|Set the environment variable|See https?:)"
)

_UNQUOTED = re.compile(r"Lexer|no viable alternative|mismatched input|extraneous input|Unknown function")


def _advice(message: str, schema: type[Any]) -> str:
    """Advice on an error of Hydra."""
    if _UNQUOTED.search(message):
        return "a value with signs or letters of its own wants quotes: \"drive.path='müll (1)'\""
    whole = re.search(r"Value (-?\d+) \(int\) is incompatible with type hint 'float'", message)
    if whole:  # OmegaConf turns whole numbers into fractions, but not inside of lists
        return f"write {whole.group(1)}.0"
    unknown = re.search(r"[Kk]ey '([\w.]+)' (?:not in|is not in)", message)
    if unknown:
        known = _keys(schema)
        leaf = unknown.group(1).split(".")[-1]
        near = difflib.get_close_matches(leaf, {key.split(".")[-1] for key in known}, n=1)
        names = [key for key in known if near and key.split(".")[-1] == near[0]]
        if names:
            return f"did you mean {' or '.join(names[:3])}?"
    return "--help lists the keys"


def _keys(schema: type[Any], prefix: str = "") -> list[str]:
    """All dotted keys below a dataclass."""
    found = []
    hints = get_type_hints(schema)
    for item in fields(schema):
        key = f"{prefix}{item.name}"
        found.append(key)
        for candidate in (hints[item.name], *get_args(hints[item.name])):
            if is_dataclass(candidate) and isinstance(candidate, type):
                found += _keys(candidate, f"{key}.")
    return found
