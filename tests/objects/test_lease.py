"""One process writes a place at a time; one that died is followed, one that lives is not disturbed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from v2hdm.errors import ConfigError
from v2hdm.store import remote as lease
from v2hdm.store.remote import Bucket, held

pytestmark = pytest.mark.usefixtures("quick")


def quiet(passed: int, of: int) -> None:
    pass


def test_who_lives_is_named_and_left_alone(memory: Bucket) -> None:
    with leased(memory, "run", quiet) as mine:
        with (
            pytest.raises(ConfigError, match=r"/run is being written by process [0-9]+ on "),
            leased(memory, "run", quiet),
        ):
            pass
        mine.check()
        with leased(memory, "other", quiet):
            pass
    with leased(memory, "run", quiet):
        pass
    assert not memory.listed()


def leased(
    memory: Bucket, name: str, tell: Callable[[int, int], None]
) -> AbstractContextManager[lease.Lease]:
    return held(memory.below(name), memory.below(f"leases/{name}"), tell)


@contextmanager
def died(memory: Bucket, monkeypatch: pytest.MonkeyPatch) -> Iterator[lease.Lease]:
    """A lease whose holder does not beat any more."""
    with monkeypatch.context() as patch:
        patch.setattr(lease.Lease, "_keep_beating", lambda self: None)
        context = leased(memory, "run", quiet)
        left = context.__enter__()
    yield left
    context.__exit__(None, None, None)


def test_who_died_is_followed_after_a_silence(memory: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    with died(memory, monkeypatch) as left:
        began_s, told = time.monotonic(), []
        with leased(memory, "run", lambda *at: told.append(at)):
            assert time.monotonic() - began_s >= lease.SILENT_S
            assert told
            with pytest.raises(ConfigError, match="another process has taken over"):
                left.check()
    assert not memory.listed()


def test_of_many_that_follow_one_holds(memory: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    at_once, most, held_by = 0, 0, 0
    lock, all_ready = threading.Lock(), threading.Barrier(4)

    def follow() -> None:
        nonlocal at_once, most, held_by
        all_ready.wait()
        try:
            with leased(memory, "run", quiet):
                with lock:
                    at_once, held_by = at_once + 1, held_by + 1
                    most = max(most, at_once)
                time.sleep(0.3)
                with lock:
                    at_once -= 1
        except ConfigError:
            return

    threads = [threading.Thread(target=follow) for _ in range(4)]
    with died(memory, monkeypatch):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert most == 1
    assert held_by >= 1


def test_who_was_suspended_looks_again_before_it_writes(
    memory: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    with died(memory, monkeypatch) as left:
        left.still()
        with leased(memory, "run", quiet), pytest.raises(ConfigError, match="another process has taken over"):
            left.still()
