"""One writer at a time at a place of a store, which has no locks that a death releases.

Who writes holds a lease: an object that can be created once, called by a number, and
beside it a beat that it changes every few seconds. Who finds a lease watches its beat: where it changes, the
holder is alive and the place is refused; where it has been silent for long, by the watcher's own clock, the
next number is created, which only one can. The highest number holds.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from v2hdm.errors import ConfigError
from v2hdm.store.objects.bucket import Bucket

_log = logging.getLogger(__name__)

LEASES = ".v2hdm-leases"
"""Prefix of leases."""

BEAT_S = 10.0
"""Between two beats."""

SILENT_S = 60.0
"""A holder that has not beaten for so long is taken for dead."""

_TRIES = 5


class Lease:
    """A lease that this process holds."""

    def __init__(self, objects: Bucket, number: int, secret: str, shown: str) -> None:
        self._objects, self._number, self._secret, self._shown = objects, number, secret, shown
        self._ended = threading.Event()
        self._beats = 0
        self._checked_s = _clocks()
        self._thread = threading.Thread(target=self._keep_beating, name="v2hdm-lease", daemon=True)
        self._beat()
        self._thread.start()

    def still(self) -> None:
        """:meth:`check`, where that was long ago; before each of many puts."""
        if max(now - before for now, before in zip(_clocks(), self._checked_s, strict=True)) > SILENT_S / 2:
            self.check()

    def check(self) -> None:
        """Refuse to go on where another process has taken over, as after minutes without a network.

        Raises:
            ConfigError: it has.
        """
        self._checked_s = _clocks()
        numbers = _numbers(self._objects)
        if (
            not numbers
            or max(numbers) != self._number
            or _told(self._objects, self._number)[0] != self._secret
        ):
            raise ConfigError(
                f"{self._shown}: another process has taken over, since nothing was heard of this one for "
                f"{SILENT_S:g} s; nothing more is written there"
            )

    def end(self) -> None:
        """Give it up."""
        self._ended.set()
        self._thread.join()
        with suppress(ConfigError):
            self._objects.remove(_beat_of(self._secret))
            if _told(self._objects, self._number)[0] == self._secret:
                self._objects.remove(str(self._number))

    def _keep_beating(self) -> None:
        while not self._ended.wait(BEAT_S):
            with suppress(ConfigError):  # the next beat may get through
                self._beat()

    def _beat(self) -> None:
        self._beats += 1
        self._objects.write(_beat_of(self._secret), str(self._beats).encode())


@contextmanager
def held(place: Bucket, objects: Bucket, tell: Callable[[int, int], None]) -> Iterator[Lease]:
    """Hold the lease of a place.

    Args:
        place: which nobody else writes meanwhile.
        objects: those of its lease.
        tell: called as ``tell(passed, of)`` with seconds while it listens whether a holder lives.

    Raises:
        ConfigError: another process holds it and is alive; the message names it.
    """
    shown = str(place)
    for _ in range(_TRIES):
        numbers = _numbers(objects)
        if numbers and _is_alive(objects, max(numbers), shown, tell):
            continue  # it was given up meanwhile
        number, secret = max(numbers, default=0) + 1, secrets.token_hex(8)
        if not objects.create(str(number), _holder(secret)):
            continue
        lease = Lease(objects, number, secret, shown)
        try:
            lease.check()
            for left in numbers:
                objects.remove(_beat_of(_told(objects, left)[0]))
                objects.remove(str(left))
            yield lease
        finally:
            lease.end()
        return
    raise ConfigError(f"{shown}: other processes are about to write there; wait for them")


def _is_alive(objects: Bucket, number: int, shown: str, tell: Callable[[int, int], None]) -> bool:
    """False where the holder of a lease has been silent for long, True where it gave the lease up.

    Raises:
        ConfigError: it beats.
    """
    secret, holder = _told(objects, number)
    first = objects.read(_beat_of(secret))
    began_s = time.monotonic()
    _log.info("%s: %s was writing it; listening for %g s whether it lives", shown, holder, SILENT_S)
    while (passed_s := time.monotonic() - began_s) < SILENT_S:
        if objects.read(str(number)) is None:
            return True
        if objects.read(_beat_of(secret)) != first:
            raise ConfigError(f"{shown} is being written by {holder}; wait for it, or give another place")
        tell(int(passed_s), int(SILENT_S))
        time.sleep(BEAT_S / 5)
    return False


def _holder(secret: str) -> bytes:
    host = os.uname().nodename if hasattr(os, "uname") else "this host"
    return json.dumps({"secret": secret, "holder": f"process {os.getpid()} on {host}"}).encode()


def _told(objects: Bucket, number: int) -> tuple[str, str]:
    """Secret and name of a lease's holder; empty where it is gone or no lease."""
    try:
        told = json.loads(objects.read(str(number)) or b"{}")
        return str(told["secret"]), str(told["holder"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return "", "another process"


def _clocks() -> tuple[float, float]:
    """Two clocks: one may stand still while a machine is suspended, the other may be set."""
    return time.monotonic(), time.time()


def _beat_of(secret: str) -> str:
    return f"beat-{secret}"


def _numbers(objects: Bucket) -> list[int]:
    return [int(name) for name in objects.listed() if name.isdecimal()]
