"""The executor of a run, from its settings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeVar

from v2hdm.errors import ConfigError
from v2hdm.executor.executor import HERE, Executor, JobProgress, Outcomes, Stage
from v2hdm.executor.memory import keep_freed_memory

_SCHEMES = ("tcp://", "tls://")
BATCH_SYSTEMS = {
    "slurm": "SLURMCluster", "pbs": "PBSCluster", "sge": "SGECluster", "lsf": "LSFCluster",
    "oar": "OARCluster", "moab": "MoabCluster", "htcondor": "HTCondorCluster",
}  # fmt: skip
"""Names of batch systems and of the classes of dask-jobqueue for them."""

if TYPE_CHECKING:  # loads Dask
    from v2hdm.executor.cluster import ClusterExecutor

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def check_cluster(cluster: str) -> None:
    """Raise ConfigError for what is neither an address nor a batch system."""
    if cluster and not cluster.startswith(_SCHEMES) and cluster not in BATCH_SYSTEMS:
        raise ConfigError(
            f"cluster={cluster}: give the address of a Dask scheduler, such as tcp://host:8786 or "
            f"tls://host:8786, or a batch system: {', '.join(BATCH_SYSTEMS)}"
        )


@contextmanager
def open_executor(
    workers: int = 0,
    cluster: str = "",
    *,
    memory_gb: float = 0.0,
    readable: Sequence[str] = (),
    writable: Sequence[str] = (),
    isolated: bool = False,
) -> Iterator[Executor]:
    """The executor of a run; whatever it has started is gone at the end of the block.

    Args:
        workers: processes, 0 for one per core; 1 is this process, unless ``isolated``. Of a batch system:
            its jobs.
        cluster: the address of a Dask scheduler, or a batch system; empty for this machine.
        memory_gb: the most that each process of this machine may take, GB; 0 for an even share of the memory.
        readable: paths that all workers of a ``cluster`` must be able to read.
        writable: paths in which they must be able to make files.
        isolated: whether jobs may not run in this process, as one that takes it down would take all.

    Raises:
        ConfigError: names the address, and the worker, where the cluster cannot be used.
    """
    check_cluster(cluster)
    keep_freed_memory()
    workers = workers or os.cpu_count() or 1
    if not cluster and workers <= 1 and not isolated:
        yield HERE
        return
    has_dask = find_spec("distributed") is not None
    if cluster and not has_dask:
        raise ConfigError(f"cluster={cluster} needs Dask: pip install 'v2hdm[map]'")
    if cluster:
        executor = _connected(cluster, workers, readable, writable)
    elif has_dask:
        executor = _WhenNeeded(workers, memory_gb, isolated)
    else:
        # It loads OpenCV, which would keep every command from its first line.
        from v2hdm.executor.processes import ProcessExecutor

        executor = ProcessExecutor(workers)
    try:
        yield executor
    finally:
        executor.close()


def _connected(cluster: str, workers: int, readable: Sequence[str], writable: Sequence[str]) -> Executor:
    """An executor of workers that were looked at."""
    from v2hdm.executor import connecting
    from v2hdm.executor.cluster import ClusterExecutor

    if cluster in BATCH_SYSTEMS:
        connected = connecting.batch_cluster(cluster, BATCH_SYSTEMS[cluster], workers)
    else:
        connected = connecting.distant_cluster(cluster)
    try:
        return ClusterExecutor(connected, connecting.inspect_workers(connected, readable, writable))
    except BaseException:
        connected.leave()
        raise


class _WhenNeeded(Executor):
    """Processes of this machine, or of the cluster that does this job; Dask is loaded by the first stage."""

    def __init__(self, workers: int, memory_gb: float, at_once: bool) -> None:
        self._workers = workers
        self._memory_gb = memory_gb
        self._at_once = at_once  # whether all processes are started, as jobs may share their work out further
        self._executor: ClusterExecutor | None = None

    @property
    def workers(self) -> int:
        return self._workers

    def outcomes(
        self, stage: Stage[_Job, _Result], jobs: Sequence[_Job], progress: JobProgress, at_once: int
    ) -> Outcomes[_Result]:
        side_by_side = max(1, min(self._workers, len(jobs)))
        needed = self._workers if self._at_once else side_by_side
        if self._executor is None:
            from v2hdm.executor import connecting
            from v2hdm.executor.cluster import ClusterExecutor

            if connecting.is_in_job():
                cluster = connecting.cluster_of_this_job()
            else:
                cluster = connecting.local_cluster(needed, side_by_side, self._memory_gb)
            self._executor = ClusterExecutor(cluster, self._workers)
        self._executor.grow(needed)
        yield from self._executor.outcomes(stage, jobs, progress, at_once)

    def close(self) -> None:
        if self._executor is not None:
            self._executor.close()
