"""Candidates that did not enter the map, as GeoJSON points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.io.maps.heights import ground_height_m
from v2hdm.records import FloatArray, GeodeticOrigin, Road
from v2hdm.store.files import load_json, take_array, take_mapping, take_number, take_text


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


def read_exclusions(path: Path) -> list[ExcludedMarking]:
    """Read what :func:`write_exclusions` wrote.

    Raises:
        MapFileError: the file is missing, damaged or not of this format.
    """
    features = load_json(path, MapFileError).get("features")
    if not isinstance(features, list):
        raise MapFileError(f"{path}: no 'features'; give what v2hdm map wrote")
    excluded = []
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        entry = take_mapping(
            take_mapping(feature, where, MapFileError).get("properties"), where, MapFileError
        )
        excluded.append(
            ExcludedMarking(
                kind=take_text(entry.get("class"), f"{where}: class", MapFileError),
                position_map=take_array(
                    entry.get("position_map", np.nan), (2,), f"{where}: position_map", MapFileError
                ),
                sightings=int(take_number(entry.get("sightings"), f"{where}: sightings", MapFileError)),
                reason=take_text(entry.get("reason"), f"{where}: reason", MapFileError),
                cameras=take_text(entry.get("cameras"), f"{where}: cameras", MapFileError),
            )
        )
    return excluded
