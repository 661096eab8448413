"""An HD map as CSV for surveyors: a row a corner or vertex, with its covariance."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.io.maps.features import Feature, features_of
from v2hdm.records import GeodeticOrigin, HdMap
from v2hdm.store.files import replace_text

_CORNERS = 4

COLUMNS: tuple[str, ...] = (
    *("id", "class", "point", "x_map_m", "y_map_m", "height_m"),
    *("longitude_deg", "latitude_deg", "ellipsoidal_height_m"),
    *("sigma_x_m", "sigma_y_m", "sightings", "relative_sigma_m"),
    *(f"cov_{own}_{other}{k}_m2" for own in "xy" for k in range(1, _CORNERS + 1) for other in "xy"),
)
"""``point`` counts from 1 along the feature. ``cov_x_y3_m2`` is the covariance of this point's x with the y
of point 3 of the same feature. Empty where it is not known."""


def write_csv(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path``, atomically, every number at full precision.

    A CSV has no place for the ``verdict``.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for feature in features_of(hd_map):
        table.writerows(_rows(feature, hd_map.origin))
    replace_text(path, text.getvalue())


def _rows(feature: Feature, origin: GeodeticOrigin | None) -> list[list[Any]]:
    count = len(feature.points_map)
    geodetic: list[list[Any]] = [["", "", ""]] * count
    if origin is not None:
        positions = np.empty((count, 3))
        positions[feature.ring] = feature.positions(origin)
        geodetic = positions.tolist()
    rows = []
    for k, (x, y) in enumerate(feature.points_map.tolist()):
        height = "" if feature.heights_m is None else float(feature.heights_m[k])
        sigmas: list[Any] = ["", ""]
        covariances: list[Any] = [""] * (4 * _CORNERS)
        if feature.covariance_m2 is not None:
            own = feature.covariance_m2[2 * k : 2 * k + 2]
            sigmas = np.sqrt(np.diag(own[:, 2 * k : 2 * k + 2])).tolist()
            covariances = own.ravel().tolist()
        relative = "" if feature.relative_sigma_m is None else feature.relative_sigma_m
        row = [feature.id, feature.kind, k + 1, x, y, height, *geodetic[k], *sigmas]
        rows.append([*row, feature.sightings, relative, *covariances])
    return rows
