"""Work shared out among processes that never outlive the one that started them.

Ctrl-C and errors reach this process alone, which ends the others. They see at once when it dies, and it when
one of them does: ``multiprocessing.Pool`` waits for ever for a process that was killed, and those of
``ProcessPoolExecutor`` stay when the process that started them is.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from v2hdm.errors import WorkerError

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PATIENCE_S = 5.0
"""How long a process may take to end."""

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
    """Do jobs in several processes and take their results in the order of the jobs.

    Processes are spawned: a fork would inherit the locks of other libraries' threads.

    Args:
        work: does one job; an exception of it is raised here, with the traceback of its process as a note.
        jobs: what to do.
        processes: how many to start at most.
        start: called in each process first, with ``arguments``.
        arguments: of ``start``.
        take: called here with each result.

    Raises:
        WorkerError: a process died.
    """
    workers: dict[Connection, BaseProcess] = {}
    try:
        with undisturbed_starts():
            context = multiprocessing.get_context("spawn")
            for _ in range(min(processes, len(jobs))):
                ours, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, start, arguments, work), daemon=True)
                process.start()
                theirs.close()
                workers[ours] = process
        _hand_out(jobs, workers, take)
    finally:
        _end(workers)


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


def _hand_out(
    jobs: Sequence[Any], workers: dict[Connection, BaseProcess], take: Callable[[Any], None]
) -> None:
    """Keep every process busy with one job after the other."""
    left, idle = deque(enumerate(jobs)), list(workers)
    doing: dict[Connection, int] = {}
    done: dict[int, Any] = {}
    taken = 0
    while taken < len(jobs):
        while idle and left:
            line = idle.pop()
            doing[line], job = left.popleft()
            try:
                line.send(job)
            except OSError:
                raise _death(workers[line]) from None
        ready = set(wait(list(doing)))
        for line in [line for line in doing if line in ready]:
            try:
                result, failure = line.recv()
            except (EOFError, OSError):
                raise _death(workers[line]) from None
            if failure is not None:
                raise failure
            done[doing.pop(line)] = result
            idle.append(line)
        while taken in done:
            take(done.pop(taken))
            taken += 1


def _death(process: BaseProcess) -> WorkerError:
    process.join(_PATIENCE_S)
    return WorkerError(
        f"a worker process died (exit code {process.exitcode}), perhaps for want of memory; "
        "set fewer workers="
    )


def _end(workers: dict[Connection, BaseProcess]) -> None:
    for line, process in workers.items():
        line.close()
        process.terminate()
    for process in workers.values():
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()


def _serve(
    line: Connection,
    start: Callable[..., None],
    arguments: tuple[object, ...],
    work: Callable[[Any], Any],
) -> None:
    """Do what comes along ``line`` until it is closed, or the first failure has been reported."""
    # Ended by an exception, it tidies away what is being written.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        start(*arguments)
        while (job := _next(line)) is not None:
            line.send((work(job[0]), None))
    except BrokenPipeError:
        return  # no one is left to take the result
    except Exception as failure:
        failure.add_note(f"in a worker process:\n{traceback.format_exc()}")
        line.send((None, failure))


def _next(line: Connection) -> tuple[Any] | None:
    try:
        return (line.recv(),)
    except (EOFError, OSError):
        return None
