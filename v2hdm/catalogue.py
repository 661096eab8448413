"""The catalogue of painted markings: families of shapes and sizes by class.

``catalogue.yaml`` lists the shipped classes. A user's file of the same form adds classes after them, so that
the channels of networks keep their meaning. A network that knows such classes carries them in its file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.records import CROSSWALK, LANE_BOUNDARY, BoolArray, FloatArray
from v2hdm.safe.texts import read_yaml, shown

CATALOGUE_FILE = Path(__file__).with_name("catalogue.yaml")

QUADRILATERAL = "quadrilateral"
STRIPE = "stripe"
LINE = "line"
SYMBOL = "symbol"
AREA = "area"
OTHER = "other"
FAMILIES = (QUADRILATERAL, STRIPE, LINE, SYMBOL, AREA, OTHER)

_SOFTNESS = 0.25  # standard deviation of a log size about its range, where the catalogue gives none
_TINY_M = 1e-3  # least size that differs from nothing, m
NOT_PAINT = "none"  # the label of everything that is no marking; no class may have this name
_NAME = re.compile(r"[A-Za-z0-9_]{1,64}")  # names of classes stand in file formats, log lines and label files
_MOST_CLASSES = 254  # labels are bytes: 0 is no paint, 255 is unknown

_KEYS = frozenset({"family", "length_m", "width_m", "softness", "group"})

_STRIPE_ASPECT = 3.0  # a stripe or a line is at least so many times as long as wide
_ASPECT_SOFTNESS = 0.1  # standard deviation of the logarithm of that least aspect


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

    def size_log_likelihood(
        self,
        length_m: float | FloatArray,
        width_m: float | FloatArray,
        *,
        whole: bool | BoolArray,
        log_sigma: float | FloatArray = 0.0,
    ) -> FloatArray:
        """Log likelihood of sizes, 0 within the ranges; of a piece that the border cuts only the upper ends.

        ``log_sigma`` is the standard deviation of the logarithm of what is measured; arguments broadcast.
        Sizes are not a number where a piece shows no ground; then they say nothing.
        """
        length, width = (np.log(np.maximum(size, _TINY_M)) for size in (length_m, width_m))
        softness, aspect = (np.hypot(softness, log_sigma) for softness in (self.softness, _ASPECT_SOFTNESS))
        sizes = ((length, self.length_m), (width, self.width_m))
        off = [(size - math.log(high)) / softness for size, (_, high) in sizes if high < math.inf]
        below = [(math.log(max(low, _TINY_M)) - size) / softness for size, (low, _) in sizes]
        if self.family in (STRIPE, LINE):
            below.append((math.log(_STRIPE_ASPECT) + width - length) / aspect)
        off += [np.where(whole, excess, 0.0) for excess in below]
        total = sum(np.square(np.maximum(excess, 0.0)) for excess in off)
        return np.asarray(np.where(np.isfinite(length + width), -0.5 * total, 0.0))


@dataclass(frozen=True)
class Catalogue:
    """All classes by name, in the order of the network's channels."""

    classes: Mapping[str, MarkingClass]

    @property
    def names(self) -> tuple[str, ...]:
        """All classes, in order."""
        return tuple(self.classes)

    @property
    def cornered(self) -> tuple[str, ...]:
        """Names of the classes that are mapped by four corners."""
        return self.of_family(QUADRILATERAL, STRIPE)

    @property
    def lane_paint(self) -> tuple[str, ...]:
        """Names of the classes whose centre lines make up lanes: those in a group with a line."""
        groups = {self.classes[name].group for name in self.of_family(LINE)}
        return tuple(name for name, entry in self.classes.items() if entry.group in groups)

    @property
    def of_any_shape(self) -> tuple[str, ...]:
        """Names of the classes whose paint is neither a quadrilateral nor a line."""
        return self.of_family(SYMBOL, AREA, OTHER)

    def of_family(self, *families: str) -> tuple[str, ...]:
        """Names of the classes of some families."""
        return tuple(name for name, entry in self.classes.items() if entry.family in families)

    def with_own(self, entries: Mapping[Any, Any], where: str) -> Catalogue:
        """This catalogue and a user's classes after it; ConfigError, from ``where``, if one is wrong."""
        name_in_use = {name.lower(): name for name in (*self.classes, LANE_BOUNDARY, NOT_PAINT)}
        for name in entries:
            if not (isinstance(name, str) and _NAME.fullmatch(name)):
                raise ConfigError(
                    f"{where}: class {shown(name)}: use at most 64 letters, digits and underscores"
                )
            if (other := name_in_use.get(name.lower())) is not None:
                raise ConfigError(
                    f"{where}: {shown(name)} is already the name of {shown(other)}; choose another"
                )
            name_in_use[name.lower()] = name
        own_classes = {name: _read_class(name, entry, where) for name, entry in entries.items()}
        groups = {shipped.group for shipped in self.classes.values()}
        lanes = {self.classes[name].group for name in self.of_family(LINE)}
        for name, added in own_classes.items():
            if added.family == LINE or added.group in lanes:
                raise ConfigError(
                    f"{where}: {shown(name)} would be lane paint, which has fixed classes "
                    f"({', '.join(self.lane_paint)}); choose another family and group"
                )
            if added.group not in groups | set(own_classes):
                shipped_groups = ", ".join(sorted(groups - lanes))
                raise ConfigError(
                    f"{where}: group of {shown(name)} is {shown(added.group)}; name one of {shipped_groups}, "
                    "or a class of your own"
                )
        if len(self.classes) + len(own_classes) > _MOST_CLASSES:
            raise ConfigError(f"{where}: more than {_MOST_CLASSES} classes in total; drop some")
        return Catalogue({**self.classes, **own_classes})


def load_catalogue(path: Path | None = None) -> Catalogue:
    """The shipped classes and, after them, those of a user's file; raises ConfigError where that is wrong."""
    return SHIPPED if path is None else SHIPPED.with_own(_read_entries(path), str(path))


def _read_entries(path: Path) -> dict[Any, Any]:
    content = read_yaml(path, ConfigError)
    entries = content.get("classes") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ConfigError(f"{path}: has no `classes`; list them as in v2hdm/catalogue.yaml")
    return entries


def _read_class(name: str, entry: Any, where: str) -> MarkingClass:
    if not isinstance(entry, dict) or not set(entry) <= _KEYS:
        raise ConfigError(f"{where}: class {shown(name)} may have only {', '.join(sorted(_KEYS))}")
    values = {"softness": _SOFTNESS, "group": name, **entry}

    def refuse(key: str, advice: str) -> ConfigError:
        return ConfigError(f"{where}: {key} of {shown(name)} is {shown(values.get(key))}; {advice}")

    if values.get("family") not in FAMILIES:
        raise refuse("family", f"choose from {', '.join(FAMILIES)}")
    for key in ("length_m", "width_m"):
        value = values.get(key)
        if not (isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))):
            raise refuse(key, "give [from, to] in m")
        if not (0 <= value[0] <= value[1] and value[1] > 0):
            raise refuse(key, "give [from, to] in m")
    if not (_is_number(values["softness"]) and 0 < values["softness"] < math.inf):
        raise refuse("softness", "give a positive number")
    if not isinstance(values["group"], str):
        raise refuse("group", "give the name of a group")
    length_m, width_m = ((float(low), float(high)) for low, high in (values["length_m"], values["width_m"]))
    return MarkingClass(name, values["family"], length_m, width_m, values["group"], float(values["softness"]))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


_SHIPPED = _read_entries(CATALOGUE_FILE).items()
SHIPPED = Catalogue({name: _read_class(name, entry, str(CATALOGUE_FILE)) for name, entry in _SHIPPED})
"""The shipped classes."""

PAINT_CLASSES = SHIPPED.names
"""The shipped classes, in the order of a network's class channels. Chevrons are the bars and angles of
traffic islands, a box is an area to be kept clear: its frame and hatching; a bicycle is any symbol of who may
go there. Other paint is whatever else is no marking to map. A network that was trained before a class was
added has the channels before it, and finds none of that class."""

AREAS = (*SHIPPED.of_family(AREA), CROSSWALK)
"""Classes of symbols that are areas: those of the catalogue, and what is composed of bars."""

CORNERED_CLASSES = SHIPPED.cornered  # shipped classes that are mapped as quadrilaterals by their four corners
