"""Work shared out among processes that never outlive the one that started them.

Ctrl-C and errors reach this process alone, which ends the others; each of them watches this one and ends when
it dies.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from v2hdm.errors import WorkerError
from v2hdm.progress import Progress

_TIDY_S = 30.0  # a worker without its parent may take this long to end, whatever it is in
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_TWICE_DEAD = (
    "a worker process died twice over the same work (exit code {}), perhaps for lack of memory; set fewer "
    "workers= (--workers)"
)

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def share_out(
    work: Callable[[_Job], _Result],
    jobs: Sequence[_Job],
    processes: int,
    start: Callable[..., None],
    arguments: tuple[object, ...],
    take: Callable[[_Result], None],
) -> None:
    """Do short jobs in processes that call ``start`` first; results in order, their errors or WorkerError."""
    results: dict[int, _Result] = {}
    taken_count = 0
    ready = _Prepared(work, start, arguments)
    for number, result in side_by_side(ready, jobs, min(processes, len(jobs)), lambda *_: None):
        if isinstance(result, WorkerError):
            raise result
        results[number] = result
        while taken_count in results:
            take(results.pop(taken_count))
            taken_count += 1


class _Prepared(Generic[_Job, _Result]):
    """Work for which every process is made ready by its first job."""

    def __init__(
        self, work: Callable[[_Job], _Result], start: Callable[..., None], arguments: tuple[object, ...]
    ) -> None:
        self._work = work
        self._start = start
        self._arguments = arguments
        self._is_ready = False

    def __call__(self, job: _Job, progress: Progress) -> _Result:
        if not self._is_ready:
            self._start(*self._arguments)
            self._is_ready = True
        return self._work(job)


def side_by_side(
    work: Callable[[_Job, Progress], _Result],
    jobs: Sequence[_Job],
    processes: int,
    progress: Callable[[_Job, str, int, int], None],
) -> Iterator[tuple[int, _Result | WorkerError]]:
    """Do long jobs in several processes; yields each job's number and result as it is done.

    ``work`` reports its steps to the progress that it is given. A job whose process dies is begun once more,
    and a WorkerError is its result where that dies, too. An exception of ``work`` is raised here. Processes
    are spawned, as a fork would inherit the locks of threads; a pipe each takes no other's messages with it.
    """
    left = list(range(len(jobs)))[::-1]
    died = set[int]()
    others = set(multiprocessing.active_children())
    idle: list[_Worker] = []
    doing: dict[object, tuple[_Worker, int]] = {}
    try:
        while left or doing:
            while left and len(doing) < max(1, processes):
                worker = idle.pop() if idle else _Worker(work)
                number = left.pop()
                doing[worker.pipe] = worker, number
                with suppress(OSError):  # it has died, as what is received says
                    worker.pipe.send(jobs[number])
            for pipe in wait([worker.pipe for worker, _ in doing.values()]):
                worker, number = doing[pipe]
                try:
                    kind, *message = worker.pipe.recv()
                except (EOFError, OSError):
                    del doing[pipe]
                    worker.process.join()
                    if number in died:
                        yield number, WorkerError(_TWICE_DEAD.format(worker.process.exitcode))
                    else:
                        died.add(number)
                        left.append(number)
                    continue
                if kind == "progress":
                    progress(jobs[number], *message)
                    continue
                idle.append(doing.pop(pipe)[0])
                if kind == "failed":
                    failure, trace = message
                    raise failure from RuntimeError(trace)
                yield number, message[0]
    finally:
        ours = [process for process in multiprocessing.active_children() if process not in others]
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
            outcome: tuple[Any, ...]
            try:
                outcome = "done", work(job, progress)
            except Exception as failure:
                outcome = "failed", failure, traceback.format_exc()
            pipe.send(outcome)


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


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_TIDY_S)
    os._exit(1)
