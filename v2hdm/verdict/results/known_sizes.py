"""Known sizes that fit nothing: a class or a size is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.mapping.options import SizeOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.mapping.stated import known_lengths
from v2hdm.verdict.verdict import Finding, Status


def check_known_sizes(sizes: SizeOptions, best: MethodResult) -> list[Finding]:
    """A finding for each known size that no marking of the map is near to, and so was not used."""
    found = []
    for name, size in sizes.by_class_m.items():
        markings = [one for one in best.hd_map.markings if one.kind == name]
        corners_map = np.array([one.corners_map for one in markings]).reshape(-1, 4, 2)
        numbers = np.arange(4 * len(markings)).reshape(-1, 4)
        alone = replace(sizes, by_class_m={name: size})
        if known_lengths(alone, [name] * len(markings), corners_map, numbers):
            continue
        says = (
            f"none of the {len(markings)} markings of class {name} is about {size[0]:g} m by {size[1]:g} m, "
            "so that the size was not used; mend or drop it"
        )
        about = f"mapping.known_sizes.by_class_m.{name}"
        found.append(Finding("known size", Status.WARN, 0.0, None, "", says, about))
    return found
