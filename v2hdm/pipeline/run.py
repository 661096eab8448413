"""A run as it is configured: :func:`v2hdm.map_drive` with a cache, and its result in a folder or at a URL.

It needs no terminal and knows nothing of Hydra. What a run is made of is looked at first: where a finished
result of just that lies in its place, nothing else is loaded or done.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from v2hdm import __version__
from v2hdm.errors import ConfigError
from v2hdm.pipeline.config import NO_DRIVE, RunConfig, admit
from v2hdm.pipeline.context import Context, Viewer, log_file, logging_to
from v2hdm.pipeline.finished import RunResult, note_finished, take_or_make
from v2hdm.pipeline.keys import result_key
from v2hdm.progress import Progress, silent
from v2hdm.store.cache import StageCache
from v2hdm.store.pruning import prune_to_limit
from v2hdm.store.results import result_folder

_log = logging.getLogger(__name__)


def run(
    config: RunConfig, config_yaml: str = "", progress: Progress = silent, viewer: Viewer | None = None
) -> RunResult:
    """Map one drive, or several together, and write the results to ``<output>/<name>/``, whole or not at all.

    Args:
        config: what to do.
        config_yaml: the configuration as text, kept beside the results.
        progress: shows how far the long steps are.
        viewer: shown images, detections and maps as they come, also where nothing has changed since.

    Raises:
        V2hdmError: The configuration, the drive or the detector is at fault, or no map can be made.
    """

    def work(config: RunConfig, cache: StageCache) -> RunResult:
        from v2hdm.detection.network import check_device

        check_device(config.detector.device)
        context = Context(progress=progress)
        return map_and_save(
            config, cache, config_yaml, context if viewer is None else replace(context, viewer=viewer)
        )

    return take_or_make(config, work, config.resume and viewer is None, progress)[0]


def map_and_save(config: RunConfig, cache: StageCache, config_yaml: str, context: Context) -> RunResult:
    """Do what :func:`run` says, with what ``cache`` keeps."""
    from v2hdm.pipeline.map_drive import map_drive  # torch and much else, which takes seconds

    name = admit(config)
    place = Path(config.output) / name
    with cache.in_use():
        with result_folder(place) as folder, logging_to(log_file(folder / "run.log")):
            _log.info("v2hdm %s, run %s", __version__, name)
            (folder / "config.yaml").write_text(config_yaml or f"{config!r}\n", encoding="utf-8")
            context = replace(context, cache=cache, workers=config.workers, folder=folder)
            found = map_drive(
                _drive_folders(config, context),
                name=name,
                options=config.mapping,
                detector=config.detector,
                reading=config.drive,
                base=config.map.base,
                accuracy_goal_cm=config.accuracy_goal_cm,
                context=context,
            )
            key = result_key(config, found.drives, found.contents, context.cache.key())
            found.write(folder, config.export, config.all_maps, config.mosaic, context)
            for line in found.verdict.lines:
                _log.info("%s", line)
        result = RunResult(place, found.metrics, found.headlines, found.verdict)
        note_finished(result, key, cache)
        prune_to_limit(Path(config.cache), config.cache_gb)
    return result


def _drive_folders(config: RunConfig, context: Context) -> tuple[Path, ...]:
    """The drives of a run; one that is rendered is made in the cache first."""
    if config.simulate is None:
        if not config.drive.paths:
            raise ConfigError(NO_DRIVE)
        return config.drive.paths
    if config.drive.paths:
        raise ConfigError(
            "both simulate and drive.path are set: a run renders a drive or reads one, remove one of them"
        )
    from v2hdm.simulate import rendered_drive

    folder, render = Path(config.cache), context.steps("render")
    with context.timed("render"):
        return (rendered_drive(config.simulate, folder, context.processes, render),)
