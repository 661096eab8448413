"""The interface of every executor, and the one that needs no other process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from v2hdm.errors import WorkerError
from v2hdm.progress import Progress

TWICE_DEAD = (
    "a worker process died twice over the same work, perhaps for lack of memory; set fewer "
    "workers= (--workers)"
)

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")

Outcomes = Generator[tuple[int, _Result | WorkerError], None, None]
"""Numbers and results of jobs as they are done; closed early, it ends what is under way."""

JobProgress = Callable[[Any, str, int, int], None]
"""Called with a job, the task within it, and how many of how many steps of that are done."""


def no_progress(job: object, task: str, done: int, total: int) -> None:
    """A :data:`JobProgress` that shows nothing."""


def _no_start() -> None:
    """The start of a stage whose processes need no preparation."""


@dataclass(frozen=True)
class Stage(Generic[_Job, _Result]):
    """Work to be done on many jobs: ``work(job, progress)`` in processes that call ``start`` once before.

    All of it, and the jobs and results, must be picklable.
    """

    work: Callable[[_Job, Progress], _Result]
    start: Callable[..., object] = _no_start
    arguments: tuple[object, ...] = ()
    processes: int = 0  # that take part at most, 0 for all: each may hold much of a GPU


_LARGEST_BATCH = 8  # short jobs handed over together: Dask takes 6 ms of CPU to hand over the least of them
_BATCHES_A_PROCESS = 32  # batches of each process at least, so that all end within a thirtieth of each other


class _Batches(Generic[_Job, _Result]):
    """Work on several jobs, one after the other, that tells nothing of its steps."""

    def __init__(self, work: Callable[[_Job], _Result]) -> None:
        self._work = work

    def __call__(self, jobs: Sequence[_Job], progress: Progress) -> list[_Result]:
        return [self._work(job) for job in jobs]


class Executor(ABC):
    """Does the jobs of stages; where this is, no stage knows."""

    @property
    @abstractmethod
    def workers(self) -> int:
        """How many jobs are done at a time."""

    @abstractmethod
    def outcomes(
        self, stage: Stage[_Job, _Result], jobs: Sequence[_Job], progress: JobProgress, at_once: int
    ) -> Outcomes[_Result]:
        """Each job's number and result as it is done, ``at_once`` of them at most under way.

        A job whose process dies is begun once more, and a WorkerError is its result where that dies, too. An
        exception of the work is raised here, as it was there.
        """

    def close(self) -> None:  # noqa: B027  # most have nothing to end
        """End what was started."""

    def side_by_side(
        self,
        work: Callable[[_Job, Progress], _Result],
        jobs: Sequence[_Job],
        progress: JobProgress = no_progress,
    ) -> Outcomes[_Result]:
        """Do long jobs, which report their steps; see :meth:`outcomes`."""
        return self.outcomes(Stage(work), jobs, progress, self.workers)

    def share_out(
        self,
        work: Callable[[_Job], _Result],
        jobs: Sequence[_Job],
        start: Callable[..., object],
        arguments: tuple[object, ...],
        take: Callable[[_Result], None],
        processes: int = 0,
    ) -> None:
        """Do short jobs in processes that call ``start`` first; ``take`` gets their results in order.

        At most so many ``processes`` take part, 0 for all. Raises errors of the work, or WorkerError.
        """
        results: dict[int, list[_Result]] = {}
        taken_count = 0
        count = min(self.workers, processes or self.workers)
        size = min(max(1, len(jobs) // (_BATCHES_A_PROCESS * count)), _LARGEST_BATCH)
        batches = [jobs[begin : begin + size] for begin in range(0, len(jobs), size)]
        stage = Stage(_Batches(work), start, arguments, processes)
        # Two batches a worker, so that none waits for the next one to reach it.
        outcomes = self.outcomes(stage, batches, no_progress, 2 * count)
        with closing(outcomes):
            for number, result in outcomes:
                if isinstance(result, WorkerError):
                    raise result
                results[number] = result
                while taken_count in results:
                    for result_of_job in results.pop(taken_count):
                        take(result_of_job)
                    taken_count += 1


class _ThisProcess(Executor):
    """Does one job after the other, here."""

    @property
    def workers(self) -> int:
        return 1

    def outcomes(
        self, stage: Stage[_Job, _Result], jobs: Sequence[_Job], progress: JobProgress, at_once: int
    ) -> Outcomes[_Result]:
        stage.start(*stage.arguments)
        for number, job in enumerate(jobs):
            yield number, stage.work(job, partial(progress, job))


HERE: Executor = _ThisProcess()
"""The executor that is this process."""
