"""Results of stages, taken from the store where they are there and made where they are not.

What a stage hands on has always been through the codec, whether it was made now or long ago: a run that goes
on with kept results cannot tell them from those of a run in one go. Nor can who reads the log: what was
logged while a result was made is logged again when it is taken.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from v2hdm.store.cache.codec import CodecError, decode, encode
from v2hdm.store.cache.keys import code_key, key_of
from v2hdm.store.cache.store import Store

_Value = TypeVar("_Value")
Line = tuple[str, int, str]
"""Name of a logger, level, message."""


class Room:
    """A store as stages use it.

    Args:
        store: where results are kept; None keeps none.
        resume: whether what is there is taken; otherwise all is made anew, and kept.
    """

    def __init__(self, store: Store | None, resume: bool = True) -> None:
        self._store, self._resume = store, resume
        self.taken: list[str] = []
        """Stages whose results were there."""

    def key(self, *parts: object) -> str:
        """The key of what is made of ``parts`` by this version of the code."""
        return key_of(code_key(), *parts)

    def made(self, stage: str, key: str, kind: type[_Value], make: Callable[[], _Value]) -> _Value:
        """The result of a stage, of type ``kind``: that kept under ``key``, or else what ``make`` makes."""
        found = self.take(stage, key, kind)
        if found is not None:
            return found
        with recorded() as lines:
            value = make()
        return self.keep(stage, key, kind, value, lines)

    def each_made(
        self, stage: str, kind: type[_Value], jobs: Sequence[tuple[str, Callable[[], Callable[[], _Value]]]]
    ) -> Iterator[_Value]:
        """Several results of a stage, in order; all that are missing are begun before one is waited for.

        A job is a key, and what begins to make the result and returns what waits for it.
        """
        found = [self.take(stage, key, kind) for key, _ in jobs]
        begun = [begin() if one is None else None for one, (_, begin) in zip(found, jobs, strict=True)]
        for one, wait, (key, _) in zip(found, begun, jobs, strict=True):
            if wait is None:
                assert one is not None
                yield one
                continue
            with recorded() as lines:
                value = wait()
            yield self.keep(stage, key, kind, value, lines)

    def take(self, stage: str, key: str, kind: type[_Value]) -> _Value | None:
        """What is kept under ``key``; None where there is nothing."""
        if self._store is None or not self._resume:
            return None
        data = self._store.get(stage, key)
        if data is None:
            return None
        try:
            lines, content = decode(data, tuple[list[Line], bytes])
            value = decode(content, kind)
        except CodecError:
            self._store.drop(stage, key)
            return None
        log_again(lines)
        self.taken.append(stage)
        return value

    def keep(
        self, stage: str, key: str, kind: type[_Value], value: _Value, lines: list[Line] | None = None
    ) -> _Value:
        """Keep ``value`` under ``key``; returns it as :meth:`take` will."""
        content = encode(value)
        if self._store is not None:
            self._store.put(stage, key, encode((lines or [], content)))
        return decode(content, kind)


class _Recorder(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.lines: list[Line] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.name, record.levelno, record.getMessage()))


def log_again(lines: Sequence[Line]) -> None:
    """Log what was :func:`recorded`."""
    for name, level, message in lines:
        logging.getLogger(name).log(level, "%s", message)


@contextmanager
def recorded() -> Iterator[list[Line]]:
    """What this library logs within."""
    recorder, logger = _Recorder(), logging.getLogger("v2hdm")
    logger.addHandler(recorder)
    try:
        yield recorder.lines
    finally:
        logger.removeHandler(recorder)
