"""What a worker does for one drive: all but detection."""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence
from functools import partial
from typing import Any

from v2hdm import pipeline
from v2hdm.door import told
from v2hdm.fleet.board import Telling
from v2hdm.fleet.eyes import detect_by
from v2hdm.fleet.finished import finish, metrics_of
from v2hdm.fleet.plan import Job
from v2hdm.fleet.rows import Row


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
        result = pipeline.run(job.config, job.config_yaml, Telling(board, job.name), partial(detect_by, eyes))
        finish(job)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = told(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug of ours, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.folder, metrics_of(result.folder), kept=False), ""
