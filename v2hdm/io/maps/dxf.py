"""An HD map as DXF for CAD: local metres, a layer a class, through ``ezdxf``.

Extended data (XDATA) of the application ``V2HDM`` at each polyline hold what CAD has no word for: strings
name the values after them, ``id``, ``sightings``, ``relative_sigma_m`` and the rows of ``covariance_m2``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v2hdm.io.maps.features import Feature, features_of
from v2hdm.io.maps.needs import need
from v2hdm.records import HdMap
from v2hdm.store.files import whole_file

APPLICATION = "V2HDM"
_TEXT, _REAL, _WHOLE = 1000, 1040, 1071
"""Group codes of extended data (DXF reference, "Extended data"): string, real, whole number of 32 bits."""

_COLOURS = 6
"""AutoCAD's first colours, red to magenta, take turns."""


def write_dxf(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically: closed 3D polylines for markings, open ones for lanes.

    A DXF has no place for the ``verdict``.

    Raises:
        ConfigError: ``ezdxf`` is not installed.
    """
    ezdxf = need("ezdxf", "dxf")
    document = ezdxf.new("R2010", units=ezdxf.units.M)
    document.appids.add(APPLICATION)
    space = document.modelspace()
    for feature in features_of(hd_map):
        layer = re.sub(r'[<>/\\":;?*|=`]', "_", feature.kind)
        if layer not in document.layers:
            document.layers.add(layer, color=1 + len(document.layers) % _COLOURS)
        points = feature.xyz_map[feature.ring].tolist()
        line = space.add_polyline3d(points, close=feature.closed, dxfattribs={"layer": layer})
        line.set_xdata(APPLICATION, _told(feature))
    with whole_file(path) as partial:
        document.saveas(partial)


def _told(feature: Feature) -> list[tuple[int, Any]]:
    told: list[tuple[int, Any]] = [(_TEXT, "id"), (_WHOLE, feature.id)]
    told += [(_TEXT, "sightings"), (_WHOLE, feature.sightings)]
    if feature.relative_sigma_m is not None:
        told += [(_TEXT, "relative_sigma_m"), (_REAL, feature.relative_sigma_m)]
    if feature.covariance_m2 is not None:
        order = [2 * k + axis for k in feature.ring for axis in (0, 1)]
        rows = feature.covariance_m2[order][:, order]
        told += [(_TEXT, "covariance_m2"), *((_REAL, value) for value in rows.ravel().tolist())]
    return told
