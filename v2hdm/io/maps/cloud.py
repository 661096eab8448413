"""Writing the mosaic of a drive's ground as a point cloud, PCD of x, y, z and intensity, for Autoware."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from v2hdm.errors import ConfigError, MapFileError
from v2hdm.extras import need
from v2hdm.records import FloatArray
from v2hdm.store.files import whole_file

_SPACING_M = 0.05  # of the points: of an edge of paint, localisation needs no finer ones
_STRIP_PX = 512
_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {0}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {0}
DATA binary
"""


def write_cloud(mosaic: Path, path: Path, height_m: Callable[[FloatArray], FloatArray]) -> None:
    """Write the ground that a ``mosaic`` shows as points in the map frame, atomically.

    ``height_m`` gives the heights (N,) of places (N, 2). The intensity is the grey value, 0 to 255. Raises
    MapFileError where the file is no mosaic of ours, ConfigError where rasterio is missing.
    """
    rasterio = need("rasterio", "gis", "the format pcd", ConfigError)
    strips = []
    try:
        with rasterio.open(mosaic, driver="GTiff") as data:
            if data.count != 3 or data.dtypes[0] != "uint8" or data.transform.b or data.transform.e >= 0:
                raise MapFileError(f"{mosaic}: not a mosaic that v2hdm wrote; give mosaic.tif of a result")
            factor = max(round(_SPACING_M / data.transform.a), 1)
            for top in range(0, data.height, _STRIP_PX * factor):
                rows = min(_STRIP_PX * factor, data.height - top)
                window = rasterio.windows.Window(0, top, data.width, rows)
                shape = (-(-rows // factor), -(-data.width // factor))
                average = rasterio.enums.Resampling.average
                seen = data.dataset_mask(window=window, out_shape=shape) > 0
                if seen.any():
                    pixels = data.read(window=window, out_shape=(3, *shape), resampling=average)
                    row, column = np.nonzero(seen)
                    step = np.array([data.width / shape[1], rows / shape[0]])
                    at = (np.column_stack([column, row]) + 0.5) * step + [0, top]
                    places = at * [data.transform.a, data.transform.e] + [data.transform.c, data.transform.f]
                    grey = pixels.mean(axis=0)[seen]
                    strips.append(np.column_stack([places, height_m(places), grey]).astype("<f4"))
    except rasterio.errors.RasterioError as failure:
        first = str(failure).splitlines()[0]
        raise MapFileError(f"{mosaic}: cannot be read as a GeoTIFF ({first}); restore it") from None
    points = np.concatenate([np.empty((0, 4), "<f4"), *strips])
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.format(len(points)).encode("ascii"))
        file.write(points.tobytes())
