"""A drive as the mapper may know it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from v2hdm.records.arrays import FloatArray
from v2hdm.records.cameras import Camera
from v2hdm.records.poses import GeodeticOrigin, PoseNoise, Reception, Road, Trajectory

DETECTIONS_SUFFIX = ".json"
"""Suffix of a file of detections, which stands for an image whose picture was not kept."""


@dataclass(frozen=True)
class Image:
    """One image of a drive."""

    camera: str
    stamp_s: float
    path: Path
    map_from_vehicle: FloatArray  # (4, 4) when it was taken
    clock_offset_s: float = 0.0  # exposure minus stamp, as far as known
    session: int = 0  # an index into ``Drive.sessions``

    @property
    def taken_s(self) -> float:
        """When the image was taken, on the clock of the poses."""
        return self.stamp_s + self.clock_offset_s


@dataclass(frozen=True)
class Session:
    """A session of a :class:`Drive`, itself a drive before joining; ``cameras`` are by its own names."""

    name: str
    root: Path
    pose_noise: PoseNoise
    truth_dir: Path | None = None
    trajectory: Trajectory | None = None
    recorded: Trajectory | None = None
    cameras: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """Everything the mapper may know of a drive."""

    name: str
    root: Path
    cameras: Mapping[str, Camera]
    images: Sequence[Image]  # sorted by session, time, then camera
    pose_noise: PoseNoise = field(default_factory=PoseNoise)
    origin: GeodeticOrigin | None = None
    truth_dir: Path | None = None  # for the report alone
    trajectory: Trajectory | None = None  # at the receiver's rate, the road laid flat
    recorded: Trajectory | None = None  # the same as recorded
    road: Road | None = None  # as recorded, None for the plane z = 0
    unposed: Mapping[str, int] = field(default_factory=dict)  # images left out, without a pose
    # First and last time, s, of all images of a camera, left out or not.
    listed_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reception: Reception | None = None  # None where the poses come from no receiver's log
    headed_by_course: bool = False  # whether its headings are its antenna's course, smoothed
    joined: tuple[Session, ...] = ()  # its sessions, if several: then it has no trajectory

    @property
    def has_pictures(self) -> bool:
        """Whether its images are pictures; else they are files of what was detected in them."""
        return not any(image.path.suffix == DETECTIONS_SUFFIX for image in self.images)

    def name_of(self, path: Path) -> str:
        """Name an image as files of results do: its path below the drive's folder, else its whole path."""
        path = path.absolute()
        root = self.root.absolute()
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)

    @property
    def spans_s(self) -> tuple[tuple[float, float], ...]:
        """The first and the last stamp of the images of each session, s."""
        stamps_of: dict[int, list[float]] = {}
        for image in self.images:
            stamps_of.setdefault(image.session, []).append(image.stamp_s)
        return tuple((min(stamps), max(stamps)) for _, stamps in sorted(stamps_of.items()))

    @property
    def route_map(self) -> FloatArray:
        """The vehicle's positions (I, 2), m, at the images."""
        return np.array([image.map_from_vehicle[:2, 3] for image in self.images])

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Its sessions: the drives that it was joined of, or itself alone."""
        if self.joined:
            return self.joined
        alone = Session(
            name=self.name,
            root=self.root,
            pose_noise=self.pose_noise,
            truth_dir=self.truth_dir,
            trajectory=self.trajectory,
            recorded=self.recorded,
            cameras={name: name for name in self.cameras},
        )
        return (alone,)

    @property
    def paths(self) -> list[Trajectory]:
        """The paths of its sessions, which say where lanes lead."""
        return [session.trajectory for session in self.sessions if session.trajectory is not None]

    @property
    def noises(self) -> tuple[PoseNoise, ...]:
        """The noise of each session's recorded poses."""
        return tuple(session.pose_noise for session in self.sessions)
