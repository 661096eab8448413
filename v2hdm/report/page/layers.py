"""The map in the page: one JSON document in local metres, and the ground mosaic below it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.catalogue import AREAS
from v2hdm.errors import MapFileError
from v2hdm.geometry.datums import utm_of
from v2hdm.geometry.geodetic import Grid, crs_of, geodetic_from_enu
from v2hdm.records import SIGMAS_95, Exclusion, FloatArray, HDMap, Lane, Marking, Symbol
from v2hdm.report.metrics import corner_errors, match_markings, rms
from v2hdm.report.page.facts import Facts, GroundResiduals
from v2hdm.report.page.reference import Reference, local_reference
from v2hdm.safe.backgrounds import Window, background_pixels
from v2hdm.safe.pixels import read_pixels
from v2hdm.site.accuracy import absolute_radii_m, corner_radii_m
from v2hdm.store import names
from v2hdm.store.files import load_json, take_array, take_mapping, take_text


def jpeg(pixels: np.ndarray, quality: int) -> str:
    """An image (H, W, 3) BGR as JPEG in base64."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return _coded(".jpg", pixels, options)


def shrunk(pixels: np.ndarray, factor: float) -> np.ndarray:
    """An image scaled by ``factor``, at least one pixel large."""
    size = (max(1, round(pixels.shape[1] * factor)), max(1, round(pixels.shape[0] * factor)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def jpeg_of(path: Path, widest_px: int, quality: int) -> str | None:
    """A picture file as JPEG in base64, at most ``widest_px`` wide; None if there is none."""
    pixels = read_pixels(path, cv2.IMREAD_COLOR) if path.is_file() else None
    return None if pixels is None else jpeg(shrunk(pixels, min(1.0, widest_px / pixels.shape[1])), quality)


def _coded(kind: str, pixels: np.ndarray, options: Sequence[int]) -> str:
    return base64.b64encode(cv2.imencode(kind, pixels, options)[1].tobytes()).decode("ascii")


LARGEST_BYTES = 3_500_000  # limit of the mosaic, as text in the page
_QUALITY = 72  # quality of the mosaic's WebP, of 100


def mosaic_layer(folder: Path) -> dict[str, Any] | None:
    """The mosaic, if any: WebP in base64, bounds (west, south, east, north), m; MapFileError if damaged."""
    if not (folder / names.MOSAIC_EXTENT).is_file():
        return None
    content = load_json(folder / names.MOSAIC_EXTENT, MapFileError)
    where = f"{folder / names.MOSAIC_EXTENT}"
    bounds = take_array(content.get("bounds_m"), (4,), f"{where}: bounds_m", MapFileError)
    path = folder / Path(take_text(content.get("image"), f"{where}: image", MapFileError)).name
    coded = path.read_bytes() if path.is_file() else b""
    text = base64.b64encode(coded).decode("ascii") if path.suffix == ".webp" else ""
    if not 0 < len(text) <= LARGEST_BYTES:
        if not coded:
            raise MapFileError(f"{path}: not a readable picture; make the mosaic again")
        text = _webp(read_pixels(path, cv2.IMREAD_UNCHANGED))
    return {"src": text, "type": "image/webp", "bounds": bounds.tolist()}


def _webp(pixels: np.ndarray) -> str:
    """An image as WebP in base64, scaled down to the limit."""
    while len(text := _coded(".webp", pixels, (cv2.IMWRITE_WEBP_QUALITY, _QUALITY))) > LARGEST_BYTES:
        pixels = shrunk(pixels, 0.9 * float(np.sqrt(LARGEST_BYTES / len(text))))
    return text


def earlier_layer(content: object) -> dict[str, Any] | None:
    """A layer as an earlier report has it; None where it has none, or none that is whole."""
    try:
        layer = take_mapping(content, "background", MapFileError)
        bounds = take_array(layer.get("bounds"), (4,), "bounds", MapFileError).tolist()
        source = take_text(layer.get("src"), "src", MapFileError)
        base64.b64decode(source, validate=True)
    except (MapFileError, ValueError):
        return None
    return {"src": source, "type": "image/webp", "bounds": bounds}


_BACKGROUND_PX = 3000  # longer side of the background: 20 cm per pixel over 600 m
_FINEST_M = 0.05  # least side of a pixel of the background


def background_layer(path: Path, facts: Facts) -> dict[str, Any]:
    """The user's GeoTIFF or XYZ tiles as a layer like :func:`mosaic_layer`; MapFileError if unusable."""
    origin = None if facts.hd_map is None else facts.hd_map.origin
    if origin is None:
        raise MapFileError(f"{path}: this map has no position on the earth; state the origin in drive.yaml")
    (west, south), (east, north) = _extent(facts)
    step_m = max(float(max(east - west, north - south)) / _BACKGROUND_PX, _FINEST_M)
    width = int(np.ceil((east - west) / step_m))
    height = int(np.ceil((north - south) / step_m))
    # The mosaic's projection agrees with the map frame to a millimetre.
    window = Window(crs_of(origin), float(west), float(north), step_m, width, height)
    bounds = [west, north - step_m * height, west + step_m * width, north]
    pixels = background_pixels(path, window)
    return {"src": _webp(pixels), "type": "image/webp", "bounds": [float(edge) for edge in bounds]}


def _extent(facts: Facts) -> tuple[FloatArray, FloatArray]:
    assert facts.hd_map is not None
    route = facts.route
    route_map = np.zeros((0, 2)) if route is None else route.map_from_vehicle[:, :2, 3]
    return map_extent(facts.hd_map, route_map)


def map_extent(hd_map: HDMap, route_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """South-west and north-east (2,), m, of a map and the path driven (F, 2), with a margin of 50 m."""
    shapes = [marking.corners_map for marking in hd_map.markings]
    shapes += [lane.points_map for lane in hd_map.lanes]
    points = np.concatenate([*shapes, route_map])
    if not len(points):
        points = np.zeros((1, 2))
    return points.min(axis=0) - 50.0, points.max(axis=0) + 50.0


def comparison(folder: Path) -> str | None:
    """The ground before and after the optimisation, JPEG in base64; None if not in the folder."""
    return jpeg_of(folder / names.COMPARISON, 1400, 84)


_LEAST_ARROW_SIGHTINGS = 4  # least number of sightings of a marking whose mean residual is drawn
_SHARED = (".geojson", ".gpkg", ".osm", ".dxf", ".csv", ".xodr", ".tif", ".tum", ".yaml", ".json", ".log")
"""Suffixes of the result files that the page links."""


def ellipses(markings: Sequence[Marking]) -> FloatArray:
    """95 % ellipses (M, 4, 3) of corners: semi-axes a >= b, m, and direction of a, rad; nan if not stated."""
    unknown = np.full((4, 2, 2), np.nan)
    blocks = [marking.corner_covariances_m2 for marking in markings]
    covariances = np.array([unknown if block is None else block for block in blocks]).reshape(-1, 4, 2, 2)
    is_known = np.isfinite(covariances).all(axis=(1, 2, 3))
    variance, axes = np.linalg.eigh(covariances[is_known])
    out = np.full((len(covariances), 4, 3), np.nan)
    out[is_known, :, :2] = SIGMAS_95 * np.sqrt(np.maximum(variance[..., ::-1], 0.0))
    out[is_known, :, 2] = np.arctan2(axes[..., 1, 1], axes[..., 0, 1])
    return out


def _radii(symbol: Symbol) -> list[float] | None:
    """The 95 % radii, m, of a symbol's vertices; the largest gives the grade."""
    covariance_m2 = symbol.covariance_m2
    return None if covariance_m2 is None else np.round(corner_radii_m(covariance_m2), 5).tolist()


def layers(
    facts: Facts, residuals: GroundResiduals | None, reference: Reference | None = None
) -> dict[str, Any]:
    """The map document: markings, lanes, symbols, truth, route, excluded candidates, mosaic.

    The table's coordinates are in the system ``reference``, else in local metres.
    """
    hd_map = facts.hd_map
    if hd_map is None:
        return {}
    named: list[Marking | Symbol] = [*hd_map.markings, *hd_map.symbols]
    lines = [line for lane in hd_map.lanes for line in lane.painted]  # a double one is drawn as both
    kinds = sorted({feature.kind for feature in named})  # colours go by the place here, lines have their own
    kinds += sorted({line.kind for line in lines} - set(kinds))
    arrows = _arrows(residuals)
    errors = _errors(facts)
    markings = _markings(hd_map.markings, kinds)
    for number, feature in enumerate(markings):
        if number in errors:
            feature["t"] = round(errors[number], 5)
        if feature["id"] in arrows:
            feature["a"] = arrows[feature["id"]]
    symbols = [_symbol(symbol, kinds) for symbol in hd_map.symbols]
    reference = reference or local_reference(facts)
    shapes = [*(m.corners_map for m in hd_map.markings), *(s.outline_map for s in hd_map.symbols)]
    centres = np.array([shape.mean(axis=0) for shape in shapes]).reshape(-1, 2)
    for feature, at in zip([*markings, *symbols], reference.words(centres), strict=True):
        feature["at"] = at
    route = facts.route
    return {
        "kinds": kinds,
        "cameras": list(residuals.cameras) if residuals else [],
        "markings": markings,
        "lanes": [_feature(line, kinds, "p", line.points_map) for line in lines],
        "lane_lines": len(hd_map.lanes),
        "symbols": symbols,
        "axes": reference.axes,
        "digits": reference.digits,
        "excluded": [_excluded(candidate) for candidate in facts.excluded],
        "checks": _checks(facts),
        "changes": _changes(facts),
        "truth": facts.truth
        and {
            "markings": [rounded(marking.corners_map) for marking in facts.truth.map.markings],
            "lanes": [rounded(lane.points_map) for lane in facts.truth.map.lanes],
        },
        "route": {
            "adjusted": [] if route is None else rounded(route.map_from_vehicle[:, :2, 3]),
            "recorded": [] if route is None or route.recorded is None else rounded(route.recorded[:, :2, 3]),
        },
        "mosaic": mosaic_layer(facts.folder),
        "systems": systems_of(hd_map, _extent(facts)),
        "files": sorted(path.name for path in facts.folder.iterdir() if path.suffix in _SHARED),
    }


def _excluded(candidate: Exclusion) -> dict[str, Any]:
    return {
        "k": candidate.kind,
        "p": rounded(candidate.position_map[None])[0],
        "n": candidate.sightings,
        "why": candidate.reason,
    }


def _markings(markings: Sequence[Marking], kinds: list[str]) -> list[dict[str, Any]]:
    """The features of markings; arrays of all at once, for a site may have tens of thousands."""
    corners = np.round([marking.corners_map for marking in markings], 3).tolist()
    axes = np.round(ellipses(markings), 5).tolist()
    radii = np.round(absolute_radii_m(markings), 5).tolist()
    features = []
    for row, marking in enumerate(markings):
        feature = {
            "id": marking.id,
            "k": kinds.index(marking.kind),
            "c": corners[row],
            "n": marking.sightings,
        }
        if marking.covariance_m2 is not None:
            feature["e"] = axes[row]
            feature["w"] = radii[row]
        if marking.relative_sigma_m is not None:
            feature["r"] = round(SIGMAS_95 * marking.relative_sigma_m, 5)
        if marking.accuracy is not None:
            feature["g"] = marking.accuracy
        if marking.variety is not None:
            feature["kind"] = marking.variety
        features.append(feature)
    return features


def _symbol(symbol: Symbol, kinds: list[str]) -> dict[str, Any]:
    feature = _feature(symbol, kinds, "p", symbol.outline_map)
    feature["w"] = _radii(symbol)
    if symbol.accuracy is not None:
        feature["g"] = symbol.accuracy
    if symbol.reading is not None:
        feature["says"] = list(symbol.reading)
    if symbol.parts:
        feature["parts"] = list(symbol.parts)
    if symbol.kind in AREAS:
        feature["area"] = 1
    return feature


def systems_of(hd_map: HDMap, extent: tuple[FloatArray, FloatArray]) -> list[dict[str, Any]]:
    """Coordinate systems besides local metres, to a millimetre: cubics in x and y; none without origin."""
    if hd_map.origin is None:
        return []
    south_west, north_east = extent
    east_m, north_m = np.linspace(south_west, north_east, 7).T
    x, y = (grid.ravel() for grid in np.meshgrid(east_m, north_m))
    places_map = np.column_stack([x, y, np.zeros_like(x)])
    systems = [("", geodetic_from_enu(hd_map.origin, places_map)[:, :2], 7)]
    if (code := utm_of(hd_map.origin)) is not None:
        systems.append((code, Grid(code, hd_map.origin).positions(places_map)[:, :2], 2))
    scale = float(np.abs([x, y]).max())
    terms = np.column_stack([(x / scale) ** a * (y / scale) ** b for a in range(4) for b in range(4 - a)])
    return [
        {
            "name": name,
            "digits": digits,
            "scale": scale,
            "of": np.linalg.lstsq(terms, to, rcond=None)[0].T.tolist(),
        }
        for name, to, digits in systems
    ]


def _feature(feature: Symbol | Lane, kinds: list[str], key: str, points_map: FloatArray) -> dict[str, Any]:
    return {
        "id": feature.id,
        "k": kinds.index(feature.kind),
        key: rounded(points_map),
        "n": feature.sightings,
    }


def rounded(points: FloatArray, digits: int = 3) -> list[list[float]]:
    """Points (N, 2) as lists, by default rounded to a millimetre."""
    out: list[list[float]] = np.round(points, digits).tolist()
    return out


def _errors(facts: Facts) -> dict[int, float]:
    """RMS corner error, m, of each marking with a true counterpart, by id."""
    if facts.truth is None or facts.hd_map is None:
        return {}
    mapped = facts.hd_map.markings
    true = facts.truth.map.markings
    rows, columns = match_markings(mapped, true)
    return {
        row: rms(corner_errors([mapped[row]], [true[column]]))
        for row, column in zip(rows, columns, strict=True)
    }


def _checks(facts: Facts) -> list[dict[str, Any]]:
    """Surveyed check points: position, and map minus survey."""
    checks = []
    for point in facts.check_points:
        place = [_number(point.get(key)) for key in ("x_map_m", "y_map_m")]
        off = [_number(point.get(key)) for key in ("dx_m", "dy_m")]
        if None not in place:
            inside = point.get("inside_95_percent", "")
            checks.append({"id": point.get("id", ""), "p": place, "off": off, "inside": inside})
    return checks


def _changes(facts: Facts) -> list[dict[str, Any]]:
    """Changes from the base map, as listed in ``metrics.json``."""
    return [
        {name: change[name] for name in ("id", "fate", "shift_m", "shift_sigma_m", "probability", "views")}
        | {"k": change["class"], "n": change["found"], "p": change["after_map"] or change["before_map"]}
        | {"before": change["before_map"] or []}
        for change in (facts.metrics.get("changes") or {}).get("listed") or []
    ]


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _arrows(residuals: GroundResiduals | None) -> dict[int, list[list[float]]]:
    """Arrows by marking, one per camera: its index, mean of projected minus observed ground, m, and count.

    Ground sampling distance grows with the squared range, so observations weigh by its inverse square.
    """
    if residuals is None:
        return {}
    good = residuals.is_point & np.isfinite(residuals.ground_m).all(axis=1) & (residuals.marking > 0)
    weight = 1.0 / np.maximum(residuals.range_m[good], 1.0) ** 4
    cameras = len(residuals.cameras)
    cell = residuals.marking[good] * cameras + residuals.camera[good]
    total = np.bincount(cell, weight)
    count = np.bincount(cell)
    sums = np.stack([np.bincount(cell, weight * residuals.ground_m[good, a]) for a in (0, 1)], axis=1)
    out: dict[int, list[list[float]]] = {}
    for index in np.flatnonzero(count >= _LEAST_ARROW_SIGHTINGS).tolist():
        marking, camera = divmod(index, cameras)
        mean = np.round(sums[index] / total[index], 5).tolist()
        out.setdefault(marking, []).append([camera, *mean, int(count[index])])
    return out
