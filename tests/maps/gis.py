"""Edits of a file as QGIS makes them: in place, through the same OGR library, and maps to try formats on."""

import ctypes
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import rasterio

from v2hdm.records import ACCURACIES, GeodeticOrigin, HDMap, Lane, Marking, Symbol

ORIGIN = GeodeticOrigin(latitude_deg=29.95, longitude_deg=122.05, altitude_m=12.0)

_VECTOR, _UPDATE = 4, 1
_POINTER, _REAL = ctypes.c_void_p, ctypes.c_double
_SIGNATURES = {
    "GDALOpenEx": (_POINTER, [ctypes.c_char_p, ctypes.c_uint, _POINTER, _POINTER, _POINTER]),
    "GDALDatasetGetLayerByName": (_POINTER, [_POINTER, ctypes.c_char_p]),
    "GDALDatasetGetLayer": (_POINTER, [_POINTER, ctypes.c_int]),
    "OGR_L_GetNextFeature": (_POINTER, [_POINTER]),
    "OGR_F_GetGeometryRef": (_POINTER, [_POINTER]),
    "OGR_F_GetFieldIndex": (ctypes.c_int, [_POINTER, ctypes.c_char_p]),
    "OGR_F_GetFieldAsInteger": (ctypes.c_int, [_POINTER, ctypes.c_int]),
    "OGR_G_GetGeometryRef": (_POINTER, [_POINTER, ctypes.c_int]),
    "OGR_G_GetGeometryCount": (ctypes.c_int, [_POINTER]),
    "OGR_G_GetPointCount": (ctypes.c_int, [_POINTER]),
    "OGR_G_GetX": (_REAL, [_POINTER, ctypes.c_int]),
    "OGR_G_GetY": (_REAL, [_POINTER, ctypes.c_int]),
    "OGR_G_GetZ": (_REAL, [_POINTER, ctypes.c_int]),
    "OGR_G_SetPoint": (None, [_POINTER, ctypes.c_int, _REAL, _REAL, _REAL]),
    "OGR_L_SetFeature": (ctypes.c_int, [_POINTER, _POINTER]),
    "GDALClose": (ctypes.c_int, [_POINTER]),
}


def move_feature(path: Path, identity: int, east: float, north: float, layer: str | None = None) -> None:
    """Move every point of the feature with a property ``id`` by steps in the file's own units, and save."""
    ogr = _ogr()
    with warnings.catch_warnings(action="error"):
        data = ogr.GDALOpenEx(str(path).encode(), _VECTOR | _UPDATE, None, None, None)
    assert data
    table = (
        ogr.GDALDatasetGetLayer(data, 0)
        if layer is None
        else ogr.GDALDatasetGetLayerByName(data, layer.encode())
    )
    moved = 0
    while feature := ogr.OGR_L_GetNextFeature(table):
        column = ogr.OGR_F_GetFieldIndex(feature, b"id")
        if ogr.OGR_F_GetFieldAsInteger(feature, column) != identity:
            continue
        points = ogr.OGR_F_GetGeometryRef(feature)
        if ogr.OGR_G_GetGeometryCount(points):
            points = ogr.OGR_G_GetGeometryRef(points, 0)
        for k in range(ogr.OGR_G_GetPointCount(points)):
            x, y, z = (get(points, k) for get in (ogr.OGR_G_GetX, ogr.OGR_G_GetY, ogr.OGR_G_GetZ))
            ogr.OGR_G_SetPoint(points, k, x + east, y + north, z)
        assert ogr.OGR_L_SetFeature(table, feature) == 0
        moved += 1
    assert ogr.GDALClose(data) == 0
    assert moved == 1


def _ogr() -> ctypes.CDLL:
    folder = Path(pyogrio.__file__).parents[1] / "pyogrio.libs"
    (library,) = folder.glob("libgdal*")
    ogr = ctypes.CDLL(str(library))
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(ogr, name)
        function.restype, function.argtypes = result, arguments
    return ogr


def street(origin: GeodeticOrigin | None = ORIGIN, with_heights: bool = True) -> HDMap:
    """A street bending left: three lane lines 3.5 m apart, a stop line across the right lane, and more.

    Corners of one diamond run clockwise; everything is known with correlated covariances, and accuracies are
    A, B and C in turn.
    """
    rng = np.random.default_rng(7)
    angle = np.linspace(0.0, 0.6, 121)
    lanes = []
    for kind, radius in (("lane_line", 53.5), ("lane_dash", 57.0), ("lane_line", 60.5)):
        points = np.column_stack([radius * np.sin(angle), 57.0 - radius * np.cos(angle)])
        heights = 1.0 + 0.03 * points[:, 0] if with_heights else None
        lanes.append(Lane(kind, points, int(rng.integers(3, 9)), heights))
    diamond = np.array([[1.0, 0.0], [0.0, 0.4], [-1.0, 0.0], [0.0, -0.4]]) / 2
    stripe = np.array([[0.2, -1.5], [0.2, 1.5], [-0.2, 1.5], [-0.2, -1.5]])
    dash = np.array([[1.0, -0.06], [1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06]])
    markings = []
    for kind, shape, place in (
        ("diamond", diamond, (3.0, 1.75)),
        ("diamond", diamond[::-1], (7.0, -1.6)),
        ("stop_line", stripe, (12.0, -0.3)),
        ("lane_dash", dash, (5.0, 0.2)),
        ("crosswalk_bar", dash * [1, 5], (15.0, 3.0)),
    ):
        corners = shape + place + rng.normal(scale=1e-3, size=(4, 2))
        half = rng.normal(scale=0.004, size=(8, 8))
        heights = 1.0 + 0.03 * corners[:, 0] if with_heights else None
        marking = Marking(
            kind, corners, int(rng.integers(3, 20)), half @ half.T, 0.002 + rng.random() / 1e3, heights
        )
        markings.append(replace(marking, accuracy=ACCURACIES[len(markings) % len(ACCURACIES)]))
    return HDMap(tuple(markings), tuple(lanes), origin)


def assert_same_map(got: HDMap, expected: HDMap) -> None:
    """Every value to the last bit, but ids, which a file gives."""
    assert got.origin == expected.origin
    for feature, other in zip(_features(got), _features(expected), strict=True):
        for name, value in vars(replace(other, id=feature.id)).items():
            np.testing.assert_array_equal(getattr(feature, name), value, err_msg=name)


def _features(hd_map: HDMap) -> list[Marking | Lane | Symbol]:
    return [*hd_map.markings, *hd_map.lanes, *hd_map.symbols]


def write_empty(path, **more):
    """A GeoTIFF of nothing but a header, in blocks of a megapixel."""
    place = rasterio.Affine(0.02, 0, 0, 0, -0.02, 0)
    look = {"width": 30_000, "height": 30_000, "count": 3, "dtype": "uint8", "transform": place, **more}
    look |= {"tiled": True, "blockxsize": 1024, "blockysize": 1024, "sparse_ok": True}
    with rasterio.open(path, "w", driver="GTiff", **look):
        pass
    assert path.stat().st_size < 100_000
