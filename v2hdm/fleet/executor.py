"""The executor of a site on Ray: one task per session of a drive, and per set of cameras."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any, TypeVar

import ray
from ray.exceptions import RayTaskError, WorkerCrashedError

from v2hdm.errors import WorkerError
from v2hdm.fleet.cluster import RETRIES
from v2hdm.store.cache import Line, log_again, recorded

_Result = TypeVar("_Result")

_CORES_EACH = 0.5
"""Booked for a task: the other half of its core is an actor's that detects, which then has nothing to do."""


class RayExecutor:
    """A :class:`v2hdm.executor.Executor` of a cluster's cores."""

    def __init__(self, cores: int, folder: str) -> None:
        """``cores`` are those of the cluster; ``folder`` is where relative paths begin."""
        self._cores, self._folder = cores, folder

    @property
    def workers(self) -> int:
        """The cores."""
        return self._cores

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Hand ``work`` to a task; one whose worker dies is begun anew."""
        level = logging.getLogger("v2hdm").getEffectiveLevel()
        task: Any = ray.remote(_done).options(num_cpus=_CORES_EACH, max_retries=RETRIES)
        reference = task.remote(work, level, self._folder)
        return lambda: _result(reference)


def _done(work: Callable[[], _Result], level: int, folder: str) -> tuple[_Result, list[Line]]:
    """The result of ``work`` in the process of a task, and its log lines."""
    os.chdir(folder)
    logging.getLogger("v2hdm").setLevel(level)
    with recorded() as lines:
        result = work()
    return result, lines


def _result(reference: Any) -> Any:
    try:
        result, lines = ray.get(reference)
    except RayTaskError as failure:
        raise failure.cause from failure
    except WorkerCrashedError:
        raise WorkerError(
            "a worker process of a site died again and again, perhaps for want of memory; set fewer --workers"
        ) from None
    log_again(lines)
    return result
