"""Work shared out among processes that never outlive the one that started them.

Ctrl-C and errors reach this process alone, which ends the others; each of them watches this one and ends when
it dies, which those of ``ProcessPoolExecutor`` do not do by themselves.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from v2hdm.errors import WorkerError

_TIDY_S = 30.0  # a worker without its parent may take this long to end, whatever it is in
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")

_failure: list[Exception] = []  # of the start of this worker process, for its first job to raise


def share_out(
    work: Callable[[_Job], _Result],
    jobs: Sequence[_Job],
    processes: int,
    start: Callable[..., None],
    arguments: tuple[object, ...],
    take: Callable[[_Result], None],
) -> None:
    """Do jobs in several processes and take their results in the order of the jobs.

    Processes are spawned: a fork would inherit the locks of other libraries' threads. Each calls ``start``
    with ``arguments`` first; an exception of ``work`` is raised here, caused by one with the traceback there.
    Raises WorkerError where a process died.
    """
    others, spawn = set(multiprocessing.active_children()), multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(max(1, min(processes, len(jobs))), spawn, _begin, (start, arguments))
    ours: set[Any] = set()
    try:
        with undisturbed_starts():
            results = pool.map(partial(_do, work), jobs)
            ours = set(multiprocessing.active_children()) - others
        for result in results:
            take(result)
    except BrokenProcessPool:
        pool.shutdown()
        ends = [one.exitcode for one in ours if one.exitcode not in (0, -signal.SIGTERM)]
        raise WorkerError(
            f"a worker process died (exit code {ends[0] if ends else 'unknown'}), perhaps for want of "
            "memory; set fewer workers="
        ) from None
    except BaseException:
        for one in ours:
            one.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def undisturbed_starts() -> Iterator[None]:
    """Processes started within never see Ctrl-C, and their linear algebra starts no thread a core each."""
    variables = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    mask = None
    if sys.platform != "win32":
        resource_tracker.ensure_running()  # started by the first process, it would lift the block
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


def live_with_parent() -> None:
    """Make this worker process end, tidily, on SIGTERM and when the one that started it dies."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # an exception tidies away what is being written
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _begin(start: Callable[..., None], arguments: tuple[object, ...]) -> None:
    live_with_parent()
    try:
        start(*arguments)
    except Exception as failure:
        _failure.append(failure)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_TIDY_S)
    os._exit(1)


def _do(work: Callable[[_Job], _Result], job: _Job) -> _Result:
    if _failure:
        raise _failure[0]
    try:
        return work(job)
    except SystemExit:  # the pool would take it for a failure of the job
        os._exit(0)
