"""A map as a data frame of ``geopandas``, for :meth:`v2hdm.records.HDMap.to_geodataframe`."""

from __future__ import annotations

from typing import Any

import numpy as np


def geodataframe(hd_map: Any) -> Any:
    """The features of an ``HDMap``, one row each; raises ModuleNotFoundError without geopandas."""
    try:
        import geopandas
        import pyproj
        import shapely
    except ModuleNotFoundError as missing:
        what = "to_geodataframe needs geopandas: install the gis extra, pip install 'v2hdm[gis]'"
        raise ModuleNotFoundError(what, name=missing.name) from None
    layers = (
        ("marking", hd_map.markings, "corners_map"),
        ("lane", hd_map.lanes, "points_map"),
        ("symbol", hd_map.symbols, "outline_map"),
    )
    rows = []
    for layer, features, name in layers:
        shape = shapely.LineString if layer == "lane" else shapely.Polygon
        for feature in features:
            points = getattr(feature, name)
            heights_m = np.zeros(len(points)) if feature.heights_m is None else feature.heights_m
            geometry = shape(np.column_stack([points, heights_m]))
            accuracy = getattr(feature, "accuracy", None)
            rows.append((feature.id, layer, feature.kind, feature.sightings, accuracy, geometry))
    columns = ["id", "layer", "kind", "sightings", "accuracy", "geometry"]
    frame = geopandas.GeoDataFrame(rows, columns=columns, geometry="geometry")
    if hd_map.origin is None:
        return frame
    at = f"+lon_0={hd_map.origin.longitude_deg!r} +lat_0={hd_map.origin.latitude_deg!r}"
    on_earth = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 {at} +h_0={hd_map.origin.altitude_m!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    geometry = shapely.transform(
        frame.geometry.values, lambda xyz: np.column_stack(on_earth.transform(*xyz.T)), include_z=True
    )
    return frame.set_geometry(geometry, crs="EPSG:4326")
