"""The sections of a drive: each has its images, and those of its neighbours that look into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.adjust.sections.way import parts_of_way
from v2hdm.association.sightings import Frames, Sightings, frames_of
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.bundle import Bundle
from v2hdm.records import BoolArray, Drive, FloatArray, IntArray, Session

_AHEAD_M = 12.0  # distance, m, from a camera to the middle of the ground that an image shows markings on

_OVERLAP_M = 26.0
"""Distance, m, of the middles of two images' grounds within which they may show the same marking.

It is twice a camera's reach from that middle, so that all who see a marking of a section are in it.
"""

_LEVEL = 0.5  # sine of a camera's angle from straight down, below which it looks ahead by less; chosen

_MOST_PER_IMAGE = 1 << 20  # more detections than any image has, in the names of sightings


@dataclass(frozen=True)
class Section:
    """A section as a drive of its images and the overlap.

    ``images`` (I,) and ``frames`` (F,) are the numbers of its drive's images and frames in the whole drive,
    ``is_own`` (I,) says which images are its own, ``neighbours`` whose the others are.
    """

    number: int
    drive: Drive
    images: IntArray
    is_own: BoolArray
    frames: IntArray
    neighbours: tuple[int, ...]

    @property
    def name(self) -> str:
        """Its name for messages: its number from 1, and where it is."""
        x, y = self.drive.route_map.mean(axis=0)
        return f"section {self.number + 1}, about x {x:.0f} m, y {y:.0f} m"

    @cached_property
    def own_frames(self) -> IntArray:
        """Frames of its own images, by their numbers in the section's drive, ascending."""
        return np.unique(frames_of(self.drive).frame_of_image[self.is_own])

    def is_inside(self, points_map: FloatArray) -> BoolArray:
        """Whether the image nearest to each point (N, 2) is the section's own."""
        _, nearest = cKDTree(self.drive.route_map).query(points_map)
        return np.asarray(self.is_own[nearest])

    def sighting_names(self, sightings: Sightings) -> IntArray:
        """Names (S,) of sightings over the whole drive: the number of their image, and their place in it."""
        image = sightings.image
        begins = np.concatenate([[True], image[1:] != image[:-1]])
        first = np.maximum.accumulate(np.where(begins, np.arange(len(image)), 0))
        return np.asarray(self.images[image] * _MOST_PER_IMAGE + np.arange(len(image)) - first)

    def observation_names(self, sightings: Sightings, bundle: Bundle) -> IntArray:
        """Names (K,) over the whole drive of the observations of a bundle of ``sightings``."""
        return 4 * self.sighting_names(sightings)[bundle.row] + bundle.own_corner


def sections_of(drive: Drive, most_m: float) -> list[Section]:
    """Sections of at most ``most_m`` of way; their own images make up the drive."""
    frames = frames_of(drive)
    part_of_image = _part_of_frame(frames, most_m)[frames.frame_of_image]
    place_of_image = _looked_at(drive, frames.map_from_vehicle[frames.frame_of_image])
    # Trajectories, of the whole way, serve the correction of clocks alone.
    bare = replace(drive, trajectory=None, recorded=None, joined=_without_trajectories(drive))
    sections = []
    for number in range(int(part_of_image.max()) + 1):
        images = np.flatnonzero(_near(place_of_image, place_of_image[part_of_image == number]))
        local = replace(bare, images=tuple(drive.images[image] for image in images.tolist()))
        parts = np.unique(part_of_image[images]).tolist()
        sections.append(
            Section(
                number=number,
                drive=local,
                images=images,
                is_own=part_of_image[images] == number,
                frames=np.unique(frames.frame_of_image[images]),
                neighbours=tuple(part for part in parts if part != number),
            )
        )
    return sections


def _part_of_frame(frames: Frames, most_m: float) -> IntArray:
    return parts_of_way(frames.map_from_vehicle[:, :2, 3], frames.session, most_m)


def _without_trajectories(drive: Drive) -> tuple[Session, ...]:
    return tuple(replace(session, trajectory=None, recorded=None) for session in drive.joined)


def _looked_at(drive: Drive, map_from_vehicle: FloatArray) -> FloatArray:
    """The middles (I, 2) of the ground that a drive's images look at, from poses (I, 4, 4)."""
    number = {name: c for c, name in enumerate(drive.cameras)}
    extrinsics = np.array([initial_extrinsic(camera) for camera in drive.cameras.values()])
    ahead = extrinsics[:, 2, :2]  # each camera's axis, by the vehicle
    level = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), _LEVEL)
    middles = np.column_stack([camera_centre(extrinsics)[:, :2] + _AHEAD_M * level, np.zeros(len(ahead))])
    of_image = middles[[number[image.camera] for image in drive.images]]
    turned = np.einsum("iab,ib->ia", map_from_vehicle[:, :2, :3], of_image)
    return np.asarray(turned + map_from_vehicle[:, :2, 3])


def _near(points_map: FloatArray, places_map: FloatArray) -> BoolArray:
    """Which points (N, 2) are within the overlap of some places (M, 2)."""
    is_near = np.zeros(len(points_map), dtype=np.bool_)
    low = places_map.min(axis=0) - _OVERLAP_M
    high = places_map.max(axis=0) + _OVERLAP_M
    inside = np.flatnonzero(((points_map >= low) & (points_map <= high)).all(axis=1))
    away_m, _ = cKDTree(places_map).query(points_map[inside], distance_upper_bound=_OVERLAP_M)
    is_near[inside] = np.isfinite(away_m)
    return is_near


def part_of_frame(sections: Sequence[Section], frame_of_image: IntArray) -> IntArray:
    """The section (J,) of each frame of the whole drive."""
    part = np.zeros(int(frame_of_image.max()) + 1, dtype=np.int64)
    for section in sections:
        part[frame_of_image[section.images[section.is_own]]] = section.number
    return part
