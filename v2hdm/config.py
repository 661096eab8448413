"""Hydra at the doors: a configuration composed, checked against its schema, turned into dataclasses.

Below the doors only dataclasses travel. Every key of ``conf/`` is checked, so that a typo stops a run
before anything is read.
"""

from __future__ import annotations

import difflib
import os
import re
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from v2hdm.errors import ConfigError

_PACKAGE = Path(__file__).resolve().parent
_Schema = TypeVar("_Schema")


def conf_dir() -> Path:
    """Folder of the shipped configuration: inside the package when installed, else the checkout's."""
    packaged = _PACKAGE / "conf"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "conf"


def register(name: str, schema: type[Any]) -> None:
    """Make a dataclass the schema that ``conf/<name>.yaml`` builds on."""
    ConfigStore.instance().store(name=f"{name}_schema", node=schema)


def compositions(name: str, schema: type[Any]) -> list[DictConfig]:
    """``conf/<name>.yaml`` composed with the command line.

    One as a rule; none after ``--help``, and several after ``--multirun``.

    Raises:
        ConfigError: A key or value is wrong, or Hydra cannot make the output folder.
    """
    # Hydra prints composition errors its own way and exits with 1 unless told to raise them.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    register(name, schema)
    composed: list[DictConfig] = []
    compose = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=name)(composed.append)
    try:
        compose()
    except (HydraException, OmegaConfBaseException) as error:
        raise explain(error, schema, sys.argv[1:]) from error
    except BrokenPipeError:  # --help has met a reader who has had enough
        raise
    except OSError as error:
        raise ConfigError(
            f"{error.filename}: no folder can be made there ({error.strerror}); set another output="
        ) from None
    return composed


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
    where = f" (in {' '.join(overrides)})" if overrides else ""
    return ConfigError(f"configuration{where}: {message}{place}; {_advice(message, schema)}")


_NOISE = re.compile(
    r"(\^$|full_key|To append to your config|reference_type|object_type|Config search path|provider="
    r"|Set the environment variable|See https?:)"
)

_UNQUOTED = re.compile(r"Lexer|no viable alternative|mismatched input|extraneous input|Unknown function")


def _advice(message: str, schema: type[Any]) -> str:
    """What to do about an error of Hydra."""
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
