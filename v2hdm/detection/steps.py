"""Work in steps, for what may have to wait for something more urgent in between."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

_Result = TypeVar("_Result")

Steps = Generator[None, None, _Result]
"""Steps that lead to a result."""


def last(steps: Steps[_Result]) -> _Result:
    """The result of steps taken one after another."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: _Result = end.value
            return result
