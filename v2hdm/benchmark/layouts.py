"""A site from an OpenDRIVE file and a trajectory: paint by design, driven along as it was driven once.

Paint is the broken marks of lanes, and the objects whose names are classes of four corners. A way is taken
from a trajectory in the coordinates of the file. The map counts from the way's first position.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from v2hdm.asbuilt.design import outline_of
from v2hdm.asbuilt.lane_marks import dashes_of
from v2hdm.asbuilt.opendrive import outlines_of
from v2hdm.catalogue import load_catalogue
from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.trajectory import read_tum
from v2hdm.records import LANE_DASH, FloatArray, HDMap, Marking
from v2hdm.safe.texts import read_bytes
from v2hdm.simulate.port.build import ORIGIN
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.survey.network import Network

_STEP_M = 0.05  # distance between the stations of a way
_MOVED_M = 0.3  # least distance between two positions of a way: nearer ones are a receiver's noise at rest
_SMOOTHED_M = 2.0  # standard deviation of the window over which a way's direction is taken; chosen
_SHORTEST_M = 25.0  # least length of a way, as of a port's route
_BESIDE_M = 40.0  # distance from the way up to which paint belongs to the site: farther than a camera sees


@dataclass(frozen=True)
class Layout:
    """The files of a site: ``design`` as OpenDRIVE, ``way`` as TUM trajectory in its coordinates."""

    design: Path
    way: Path

    @property
    def digests(self) -> tuple[str, str]:
        """SHA-256 of both files. Raises MapFileError or DriveError if one cannot be read."""
        design = read_bytes(self.design, MapFileError)
        way = read_bytes(self.way, DriveError)
        return hashlib.sha256(design).hexdigest(), hashlib.sha256(way).hexdigest()


def network_of(layout: Layout, speed_mps: float) -> Network:
    """The paint of a layout and the way along it.

    Raises:
        MapFileError: the design is damaged, or has no paint beside the way.
        DriveError: the way is damaged, or too short.
    """
    trajectory = read_tum(layout.way)
    positions = trajectory.map_from_vehicle[:, :2, 3]
    path = route_along(positions - positions[0], speed_mps, str(layout.way))
    markings = []
    for kind, outline in _shapes(layout.design):
        corners_map = outline_of(outline - positions[0]).corners_map
        if path.distance_to(corners_map).max() < _BESIDE_M:
            markings.append(Marking(kind, corners_map, 0))
    if not markings:
        raise MapFileError(
            f"{layout.design}: has no broken lane mark, and no object that is named as a class of four "
            f"corners, within {_BESIDE_M:g} m of {layout.way}; give a way in the file's coordinates"
        )
    return Network(path, HDMap(tuple(markings), (), origin=ORIGIN), beside_m=0.0)


def _shapes(design: Path) -> list[tuple[str, FloatArray]]:
    """The class and the outline (N, 2) of each marking in an OpenDRIVE file."""
    shapes = [(LANE_DASH, outline) for outline in dashes_of(design)]
    cornered = load_catalogue().cornered
    for outline in outlines_of(design).outlines:
        if outline.called in cornered:
            shapes.append((outline.called, outline.positions))
    return shapes


def route_along(positions: FloatArray, speed_mps: float, where: str) -> Route:
    """The route through positions (N, 2) in order of time; DriveError where they are too few or too near."""
    corners = [positions[0]]
    for position in positions[1:]:
        if np.linalg.norm(position - corners[-1]) >= _MOVED_M:
            corners.append(position)
    corners_map = np.array(corners)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners_map, axis=0), axis=1))])
    if along_m[-1] < _SHORTEST_M:
        raise DriveError(f"{where}: moves by {along_m[-1]:.1f} m in all; give {_SHORTEST_M:g} m or more")
    station_m = np.linspace(0.0, along_m[-1], round(along_m[-1] / _STEP_M) + 1)
    points = np.column_stack([np.interp(station_m, along_m, axis) for axis in corners_map.T])
    # Beyond its ends the way goes on straight, so that they stay where they are.
    window = round(4 * _SMOOTHED_M / _STEP_M)
    longer = np.pad(points, ((window, window), (0, 0)), mode="reflect", reflect_type="odd")
    points = gaussian_filter1d(longer, _SMOOTHED_M / _STEP_M, axis=0)[window:-window]
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    station_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    slope = np.gradient(points, axis=0)
    yaw_rad = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
    return Route(station_m, points, yaw_rad, np.gradient(yaw_rad, station_m), speed_mps)
