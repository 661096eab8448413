"""The catalogue of painted markings: families of shapes and sizes by class."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from v2hdm.errors import ConfigError

CATALOGUE_FILE = Path(__file__).with_name("catalogue.yaml")

QUADRILATERAL, STRIPE, LINE, SYMBOL, OTHER = "quadrilateral", "stripe", "line", "symbol", "other"
FAMILIES = (QUADRILATERAL, STRIPE, LINE, SYMBOL, OTHER)

_SOFTNESS = 0.25
"""Standard deviation of a log size about its range, where the catalogue gives none."""

_TINY_M = 1e-3
"""Least size that is told from nothing, m."""

_STRIPE_ASPECT, _ASPECT_SOFTNESS = 3.0, 0.1
"""A stripe or a line is at least this many times as long as wide; the deviation of the logarithm of that."""


@dataclass(frozen=True)
class MarkingClass:
    """One class of paint: its ``family``, the ranges of its sizes, m, and the ``group`` that looks alike."""

    name: str
    family: str
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    group: str
    softness: float = _SOFTNESS

    @property
    def cornered(self) -> bool:
        """Whether it is mapped by four corners."""
        return self.family in (QUADRILATERAL, STRIPE)

    def size_log_likelihood(self, length_m: float, width_m: float, *, whole: bool) -> float:
        """Log likelihood of a size, 0 within the ranges; of a piece that the border cuts only the upper ends.

        Sizes are not a number where a piece shows no ground; then they say nothing.
        """
        if not (math.isfinite(length_m) and math.isfinite(width_m)):
            return 0.0
        sizes = ((max(length_m, _TINY_M), self.length_m), (max(width_m, _TINY_M), self.width_m))
        off = [math.log(size / high) / self.softness for size, (_, high) in sizes if high < math.inf]
        if whole:
            off += [math.log(max(low, _TINY_M) / size) / self.softness for size, (low, _) in sizes]
            if self.family in (STRIPE, LINE):
                off.append(math.log(_STRIPE_ASPECT * sizes[1][0] / sizes[0][0]) / _ASPECT_SOFTNESS)
        return -0.5 * sum(max(one, 0.0) ** 2 for one in off)


@dataclass(frozen=True)
class Catalogue:
    """All classes by name."""

    classes: Mapping[str, MarkingClass]

    def of_family(self, *families: str) -> tuple[str, ...]:
        """Names of the classes of some families."""
        return tuple(name for name, one in self.classes.items() if one.family in families)


@cache
def load_catalogue(path: Path = CATALOGUE_FILE) -> Catalogue:
    """Read a catalogue.

    Raises:
        ConfigError: the file is missing, is no YAML, or an entry is wrong.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read as a catalogue of markings ({error}); mend it") from error
    entries = content.get("classes") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ConfigError(f"{path}: no `classes` in it; list them as v2hdm/catalogue.yaml does")
    return Catalogue({name: _read_class(name, entry, path) for name, entry in entries.items()})


def _read_class(name: str, entry: Any, path: Path) -> MarkingClass:
    known = {"family", "length_m", "width_m", "softness", "group"}
    if not isinstance(entry, dict) or not set(entry) <= known:
        raise ConfigError(f"{path}: class {name!r} may have {', '.join(sorted(known))} and nothing else")
    family = entry.get("family")
    if family not in FAMILIES:
        raise ConfigError(f"{path}: family of {name!r} is {family!r}; choose from {', '.join(FAMILIES)}")
    ranges = {}
    for key in ("length_m", "width_m"):
        value = entry.get(key)
        if not (isinstance(value, list) and len(value) == 2 and 0 <= value[0] <= value[1] and value[1] > 0):
            raise ConfigError(f"{path}: {key} of {name!r} is {value!r}; give [from, to] in m")
        ranges[key] = (float(value[0]), float(value[1]))
    softness = entry.get("softness", _SOFTNESS)
    if not (isinstance(softness, (int, float)) and softness > 0):
        raise ConfigError(f"{path}: softness of {name!r} is {softness!r}; give a positive number")
    return MarkingClass(
        name, family, ranges["length_m"], ranges["width_m"], entry.get("group", name), float(softness)
    )
