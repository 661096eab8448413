"""Work in steps, for what may have to wait for something more urgent in between."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

from v2hdm.detection.stopwatch import lap

_Result = TypeVar("_Result")

Steps = Generator[None, None, _Result]
"""Steps that lead to a result."""


def timed(stage: str, steps: Steps[_Result]) -> Steps[_Result]:
    """Steps of a stage, each timed as a part of it."""
    while True:
        try:
            with lap(stage):
                next(steps)
        except StopIteration as end:
            result: _Result = end.value
            return result
        yield


def last(steps: Steps[_Result]) -> _Result:
    """The result of steps taken one after another."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: _Result = end.value
            return result
