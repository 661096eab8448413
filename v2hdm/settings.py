"""One check for the settings of all commands: every number is finite and within its range.

Ranges stand beside the dataclasses that they are of, by the keys that users write. A key in a list or a
mapping shares the range of the list.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass

from v2hdm.errors import ConfigError

MOST_PROCESSES = 1024  # or threads; more are a typing error, and take the machine's memory


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


POSITIVE = Within(0, open=True)
NOT_NEGATIVE = Within(0)
SHARE = Within(0, 1)
COUNT = Within(1, 10**12)
SEED = Within(0, 2**63 - 1)


def check_workers(workers: int) -> None:
    """Raise ConfigError for a number of processes that no machine has."""
    if not 0 <= workers <= MOST_PROCESSES:
        raise ConfigError(f"--workers {workers}: give 1 to {MOST_PROCESSES} processes, or 0 for one per core")


def check_settings(config: object, ranges: Mapping[str, Within], prefix: str = "") -> None:
    """Refuse numbers that are not finite or out of range, with ConfigError that names ``prefix`` and key.

    ``ranges`` are by dotted key; ``*`` stands for the entries of a mapping.
    """
    for key, pattern, value in _numbers(config, "", ""):
        if not math.isfinite(value):
            raise ConfigError(f"{prefix}{key} is {value}: set a finite number")
        allowed = ranges.get(pattern)
        if allowed is not None and not allowed.holds(value):
            raise ConfigError(f"{prefix}{key} is {value}: set {allowed}")


def _numbers(value: object, key: str, pattern: str) -> Iterator[tuple[str, str, float]]:
    """All numbers with their keys, and with the keys of their ranges."""
    if isinstance(value, bool):
        return
    if isinstance(value, int | float):
        yield key, pattern, value
    elif is_dataclass(value):
        dot = "." if key else ""
        for name, item in vars(value).items():
            yield from _numbers(item, f"{key}{dot}{name}", f"{pattern}{dot}{name}")
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _numbers(item, f"{key}.{name}", f"{pattern}.*")
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            yield from _numbers(item, f"{key}[{number}]", pattern)
