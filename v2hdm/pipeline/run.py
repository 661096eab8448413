"""A run as it is configured: :func:`v2hdm.map_drive` with a cache, and its result in a folder or at a URL.

It needs no terminal and knows nothing of Hydra. What a run is made of is looked at first: where a finished
result of just that lies in its place, nothing else is loaded or done. A result
for an object store is written to a folder in the cache, whole, and then uploaded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm import __version__
from v2hdm.errors import ConfigError, V2hdmError, masked
from v2hdm.executor import Executor, open_executor
from v2hdm.io.drive import read_drive
from v2hdm.io.maps.formats import check_crs
from v2hdm.pipeline.config import (
    NO_DRIVE,
    Contents,
    RunConfig,
    admit,
    base_files,
    made_of_drives,
    result_key,
    run_name,
)
from v2hdm.pipeline.context import Context, log_file, logging_to
from v2hdm.progress import Progress, silent
from v2hdm.records import Drive
from v2hdm.report.job import job_of
from v2hdm.safe.texts import take_name
from v2hdm.simulate.survey.drive import folders_of
from v2hdm.store import remote
from v2hdm.store.cache import CodecError, StageCache, code_key, decode, encode, key_of, prune_to_limit
from v2hdm.store.folders import HOST, note_use
from v2hdm.store.inputs import note_input
from v2hdm.store.names import CONFIG, LOG
from v2hdm.store.remote import RemoteFolder, is_url, place_of
from v2hdm.store.results import drop_result, files_of_result, is_whole, locked_folder, result_folder
from v2hdm.verdict.verdict import Verdict

_log = logging.getLogger(__name__)

_STAGE = "finished"
_UPLOADS = "uploads"  # folder in the cache of results that are not uploaded yet
_RECORD = ".v2hdm-finished"  # object beside a result at a store, which says what it was made of


@dataclass(frozen=True)
class RunResult:
    """A run's folder, or ``url`` if sent away, ``metrics.json``'s content, sentences, and the verdict."""

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
    says so.
    """
    output = place_of(config.output, "output=")
    if is_url(config.cache):
        raise ConfigError(f"cache={config.cache}: is a URL; give a folder, which machines may share")
    stages = StageCache(Path(config.cache), config.resume)
    if isinstance(output, RemoteFolder):
        return _take_or_upload(config, output, stages, work, take, progress)
    earlier = finished(config, stages) if take else None
    return (work(config, stages), False) if earlier is None else (earlier, True)


def note_finished(result: RunResult, key: str, cache: StageCache) -> None:
    """Keep what is needed to know that nothing has changed since."""
    entry = _Finished(key, files_of_result(result.folder), result)
    cache.put(_STAGE, key_of(result.folder.resolve()), _Finished, entry)


def finished(config: RunConfig, cache: StageCache) -> RunResult | None:
    """The result of a run if it lies in its folder, whole, and made of the same; else None."""
    try:
        folder = Path(config.output) / run_name(config)
        entry = _noted(folder, cache)
        if entry is None:
            return None
        files = files_of_result(folder)  # a report may have been made again, and a mosaic added
        if not is_whole(folder, {name: files.get(name, "") for name in entry.files}):
            return None
        if not _is_of(config, entry.key):
            return None
    except (V2hdmError, OSError):
        return None
    return _taken(replace(entry.result, folder=folder, url=""))


def _noted(folder: Path, cache: StageCache) -> _Finished | None:
    return StageCache(cache.folder).get(_STAGE, key_of(folder.resolve()), _Finished)


def _taken(result: RunResult) -> RunResult:
    _log.info("nothing has changed: %s is reused (resume=false recomputes it)", result.place)
    return result


def _is_of(config: RunConfig, key: str) -> bool:
    """Whether ``key`` is that of a run's result, made now; raises where an input cannot be read."""
    paths = config.drive.paths
    if config.simulate is not None:
        paths = folders_of(config.simulate, Path(config.cache))
        for path in paths:
            note_use(path)
    drives = [read_drive(path, config.drive) for path in paths]
    return key == result_key(config, drives, Contents.of(drives), key_of(code_key()))


def _take_or_upload(
    config: RunConfig, output: RemoteFolder, cache: StageCache, work: Work, take: bool, progress: Progress
) -> tuple[RunResult, bool]:
    name = run_name(config)
    take_name(name, "name", ConfigError)
    place = output.below(name)
    folder = Path(config.cache) / _UPLOADS / key_of(output.url)[:16]
    if take and (earlier := _finished_at(place, config)) is not None:
        return earlier, True
    writer = f"{HOST}, {key_of(folder.resolve())[:8]}"
    remote.refuse_upload(place, writer)  # what is not ours is reported before any work
    local = replace(config, output=str(folder))
    result = (finished(local, cache) if take else None) or work(local, cache)
    earlier = _finished_at(place, config) if take else None  # of who was faster
    with locked_folder(result.folder):
        if earlier is None:
            entry = _noted(result.folder, cache)
            record = {} if entry is None else {_RECORD: encode(entry)}
            contents = remote.contents_of(result.folder) | record
            remote.upload(place, contents, writer, partial(progress, "upload"))
        drop_result(result.folder)
    with suppress(OSError):  # other results wait there for their upload
        folder.rmdir()
        folder.parent.rmdir()
    return (replace(result, url=place.url), False) if earlier is None else (earlier, True)


def _finished_at(place: RemoteFolder, config: RunConfig) -> RunResult | None:
    """The result that is at a store, where it is whole and made of the same."""
    try:
        if remote.is_whole_at(place):
            entry = decode(place.read(_RECORD) or b"", _Finished)
            if _is_of(config, entry.key):
                return _taken(replace(entry.result, url=place.url))
    except (CodecError, V2hdmError, OSError):  # the run that follows reports it
        pass
    return None


def run(config: RunConfig, config_yaml: str = "", progress: Progress = silent) -> RunResult:
    """Map one drive, or several together, and write the results to ``<output>/<name>/``, whole or not at all.

    Args:
        config: what to do.
        config_yaml: the configuration as text, kept beside the results.
        progress: shows how far the long steps are.

    Raises:
        V2hdmError: The configuration, the drive or the detector is at fault, or no map can be made.
    """
    return take_or_run(config, config_yaml, progress)[0]


def take_or_run(config: RunConfig, config_yaml: str, progress: Progress) -> tuple[RunResult, bool]:
    """As :func:`run`, and whether a finished result of the same was taken."""

    def work(local: RunConfig, cache: StageCache) -> RunResult:
        from v2hdm.detection.network import check_device

        check_device(local.detector.device)
        with open_run_executor(local) as executor:
            context = Context(progress=progress, executor=executor)
            return map_and_save(local, cache, config_yaml, context, made_of(config))

    return take_or_make(config, work, config.resume, progress)


def open_run_executor(config: RunConfig, isolated: bool = False) -> AbstractContextManager[Executor]:
    """The executor of a run, whose workers can read its drives and write to its cache."""
    return open_executor(
        config.workers,
        config.cluster,
        memory_gb=config.worker_gb,
        readable=[str(path) for path in config.drive.paths],
        writable=[config.cache],
        isolated=isolated,
    )


def made_of(config: RunConfig) -> str:
    """Name a run and its drives: only such a run replaces its result; ``config`` is the user's own."""
    if config.simulate is not None:
        return f"v2hdm map of the rendered {config.simulate.name}"
    paths = config.drive.path if isinstance(config.drive.path, list) else [config.drive.path]
    return made_of_drives([str(Path(path).resolve()) for path in paths if path])


def map_and_save(
    config: RunConfig, cache: StageCache, config_yaml: str, context: Context, maker: str
) -> RunResult:
    """Do what :func:`run` says, with what ``cache`` keeps, in place of an earlier result of the same."""
    from v2hdm.pipeline.map_drive import map_drive  # torch and much else, which takes seconds
    from v2hdm.pipeline.saving import Outputs, write_result

    name = admit(config)
    place = Path(config.output) / name
    with cache.in_use():
        for path in () if config.map.base is None else base_files(Path(config.map.base))[:1]:
            note_input(path)  # before any work is done for nothing
        with result_folder(place, maker=maker) as folder, logging_to(log_file(folder / LOG)):
            _log.info("v2hdm %s, run %s", __version__, name)
            (folder / CONFIG).write_text(masked(config_yaml or f"{config!r}\n"), encoding="utf-8")

            def accept(drive: Drive) -> None:
                check_crs(
                    config.crs, [name for name in config.export if name != "geojson"], drive.origin, "crs"
                )
                if config.report.background is not None and drive.origin is None:
                    raise ConfigError(
                        "report.background: this drive has no position on the earth; state its origin in "
                        "drive.yaml, or leave the picture out"
                    )

            context = replace(context, cache=cache, workers=config.workers, accept=accept)
            mapped = map_drive(
                _drive_folders(config, context),
                name=name,
                options=config.mapping,
                detector=config.detector,
                reading=config.drive,
                base=config.map.base,
                corrections=config.map.corrections,
                accuracy_goal_cm=config.accuracy_goal_cm,
                context=context,
                all_maps=config.all_maps or (_is_rendered(config) and not config.map.section_m),
                section_m=config.map.section_m,
            )
            key = result_key(config, mapped.drives, mapped.contents, context.cache.key())
            outputs = Outputs(
                formats=config.export,
                all_maps=config.all_maps,
                mosaic=config.mosaic,
                crs=config.crs,
                background=config.report.background,
                job=job_of(config.report),
                pdf=config.report.pdf,
                reach_m=config.mapping.max_range_m,
            )
            write_result(mapped, folder, outputs, context)
            for line in mapped.verdict.lines:
                _log.info("%s", line)
        result = RunResult(place, mapped.metrics, mapped.headlines, mapped.verdict)
        note_finished(result, key, cache)
        prune_to_limit(Path(config.cache), config.cache_gb)
    return result


def _is_rendered(config: RunConfig) -> bool:
    """Whether the drive is a rendered port, on which methods are compared; a survey is too long for that."""
    return config.simulate is not None and not config.simulate.survey.length_km


def _drive_folders(config: RunConfig, context: Context) -> tuple[Path, ...]:
    """The drives of a run; one that is rendered is made in the cache first."""
    if config.simulate is None:
        if not config.drive.paths:
            raise ConfigError(NO_DRIVE)
        return config.drive.paths
    if config.drive.paths:
        raise ConfigError("both simulate and drive.path are set: a run takes one, remove the other")
    from v2hdm.simulate.survey.drive import simulated_drives

    with context.timed("render"):
        folder = Path(config.cache)
        steps = context.steps("render")
        return simulated_drives(config.simulate, folder, context.executor, steps)
