"""Candidates that did not enter the map, as GeoJSON points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from v2hdm.hdmap.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.hdmap.heights import ground_height_m
from v2hdm.records import FloatArray, GeodeticOrigin, Road


@dataclass(frozen=True)
class ExcludedMarking:
    """A candidate that the map of ``cameras`` left out: its class, where (2,) in the map, and why."""

    kind: str
    position_map: FloatArray
    sightings: int
    reason: str
    cameras: str


def write_exclusions(
    excluded: Sequence[ExcludedMarking], path: Path, origin: GeodeticOrigin | None, road: Road | None
) -> None:
    """Write a FeatureCollection of points, atomically; ``cameras`` names the camera set of each."""
    features = []
    for number, one in enumerate(excluded):
        place = one.position_map.reshape(1, 2)
        heights = None if road is None else ground_height_m(road, place)
        properties = {
            "id": number,
            "class": one.kind,
            "reason": one.reason,
            "sightings": one.sightings,
            "cameras": one.cameras,
            "position_map": one.position_map.tolist(),
        }
        (position,) = geojson_positions(place, heights, origin)
        features.append(geojson_feature(f"excluded/{number}", "Point", position, properties))
    write_features(path, features, origin, {})
