"""The map of any tool as GeoJSON, in the frame of a site: ours, or polygons and lines with a class each."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.asbuilt.design import check_place, moved_to, outline_of
from v2hdm.asbuilt.reading import (
    Drawn,
    Source,
    called_by,
    classes_of,
    crs_of_geojson,
    in_map,
    of_known_kinds,
)
from v2hdm.catalogue import load_catalogue
from v2hdm.errors import MapFileError
from v2hdm.geometry.planar import signed_area
from v2hdm.io.maps.reading import geometry_of_geojson, read_map
from v2hdm.records import FloatArray, HDMap, Lane, Marking
from v2hdm.report.metrics import match_markings
from v2hdm.safe.fields import take_covariance
from v2hdm.store.files import load_json, take_mapping, take_number
from v2hdm.store.names import map_file

_log = logging.getLogger(__name__)

VERDICTS = ("PASS", "WARN", "FAIL")

_SWAPPED = 2.0  # swapped axes must match this many times more markings to be reported as swapped; chosen


@dataclass(frozen=True)
class Submission:
    """A tool's map in the frame of a site, and the verdict that the tool states, None without one."""

    hd_map: HDMap
    verdict: str | None


def read_content(path: Path) -> Mapping[str, Any]:
    """The content of a GeoJSON file, or of the one in a result folder; MapFileError where it is none."""
    path = map_file(path)
    if not path.exists():
        raise MapFileError(f"{path}: no such file; give a map as GeoJSON, or the result folder of v2hdm map")
    if path.suffix.lower() not in (".geojson", ".json"):
        raise MapFileError(f"{path}: is not a GeoJSON file; give one that ends in .geojson")
    return load_json(path, MapFileError)


def read_submission(path: Path, true_map: HDMap, source: Source | None = None) -> Submission:
    """Read the map of a site whose true map gives the frame and the classes.

    Raises:
        MapFileError: the file is damaged, empty, of another place, system or datum, or with swapped axes.
        ConfigError: a class or system that ``source`` names is unknown.
    """
    content = read_content(path)
    path = map_file(path)
    if "v2hdm" in content:
        hd_map, stated = read_map(path)
        submission = Submission(_moved(hd_map, true_map, path), _verdict(stated, path))
    else:
        submission = _foreign(content, true_map, source or Source(), path)
    _check(submission.hd_map, true_map, path)
    return submission


def _moved(hd_map: HDMap, true_map: HDMap, path: Path) -> HDMap:
    """A map of ours in the frame of the true map."""
    origin = hd_map.origin
    target = true_map.origin
    if origin == target:
        return hd_map
    if origin is None or target is None:
        raise MapFileError(f"{path}: has no origin on the earth; map the drive as it is, with its origin")
    markings = [
        replace(marking, corners_map=moved_to(marking.corners_map, origin, target))
        for marking in hd_map.markings
    ]
    lanes = [replace(lane, points_map=moved_to(lane.points_map, origin, target)) for lane in hd_map.lanes]
    return replace(hd_map, markings=tuple(markings), lanes=tuple(lanes), symbols=(), origin=target)


def _foreign(content: Mapping[str, Any], true_map: HDMap, source: Source, path: Path) -> Submission:
    """A map of another tool."""
    features = content.get("features")
    if not isinstance(features, list):
        raise MapFileError(f"{path}: is not a collection of features; give one")
    crs = source.crs or crs_of_geojson(content)
    polygons, lines = _drawn(features, path)
    classes = classes_of(true_map)
    cornered = load_catalogue().cornered
    kinds = of_known_kinds(polygons, classes, source, path) if polygons else []
    markings = [
        _marking(drawn, kind, in_map(drawn.positions, crs, true_map.origin, str(path)), path)
        for drawn, kind in kinds
        if kind in cornered
    ]
    others = Counter(kind or "without a class" for _, kind in kinds if kind not in cornered)
    if others:
        named = ", ".join(f"{count} {kind}" for kind, count in others.most_common())
        _log.warning("%s: not scored, for they have no four corners or no class: %s", path, named)
    lanes = [
        Lane(drawn.called or "", in_map(drawn.positions, crs, true_map.origin, str(path)), 1)
        for drawn in lines
    ]
    hd_map = HDMap(tuple(markings), tuple(lanes), origin=true_map.origin)
    return Submission(hd_map, _verdict(content.get("verdict"), path))


class _Features(NamedTuple):
    """The features of a file by what they are drawn as."""

    polygons: list[Drawn]
    lines: list[Drawn]


def _drawn(features: Sequence[object], path: Path) -> _Features:
    drawn = _Features([], [])
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        entry = take_mapping(feature, where, MapFileError)
        properties = take_mapping(entry.get("properties") or {}, where, MapFileError)
        geometry = geometry_of_geojson(entry.get("geometry"), where)
        if geometry is None:
            continue
        shape = Drawn(geometry.positions[:, :2], f"feature {number}", called_by(properties), properties)
        (drawn.polygons if geometry.closed else drawn.lines).append(shape)
    return drawn


def _marking(drawn: Drawn, kind: str, outline_map: FloatArray, path: Path) -> Marking:
    """A polygon as a marking of four corners, counter-clockwise, with what is stated of its accuracy."""
    where = f"{path}: {drawn.name}"
    if len(outline_map) < 3 or abs(signed_area(outline_map)) < _LEAST_AREA_M2:
        raise MapFileError(f"{where}: encloses nothing; fix or drop it")
    corners_map, is_own = outline_of(outline_map)
    covariance_m2 = _covariance(drawn.properties, where)
    if covariance_m2 is not None and not is_own:
        raise MapFileError(f"{where}: has a covariance but not four corners; give four")
    if covariance_m2 is not None and signed_area(outline_map) < 0:
        covariance_m2 = covariance_m2.reshape(4, 2, 4, 2)[::-1, :, ::-1].reshape(8, 8)
    sigma_m = drawn.properties.get("sigma_m")
    if covariance_m2 is None and sigma_m is not None:
        sigma_m = take_number(sigma_m, f"{where}, sigma_m", MapFileError)
        if sigma_m <= 0:
            raise MapFileError(
                f"{where}, sigma_m: {sigma_m:g} m is not a standard deviation; give more than 0"
            )
        covariance_m2 = sigma_m**2 * np.eye(8)
    return Marking(kind, corners_map, 1, covariance_m2)


_LEAST_AREA_M2 = 1e-4  # least area of a marking, m^2: a centimetre squared


def _covariance(properties: Mapping[str, Any], where: str) -> FloatArray | None:
    stated = properties.get("covariance_m2")
    if stated is None:
        return None
    return take_covariance(stated, 8, f"{where}, covariance_m2", MapFileError)


def _verdict(stated: object, path: Path) -> str | None:
    """PASS, WARN or FAIL, alone or as ``status``; None where none is stated."""
    status = stated.get("status") if isinstance(stated, Mapping) else stated
    if status is None or status in VERDICTS:
        return status
    raise MapFileError(f"{path}: its verdict is not one of {', '.join(VERDICTS)}; fix or drop it")


def _check(hd_map: HDMap, true_map: HDMap, path: Path) -> None:
    """Refuse a map without markings, of another place, or with swapped axes."""
    kinds = dict.fromkeys(marking.kind for marking in true_map.markings)
    if not hd_map.markings:
        raise MapFileError(
            f"{path}: has no marking of four corners to score; give polygons with a class: {', '.join(kinds)}"
        )
    corners = np.array([marking.corners_map for marking in hd_map.markings])
    true = np.array([marking.corners_map for marking in true_map.markings]).reshape(-1, 2)
    check_place(corners.mean(axis=1), true, str(path), "the site's markings")
    swapped = [replace(m, corners_map=m.corners_map[:, ::-1]) for m in hd_map.markings]
    matched = len(match_markings(hd_map.markings, true_map.markings)[0])
    if len(match_markings(swapped, true_map.markings)[0]) > max(_SWAPPED * matched, _FEWEST):
        raise MapFileError(f"{path}: fits the site with x and y swapped; swap them back")


_FEWEST = 10  # matches that swapped axes need at least, so that chance does not make them; chosen
