"""What a worker does for one drive: all but detection."""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm.errors import describe
from v2hdm.fleet.board import Telling
from v2hdm.fleet.eyes import detect_by
from v2hdm.fleet.plan import Job
from v2hdm.fleet.rows import Row
from v2hdm.pipeline.config import RunConfig
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.finished import RunResult
from v2hdm.pipeline.places import in_place
from v2hdm.pipeline.run import map_and_save
from v2hdm.store.cache.store import Store


def map_drive(job: Job, eyes: Sequence[Any], board: Any, folder: str) -> tuple[Row, str]:
    """Map one drive and write its results; its row, and the traceback where it met a bug of ours.

    Args:
        job: what to map.
        eyes: the actors that detect.
        board: the actor that is told of the progress.
        folder: where relative paths begin.
    """
    os.chdir(folder)
    job.config.workers = 1
    try:
        telling = Telling(board, job.name)
        mapped = partial(_mapped, job, eyes, telling)
        result, kept = in_place(job.config, mapped, job.config.resume, telling)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = describe(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug of ours, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.place, result.metrics, kept), ""


def _mapped(job: Job, eyes: Sequence[Any], telling: Telling, config: RunConfig, store: Store) -> RunResult:
    # It loads torch, which a finished result does not need.
    from v2hdm.fleet.crew import RayCrew

    crew = RayCrew(len(eyes), str(Path.cwd())) if len(config.drive.paths) > 1 else None
    context = Context(progress=telling, detect=partial(detect_by, eyes), executor=crew)
    return map_and_save(config, store, job.config_yaml, context)
