"""The content that the page of ``v2hdm view`` draws: one JSON document in millimetres of the map frame."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.catalogue import AREAS, SHIPPED
from v2hdm.errors import MapFileError
from v2hdm.io.trajectory import read_tum
from v2hdm.records import BEST, Exclusion, FloatArray, HDMap, Marking, Symbol
from v2hdm.report.page.layers import map_extent, systems_of
from v2hdm.report.view.session import flat_mm, painted_lines, thinned
from v2hdm.site.accuracy import corner_radii_m, radius_95_m
from v2hdm.store import names
from v2hdm.store.files import load_json, take_array

_MM = 1000.0  # millimetres in a metre: places are whole numbers of them, which are short and fast to read


def scene_bytes(
    folder: Path,
    metrics: Mapping[str, Any],
    hd_map: HDMap,
    excluded: Sequence[Exclusion],
    background: str | None = None,
) -> bytes:
    """The document as JSON; raises MapFileError where a file of the result is damaged.

    ``background`` names where tiles come from, None without any.
    """
    scene = scene_of(folder, metrics, hd_map, excluded) | {"background": background}
    return json.dumps(scene, allow_nan=False, separators=(",", ":")).encode()


def scene_of(
    folder: Path, metrics: Mapping[str, Any], hd_map: HDMap, excluded: Sequence[Exclusion]
) -> dict[str, Any]:
    """Markings, symbols, lane lines, route, candidates that were left out, and what to look at first."""
    named: list[Marking | Symbol] = [*hd_map.markings, *hd_map.symbols]
    lines = painted_lines(hd_map)
    # In the report's order, which gives the colours.
    kinds = sorted({feature.kind for feature in named})
    kinds += sorted({line.kind for line in lines} - set(kinds))
    kinds += sorted({candidate.kind for candidate in excluded} - set(kinds))
    index = {kind: number for number, kind in enumerate(kinds)}
    route_map = _route(folder)
    verdict = metrics.get("verdict") or {}
    return {
        "name": str(metrics.get("name", folder.name)),
        "status": str(verdict.get("status", "FAIL")),
        "headline": str(verdict.get("headline") or "").partition(": ")[2],
        "kinds": kinds,
        "choices": sorted({*SHIPPED.names, *(feature.kind for feature in named)}),
        "cornered": sorted({*SHIPPED.cornered, *(marking.kind for marking in hd_map.markings)}),
        "line_kinds": list(SHIPPED.lane_paint),
        "markings": _markings(hd_map.markings, index),
        "symbols": [_symbol(symbol, index) for symbol in hd_map.symbols],
        "lanes": [
            {
                "id": line.id,
                "k": index[line.kind],
                "p": flat_mm(thinned(line.points_map)),
                "n": line.sightings,
            }
            for line in lines
        ],
        "excluded": [
            {
                "k": index[candidate.kind],
                "p": flat_mm(candidate.position_map[None]),
                "n": candidate.sightings,
                "why": candidate.reason,
            }
            for candidate in excluded
        ],
        "suspicious": _suspicious(metrics),
        "route": flat_mm(route_map),
        "systems": systems_of(hd_map, map_extent(hd_map, route_map)),
        "mosaic": _mosaic_bounds(folder),
    }


def _markings(markings: Sequence[Marking], index: Mapping[str, int]) -> list[dict[str, Any]]:
    corners_map = np.array([marking.corners_map for marking in markings]).reshape(-1, 8)
    places_mm = np.rint(_MM * corners_map).astype(np.int64).tolist()
    covered = [k for k, marking in enumerate(markings) if marking.covariance_m2 is not None]
    worst_m: dict[int, float] = {}
    if covered:
        # Of the worst corner, as the grade is; all at once, which takes a tenth of the time.
        stacked = np.array([markings[k].covariance_m2 for k in covered]).reshape(-1, 4, 2, 4, 2)
        corner = np.arange(4)
        blocks = stacked[:, corner, :, corner, :].transpose(1, 0, 2, 3)
        worst_m = dict(zip(covered, radius_95_m(blocks).max(axis=1).tolist(), strict=True))
    features = []
    for k, marking in enumerate(markings):
        feature = _paint(marking, index, places_mm[k], worst_m.get(k))
        if marking.relative_sigma_m is not None:
            feature["r"] = round(_MM * marking.relative_sigma_m, 2)
        features.append(feature)
    return features


def _symbol(symbol: Symbol, index: Mapping[str, int]) -> dict[str, Any]:
    covariance_m2 = symbol.covariance_m2
    worst_m = None if covariance_m2 is None else float(np.max(corner_radii_m(covariance_m2)))
    feature = _paint(symbol, index, flat_mm(symbol.outline_map), worst_m)
    if symbol.reading is not None:
        feature["says"] = symbol.reading[0]
    if symbol.kind in AREAS:
        feature["area"] = 1
    return feature


def _paint(
    paint: Marking | Symbol, index: Mapping[str, int], places_mm: list[int], worst_m: float | None
) -> dict[str, Any]:
    feature: dict[str, Any] = {"id": paint.id, "k": index[paint.kind], "p": places_mm, "n": paint.sightings}
    if worst_m is not None:
        feature["w"] = round(_MM * worst_m, 1)
    if paint.accuracy is not None:
        feature["g"] = paint.accuracy
    return feature


def _route(folder: Path) -> FloatArray:
    """The path driven (F, 2), m; empty without one."""
    path = folder / names.TRAJECTORY
    return read_tum(path).map_from_vehicle[:, :2, 3] if path.is_file() else np.zeros((0, 2))


def _suspicious(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The most suspicious markings, worst first, each with its worst criterion."""
    sets = list((metrics.get("results") or {}).values())
    suspects = (sets[-1].get(BEST) or {}).get("suspicious") or [] if sets else []
    return [
        {
            "id": suspect["marking"],
            "p": float(suspect["p"]),
            "by": min(("shape", "residuals", "sightings"), key=lambda name: suspect[f"p_{name}"]),
        }
        for suspect in suspects
    ]


def _mosaic_bounds(folder: Path) -> list[float] | None:
    """West, south, east and north of the mosaic, m; None without one."""
    path = folder / names.MOSAIC_EXTENT
    if not path.is_file():
        return None
    content = load_json(path, MapFileError)
    bounds: list[float] = take_array(
        content.get("bounds_m"), (4,), f"{path}: bounds_m", MapFileError
    ).tolist()
    return bounds
