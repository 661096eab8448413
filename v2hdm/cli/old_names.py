"""Settings of 1.0 that are called otherwise now, or have no effect: taken until 2.0, with a line each."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

from v2hdm.errors import ConfigError, one_line
from v2hdm.safe.texts import parse_yaml, read_yaml
from v2hdm.store.files import dump_yaml

RENAMED = {"mapping.device": "device", "mapping.mode": "mode"}
WITHDRAWN = {
    "mapping.acceptance.max_sigma_m": (
        "mapping.acceptance.accuracy=A, B or C takes its place (docs/accuracy.md)"
    ),
    "mapping.association": "gates follow from the sigmas of the inputs",
}
_POINTS, _NAMED_POINTS = "mapping.survey.points_map", "mapping.survey.points"


def renamed_overrides(overrides: Sequence[str]) -> list[str]:
    """Overrides of a command line, ``key=value``, by the names of now; those without effect are left out."""
    result = []
    for override in overrides:
        key, equals, value = override.partition("=")
        name = key.lstrip("+")
        if not equals:
            result.append(override)
        elif name in RENAMED:
            _say_renamed(name, RENAMED[name])
            result.append(f"{RENAMED[name]}={value}")
        elif name == _POINTS:
            _say_renamed(name, _NAMED_POINTS)
            result.append(f"{_NAMED_POINTS}=[{','.join(_point_override(point) for point in _points(value))}]")
        elif (withdrawn := _withdrawn(name)) is not None:
            _say_withdrawn(name, withdrawn)
        else:
            result.append(override)
    return result


def renamed_file(path: Path) -> str | None:
    """The text of a run file with today's names; None if it has no old names."""
    content = read_yaml(path, ConfigError)
    if not isinstance(content, dict):
        return None
    settings = deepcopy(content)
    for name, new in RENAMED.items():
        if (value := _taken(settings, name)) is not _ABSENT:
            _say_renamed(name, new)
            settings[new] = value
    if (value := _taken(settings, _POINTS)) is not _ABSENT:
        _say_renamed(_POINTS, _NAMED_POINTS)
        settings["mapping"]["survey"]["points"] = [
            {"id": f"{x} {y}", "position_map": [x, y], "sigma_m": [_SIGMA, _SIGMA]} for x, y in _pairs(value)
        ]
    for name, instead in WITHDRAWN.items():
        if _taken(settings, name) is not _ABSENT:
            _say_withdrawn(name, instead)
    return None if settings == content else f"# @package _global_\n{dump_yaml(settings)}"


class Share(NamedTuple):
    """Every so many drives of a fleet, beginning with the first-th."""

    first: int
    every: int


def share_of(text: str) -> Share:
    """The share ``K/N`` of a fleet, as ``v2hdm fleet --share`` took it."""
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    first, every = (int(number) for number in numbers.groups()) if numbers else (0, 0)
    if not 1 <= first <= every:
        raise ConfigError(f"--share {text}: give K/N, such as 1/4 to 4/4")
    say("--share is deprecated and goes with 2.0: --cluster ADDRESS shares out work (docs/fleet.md)")
    return Share(first, every)


_ABSENT = object()
_SIGMA = "${mapping.survey.sigma_m}"  # of a point that states none, as the configuration has it


def _taken(settings: dict[str, Any], name: str) -> Any:
    """The value of a key such as ``mapping.mode``, which is removed; ``_ABSENT`` where there is none."""
    *parents, leaf = name.split(".")
    place: Any = settings
    for parent in parents:
        place = place.get(parent) if isinstance(place, dict) else None
    return place.pop(leaf, _ABSENT) if isinstance(place, dict) else _ABSENT


def _points(value: str) -> list[tuple[float, float]]:
    return _pairs(parse_yaml(value, "mapping.survey.points_map", ConfigError))


def _pairs(value: Any) -> list[tuple[float, float]]:
    try:
        return [(float(x), float(y)) for x, y in value]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{_POINTS}: give pairs of x and y in m, as [[3.21, 4.05]]") from error


def _point_override(point: tuple[float, float]) -> str:
    x, y = point
    return f"{{id:'{x} {y}',position_map:[{x},{y}],sigma_m:[{_SIGMA},{_SIGMA}]}}"


def _withdrawn(name: str) -> str | None:
    """The advice for a key that has no effect, None for any other."""
    for old, instead in WITHDRAWN.items():
        if name == old or name.startswith(f"{old}."):
            return instead
    return None


def _say_renamed(name: str, new: str) -> None:
    say(f"{name} is deprecated and goes with 2.0: it is called {new}")


def _say_withdrawn(name: str, instead: str) -> None:
    say(f"{name} has no effect since 1.1 and goes with 2.0: {instead}")


def say(line: str) -> None:
    """Tell the user, on stderr, of a name that goes."""
    print(one_line(line), file=sys.stderr, flush=True)
