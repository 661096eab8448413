"""Threads of a solve: torch on one, compiled kernels on as many as torch had."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache

import torch

_WORTH_THREADS = 50_000  # fewer observations do not repay starting threads

_granted: int | None = None


@contextmanager
def one_thread_in_torch(observations: int, alone: bool) -> Iterator[None]:
    """Within, torch computes on one thread, and kernels on as many as torch had.

    Products are small here, and waiting threads cost more than they save. ``alone`` states that torch has
    nothing large to do, for any number of ``observations``.
    """
    global _granted
    before = torch.get_num_threads()
    granted = _granted
    if before == 1 or not (alone or observations < _WORTH_THREADS):
        yield
        return
    _granted = before
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _granted = granted
        torch.set_num_threads(before)


def share(work: Callable[[int, int], None], chunks: int, observations: int) -> None:
    """Call ``work(begin, end)`` for ranges that partition the ``chunks``."""
    is_small = chunks == 1 or observations < _WORTH_THREADS
    threads = 1 if is_small else min(_granted or torch.get_num_threads(), chunks)
    if threads <= 1:
        work(0, chunks)
        return
    for _ in _executor(threads).map(lambda chunk: work(chunk, chunk + 1), range(chunks)):
        pass


@lru_cache(maxsize=1)
def _executor(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="v2hdm-kernel")


if hasattr(os, "register_at_fork"):
    # A forked process has none of its parent's threads.
    os.register_at_fork(after_in_child=_executor.cache_clear)
