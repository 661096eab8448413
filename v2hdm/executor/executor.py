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

_PARTS = 8  # least number of parts of a stage's jobs a worker: the last ones keep others waiting; chosen

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


class _Plain(Generic[_Job, _Result]):
    """Work on several jobs, which tells nothing of its steps."""

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
        """Each job's number and result when it finishes; at most ``at_once`` jobs run.

        A job whose process dies is begun once more, and a WorkerError is its result where that dies, too. An
        exception of the work is raised here, as it was there.
        """

    def close(self) -> None:  # noqa: B027  # most have nothing to end
        """End the started processes."""

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
        together: int = 1,
    ) -> None:
        """Do short jobs in processes that call ``start`` first; ``take`` gets their results in order.

        At most so many ``processes`` take part, 0 for all. Where there are many jobs, a process gets so many
        ``together``: to hand one over costs some 17 ms of CPU. Raises errors of the work, or WorkerError.
        """
        results: dict[int, list[_Result]] = {}
        taken_count = 0
        stage = Stage(_Plain(work), start, arguments, processes)
        at_work = min(self.workers, processes or self.workers)
        size = min(together, max(1, len(jobs) // (_PARTS * at_work)))
        parts = [jobs[first : first + size] for first in range(0, len(jobs), size)]
        # Two parts a worker, so that none waits for the next one to reach it.
        outcomes = self.outcomes(stage, parts, no_progress, 2 * at_work)
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
