"""A small site whose scores can be worked out by hand, and maps of it as files of other tools."""

import json

import numpy as np

from v2hdm.benchmark.sites import Reference
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.records import GeodeticOrigin, HDMap, Lane, Marking, Truth

ORIGIN = GeodeticOrigin(29.95, 122.05, 12.0)
DIAMOND = np.array([[-0.5, 0.0], [0.0, -0.35], [0.5, 0.0], [0.0, 0.35]])
DASH = np.array([[-1.0, -0.06], [1.0, -0.06], [1.0, 0.06], [-1.0, 0.06]])


def at(points, x, y):
    """Points (N, 2) moved to a place."""
    return points + np.array([x, y])


def site():
    """Thirty diamonds and ten dashes, 4 m apart, beside a lane line; the drive has not gone past the last."""
    diamonds = [Marking("diamond", at(DIAMOND, 4.0 * k, 3.0), 1) for k in range(30)]
    dashes = [Marking("lane_dash", at(DASH, 4.0 * k, -3.0), 1) for k in range(10)]
    line = np.column_stack([np.arange(0.0, 121.0), np.zeros(121)])
    hd_map = HDMap((*diamonds, *dashes), (Lane("lane_line", line, 1),), ORIGIN)
    truth = Truth(
        map=hd_map,
        cam_from_vehicle={},
        map_from_vehicle=np.zeros((0, 4, 4)),
        visibility=np.zeros((0, 40)),
        lane_visible=(np.ones(121, dtype=np.bool_),),
        disturbances={},
    )
    return Reference(truth, np.arange(40) < 39)


def feature(kind, points_map, geometry="Polygon", swap=False, local=False, **properties):
    """A feature of another tool, in longitude and latitude unless it is ``local``."""
    positions = points_map
    if not local:
        positions = geodetic_from_enu(ORIGIN, np.column_stack([points_map, np.zeros(len(points_map))]))
        positions = positions[:, :2] if swap else positions[:, [1, 0]]
    listed = positions.tolist()
    coordinates = [[*listed, listed[0]]] if geometry == "Polygon" else listed
    shape = {"type": geometry, "coordinates": coordinates}
    return {"type": "Feature", "geometry": shape, "properties": {"class": kind, **properties}}


def write(path, features, **members):
    """A collection of features with further members."""
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **members}))
    return path


def paint(reference, moved=(0.0, 0.0), **how):
    """The true markings as features, moved."""
    return [feature(m.kind, m.corners_map + moved, **how) for m in reference.truth.map.markings]
