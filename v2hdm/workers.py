"""Work shared out among processes that never outlive the one that started them.

Ctrl-C and errors reach this process alone, which ends the others; each of them watches this one and ends when
it dies, which those of ``ProcessPoolExecutor`` do not do by themselves.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from v2hdm.errors import WorkerError
from v2hdm.progress import Progress

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
        raise _died("a worker process died", ends[0] if ends else None) from None
    except BaseException:
        for one in ours:
            one.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def side_by_side(
    work: Callable[[_Job, Progress], _Result],
    jobs: Sequence[_Job],
    processes: int,
    progress: Callable[[_Job, str, int, int], None],
) -> Iterator[tuple[int, _Result | WorkerError]]:
    """Do long jobs in several processes; yields each job's number and result as it is done.

    ``work`` reports its steps to the progress that it is given, and ``progress`` is called with them here. A
    job whose process dies is begun once more, and a WorkerError is its result where that dies, too. An
    exception of ``work`` is raised here. Messages go through a pipe per process: one that is killed takes no
    other's with it, and there is no socket that anybody else could reach.
    """
    left, died = list(range(len(jobs)))[::-1], set[int]()
    others = set(multiprocessing.active_children())
    idle: list[_Worker] = []
    doing: dict[object, tuple[_Worker, int]] = {}
    try:
        while left or doing:
            while left and len(doing) < max(1, processes):
                worker = idle.pop() if idle else _Worker(work)
                worker.pipe.send(jobs[left[-1]])
                doing[worker.pipe] = worker, left.pop()
            for pipe in wait([worker.pipe for worker, _ in doing.values()]):
                worker, number = doing[pipe]
                try:
                    kind, *message = worker.pipe.recv()
                except (EOFError, OSError):
                    del doing[pipe]
                    worker.process.join()
                    if number in died:
                        yield number, _died("its process died twice", worker.process.exitcode)
                    else:
                        died.add(number)
                        left.append(number)
                    continue
                if kind == "progress":
                    progress(jobs[number], *message)
                    continue
                idle.append(doing.pop(pipe)[0])
                if kind == "failed":
                    raise message[0]
                yield number, message[0]
    finally:
        ours = [one for one in multiprocessing.active_children() if one not in others]
        for process in ours:
            process.terminate()
        for process in ours:
            process.join()


class _Worker:
    """A process that does jobs of :func:`side_by_side`; it ends with the other end of its ``pipe``."""

    def __init__(self, work: Callable[[Any, Progress], Any]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.pipe, theirs = spawn.Pipe()
        self.process = spawn.Process(target=_serve, args=(work, theirs))
        with undisturbed_starts():
            self.process.start()
        theirs.close()


def _serve(work: Callable[[Any, Progress], Any], pipe: Connection) -> None:
    live_with_parent()
    logging.getLogger("v2hdm").addHandler(logging.NullHandler())  # warnings are the results' to state

    def progress(task: str, done: int, total: int) -> None:
        pipe.send(("progress", task, done, total))

    with suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            try:
                outcome = "done", work(job, progress)
            except Exception as failure:
                outcome = "failed", failure
            pipe.send(outcome)


def _died(what: str, code: int | None) -> WorkerError:
    shown = "unknown" if code is None else code
    return WorkerError(
        f"{what} (exit code {shown}), perhaps for want of memory; set fewer workers= (--workers)"
    )


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
