"""Where parallel stages of a run are done: in this process, in others of this machine, or on a Dask cluster.

A run opens one :class:`Executor` with :func:`open_executor` and hands it down to its stages. Its processes
start with the first stage that has enough to share out, and stay for the later ones.
"""

from v2hdm.executor.executor import HERE, Executor, Stage
from v2hdm.executor.opening import check_cluster, open_executor

__all__ = ["HERE", "Executor", "Stage", "check_cluster", "open_executor"]
