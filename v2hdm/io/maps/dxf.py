"""Writing an HD map as DXF, for CAD.

Extended data (XDATA) of the application ``V2HDM`` at each polyline hold what CAD has no word for: strings
name the values after them, ``id``, ``sightings``, ``relative_sigma_m``, ``accuracy``, ``kind``, ``parts``,
``lines``, ``apart_m``, ``heights_sigma_m``, the rows of ``covariance_m2``, and what a text says, which is
also a TEXT there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.colours import LINE, OTHER, channels, colours_of
from v2hdm.io.maps.features import COMPOSITION, TEXT_READ, Feature, features_of, in_words, properties_of
from v2hdm.records import LANE_DASH, FloatArray, HDMap
from v2hdm.store.files import whole_file

APPLICATION = "V2HDM"
# Group codes of extended data (DXF reference, "Extended data"):
_TEXT = 1000  # group code of a string
_REAL = 1040  # group code of a real number
_WHOLE = 1071  # group code of a whole number of 32 bits

_AROUND_M = 5.0  # margin of the first view around the drawing, m; chosen
_TALL = 0.6  # height of CAD's window by its width, about; chosen
_DASHED = "DASHED"  # the linetype of dashed lane lines, by its name in every CAD


def write_dxf(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as DXF, atomically: metres, a layer per class, closed 3D polylines for markings.

    They are local, or of the ``grid``, which the drawing's custom properties name with datum and epoch.
    Raises ConfigError when ``ezdxf`` is not installed.
    """
    ezdxf = need("ezdxf", "gis", "the format dxf", ConfigError)
    document = ezdxf.new("R2010", setup=["linetypes"], units=ezdxf.units.M)
    document.appids.add(APPLICATION)
    if grid is not None:
        for key, value in grid.stated.items():
            document.header.custom_vars.append(key, value)
    space = document.modelspace()
    features = features_of(hd_map)
    colours = colours_of(features)
    places = [np.zeros((1, 3))] if not features else []
    for feature in features:
        layer = _layer(document, feature, colours)
        points = (feature.xyz_map[feature.ring] if grid is None else feature.positions(grid)).tolist()
        places.append(np.array(points))
        look = {"layer": layer}
        if not feature.closed and feature.kind == LANE_DASH:
            look["linetype"] = _DASHED
        line = space.add_polyline3d(points, close=feature.closed, dxfattribs=look)
        data: list[tuple[int, Any]] = [(_TEXT, "id"), (_WHOLE, feature.id)]
        data += [(_TEXT, "sightings"), (_WHOLE, feature.sightings)]
        if feature.relative_sigma_m is not None:
            data += [(_TEXT, "relative_sigma_m"), (_REAL, feature.relative_sigma_m)]
        if feature.accuracy is not None:
            data += [(_TEXT, "accuracy"), (_TEXT, feature.accuracy)]
        for key in (*COMPOSITION, *TEXT_READ):
            if (stated := properties_of(feature).get(key)) is not None:
                data += [(_TEXT, key), (_TEXT, in_words(stated))]
        if feature.heights_sigma_m is not None:
            sigmas_m = feature.heights_sigma_m[feature.ring].tolist()
            data += [(_TEXT, "heights_sigma_m"), *((_REAL, value) for value in sigmas_m)]
        if (covariance := feature.ring_covariance_m2) is not None:
            data += [(_TEXT, "covariance_m2"), *((_REAL, value) for value in covariance.ravel().tolist())]
        if feature.reading is not None:
            _add_text(space, feature.reading.text, np.array(points), layer)
        line.set_xdata(APPLICATION, data)
    _show(document, np.concatenate(places))
    with whole_file(path) as partial:
        document.saveas(partial)


def _layer(document: Any, feature: Feature, colours: Mapping[str, str]) -> str:
    """The layer of a feature's class, in the colour of the report's map."""
    layer = re.sub(r'[<>/\\":;?*|=`]', "_", feature.kind)
    if layer not in document.layers:
        colour = colours.get(feature.kind, OTHER) if feature.closed else LINE
        document.layers.add(layer).rgb = channels(colour)
    return layer


def _show(document: Any, places: FloatArray) -> None:
    """State the extent of all ``places`` (N, 3), and let CAD open the drawing on it."""
    low = places.min(axis=0)
    high = places.max(axis=0)
    document.modelspace().reset_extents(low.tolist(), high.tolist())
    width_m, height_m = (high - low)[:2] + 2 * _AROUND_M
    middle = ((low + high) / 2)[:2].tolist()
    document.set_modelspace_vport(height=max(height_m, width_m * _TALL), center=middle)


def _add_text(space: Any, text: str, corners: FloatArray, layer: str) -> None:
    """Write a text between the lower left and the upper right of its outline (N, 3), which begin there."""
    along = (corners[1] - corners[0])[:2]
    height_m = float(np.linalg.norm(corners[-1] - corners[0]))
    turned_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
    about = {"layer": layer, "rotation": turned_deg, "insert": corners[0].tolist()}
    space.add_text(text, height=height_m, dxfattribs=about)
