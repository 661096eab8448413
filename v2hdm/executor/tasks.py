"""The part of a Dask worker in a stage: it does jobs one at a time, in a thread that can be stopped."""

from __future__ import annotations

import asyncio
import ctypes
import os
import pickle
import threading
import time
import traceback
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
from distributed import Worker, get_worker, process
from distributed.utils import sync

from v2hdm.executor.executor import TWICE_DEAD, Stage
from v2hdm.executor.processes import prepare_process

_EVERY_S = 0.1  # between two messages on one task of a job; chosen
_STOP_S = 3.0  # time for a job to end when it is stopped; most end at their next line of Python
MOST_BEGUN = 2  # times that a job is begun: once more after its process has died

DONE, FAILED, DEAD, STOPPED = "done", "failed", "dead", "stopped"
"""The kinds of an :class:`Outcome`."""


class StageName(NamedTuple):
    """A stage, known to its scheduler by ``token``; its client works in ``folder``."""

    token: str
    folder: str


class Outcome(NamedTuple):
    """The end of a job: its result, its exception and the traceback, or what is said of it."""

    kind: str
    value: Any
    trace: str = ""


class Stopped(BaseException):
    """The client wants no result any more."""


_stages: dict[str, Stage[Any, Any]] = {}  # those that this process was made ready for, by token
_threads: dict[int, str] = {}  # tokens of the jobs under way by the thread that does each
_lock = threading.Lock()


def perform(name: StageName, number: int, job: Any) -> Outcome:
    """Do a job of a stage on this worker; whatever it raises is its outcome."""
    worker = get_worker()
    try:
        with _stoppable(name.token):
            before = _begun(worker, name.token, number)
            if before >= MOST_BEGUN:
                return Outcome(DEAD, TWICE_DEAD)
            with suppress(OSError):  # where all paths are absolute, nobody misses it
                os.chdir(name.folder)
            stage = _ready(worker, name.token)
            result = stage.work(job, _Messages(worker, name.token, number))
            # Its worker may yet die of another job, with this result: that is no death of this one.
            _note_begun(worker, name.token, number, before)
            return Outcome(DONE, result)
    except Stopped:
        return Outcome(STOPPED, None)
    except Exception as failure:
        return Outcome(FAILED, _portable(failure), traceback.format_exc())


def begun_key(token: str, number: int) -> list[str]:
    """Where the scheduler keeps how often a job was begun and not done."""
    return [token, f"begun {number}"]


def _begun(worker: Worker, token: str, number: int) -> int:
    """How often this job was begun and not done before; one more is noted where no death can erase it."""
    key = begun_key(token, number)
    before: int = sync(worker.loop, worker.scheduler.get_metadata, keys=key, default=0)
    _note_begun(worker, token, number, before + 1)
    return before


def _note_begun(worker: Worker, token: str, number: int, count: int) -> None:
    key = begun_key(token, number)
    sync(worker.loop, worker.scheduler.set_metadata, keys=key, value=count)


def _ready(worker: Worker, token: str) -> Stage[Any, Any]:
    """The stage, for which this process is made ready by its first job."""
    if token not in _stages:
        data: bytes = sync(worker.loop, worker.scheduler.get_metadata, keys=[token, "stage"])
        stage: Stage[Any, Any] = cloudpickle.loads(data)
        prepare_process()
        vars(process)["os"] = _TidyEnd()
        stage.start(*stage.arguments)
        _stages.clear()  # an earlier one is over, or outside of this one, whose own job holds it
        _stages[token] = stage
    return _stages[token]


class _Messages:
    """The progress of one job, told to whoever listens to its stage."""

    def __init__(self, worker: Worker, token: str, number: int) -> None:
        self._worker = worker
        self._token = token
        self._number = number
        self._told_s: dict[str, float] = {}

    def __call__(self, task: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if done < total and now_s - self._told_s.get(task, -_EVERY_S) < _EVERY_S:
            return
        self._told_s[task] = now_s
        self._worker.log_event(self._token, (self._number, task, done, total))


def _portable(failure: Exception) -> Exception:
    """The exception if it can be pickled, else one with the same message."""
    try:
        pickle.loads(pickle.dumps(failure))
    except Exception:
        return RuntimeError(f"{type(failure).__name__}: {failure}")
    return failure


@contextmanager
def _stoppable(token: str) -> Iterator[None]:
    """Let :func:`stop` raise Stopped in this thread, within the block alone."""
    thread = threading.get_ident()
    with _lock:
        _threads[thread] = token
    try:
        yield
    finally:
        with _lock:
            del _threads[thread]
            _raise_in(thread, None)  # one that came too late


def _raise_in(thread: int, exception: type[BaseException] | None) -> None:
    pointer = None if exception is None else ctypes.py_object(exception)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), pointer)


async def stop(token: str) -> None:
    """Stop a stage's jobs in this process so that they clean up; jobs in long calls are abandoned."""
    await asyncio.to_thread(_stop, {token})


def _stop(tokens: Collection[str]) -> None:
    with _lock:
        for thread, token in _threads.items():
            if token in tokens:
                _raise_in(thread, Stopped)
    end_s = time.monotonic() + _STOP_S
    while set(_threads.values()) & set(tokens) and time.monotonic() < end_s:
        time.sleep(0.02)


class _TidyEnd:
    """The module os for Dask's watcher, which would end this process at once when its parent is gone."""

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def _exit(self, code: int) -> None:
        _stop(set(_threads.values()))
        os._exit(code)


class Look(NamedTuple):
    """A worker's versions, its threads, and the first of the paths that it cannot read."""

    versions: Mapping[str, str]
    code: str
    threads: int
    unread: str  # empty where all can be


def look(folder: str, readable: tuple[str, ...], writable: tuple[str, ...], dask_worker: Worker) -> Look:
    """Look around on a worker, before any work: paths are those of a client that works in ``folder``."""
    from v2hdm.store.cache import code_key, library_versions

    base = Path(folder)
    unread = ""
    for name, mode in [*((name, os.R_OK) for name in readable), *((name, os.W_OK) for name in writable)]:
        path = base / name
        if mode == os.W_OK:  # the first of its folders that is there: the rest is made when it is written
            path = next(parent for parent in (path, *path.parents) if parent.exists())
        if not os.access(path, mode):
            verb = "read" if mode == os.R_OK else "write to"
            unread = unread or f"cannot {verb} {base / name}"
    return Look(library_versions(), code_key(), dask_worker.state.nthreads, unread)
