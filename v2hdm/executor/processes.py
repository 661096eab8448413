"""Processes of this machine that never outlive the one that started them: the executor of a base install.

Ctrl-C and errors reach this process alone, which ends the others; each of them watches this one and ends when
it dies.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import cv2

from v2hdm.errors import WorkerError
from v2hdm.executor.executor import TWICE_DEAD, Executor, JobProgress, Outcomes, Stage
from v2hdm.executor.memory import keep_freed_memory
from v2hdm.progress import silent
from v2hdm.settings import THREAD_VARIABLES

_TIDY_S = 30.0  # a worker without its parent may take this long to end, whatever it is in
_MOST_DEATHS = 2  # processes that one job may cost; chosen: one is an accident

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


class ProcessExecutor(Executor):
    """Spawns processes for each stage, as a fork would inherit the locks of threads.

    The steps within a job are not told.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    @property
    def workers(self) -> int:
        """How many jobs are done at a time."""
        return self._workers

    def outcomes(
        self, stage: Stage[_Job, _Result], jobs: Sequence[_Job], progress: JobProgress, at_once: int
    ) -> Outcomes[_Result]:
        """See :meth:`Executor.outcomes`."""
        count = max(1, min(self._workers, len(jobs), stage.processes or self._workers))
        pool = _Pool(stage, count)
        left = deque(range(len(jobs)))
        deaths = Counter[int]()
        number_of: dict[Future[Any], int] = {}
        try:
            while left or number_of:
                # Whoever may have killed a process runs alone, so that no other is blamed for it.
                is_alone = bool(deaths.keys() & {*number_of.values(), *itertools.islice(left, 1)})
                while left and len(number_of) < (1 if is_alone else at_once):
                    number = left.popleft()
                    number_of[pool.submit(jobs[number])] = number
                finished, _ = wait(number_of, return_when=FIRST_COMPLETED)
                are_dead = any(isinstance(future.exception(), BrokenProcessPool) for future in finished)
                for future in finished:
                    if not isinstance(future.exception(), BrokenProcessPool):
                        yield number_of.pop(future), future.result()
                if not are_dead:
                    continue
                pool.end()
                pool = _Pool(stage, count)
                lost = sorted(number_of.values())  # a pool that lost one process loses all
                number_of.clear()
                deaths.update(lost)
                if len(lost) == 1 and deaths[lost[0]] >= _MOST_DEATHS:
                    yield lost[0], WorkerError(TWICE_DEAD)
                else:
                    left.extendleft(reversed(lost))
        finally:
            pool.end()


class _Pool:
    """Processes that do jobs of one stage; they are started as jobs come."""

    def __init__(self, stage: Stage[Any, Any], workers: int) -> None:
        self._others = set(multiprocessing.active_children())
        spawn = multiprocessing.get_context("spawn")
        with undisturbed_starts():
            self._pool = ProcessPoolExecutor(workers, spawn, _begin, (stage,))

    def submit(self, job: object) -> Future[Any]:
        """Submit a job; its future fails if a process of the pool has died."""
        with undisturbed_starts():
            try:
                return self._pool.submit(_perform, job)
            except BrokenProcessPool as failure:
                failed = Future[Any]()
                failed.set_exception(failure)
                return failed

    def end(self) -> None:
        """End the processes, whatever they do."""
        processes = [process for process in multiprocessing.active_children() if process not in self._others]
        for process in processes:
            process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)
        for process in processes:
            process.join()


_stage: Stage[Any, Any] | None = None
_is_started = False


def _begin(stage: Stage[Any, Any]) -> None:
    global _stage
    _stage = stage
    live_with_parent()
    prepare_process()


def _perform(job: object) -> object:
    global _is_started
    assert _stage is not None
    try:
        if not _is_started:
            _stage.start(*_stage.arguments)
            _is_started = True
        return _stage.work(job, silent)
    except (
        SystemExit
    ):  # of SIGTERM: all is tidied away, and the pool would take this for a failure of the job
        os._exit(128 + signal.SIGTERM)


def prepare_process() -> None:
    """Make a worker process one of one thread, whose log is for the results to state."""
    keep_freed_memory()
    cv2.setNumThreads(1)
    torch: Any = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # for what is loaded later
    logger = logging.getLogger("v2hdm")
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    logger.setLevel(logging.DEBUG)


@contextmanager
def undisturbed_starts() -> Iterator[None]:
    """Processes started within never see Ctrl-C, and their linear algebra starts no thread a core each."""
    variables = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    mask = None
    if sys.platform != "win32":
        _start_tracker()  # started by the first process, it would lift the block
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in variables.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_tracker() -> None:
    """Start the resource tracker, and silence its messages on killed processes."""
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")  # which it inherits
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.pop()


def live_with_parent() -> None:
    """Make this worker process end, tidily, on SIGTERM and when the one that started it dies."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # an exception tidies away what is being written
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_TIDY_S)
    os._exit(1)
