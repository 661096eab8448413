"""Ways to a Dask cluster, and what of it is looked at before any work."""

from __future__ import annotations

import asyncio
import importlib
import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, Security, get_worker, rpc, worker_client
from distributed.system import MEMORY_LIMIT

from v2hdm.errors import ConfigError, one_line
from v2hdm.executor import tasks
from v2hdm.executor.cluster import Cluster
from v2hdm.executor.processes import undisturbed_starts
from v2hdm.store.cache import code_key, library_versions

_CONNECT_S = 10.0  # for a scheduler to answer, and then for its first worker to be there; chosen
_QUEUE_S = 600.0  # for a batch system to start its first job; chosen
_CLOSE_S = 3.0  # for processes of this machine to end by themselves
_LOCAL = {
    # A process that takes too much is ended by its nanny; none is paused, or writes results to the disk.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,  # of the limit of a worker; Dask's own
    "distributed.worker.profile.enabled": False,
    # Dask has processes hand every freed array back to the system, which clears the memory of the next one:
    # a third of the time of a rendered image. They keep 256 MB, and allocate what is below 32 MB from that.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,  # an arena of a thread keeps less
    # A nanny starts its process again; whoever finds none at just that moment must not end the nanny.
    "distributed.deploy.lost-worker-timeout": "1 day",
}


def quiet() -> None:
    """Keep Dask's log off the terminal: our errors report what matters."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):  # each has a level of its own
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def local_cluster(workers: int, jobs: int, memory_gb: float) -> Cluster:
    """Processes of this machine with one thread each, which only this machine can reach.

    Each may take ``memory_gb``, or where that is 0 the memory divided by the ``jobs`` that are done at a
    time: a process that has nothing to do leaves others its part.
    """
    quiet()
    limit = round(memory_gb * 1e9) or MEMORY_LIMIT // jobs
    stack = ExitStack()
    stack.enter_context(dask.config.set(_LOCAL))  # is looked at as long as the cluster is there
    with undisturbed_starts(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cluster = LocalCluster(
            host="127.0.0.1",
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=limit,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        )
        client = Client(cluster)

    def grow(workers: int) -> None:
        if workers > len(cluster.workers):
            cluster.scale(workers)
            client.wait_for_workers(workers)

    def leave() -> None:
        with suppress(Exception):
            client.close(timeout=_CLOSE_S)
        with suppress(Exception):
            cluster.close(timeout=_CLOSE_S)
        stack.close()

    return Cluster(client, "processes of this machine", leave, grow)


def distant_cluster(address: str) -> Cluster:
    """The cluster of the scheduler at an address, with its workers; ConfigError where there is none."""
    quiet()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions, which are compared below
            # A client would wait without end for what listens there and says nothing.
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _ask(address)).result()
            client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as failure:
        raise ConfigError(f"cluster={address}: {_reason(failure)}") from None
    _wait_for_workers(client, address, _CONNECT_S, f"start dask worker {address} --nthreads 1")
    return Cluster(client, f"cluster={address}", partial(_close, client))


async def _ask(address: str) -> None:
    """Ask the scheduler at an address who it is; raises where none answers."""
    arguments = Security().get_connection_args("client")
    async with rpc(address, timeout=_CONNECT_S, connection_args=arguments) as scheduler:
        await asyncio.wait_for(scheduler.identity(), _CONNECT_S)


def _reason(failure: BaseException) -> str:
    """The reason why a client does not reach a scheduler, the innermost cause first, and a remedy."""
    causes = [failure]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    said = one_line(str(causes[-1]) or str(failure) or type(failure).__name__)
    text = " ".join(str(cause) for cause in causes)
    if any(word in text for word in ("ssl", "SSL", "certificate", "TLS")):
        return (
            f"the certificates do not fit ({said}); name the files of this cluster in Dask's settings "
            "distributed.comm.tls (docs/fleet.md)"
        )
    return f"no Dask scheduler answers there ({said}); start one with dask scheduler, and check the address"


def _wait_for_workers(client: Client, name: str, seconds: float, remedy: str) -> None:
    try:
        client.wait_for_workers(1, timeout=seconds)
    except TimeoutError:
        _close(client)
        raise ConfigError(f"cluster={name}: has no worker; {remedy}") from None


def _close(client: Client) -> None:
    with suppress(Exception):
        client.close(timeout=_CLOSE_S)


def batch_cluster(system: str, class_name: str, workers: int) -> Cluster:
    """Workers that are jobs of a batch system, as dask-jobqueue's own settings of a class describe them."""
    quiet()
    try:
        module = importlib.import_module("dask_jobqueue")
    except ModuleNotFoundError:
        raise ConfigError(f"cluster={system} needs dask-jobqueue: pip install dask-jobqueue") from None
    try:
        jobs = getattr(module, class_name)(processes=1)
        jobs.scale(jobs=workers)
    except (OSError, ValueError, TypeError, RuntimeError) as failure:
        raise ConfigError(
            f"cluster={system}: {one_line(str(failure))}; describe its jobs in dask-jobqueue's jobqueue.yaml"
        ) from None
    client = Client(jobs)
    _wait_for_workers(client, system, _QUEUE_S, "look at the queue of the batch system")

    def leave() -> None:
        _close(client)
        with suppress(Exception):
            jobs.close(timeout=_CLOSE_S)

    return Cluster(client, f"cluster={system}", leave)


def is_in_job() -> bool:
    """Whether this is called by a job on a Dask worker."""
    try:
        get_worker()
    except ValueError:
        return False
    return True


def cluster_of_this_job() -> Cluster:
    """The cluster that does this job, for jobs of its own; the worker may do another one meanwhile."""
    stack = ExitStack()
    return Cluster(stack.enter_context(worker_client()), "the cluster of this job", stack.close)


def inspect_workers(cluster: Cluster, readable: Sequence[str], writable: Sequence[str]) -> int:
    """The number of workers; ConfigError in one line for the first that differs from this process.

    ``readable`` are paths that every worker must be able to read, ``writable`` those where it must be able to
    make files.
    """
    client = cluster.client
    folder = str(Path.cwd())
    # What this machine cannot read either is no matter of the workers.
    paths = tuple(path for path in readable if os.access(path, os.R_OK))
    answers = client.run(tasks.look, folder, paths, tuple(writable), on_error="return")
    local_versions = library_versions()
    code = code_key()
    for address, answer in sorted(answers.items()):
        problem = _problem_of(answer, local_versions, code)
        if problem:
            raise ConfigError(f"{cluster.name}: the worker {address} {problem}")
    return len(answers)


def _problem_of(answer: Any, local_versions: Mapping[str, str], code: str) -> str:
    """Why a worker that has answered so cannot take part, and what to do; empty where it can."""
    if isinstance(answer, ModuleNotFoundError):
        return f"has no {answer.name}; install V2HDM there with the extra map"
    if isinstance(answer, Exception):
        return f"cannot be asked ({type(answer).__name__}: {one_line(str(answer))}); install the same V2HDM"
    for library, version in local_versions.items():
        version_of_worker = answer.versions.get(library, "none")
        if version_of_worker != version:
            return f"has {library} {version_of_worker}, and this machine {version}; install the same on both"
    if answer.code != code:
        return "has another V2HDM than this machine; install the same on both"
    if answer.threads != 1:
        return (
            f"has {answer.threads} threads; start it with "
            f"dask worker --nthreads 1 --nworkers {answer.threads}"
        )
    if answer.unread:
        return f"{answer.unread}; name a folder that all machines share"
    return ""
