"""How far the drives of a fleet are: told by their workers, read by the head."""

from __future__ import annotations

import time
from typing import Any

_TELL_EVERY_S = 0.5


class Board:
    """An actor that takes what the drives tell of their progress."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[int, int]] = {}

    def tell(self, drive: str, stage: str, done: int, total: int) -> None:
        """Note how far a drive is."""
        self._told[drive, stage] = done, total

    def take(self) -> list[tuple[str, str, int, int]]:
        """What has been told since the last call."""
        told, self._told = self._told, {}
        return [(*key, *value) for key, value in told.items()]


class Telling:
    """Tells the board how far a drive is, now and then and at the ends of its stages."""

    def __init__(self, board: Any, drive: str) -> None:
        self._board, self._drive, self._told_s = board, drive, -_TELL_EVERY_S

    def __call__(self, task: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``task`` are finished."""
        now_s = time.monotonic()
        if done < total and now_s - self._told_s < _TELL_EVERY_S:
            return
        self._told_s = now_s
        self._board.tell.remote(self._drive, task, done, total)
