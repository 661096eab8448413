"""Hydra at the door: schemas registered, the composed configuration turned into dataclasses.

Below this module only dataclasses travel. Every key of ``conf/`` is checked against the schema, so
that a typo stops a run before anything is read.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from v2hdm.errors import ConfigError
from v2hdm.pipeline import RunConfig

_PACKAGE = Path(__file__).resolve().parent


def conf_dir() -> Path:
    """Folder of the shipped configuration: inside the package when installed, else the checkout's."""
    packaged = _PACKAGE / "conf"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "conf"


def register_schemas() -> None:
    """Make :class:`v2hdm.pipeline.RunConfig` the schema that ``conf/map.yaml`` builds on."""
    ConfigStore.instance().store(name="map_schema", node=RunConfig)


def to_run_config(composed: DictConfig) -> RunConfig:
    """The composed configuration as dataclasses.

    Raises:
        ConfigError: A required value is missing.
    """
    missing = sorted(OmegaConf.missing_keys(composed))
    if missing:
        raise ConfigError(
            f"configuration: no value for {', '.join(missing)}; choose a run (+run=port1, +run=port2, "
            f"+run=kitti drive.path=...) or set it on the command line"
        )
    config = OmegaConf.to_object(composed)
    assert isinstance(config, RunConfig)
    return config


def to_yaml(composed: DictConfig) -> str:
    """The composed configuration with all references resolved, to be kept beside the results."""
    return OmegaConf.to_yaml(composed, resolve=True)


def explain(error: Exception, overrides: list[str]) -> ConfigError:
    """One line for an error of Hydra or OmegaConf: what is wrong, with the nearest valid key."""
    root: BaseException = error
    while root.__cause__ is not None:
        root = root.__cause__
    lines = [line.strip().rstrip(".") for line in f"{error}\n{root}".splitlines() if line.strip()]
    message = "; ".join(dict.fromkeys(line for line in lines if not _NOISE.match(line)))
    unknown = re.search(r"[Kk]ey '([\w.]+)' (?:not in|is not in)", message)
    hint = ""
    if unknown:
        known = _keys(RunConfig)
        leaf = unknown.group(1).split(".")[-1]
        near = difflib.get_close_matches(leaf, {k.split(".")[-1] for k in known}, n=1)
        names = [key for key in known if near and key.split(".")[-1] == near[0]]
        hint = f"; did you mean {' or '.join(names[:3])}?" if names else ""
    if _UNQUOTED.search(message):
        hint = "; a value with signs or letters of its own wants quotes: \"drive.path='müll (1)'\""
    whole = re.search(r"Value (-?\d+) \(int\) is incompatible with type hint 'float'", message)
    if whole:  # OmegaConf turns whole numbers into fractions, but not inside of lists
        hint = f"; write {whole.group(1)}.0"
    key = re.search(r"full_key: (\S+)", f"{error}\n{root}")
    place = f" of {key.group(1)}" if key and key.group(1) not in message else ""
    where = f" (in {' '.join(overrides)})" if overrides else ""
    return ConfigError(f"configuration{where}: {message}{place}{hint}")


_NOISE = re.compile(
    r"(\^$|full_key|To append to your config|reference_type|object_type"
    r"|Set the environment variable|See https?:)"
)

_UNQUOTED = re.compile(r"Lexer|no viable alternative|mismatched input|extraneous input|Unknown function")


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
