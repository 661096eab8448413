"""The type, range and meaning of each setting of all commands, which stand beside it.

A setting is a field of a dataclass, ``max_gap_s: Annotated[float, POSITIVE, "longest gap, s."] = 0.5``. The
check before any work, ``--help``, the schemas for editors and the library's pages are made of these.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from v2hdm.errors import ConfigError

MOST_PROCESSES = 1024  # or threads; more are a typing error, and take the machine's memory
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables with the number of threads of numerical libraries, which read them when loaded."""


@dataclass(frozen=True)
class Within:
    """Numbers from ``least``, not itself where ``open``, to ``most``, that ``step`` divides if given."""

    least: float = -math.inf
    most: float = math.inf
    open: bool = False
    step: int | None = None

    def holds(self, value: float) -> bool:
        """Whether ``value`` is one of them."""
        above = value > self.least if self.open else value >= self.least
        return above and value <= self.most and (self.step is None or value % self.step == 0)

    def __str__(self) -> str:
        low = f"{self.least:g}"
        high = f"{self.most:g}"
        if self.most == math.inf:
            text = f"more than {low}" if self.open else f"{low} or more"
        else:
            text = f"{'more than ' if self.open else ''}{low} to {high}"
        return text if self.step is None else f"a multiple of {self.step}, {text}"


NO_KEY = {"omegaconf_ignore": True}
"""Metadata of a field that no run file and no command line sets: another setting does."""

ANY_NUMBER = Within()
POSITIVE = Within(0, open=True)  # above zero
NOT_NEGATIVE = Within(0)  # zero or more
SHARE = Within(0, 1)  # of a whole
COUNT = Within(1, 10**12)  # chosen: more than any machine holds
Processes = Annotated[int, Within(0, MOST_PROCESSES)]
"""Number of processes; 0 is one per core."""
TOLERANCE_M = Within(1e-4, 10.0)  # from the rounding of a survey to more than any paint is judged by
Tolerance = Annotated[float, TOLERANCE_M]
"""Largest difference from a design that conforms, m."""
SEED = Within(0, 2**63 - 1)  # whole numbers of 64 bits with a sign


@dataclass(frozen=True)
class Setting:
    """A setting as a field of a dataclass declares it: type, the numbers that it takes, and its meaning."""

    hint: Any
    allowed: Within = ANY_NUMBER
    meaning: str = ""


def settings_of(schema: type[Any]) -> Mapping[str, Setting]:
    """The settings of a dataclass by name, in order, those of classes that it extends first."""
    hints = get_type_hints(schema, include_extras=True)
    return {field.name: _setting_of(hints[field.name]) for field in fields(schema)}


def _setting_of(hint: Any) -> Setting:
    if get_origin(hint) is not Annotated:
        return Setting(hint)
    plain, *notes = get_args(hint)
    allowed = next((note for note in notes if isinstance(note, Within)), ANY_NUMBER)
    return Setting(plain, allowed, next((note for note in notes if isinstance(note, str)), ""))


def check_workers(workers: int) -> None:
    """Raise ConfigError for a number of processes that no machine has."""
    if not 0 <= workers <= MOST_PROCESSES:
        raise ConfigError(f"--workers {workers}: give 1 to {MOST_PROCESSES} processes, or 0 for one per core")


def check_settings(config: Any, prefix: str = "") -> None:
    """Refuse numbers that are not finite or not in the range of their setting.

    Raises:
        ConfigError: names ``prefix`` and the key.
    """
    for key, value, allowed in _numbers(config, prefix, ANY_NUMBER):
        if not math.isfinite(value):
            raise ConfigError(f"{key} is {value}: set a finite number")
        if not allowed.holds(value):
            raise ConfigError(f"{key} is {value}: set {allowed}")


def _numbers(value: object, key: str, allowed: Within) -> Iterator[tuple[str, float, Within]]:
    """All numbers with their keys and ranges; the entries of a list or a mapping share its range."""
    if isinstance(value, bool):
        return
    if isinstance(value, int | float):
        yield key, value, allowed
    elif is_dataclass(value) and not isinstance(value, type):
        dot = "" if not key or key.endswith(".") else "."
        for name, setting in settings_of(type(value)).items():
            yield from _numbers(getattr(value, name), f"{key}{dot}{name}", setting.allowed)
    elif isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _numbers(entry, f"{key}.{name}", allowed)
    elif isinstance(value, list | tuple):
        for number, entry in enumerate(value):
            yield from _numbers(entry, f"{key}[{number}]", allowed)
