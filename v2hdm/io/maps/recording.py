"""Writing a result as an MCAP recording of ROS 2, for Foxglove, Lichtblick, RViz and ``ros2 bag play``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from v2hdm.errors import ConfigError, need
from v2hdm.io.maps import messages
from v2hdm.records import HDMap, Trajectory
from v2hdm.store.files import whole_file
from v2hdm.store.names import camera_of_overlay

MAP_TOPIC = "/map/features"
MARKERS_TOPIC = "/map/markers"
TRANSFORMS_TOPIC = "/tf"


class _Entry(NamedTuple):
    """A message of a recording, and when it was sent."""

    nanoseconds: int
    topic: str
    kind: str
    message: Any


def write_mcap(
    hd_map: HDMap, path: Path, trajectories: Sequence[Trajectory] = (), pictures: Sequence[Path] = ()
) -> None:
    """Write ``hd_map`` as an MCAP, atomically, with the poses of its drives and PNG ``pictures`` of overlays.

    What does not move is sent once, at the first pose, to those who subscribe later as well. Poses are
    transforms, of several drives to ``vehicle_1``, ``vehicle_2``, ... Raises ConfigError without
    ``rosbags``.
    """
    need("rosbags", "ros", f"the format of {path.name}", ConfigError)
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for kind, definition in messages.DEFINITIONS.items():
        store.register(get_types_from_msg(definition, kind))

    def make(kind: str, **fields: Any) -> Any:
        return store.types[kind](**fields)

    forever = QosTime(sec=9223372036, nsec=854775807)  # what rosbag2 writes where there is no limit
    latched = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
    with whole_file(path) as partial, TemporaryDirectory(".part", f".{path.name}.", path.parent) as folder:
        bag = Path(folder, "bag")
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for entry in _entries(hd_map, trajectories, pictures, make):
                if entry.topic not in connections:
                    profiles = [] if entry.topic == TRANSFORMS_TOPIC else [latched]
                    connections[entry.topic] = writer.add_connection(
                        entry.topic, entry.kind, typestore=store, offered_qos_profiles=profiles
                    )
                data = store.serialize_cdr(entry.message, entry.kind)
                writer.write(connections[entry.topic], entry.nanoseconds, data)
        Path(bag, "bag.mcap").replace(partial)


def _entries(
    hd_map: HDMap, trajectories: Sequence[Trajectory], pictures: Sequence[Path], make: messages.Make
) -> list[_Entry]:
    """All messages in the order of their times."""
    driven = [trajectory for trajectory in trajectories if len(trajectory.stamp_s)]
    start = min((round(trajectory.stamp_s[0] * 1e9) for trajectory in driven), default=0)
    entries = [
        _Entry(start, MAP_TOPIC, messages.MAP, messages.map_message(hd_map, start, make)),
        _Entry(start, MARKERS_TOPIC, messages.MARKERS, messages.marker_message(hd_map, start, make)),
    ]
    for picture in pictures:
        message = messages.picture_message(picture.read_bytes(), "png", start, make)
        topic = f"/{camera_of_overlay(picture)}/overlay"
        entries.append(_Entry(start, topic, messages.PICTURE, message))
    moving = []
    for number, trajectory in enumerate(driven, 1):
        frame = messages.VEHICLE_FRAME if len(driven) == 1 else f"{messages.VEHICLE_FRAME}_{number}"
        message = messages.path_message(trajectory, start, make)
        entries.append(_Entry(start, f"/{frame}/path", messages.PATH, message))
        moving += [
            _Entry(nanoseconds, TRANSFORMS_TOPIC, messages.TRANSFORMS, transforms)
            for nanoseconds, transforms in messages.transform_messages(trajectory, frame, make)
        ]
    return entries + sorted(moving, key=lambda entry: entry.nanoseconds)
