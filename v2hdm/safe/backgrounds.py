"""Pictures of a site from outside that lie under its map: GeoTIFFs and folders of XYZ tiles.

Where the pixels of a picture lie is asked first; then pixels alone, without their file, are carried over.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import MapFileError, need
from v2hdm.records import FloatArray
from v2hdm.safe.child import next_step
from v2hdm.safe.rasters import ask, geotiff
from v2hdm.safe.tiles import check_tiles, read_tiles

_EARTH = "EPSG:4326"
_WEB_MERCATOR = "EPSG:3857"
_PIXELS = "pixels.npy"  # what a child leaves of a picture
_SAMPLES = 21  # places a side of a window whose places in the picture say which part of it is read
_MARGIN_PX = 2  # of a picture that are read about a window, for what lies between the samples
_FINER = 1.5  # pixels of a picture that are read for one of a window, a side: the two may lie askew


@dataclass(frozen=True)
class Window:
    """A rectangle of the ground, in the metres of a projection, and its pixels."""

    crs: str
    west_m: float
    north_m: float
    step_m: float  # side of a pixel
    width: int
    height: int


class _Picture(NamedTuple):
    """Pixels (4, H, W) uint8, BGR and mask, with their projection and the affine map to places in it."""

    pixels: np.ndarray
    crs: Any
    place_from_px: Any


def check_background(path: Path) -> None:
    """Raise MapFileError where the user's GeoTIFF or XYZ tiles cannot be used."""
    ask(_probe, path)


def background_pixels(path: Path, window: Window) -> np.ndarray:
    """The user's GeoTIFF or XYZ tiles in a window, (H, W, 4) uint8 BGR and mask; MapFileError if unusable."""
    with TemporaryDirectory() as folder:
        ask(_warp, path, window, Path(folder))
        return np.asarray(np.load(Path(folder) / _PIXELS, allow_pickle=False))


def _probe(path: Path) -> None:
    """Look at a GeoTIFF, or at every tile of a folder."""
    if path.is_dir():
        check_tiles(path)
        return
    with _picture(path):
        pass


@contextmanager
def _picture(path: Path) -> Iterator[Any]:
    """The user's GeoTIFF, open in rasterio; MapFileError where it cannot be used."""
    if not path.is_file():
        raise MapFileError(f"{path}: not a readable GeoTIFF or folder of XYZ tiles; check the path")
    # What says nothing about its place is refused, and not warned of.
    with warnings.catch_warnings(action="ignore"), geotiff(path) as source:
        _check_place(source, path)
        yield source


def _warp(path: Path, window: Window, folder: Path) -> None:
    """Write the pixels of a background in a window into a folder."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    warp = need("rasterio.warp", "gis", "a background", MapFileError)
    picture = _of_tiles(path, window) if path.is_dir() else _of_geotiff(path, window)
    pixels = np.zeros((4, window.height, window.width), np.uint8)
    if picture is not None:
        next_step()
        place_from_px = rasterio.Affine(window.step_m, 0, window.west_m, 0, -window.step_m, window.north_m)
        with _projecting(path):
            warp.reproject(
                picture.pixels, pixels, resampling=rasterio.enums.Resampling.bilinear,
                src_crs=picture.crs, src_transform=picture.place_from_px, src_alpha=4,
                dst_crs=window.crs, dst_transform=place_from_px, dst_alpha=4,
            )  # fmt: skip
    if not pixels[3].any():
        raise MapFileError(f"{path}: does not cover this map; give a picture of its site")
    np.save(folder / _PIXELS, np.ascontiguousarray(np.moveaxis(pixels, 0, 2)))


def _of_tiles(path: Path, window: Window) -> _Picture | None:
    """The pixels of a folder of tiles in a window; None where there are none."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    places_m = _places_in(window, _WEB_MERCATOR, path)
    if not len(places_m):
        return None
    low_m = places_m.min(axis=0)
    high_m = places_m.max(axis=0)
    step_m = float(((high_m - low_m) / [window.width, window.height]).min())
    tiles = read_tiles(path, low_m, high_m, step_m)
    if tiles is None:
        return None
    place_from_px = rasterio.Affine(tiles.step_m, 0, tiles.west_m, 0, -tiles.step_m, tiles.north_m)
    return _Picture(tiles.pixels, _WEB_MERCATOR, place_from_px)


def _of_geotiff(path: Path, window: Window) -> _Picture | None:
    """The pixels of a GeoTIFF in a window, no finer than needed; None where there are none."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    with _picture(path) as source:
        places = _places_in(window, source.crs, path)
        px = np.array([~source.transform * place for place in places.tolist()]).reshape(-1, 2)
        size_px = np.array([source.width, source.height])
        if not len(px):
            return None
        first = np.clip(np.floor(px.min(axis=0)) - _MARGIN_PX, 0, size_px).astype(int)
        last = np.clip(np.ceil(px.max(axis=0)) + _MARGIN_PX, 0, size_px).astype(int)
        own_px = last - first
        if own_px.min() < 1:
            return None
        most_px = (_FINER * np.array([window.width, window.height])).astype(int)
        read_px = np.maximum(np.minimum(own_px, most_px), 1)
        part = rasterio.windows.Window(*first.tolist(), *own_px.tolist())
        pixels = _read(source, part, (int(read_px[1]), int(read_px[0])))
        place_from_px = source.transform * rasterio.Affine.translation(*first.tolist())
        place_from_px *= rasterio.Affine.scale(*(own_px / read_px).tolist())
        return _Picture(pixels, source.crs, place_from_px)


def _read(source: Any, part: Any, shape: tuple[int, int]) -> np.ndarray:
    """A part of an open GeoTIFF as pixels (4, H, W) uint8 of that shape: BGR and mask."""
    rasterio = need("rasterio", "gis", "a background", MapFileError)
    has_palette = source.colorinterp[0] == rasterio.enums.ColorInterp.palette
    resampling = rasterio.enums.Resampling.nearest if has_palette else rasterio.enums.Resampling.average
    indexes = [3, 2, 1] if source.count >= 3 else [1]
    bands = source.read(indexes, window=part, out_shape=(len(indexes), *shape), resampling=resampling)
    mask = source.dataset_mask(window=part, out_shape=shape)
    if has_palette:
        table = np.zeros((3, np.iinfo(bands.dtype).max + 1), np.uint8)
        for value, (red, green, blue, _) in source.colormap(1).items():
            table[:, value] = blue, green, red
        bands = table[:, bands[0]]
    colours = np.broadcast_to(_as_bytes(bands, mask), (3, *shape))
    return np.concatenate([colours, mask[None]])


def _as_bytes(bands: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Bands as 8 bits; other types are stretched from dark to bright."""
    if bands.dtype == np.uint8:
        return bands
    values = bands[:, mask > 0]
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, (1, 99)).tolist() if len(values) else (0.0, 1.0)
    scaled = (bands - low) * (255.0 / max(high - low, 1e-9))
    return np.clip(np.nan_to_num(scaled, nan=0.0), 0, 255).astype(np.uint8)


def _check_place(source: Any, path: Path) -> None:
    """Raise MapFileError for a GeoTIFF that lies nowhere on the earth, or is no picture."""
    if source.crs is None:
        raise MapFileError(f"{path}: states no coordinate system; give a GeoTIFF that has one")
    if source.transform.is_identity or source.transform.is_degenerate:
        raise MapFileError(f"{path}: does not state where its pixels lie; give a GeoTIFF that does")
    if np.dtype(source.dtypes[0]).kind not in "uif":
        raise MapFileError(f"{path}: has pixels of type {source.dtypes[0]}; give a picture of real numbers")
    _carried(source.crs, _EARTH, np.array([source.transform * (0, 0)]), path)


def _places_in(window: Window, crs: Any, path: Path) -> FloatArray:
    """Places (N, 2) of another projection all over a window, those that it has."""
    share = np.linspace(0.0, 1.0, _SAMPLES)
    across, down = (values.ravel() for values in np.meshgrid(share, share))
    x_m = window.west_m + across * window.step_m * window.width
    y_m = window.north_m - down * window.step_m * window.height
    places = _carried(window.crs, crs, np.column_stack([x_m, y_m]), path)
    return places[np.isfinite(places).all(axis=1)]


def _carried(source_crs: Any, crs: Any, places: FloatArray, path: Path) -> FloatArray:
    """Places (N, 2) of a projection in another one; MapFileError where no way leads there."""
    warp = need("rasterio.warp", "gis", "a background", MapFileError)
    with _projecting(path):
        x, y = warp.transform(source_crs, crs, *places.T)
    return np.column_stack([x, y])


@contextmanager
def _projecting(path: Path) -> Iterator[None]:
    """Errors of projections within as one line: GDAL's own are not all made rasterio's."""
    try:
        yield
    except Exception as failure:
        if not type(failure).__module__.startswith("rasterio"):
            raise
        raise MapFileError(
            f"{path}: its coordinate system has no place on the earth; give one that has"
        ) from None
