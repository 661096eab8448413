"""Stages on a Dask cluster: of processes of this machine, of workers at an address, or of a batch system."""

from __future__ import annotations

import os
import queue
import secrets
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import cloudpickle
from distributed import Client, Future
from distributed.scheduler import KilledWorker
from distributed.utils import sync

from v2hdm.errors import WorkerError
from v2hdm.executor import tasks
from v2hdm.executor.executor import TWICE_DEAD, Executor, JobProgress, Outcomes, Stage

_END_S = 4.0  # time for workers to stop their jobs, before they are ended as they are
_LOOK_S = 1.0  # time without a message after which the cluster is looked at
_PATIENCE_S = 60.0  # time without any worker after which none is expected back; a nanny starts one in 3 s
_GONE = "{}: the scheduler, or all workers, are gone; finished work is kept, start again to go on"

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Cluster:
    """A cluster that is connected, how to leave it, and its name in errors."""

    client: Client
    name: str
    leave: Callable[[], None]
    grow: Callable[[int], None] = lambda workers: None
    """Start processes until there are so many, where they are ours to start."""


class ClusterExecutor(Executor):
    """Does jobs on the workers of a cluster."""

    def __init__(self, cluster: Cluster, workers: int) -> None:
        self._cluster = cluster
        self._workers = workers

    @property
    def workers(self) -> int:
        """How many jobs are done at a time."""
        return self._workers

    def grow(self, workers: int) -> None:
        """Start processes until there are so many, where they are ours to start."""
        self._cluster.grow(workers)

    def close(self) -> None:
        """Leave the cluster; processes of this machine end."""
        self._cluster.leave()

    def outcomes(
        self, stage: Stage[_Job, _Result], jobs: Sequence[_Job], progress: JobProgress, at_once: int
    ) -> Outcomes[_Result]:
        """See :meth:`Executor.outcomes`."""
        with _under_way(self._cluster, stage) as course:
            left = list(range(len(jobs)))[::-1]
            while left or course.futures:
                while left and len(course.futures) < at_once:
                    number = left.pop()
                    course.begin(number, jobs[number])
                message = course.next_message()
                if isinstance(message, _Step):
                    progress(jobs[message.number], message.task, message.done, message.total)
                    continue
                outcome = course.outcome(message)
                if outcome is None:
                    continue
                if outcome.kind == tasks.STOPPED:  # its workers died of what others did
                    left.append(message)
                    continue
                if outcome.kind == tasks.FAILED:
                    raise outcome.value from RuntimeError(outcome.trace)
                yield message, WorkerError(outcome.value) if outcome.kind == tasks.DEAD else outcome.value


class _Step(NamedTuple):
    """The progress of a job."""

    number: int
    task: str
    done: int
    total: int


class _Course:
    """The running jobs of one stage, and their reports."""

    def __init__(self, cluster: Cluster, token: str, processes: int) -> None:
        self.futures: dict[int, Future[Any]] = {}
        self.inbox = queue.SimpleQueue[_Step | int]()
        self._cluster = cluster
        self._places: list[Any] | None = None
        if processes:
            workers = cluster.client.scheduler_info()["workers"].values()
            self._places = sorted((worker["name"] for worker in workers), key=str)[:processes]
        self._name = tasks.StageName(token, os.getcwd())  # noqa: PTH109  # as text, for another machine

    def begin(self, number: int, job: object) -> None:
        """Hand a job to the cluster."""
        key = f"v2hdm-{self._name.token}-{number}-{secrets.token_hex(2)}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a job is large: nobody can make it smaller
            future = self._cluster.client.submit(
                tasks.perform,
                self._name,
                number,
                job,
                key=key,
                pure=False,
                retries=0,
                workers=self._places,
                allow_other_workers=self._places is not None,
            )
        self._wait_for(number, future)

    def _wait_for(self, number: int, future: Future[Any]) -> None:
        self.futures[number] = future
        future.add_done_callback(lambda _: self.inbox.put(number))

    def next_message(self) -> _Step | int:
        """The next reported step, or the number of a finished job; raises WorkerError otherwise."""
        client = self._cluster.client
        last_s = time.monotonic()
        while True:
            with suppress(queue.Empty):
                return self.inbox.get(timeout=_LOOK_S)
            if client.status == "running" and client.scheduler_info()["workers"]:
                last_s = time.monotonic()
            elif client.status not in ("running", "connecting") or time.monotonic() - last_s > _PATIENCE_S:
                raise WorkerError(_GONE.format(self._cluster.name))

    def outcome(self, number: int) -> tasks.Outcome | None:
        """How a job has ended, None where its worker died with the result and it is done again.

        Raises WorkerError where nobody will know any more.
        """
        future = self.futures.pop(number)
        if future.status == "finished":
            outcome: tasks.Outcome = future.result()
            return outcome
        if future.status in ("lost", "pending"):
            self._wait_for(number, future)
            return None
        if future.status == "error":
            failure = future.exception()
            if not isinstance(failure, KilledWorker):
                return tasks.Outcome(tasks.FAILED, failure)
            begins = self._cluster.client.get_metadata(tasks.begun_key(self._name.token, number), 0)
            kind = tasks.DEAD if begins >= tasks.MOST_BEGUN else tasks.STOPPED
            return tasks.Outcome(kind, TWICE_DEAD)
        raise WorkerError(_GONE.format(self._cluster.name))


@contextmanager
def _under_way(cluster: Cluster, stage: Stage[Any, Any]) -> Iterator[_Course]:
    """Run a stage; its remaining jobs are stopped at the end."""
    client = cluster.client
    token = secrets.token_hex(8)
    course = _Course(cluster, token, stage.processes)
    client.set_metadata([token, "stage"], cloudpickle.dumps(stage))
    client.subscribe_topic(token, lambda event: course.inbox.put(_Step(*event[1])))
    try:
        yield course
    finally:
        if course.futures:
            _stop(client, token, list(course.futures.values()))
        with suppress(Exception):  # of a connection that is gone, and the stage with it
            client.unsubscribe_topic(token)
            client.set_metadata(token, None)


def _stop(client: Client, token: str, futures: Sequence[Future[Any]]) -> None:
    """Take jobs back, and wait a little until those that are done now have tidied up."""

    async def ask_workers() -> None:
        await client.cancel(futures, force=True)
        await client.run(tasks.stop, token, on_error="ignore")

    with suppress(Exception):
        assert client.loop is not None
        sync(client.loop, ask_workers, callback_timeout=_END_S)
