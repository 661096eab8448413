"""A map and the poses of its drives as messages of ROS 2: by fields, whatever library made their classes.

``MAP`` is a message form of the map that holds all of it; markers are how RViz, Foxglove and Lichtblick
show it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from v2hdm.geometry.geodetic import crs_of
from v2hdm.geometry.rigid import quaternion_from_rotation
from v2hdm.io.maps.colours import LINE, OTHER, channels, colours_of
from v2hdm.io.maps.features import Feature, features_of, properties_of
from v2hdm.records import LANE_DASH, FloatArray, HDMap, Trajectory

Make = Callable[..., Any]
"""``make("std_msgs/msg/Header", stamp=..., ...)``: a message of a type, with these fields."""

MAP = "v2hdm_msgs/msg/HDMap"
FEATURE = "v2hdm_msgs/msg/Feature"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"
PICTURE = "sensor_msgs/msg/CompressedImage"

DEFINITIONS: Mapping[str, str] = {
    FEATURE: """\
# A marking, symbol or lane line of the map.
uint32 id
string label                  # its class, such as diamond
bool closed                   # an outline; else a line
geometry_msgs/Point[] points  # m, in the frame of the map; outlines counter-clockwise from above
uint32 sightings              # images that it was seen in
float64 sigma_m               # standard deviation a coordinate, m; NaN where it is not known
string accuracy               # A, B, C, or empty where it is not known
float64[] covariance_m2       # of x1 y1 x2 y2 ..., row by row; empty where it is not known
string properties             # JSON: text, kind, wear, parts, lines
""",
    MAP: """\
# A map. Its frame lies east, north and up of the origin.
std_msgs/Header header
string crs                    # projection of the frame for PROJ, or EPSG; empty without an origin
float64 latitude_deg          # origin; NaN without one
float64 longitude_deg
float64 altitude_m            # ellipsoidal
Feature[] features
""",
}
"""Definitions of our own messages, by type."""

MAP_FRAME = "map"
VEHICLE_FRAME = "vehicle"

# Constants of visualization_msgs/msg/Marker:
_LINE_LIST = 5  # a type of marker: pairs of points, each a piece of a line
_TEXT = 9  # a type of marker: a text that faces the camera
_ADD = 0  # an action of a marker

_WIDE_M = 0.05  # width of drawn lines, m; chosen
_TALL_M = 0.4  # height of drawn texts, m; chosen
_DASH_M = 1.0  # length of the dashes, and of the gaps, of dashed lane lines, m; chosen
_IN_FIELDS = ("id", "class", "sightings", "sigma_m", "accuracy", "covariance_m2", "heights_m")
"""Properties of a feature that its message holds as fields of their own."""


def stamp_message(nanoseconds: int, make: Make) -> Any:
    """A time since 1970 as a ``builtin_interfaces/msg/Time``."""
    seconds, remainder = divmod(nanoseconds, 10**9)
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=remainder)


def _header(nanoseconds: int, make: Make) -> Any:
    return make("std_msgs/msg/Header", stamp=stamp_message(nanoseconds, make), frame_id=MAP_FRAME)


def map_message(hd_map: HDMap, nanoseconds: int, make: Make) -> Any:
    """The whole map, with a time since 1970."""
    origin = hd_map.origin
    return make(
        MAP,
        header=_header(nanoseconds, make),
        crs="" if origin is None else crs_of(origin),
        latitude_deg=np.nan if origin is None else origin.latitude_deg,
        longitude_deg=np.nan if origin is None else origin.longitude_deg,
        altitude_m=np.nan if origin is None else origin.altitude_m,
        features=[_feature_message(feature, make) for feature in features_of(hd_map)],
    )


def _feature_message(feature: Feature, make: Make) -> Any:
    covariance_m2 = feature.ring_covariance_m2
    others = {
        key: value
        for key, value in properties_of(feature).items()
        if key not in _IN_FIELDS and key != feature.key
    }
    return make(
        FEATURE,
        id=feature.id,
        label=feature.kind,
        closed=feature.closed,
        points=_points(feature.xyz_map[feature.ring], make),
        sightings=feature.sightings,
        sigma_m=np.nan if feature.sigma_m is None else feature.sigma_m,
        accuracy=feature.accuracy or "",
        covariance_m2=np.empty(0) if covariance_m2 is None else covariance_m2.ravel(),
        properties=json.dumps(others),
    )


def _points(places: FloatArray, make: Make) -> list[Any]:
    return [make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in places.tolist()]


def marker_message(hd_map: HDMap, nanoseconds: int, make: Make) -> Any:
    """Markers in the colours of the report's map: the lines of each class, and the texts that were read.

    A class is a namespace, which viewers show and hide.
    """
    features = features_of(hd_map)
    colours = colours_of(features)
    looks = sorted({(feature.kind, feature.closed) for feature in features})
    markers = []
    for number, (kind, closed) in enumerate(looks):
        alike = [feature for feature in features if (feature.kind, feature.closed) == (kind, closed)]
        pieces = np.concatenate([_pieces(feature) for feature in alike])
        colour = colours.get(kind, OTHER) if closed else LINE
        points = _points(pieces.reshape(-1, 3), make)
        markers.append(_marker(make, nanoseconds, kind, number, _LINE_LIST, colour, points=points))
    for feature in features:
        if feature.reading is not None:
            colour = colours.get(feature.kind, OTHER)
            place = feature.xyz_map.mean(axis=0)
            marker = _marker(
                make, nanoseconds, "texts", feature.id, _TEXT, colour, place, text=feature.reading.text
            )
            markers.append(marker)
    return make(MARKERS, markers=markers)


def _pieces(feature: Feature) -> FloatArray:
    """The ends (N, 2, 3) of the straight pieces of a feature's outline or line; dashed lines are dashes."""
    points = feature.xyz_map
    if feature.closed:
        return np.stack([points, np.roll(points, -1, axis=0)], axis=1)
    if feature.kind != LANE_DASH:
        return np.stack([points[:-1], points[1:]], axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    starts_m = np.arange(0.0, along_m[-1], 2 * _DASH_M)
    ends_m = np.stack([starts_m, np.minimum(starts_m + _DASH_M, along_m[-1])], axis=1)
    return np.stack([np.interp(ends_m, along_m, points[:, axis]) for axis in range(3)], axis=2)


def _marker(
    make: Make,
    nanoseconds: int,
    namespace: str,
    number: int,
    shape: int,
    colour: str,
    place: FloatArray | None = None,
    points: Sequence[Any] = (),
    text: str = "",
) -> Any:
    x, y, z = (0.0, 0.0, 0.0) if place is None else place.tolist()
    red, green, blue = (channel / 255 for channel in channels(colour))
    none = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    is_text = shape == _TEXT
    return make(
        "visualization_msgs/msg/Marker",
        header=_header(nanoseconds, make),
        ns=namespace,
        id=number,
        type=shape,
        action=_ADD,
        pose=_pose(np.array([x, y, z]), np.array([0.0, 0.0, 0.0, 1.0]), make),
        scale=make("geometry_msgs/msg/Vector3", x=0.0 if is_text else _WIDE_M, y=0.0, z=_TALL_M * is_text),
        color=make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=list(points),
        colors=[],
        texture_resource="",
        texture=make(
            PICTURE,
            header=make("std_msgs/msg/Header", stamp=none, frame_id=""),
            format="",
            data=np.empty(0, dtype=np.uint8),
        ),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _pose(place: FloatArray, quaternion: FloatArray, make: Make) -> Any:
    x, y, z = place.tolist()
    qx, qy, qz, qw = quaternion.tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def transform_messages(trajectory: Trajectory, frame: str, make: Make) -> Iterator[tuple[int, Any]]:
    """The poses of a drive as transforms from the map to the vehicle's ``frame``, with their times in ns."""
    quaternions = quaternion_from_rotation(trajectory.map_from_vehicle[:, :3, :3])
    places = trajectory.map_from_vehicle[:, :3, 3]
    for stamp_s, place, quaternion in zip(trajectory.stamp_s, places, quaternions, strict=True):
        nanoseconds = round(stamp_s * 1e9)
        x, y, z = place.tolist()
        qx, qy, qz, qw = quaternion.tolist()
        transform = make(
            "geometry_msgs/msg/TransformStamped",
            header=_header(nanoseconds, make),
            child_frame_id=frame,
            transform=make(
                "geometry_msgs/msg/Transform",
                translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            ),
        )
        yield nanoseconds, make(TRANSFORMS, transforms=[transform])


def path_message(trajectory: Trajectory, nanoseconds: int, make: Make) -> Any:
    """All poses of a drive as one path, with a time since 1970 at which it is known."""
    quaternions = quaternion_from_rotation(trajectory.map_from_vehicle[:, :3, :3])
    places = trajectory.map_from_vehicle[:, :3, 3]
    poses = [
        make(
            "geometry_msgs/msg/PoseStamped",
            header=_header(round(stamp_s * 1e9), make),
            pose=_pose(place, quaternion, make),
        )
        for stamp_s, place, quaternion in zip(trajectory.stamp_s, places, quaternions, strict=True)
    ]
    return make(PATH, header=_header(nanoseconds, make), poses=poses)


def picture_message(encoded: bytes, kind: str, nanoseconds: int, make: Make) -> Any:
    """An encoded picture, such as a ``png``, as a message."""
    data = np.frombuffer(encoded, dtype=np.uint8)
    return make(PICTURE, header=_header(nanoseconds, make), format=kind, data=data)
