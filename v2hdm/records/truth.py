"""The ground truth of a rendered drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from v2hdm.records.arrays import BoolArray, FloatArray
from v2hdm.records.maps import HDMap


@dataclass(frozen=True)
class Truth:
    """Ground truth of a rendered drive. Only the report reads it; the mapper never does."""

    map: HDMap
    cam_from_vehicle: Mapping[str, FloatArray]
    map_from_vehicle: FloatArray  # (I, 4, 4) one per ``Drive.images``
    visibility: FloatArray  # (I, J) fraction of marking j that image i shows, unoccluded
    lane_visible: tuple[BoolArray, ...]  # per lane, the vertices seen by some camera
    disturbances: Mapping[str, float]
    symbol_visibility: FloatArray | None = None  # (I, S) of symbol s, as of markings
    texts: Mapping[int, str] = field(default_factory=dict)  # what symbols say, by their number
