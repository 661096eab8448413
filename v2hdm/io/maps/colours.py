"""The colours of classes in files that have colours: those of the report's map in its light theme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from v2hdm.io.maps.features import Feature

SERIES = (
    "#0072b2", "#009e73", "#d55e00", "#cc79a7", "#e69f00",
    "#56b4e9", "#882255", "#44aa99", "#999933", "#332288",
)  # fmt: skip
"""Colours that classes of markings and symbols take in turn, in the order of their names."""

LINE = "#56b4e9"
"""The colour of lane lines, which a dashed stroke tells apart."""

OTHER = "#7f7f7f"
"""The colour of classes that an edit adds later."""


def colours_of(features: Sequence[Feature]) -> Mapping[str, str]:
    """The colour of each class of a map's markings and symbols."""
    kinds = sorted({feature.kind for feature in features if feature.closed})
    return {kind: SERIES[place % len(SERIES)] for place, kind in enumerate(kinds)}


def channels(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour such as ``#0072b2``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
