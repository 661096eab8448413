"""The ground as files: GeoTIFF for a GIS, OpenCRG for a simulator, and its mosaic as a point cloud (PCD)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import crs_of
from v2hdm.geometry.planar import cross
from v2hdm.records import FloatArray, GroundStrip, HDMap
from v2hdm.safe.rasters import mosaic_points
from v2hdm.store.files import whole_file

_CELL_M = 0.25  # size of a cell of the GeoTIFF, m
_MOST_CELLS = 4e6  # most cells of the rectangle about a map; beyond, cells are larger
_NOTHING = -9999.0  # value of cells without ground


def write_ground_geotiff(hd_map: HDMap, path: Path) -> None:
    """Write the ground as GeoTIFF, heights above the origin and sigmas, m; the surer of two strips counts."""
    rasterio = need("rasterio", "gis", "the format geotiff", ConfigError)
    edges = np.concatenate(
        [strip.points(m) for strip in hd_map.ground for m in strip.left_m[[0, -1]].tolist()]
    )
    low = edges.min(axis=0)
    high = edges.max(axis=0)
    cell_m = max(_CELL_M, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    columns, rows = (int(n) for n in np.ceil((high - low) / cell_m))
    x = low[0] + cell_m * (np.arange(columns) + 0.5)
    y = high[1] - cell_m * (np.arange(rows) + 0.5)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    surest = np.full((2, len(cells)), np.inf)
    for strip in hd_map.ground:
        of_strip = _sampled(strip, cells)
        surer = of_strip[1] < surest[1]
        surest[:, surer] = of_strip[:, surer]
    bands = np.where(np.isfinite(surest), surest, _NOTHING).reshape(2, rows, columns).astype(np.float32)
    profile = {
        "driver": "GTiff", "width": columns, "height": rows, "count": 2, "dtype": "float32",
        "nodata": _NOTHING, "crs": rasterio.crs.CRS.from_user_input(crs_of(hd_map.origin)),
        "transform": rasterio.Affine(cell_m, 0, low[0], 0, -cell_m, high[1]), "compress": "deflate",
    }  # fmt: skip
    with rasterio.MemoryFile(ext=".tif") as memory:
        with memory.open(**profile) as dataset:
            dataset.write(bands)
            dataset.descriptions = ("height above the map's origin, m", "standard deviation, m")
        with whole_file(path) as partial:
            partial.write_bytes(memory.getbuffer())


def _sampled(strip: GroundStrip, cells: FloatArray) -> FloatArray:
    """Heights and sigmas (2, K) of a strip at points (K, 2), infinite beyond it."""
    from scipy.ndimage import map_coordinates  # of the map extra, whose runs alone have such a strip
    from scipy.spatial import cKDTree

    sampled = np.full((2, len(cells)), np.inf)
    right_m, left_m = strip.left_m[[0, -1]].tolist()
    reach_m = max(-right_m, left_m)
    distance_m, place = cKDTree(strip.points_map).query(
        cells, distance_upper_bound=np.hypot(reach_m, strip.step_m)
    )
    in_reach = np.flatnonzero(np.isfinite(distance_m))
    off = cells[in_reach] - strip.points_map[place[in_reach]]
    ahead = strip.ahead[place[in_reach]]
    along = place[in_reach] + np.einsum("ki,ki->k", off, ahead) / strip.step_m
    side = cross(ahead, off)
    inside = (side >= right_m) & (side <= left_m) & (along >= 0) & (along <= len(strip.points_map) - 1)
    coordinates = np.stack([along, (side - right_m) / (strip.left_m[1] - right_m)])[:, inside]
    for band, values in zip(sampled, (strip.heights_m, strip.sigma_m), strict=True):
        band[in_reach[inside]] = map_coordinates(values, coordinates, order=1)
    return sampled


def write_opencrg(hd_map: HDMap, path: Path) -> None:
    """Write the ground as OpenCRG, by session: heights (m) on a grid along the path; sigmas have no place."""
    crg = need("pyopencrg", "gis", "the format opencrg", ConfigError)
    for number, strip in enumerate(hd_map.ground, start=1):
        base_m = float(strip.heights_m.mean())
        x, y = np.diff(strip.points_map, axis=0).T
        road = crg.CrgRoad(
            strip.heights_m - base_m,
            u_inc=strip.step_m,
            v=strip.left_m,
            heading=np.arctan2(y, x),  # along which a reader goes on by u_inc
            x_start=strip.points_map[0, 0],
            y_start=strip.points_map[0, 1],
            z_start=base_m,
        )
        road.comments = ["ground by v2hdm; x, y and z are metres of the map's frame"]
        session_path = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        with whole_file(session_path) as partial:
            road.save(partial, fmt="KDBI")


_SPACING_M = 0.05  # spacing of a cloud's points, m: of an edge of paint, localisation needs no finer ones
_MOST_POINTS = 20_000_000  # points of a cloud, which have 320 MB: chosen, as of 5 hectares in full
_PIECE_PX = 1_000_000  # averaged pixels of the mosaic that are read at a time
_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {0:<10d}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {0:<10d}
DATA binary
"""


def write_cloud(mosaic: Path, path: Path, height_m: Callable[[FloatArray], FloatArray]) -> None:
    """Write the ground that a ``mosaic`` shows as points in the map frame, atomically.

    They are 5 cm apart, or so much farther that they are at most 20 million.

    ``height_m`` gives the heights (N,) of places (N, 2). The intensity is the grey value, 0 to 255. Raises
    MapFileError where the file is no mosaic of ours, ConfigError where rasterio is missing.
    """
    count = 0
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.format(count).encode("ascii"))
        for points in mosaic_points(mosaic, _SPACING_M, _MOST_POINTS, _PIECE_PX):
            places = points[:, :2]
            cloud = np.column_stack([places, height_m(places), points[:, 2]]).astype("<f4")
            file.write(cloud.tobytes())
            count += len(cloud)
        file.seek(0)
        file.write(_HEADER.format(count).encode("ascii"))
