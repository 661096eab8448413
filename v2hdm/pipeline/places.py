"""Runs whose drive, cache or results are at an object store: they work in folders of this machine.

A drive is copied into the cache first; results are written to a folder there, whole, and then put in their
place, where a finished one is known by what lies beside it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.io.importers.mirror import mirrored
from v2hdm.io.texts import take_name
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.finished import NOTHING_CHANGED, RunResult, finished, is_of, key_of_finished
from v2hdm.progress import Progress
from v2hdm.store.cache.codec import CodecError, decode, encode
from v2hdm.store.cache.keys import key_of
from v2hdm.store.cache.store import Store
from v2hdm.store.listing import LIST
from v2hdm.store.objects.bucket import Bucket, is_url, place_of
from v2hdm.store.objects.results import ResultObjects, contents_of
from v2hdm.store.outputs import drop_result

_log = logging.getLogger(__name__)

Work = Callable[[RunConfig, Store], RunResult]

_UPLOADS = "uploads"
"""Folder in the cache of results that are not yet in their place."""

_RECORD = ".v2hdm-finished"


@dataclass(frozen=True)
class _Record:
    """The key of what a result was made of, and the result; an object beside it."""

    key: str
    result: RunResult


def in_place(config: RunConfig, work: Work, take: bool, progress: Progress) -> tuple[RunResult, bool]:
    """The result of a run in the place that its settings name, and whether it was there already.

    Args:
        config: of the run.
        work: makes a result in folders of this machine.
        take: whether a finished result of the same is taken.
        progress: told how far it is with what it copies.

    Raises:
        V2hdmError: as ``work``; or a store does not work, or holds what is not ours.
    """
    output, cache = place_of(config.output, "output="), place_of(config.cache, "cache=")
    if is_url(config.local_cache):
        raise ConfigError(f"local_cache={config.local_cache}: is a URL; give a folder of this machine")
    for place in (output, cache):
        if isinstance(place, Bucket):
            place.check()
    behind = cache if isinstance(cache, Bucket) else None
    folder = Path(config.local_cache) if isinstance(cache, Bucket) else cache
    local = _local(config, folder, progress)
    store = Store(folder, behind)
    if isinstance(output, Bucket):
        return _put(local, output, store, work, take, progress)
    local.output = str(output)
    there = finished(local, store) if take else None
    return (work(local, store), False) if there is None else (there, True)


def _local(config: RunConfig, folder: Path, progress: Progress) -> RunConfig:
    """The settings with folders of this machine for the cache and the drives."""
    drive = config.drive
    imports = str(folder) if is_url(drive.cache) else drive.cache
    paths = drive.path if isinstance(drive.path, list) else [drive.path]
    places = [place_of(one, "drive.path=") if isinstance(one, str) and is_url(one) else one for one in paths]
    if any(isinstance(one, Bucket) for one in places):
        config = replace(config, name=run_name(config))  # as before anything was copied
    tell = partial(progress, "copy")
    folders = [mirrored(one, folder, tell) if isinstance(one, Bucket) else one for one in places]
    if folders != paths:
        told = [str(one) for one in folders]
        drive = replace(drive, path=told if isinstance(drive.path, list) else told[0])
    return replace(config, cache=str(folder), drive=replace(drive, cache=imports))


def _put(
    config: RunConfig, output: Bucket, store: Store, work: Work, take: bool, progress: Progress
) -> tuple[RunResult, bool]:
    name = run_name(config)
    take_name(name, "name", ConfigError)
    result = ResultObjects(output.below(name))
    there = _taken(result, config) if take else None
    if there is not None:
        return there, True
    with result.leased(output, partial(progress, "listen")) as lease:
        there = _taken(result, config) if take else None
        if there is not None:  # who held the lease has finished it
            return there, True
        result.ours()  # what is not ours is told before any work
        place = Path(config.cache) / _UPLOADS / key_of(output.url)[:16]
        local = replace(config, output=str(place))
        made = (finished(local, store) if take else None) or work(local, store)
        key = key_of_finished(made.folder, store)
        record = {} if key is None else {_RECORD: encode(_Record(key, made))}
        result.put({**contents_of(made.folder, LIST), **record}, lease, partial(progress, "upload"))
    drop_result(made.folder)
    with suppress(OSError):  # other results wait there for their upload
        place.rmdir()
        place.parent.rmdir()
    return replace(made, url=result.objects.url), False


def _taken(result: ResultObjects, config: RunConfig) -> RunResult | None:
    """The result that is at the store, where it is whole and made of the same."""
    if not result.is_whole():
        return None
    try:
        record = decode(result.objects.read(_RECORD) or b"", _Record)
        if not is_of(config, record.key):
            return None
    except (CodecError, V2hdmError, OSError):  # told by the run that follows
        return None
    _log.info(NOTHING_CHANGED, result.objects)
    return replace(record.result, url=result.objects.url)
