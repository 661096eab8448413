"""Finished results: one that nothing has changed for is taken as it lies there."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.errors import V2hdmError
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.keys import Contents, read_drives, result_key
from v2hdm.simulate.port.drive import folder_of_port
from v2hdm.store.cache.folders import note_use
from v2hdm.store.cache.keys import code_key, key_of
from v2hdm.store.cache.room import Room
from v2hdm.store.cache.store import Store
from v2hdm.store.outputs import files_of_result, is_whole
from v2hdm.verdict.verdict import Verdict

_log = logging.getLogger(__name__)

_STAGE = "finished"
NOTHING_CHANGED = "nothing has changed: %s is taken as it is (resume=false makes it anew)"


@dataclass(frozen=True)
class RunResult:
    """The folder of a run, ``metrics.json``'s content, sentences for a reader, and the verdict.

    Where the results are at an object store, ``url`` says where, and the folder is gone.
    """

    folder: Path
    metrics: Mapping[str, Any]
    headlines: Sequence[str]
    verdict: Verdict
    url: str = ""

    @property
    def place(self) -> str:
        """Where the results are, as a user is told."""
        return self.url or str(self.folder)


@dataclass(frozen=True)
class _Finished:
    """A result and the key of what it was made of; ``files`` are SHA-256 of our files in its folder."""

    key: str
    files: dict[str, str]
    result: RunResult


def note_finished(result: RunResult, key: str, store: Store) -> None:
    """Keep what is needed to know that nothing has changed since."""
    kept = _Finished(key, files_of_result(result.folder), result)
    Room(store.on_disk).keep(_STAGE, _place(result.folder), _Finished, kept)


def key_of_finished(folder: Path, store: Store) -> str | None:
    """The key of what the result in a folder was made of, where that is known."""
    kept = Room(store.on_disk).take(_STAGE, _place(folder), _Finished)
    return None if kept is None else kept.key


def finished(config: RunConfig, store: Store) -> RunResult | None:
    """The result of a run where it lies in its folder already, whole, and made of the same; else None.

    Nothing is refused here: what cannot be read is told by the run that follows.
    """
    try:
        folder = Path(config.output) / run_name(config)
        kept = Room(store.on_disk).take(_STAGE, _place(folder), _Finished)
        if kept is None or not is_whole(folder, kept.files) or not is_of(config, kept.key):
            return None
    except (V2hdmError, OSError):
        return None
    _log.info(NOTHING_CHANGED, folder)
    return RunResult(folder, kept.result.metrics, kept.result.headlines, kept.result.verdict)


def is_of(config: RunConfig, key: str) -> bool:
    """Whether ``key`` is that of a run's result, made now.

    Raises:
        V2hdmError, OSError: what it would be made of cannot be read.
    """
    if config.simulate is not None:
        paths: tuple[Path, ...] = (folder_of_port(config.simulate, Path(config.cache)),)
        note_use(paths[0])
    else:
        paths = config.drive.paths
    drives = read_drives(config, paths)
    return key == result_key(config, drives, Contents.of(drives), key_of(code_key()))


def _place(folder: Path) -> str:
    return key_of(folder.resolve())
