"""Finished results: one that nothing has changed for is taken as it lies there."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.caching.folders import note_use
from v2hdm.caching.keys import code_key, key_of
from v2hdm.caching.room import Room
from v2hdm.caching.store import Store
from v2hdm.errors import V2hdmError
from v2hdm.outputs import files_of_result, is_whole
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.keys import Contents, read_drives, result_key
from v2hdm.quality.verdict import Verdict
from v2hdm.simulate.port.drive import folder_of_port

_log = logging.getLogger(__name__)

_STAGE = "finished"


@dataclass(frozen=True)
class RunResult:
    """The folder of a run, ``metrics.json``'s content, sentences for a reader, and the verdict."""

    folder: Path
    metrics: Mapping[str, Any]
    headlines: Sequence[str]
    verdict: Verdict


@dataclass(frozen=True)
class _Finished:
    """A result and the key of what it was made of; ``files`` are SHA-256 of our files in its folder."""

    key: str
    files: dict[str, str]
    result: RunResult


def note_finished(result: RunResult, key: str, store: Store) -> None:
    """Keep what is needed to know that nothing has changed since."""
    kept = _Finished(key, files_of_result(result.folder), result)
    Room(store).keep(_STAGE, _place(result.folder), _Finished, kept)


def finished(config: RunConfig, store: Store) -> RunResult | None:
    """The result of a run where it lies in its folder already, whole, and made of the same; else None.

    Nothing is refused here: what cannot be read is told by the run that follows.
    """
    try:
        folder = Path(config.output) / run_name(config)
        kept = Room(store).take(_STAGE, _place(folder), _Finished)
        if kept is None or not is_whole(folder, kept.files):
            return None
        if config.simulate is not None:
            paths: tuple[Path, ...] = (folder_of_port(config.simulate, Path(config.cache)),)
            note_use(paths[0])
        else:
            paths = config.drive.paths
        drives = read_drives(config, paths)
        key = result_key(config, drives, Contents.of(drives), key_of(code_key()))
    except (V2hdmError, OSError):
        return None
    if key != kept.key:
        return None
    _log.info("nothing has changed: %s is taken as it is (resume=false makes it anew)", folder)
    return RunResult(folder, kept.result.metrics, kept.result.headlines, kept.result.verdict)


def _place(folder: Path) -> str:
    return key_of(folder.resolve())
