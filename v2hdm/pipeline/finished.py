"""Finished results: one that nothing has changed for is taken as it is, in its folder or at its store.

Runs whose drive or results are at an object store work in the cache: a drive is copied there first; a result
is written to a folder there, whole, and then uploaded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.io.safe.texts import take_name
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.keys import Contents, read_drives, result_key
from v2hdm.progress import Progress
from v2hdm.simulate.port.drive import folder_of_port
from v2hdm.store.cache import CodecError, StageCache, code_key, decode, encode, key_of
from v2hdm.store.folders import note_use
from v2hdm.store.lock import HOST
from v2hdm.store.remote import (
    RemoteFolder,
    contents_of,
    download,
    is_url,
    is_whole_at,
    place_of,
    refuse_upload,
    upload,
)
from v2hdm.store.results import drop_result, files_of_result, is_whole, locked_folder
from v2hdm.verdict.verdict import Verdict

_log = logging.getLogger(__name__)

_STAGE = "finished"
_UPLOADS = "uploads"
"""Folder in the cache of results that are not uploaded yet."""

_RECORD = ".v2hdm-finished"
"""Object beside a result at a store, which says what it was made of."""


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
        """Where the results are, to be shown."""
        return self.url or str(self.folder)


@dataclass(frozen=True)
class _Finished:
    """A result and the key of its inputs; ``files`` are SHA-256 of our files in its folder."""

    key: str
    files: dict[str, str]
    result: RunResult


Work = Callable[[RunConfig, StageCache], RunResult]


def take_or_make(config: RunConfig, work: Work, take: bool, progress: Progress) -> tuple[RunResult, bool]:
    """The result of a run in the place that its settings name, and whether it was there already.

    ``work`` makes a result in folders of this machine; a finished one of the same is taken where ``take``
    says so. Raises V2hdmError as ``work``; or a store does not work, or holds what is not ours.
    """
    output, folder = place_of(config.output, "output="), place_of(config.cache, "cache=")
    if isinstance(folder, RemoteFolder):
        raise ConfigError(f"cache={config.cache}: is a URL; give a folder, on a disk that machines may share")
    if isinstance(output, RemoteFolder):
        output.check()
    local, stages = _local(config, folder, progress), StageCache(folder, config.resume)
    if isinstance(output, RemoteFolder):
        return _take_or_upload(local, output, stages, work, take, progress)
    local.output = str(output)
    there = finished(local, stages) if take else None
    return (work(local, stages), False) if there is None else (there, True)


def note_finished(result: RunResult, key: str, cache: StageCache) -> None:
    """Keep what is needed to know that nothing has changed since."""
    entry = _Finished(key, files_of_result(result.folder), result)
    cache.put(_STAGE, key_of(result.folder.resolve()), _Finished, entry)


def finished(config: RunConfig, cache: StageCache) -> RunResult | None:
    """The result of a run where it lies in its folder already, whole, and made of the same; else None.

    Nothing is refused here: the run that follows reports what cannot be read.
    """
    try:
        folder = Path(config.output) / run_name(config)
        entry = _noted(folder, cache)
        if entry is None or not is_whole(folder, entry.files) or not _is_of(config, entry.key):
            return None
    except (V2hdmError, OSError):
        return None
    return _taken(replace(entry.result, folder=folder, url=""))


def _noted(folder: Path, cache: StageCache) -> _Finished | None:
    return StageCache(cache.folder).get(_STAGE, key_of(folder.resolve()), _Finished)


def _taken(result: RunResult) -> RunResult:
    _log.info("nothing has changed: %s is taken as it is (resume=false makes it anew)", result.place)
    return result


def _is_of(config: RunConfig, key: str) -> bool:
    """Whether ``key`` is that of a run's result, made now; raises where an input cannot be read."""
    paths = config.drive.paths
    if config.simulate is not None:
        paths = (folder_of_port(config.simulate, Path(config.cache)),)
        note_use(paths[0])
    drives = read_drives(config, paths)
    return key == result_key(config, drives, Contents.of(drives), key_of(code_key()))


def _local(config: RunConfig, folder: Path, progress: Progress) -> RunConfig:
    """The settings with folders of this machine for the cache and the drives."""
    drive = config.drive
    given = drive.path if isinstance(drive.path, list) else [drive.path]
    paths = [place_of(one, "drive.path=") if isinstance(one, str) and is_url(one) else one for one in given]
    if any(isinstance(one, RemoteFolder) for one in paths):
        config = replace(config, name=run_name(config))  # as before anything was copied
    copy = partial(download, cache=folder, report=partial(progress, "copy"))
    paths = [copy(one) if isinstance(one, RemoteFolder) else one for one in paths]
    if paths != given:
        local = [str(one) for one in paths]
        drive = replace(drive, path=local if isinstance(drive.path, list) else local[0])
    imports = str(folder) if is_url(drive.cache) else drive.cache
    return replace(config, cache=str(folder), drive=replace(drive, cache=imports))


def _take_or_upload(
    config: RunConfig, output: RemoteFolder, cache: StageCache, work: Work, take: bool, progress: Progress
) -> tuple[RunResult, bool]:
    name = run_name(config)
    take_name(name, "name", ConfigError)
    place, folder = output.below(name), Path(config.cache) / _UPLOADS / key_of(output.url)[:16]
    if take and (there := _finished_at(place, config)) is not None:
        return there, True
    writer = f"{HOST}, {key_of(folder.resolve())[:8]}"
    refuse_upload(place, writer)  # what is not ours is reported before any work
    local = replace(config, output=str(folder))
    made = (finished(local, cache) if take else None) or work(local, cache)
    there = _finished_at(place, config) if take else None  # of who was faster
    with locked_folder(made.folder):
        if there is None:
            entry = _noted(made.folder, cache)
            record = {} if entry is None else {_RECORD: encode(entry)}
            upload(place, {**contents_of(made.folder), **record}, writer, partial(progress, "upload"))
        drop_result(made.folder)
    with suppress(OSError):  # other results wait there for their upload
        folder.rmdir()
        folder.parent.rmdir()
    return (replace(made, url=place.url), False) if there is None else (there, True)


def _finished_at(place: RemoteFolder, config: RunConfig) -> RunResult | None:
    """The result that is at a store, where it is whole and made of the same."""
    try:
        if is_whole_at(place):
            entry = decode(place.read(_RECORD) or b"", _Finished)
            if _is_of(config, entry.key):
                return _taken(replace(entry.result, url=place.url))
    except (CodecError, V2hdmError, OSError):  # the run that follows reports it
        pass
    return None
