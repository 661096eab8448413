"""Our own map file, unchanged since we wrote it, read many times faster than one that others may have edited.

The list of a result's files says that it is unchanged. Such markings need none of the checks of
:mod:`v2hdm.io.maps.reading`, which reads everything else, and the file where anything is unexpected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from v2hdm.io.maps.features import CORNERS, PAINT
from v2hdm.io.maps.reading import read_geojson, read_geojson_of
from v2hdm.records import FloatArray, HDMap, Lane, Marking, PaintLeft, Symbol
from v2hdm.store.inputs import is_as_written, note_input

_CORNERED = f'"{CORNERS}"'.encode()


class _Properties(msgspec.Struct, forbid_unknown_fields=True):
    """The properties that we write of a marking."""

    id: int
    kind_: str = msgspec.field(name="class")
    sightings: int
    corners_map: msgspec.Raw
    heights_m: list[float] | None = None
    heights_sigma_m: list[float] | None = None
    sigma_m: float | None = None
    covariance_m2: msgspec.Raw = msgspec.Raw()
    relative_sigma_m: float | None = None
    accuracy: str | None = None
    variety: str | None = msgspec.field(name="kind", default=None)
    paint_left: float | None = None
    paint_left_sigma: float | None = None
    paint_left_change: float | None = None
    paint_left_change_sigma: float | None = None


class _Feature(msgspec.Struct):
    properties: _Properties


class _File(msgspec.Struct):
    v2hdm: dict[str, Any]
    features: list[msgspec.Raw]


def read_written(path: Path) -> HDMap:
    """The map in a GeoJSON of ours; errors as :func:`v2hdm.io.maps.reading.read_geojson`."""
    note_input(path)
    try:
        data = path.read_bytes()
    except OSError:
        return read_geojson(path)
    if not is_as_written(path, data):
        return read_geojson(path)
    try:
        content = msgspec.json.decode(data, type=_File)
        raw = [bytes(feature) for feature in content.features]
        cornered = [feature for feature in raw if _CORNERED in feature]
        joined = b"[" + b",".join(cornered) + b"]"
        features = msgspec.json.decode(joined, type=list[_Feature])
        markings = _markings([feature.properties for feature in features])
        others = [msgspec.json.decode(feature) for feature in raw if _CORNERED not in feature]
    except (msgspec.MsgspecError, ValueError):  # something that a marking of ours has and this does not know
        return read_geojson(path)
    hd_map = read_geojson_of({"v2hdm": content.v2hdm, "features": others}, path)
    paints: list[Marking | Lane | Symbol] = [*markings, *hd_map.lanes, *hd_map.symbols]
    ids = [paint.id or 0 for paint in paints]
    if len(set(ids)) < len(ids) or min(ids, default=1) < 1:
        return read_geojson(path)
    return replace(hd_map, markings=tuple(markings))


def _markings(stated: Sequence[_Properties]) -> list[Marking]:
    if not stated:
        return []
    corners_map = _numbers([properties.corners_map for properties in stated]).reshape(-1, 4, 2)
    covered = [k for k, properties in enumerate(stated) if bytes(properties.covariance_m2)]
    covariance_m2: list[FloatArray | None] = [None] * len(stated)
    if covered:
        matrices = _numbers([stated[k].covariance_m2 for k in covered]).reshape(-1, 8, 8)
        for k, matrix in zip(covered, matrices, strict=True):
            covariance_m2[k] = matrix
    return [
        Marking(
            kind=properties.kind_,
            corners_map=corners,
            sightings=properties.sightings,
            covariance_m2=covariance,
            relative_sigma_m=properties.relative_sigma_m,
            heights_m=_array(properties.heights_m),
            id=properties.id,
            paint=_paint(properties),
            heights_sigma_m=_array(properties.heights_sigma_m),
            accuracy=properties.accuracy,
            variety=properties.variety,
        )
        for properties, corners, covariance in zip(stated, corners_map, covariance_m2, strict=True)
    ]


def _numbers(lists: Sequence[Any]) -> FloatArray:
    """The numbers (N,) in JSON lists of lists, all in a row."""
    text = b",".join(bytes(numbers) for numbers in lists).translate(None, b"[] ")
    return np.fromstring(text.decode(), dtype=np.float64, sep=",")


def _array(numbers: list[float] | None) -> FloatArray | None:
    return None if numbers is None else np.array(numbers)


def _paint(properties: _Properties) -> PaintLeft | None:
    share, sigma, change, change_sigma = (getattr(properties, name) for name in PAINT)
    return None if share is None or sigma is None else PaintLeft(share, sigma, change, change_sigma)
