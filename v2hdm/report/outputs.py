"""The folder of a run's results: it appears whole, or not at all."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError


@contextmanager
def result_folder(folder: Path) -> Iterator[Path]:
    """A hidden folder beside ``folder`` to write into, which takes its place when the block succeeds.

    An earlier result stays untouched until then; after an error nothing new is left.

    Raises:
        ConfigError: The folder cannot be written, or holds something that is no earlier result.
    """
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "config.yaml").is_file():
        raise ConfigError(
            f"output folder {folder} holds files that are no results of ours: name another with output="
        )
    unfinished = folder.with_name(f".{folder.name}.part")
    previous = folder.with_name(f".{folder.name}.previous")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            f"output folder {folder} cannot be written: {error.strerror}; set output="
        ) from error
    try:
        yield unfinished
        shutil.rmtree(previous, ignore_errors=True)
        if folder.exists():
            folder.replace(previous)
        unfinished.replace(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.rmtree(previous, ignore_errors=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write strict JSON; figures that do not exist (nan) are left out of their object."""
    path.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items() if not _is_nan(item)}
    if isinstance(value, (list, tuple)):
        return [None if _is_nan(item) else _finite(item) for item in value]
    return value.item() if hasattr(value, "item") else value


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)
