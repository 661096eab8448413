"""A made site: two port lanes that cross, and a T with turn lanes, as a map and the paths of ten drives.

::

                 N
                 |
      W ---------+---------------------- T ------ E       y = 0, lanes 3.65 m wide, driven on the right
                 |                       |
                 S (x = 0)               M (x = 98)

Lines end 10 m before the crossing and where the T opens. On the way east a lane for right turns begins 30 m
before the T; the minor road M has one lane for each turn.

``python examples/lanes/site.py FOLDER`` writes ``map.geojson`` and a ``trajectory_<drive>.tum`` a drive.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.records import GIVE_WAY, STOP_LINE, FloatArray, GeodeticOrigin, HDMap, Lane, Marking, Trajectory

WIDTH_M = 3.65
ORIGIN = GeodeticOrigin(latitude_deg=29.95, longitude_deg=122.05, altitude_m=12.0)

LINES: Sequence[tuple[str, Sequence[tuple[float, float]]]] = (
    # The road from west to east, west of the crossing, then from there to the T, then beyond it:
    ("lane_line", [(-80, 3.65), (-10, 3.65)]),
    ("lane_dash", [(-80, 0), (-10, 0)]),
    ("lane_line", [(-80, -3.65), (-10, -3.65)]),
    ("lane_line", [(10, 3.65), (200, 3.65)]),
    ("lane_line", [(10, 0), (92, 0)]),
    ("lane_line", [(10, -3.65), (30, -3.65), (60, -7.3), (92, -7.3)]),
    ("lane_dash", [(62, -3.65), (92, -3.65)]),
    ("lane_line", [(108, 0), (200, 0)]),
    ("lane_line", [(108, -3.65), (200, -3.65)]),
    # The road from south to north:
    *((kind, [(x, y), (x, y + 70)]) for y in (-80, 10) for kind, x in
      (("lane_line", -3.65), ("lane_dash", 0), ("lane_line", 3.65))),
    # The minor road, which splits into a lane for each turn:
    ("lane_line", [(94.5, -100), (94.5, -16)]),
    ("lane_line", [(98.15, -100), (98.15, -16)]),
    ("lane_line", [(101.8, -100), (101.8, -75), (105.45, -50), (105.45, -16)]),
    ("lane_dash", [(101.8, -48), (101.8, -16)]),
)  # fmt: skip

EAST, WEST, NORTH, SOUTH = (-1.825, 1.825, 1.825, -1.825)  # y, or x, of the middle of a lane that way
TURN_LANE = -5.475  # y of the middle of the lane for right turns
DOWN, UP, UP_LEFT, UP_RIGHT = 96.325, 99.975, 99.975, 103.625  # x of lanes of the minor road

DRIVES: Sequence[Sequence[tuple[float, float]]] = (
    [(-80, EAST), (200, EAST)],
    [(200, WEST), (-80, WEST)],
    [(NORTH, -80), (NORTH, 80)],
    [(SOUTH, 80), (SOUTH, -80)],
    [(-80, EAST), (NORTH, EAST), (NORTH, 80)],
    [(-80, EAST), (SOUTH, EAST), (SOUTH, -80)],
    [(SOUTH, 80), (SOUTH, EAST), (30, EAST), (60, TURN_LANE), (DOWN, TURN_LANE), (DOWN, -100)],
    [(200, WEST), (DOWN, WEST), (DOWN, -100)],
    [(UP, -100), (UP_LEFT, -50), (UP_LEFT, WEST), (SOUTH, WEST), (SOUTH, -80)],
    [(UP, -100), (UP, -75), (UP_RIGHT, -50), (UP_RIGHT, EAST), (200, EAST)],
)
"""Corners of the paths driven, rounded by arcs."""

STOPS: Sequence[tuple[tuple[float, float], tuple[float, float], str | None]] = (
    ((SOUTH, 11), (1.6, 0.2), None),
    ((NORTH, -11), (1.6, 0.2), None),
    ((UP_LEFT, -17), (1.6, 0.2), GIVE_WAY),
    ((UP_RIGHT, -17), (1.6, 0.2), GIVE_WAY),
)
"""Middles and half sizes of the lines across lanes, m, and their varieties."""


@dataclass(frozen=True)
class Site:
    """A made map and the drives that passed it."""

    hd_map: HDMap
    trajectories: tuple[Trajectory, ...]


def made_site(
    seed: int = 0, sigma_m: float = 0.01, drives: Sequence[int] = tuple(range(10)), wander_m: float = 0.15
) -> Site:
    """The site as mapped with errors of ``sigma_m`` by drives that wander within their lanes."""
    rng = np.random.default_rng(seed)
    lanes = tuple(
        _line(kind, corners, rng, sigma_m, number) for number, (kind, corners) in enumerate(LINES, 1)
    )
    stops = tuple(_stop(*stop, 100 + k) for k, stop in enumerate(STOPS))
    hd_map = HDMap(stops, lanes, ORIGIN)
    return Site(hd_map, tuple(trajectory(DRIVES[k], rng, wander_m) for k in drives))


def height_m(points: FloatArray) -> FloatArray:
    """The site's true heights: a slope of 1 % to the east, and a swell."""
    return np.asarray(0.01 * points[:, 0] + 0.3 * np.sin(points[:, 1] / 40.0))


def _line(
    kind: str, corners: Sequence[tuple[float, float]], rng: np.random.Generator, sigma_m: float, number: int
) -> Lane:
    points = even(np.array(corners, dtype=float), 0.5)
    noise = gaussian_filter1d(rng.normal(size=points.shape), 4.0, axis=0, mode="nearest")
    points += sigma_m * noise / noise.std()
    return Lane(kind, points, 9, height_m(points), id=number)


def _stop(
    middle: tuple[float, float], half: tuple[float, float], variety: str | None, number: int
) -> Marking:
    corners = np.array(middle) + np.array(half) * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return Marking(STOP_LINE, corners, 9, np.eye(8) * 1e-4, id=number, variety=variety)


def even(corners: FloatArray, step_m: float) -> FloatArray:
    """Points about ``step_m`` apart along straight lines from corner to corner."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], round(along[-1] / step_m) + 1)
    return np.column_stack([np.interp(at, along, axis) for axis in corners.T])


def trajectory(
    corners: Sequence[tuple[float, float]],
    rng: np.random.Generator,
    wander_m: float = 0.15,
    speed_mps: float = 5.0,
) -> Trajectory:
    """A drive along corners rounded by arcs of 9 m radius, at 10 Hz, noise 1.5 cm."""
    points = even(rounded(np.array(corners, dtype=float), 9.0), speed_mps / 10)
    wander = gaussian_filter1d(rng.normal(size=points.shape), 20.0, axis=0, mode="nearest")
    points = points + wander_m * wander / wander.std() + rng.normal(scale=0.015, size=points.shape)
    ahead = gaussian_filter1d(np.gradient(points, axis=0), 3.0, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    map_from_vehicle = np.tile(np.eye(4), (len(points), 1, 1))
    map_from_vehicle[:, 0, 0] = map_from_vehicle[:, 1, 1] = np.cos(yaw)
    map_from_vehicle[:, 1, 0] = np.sin(yaw)
    map_from_vehicle[:, 0, 1] = -np.sin(yaw)
    map_from_vehicle[:, :2, 3] = points
    map_from_vehicle[:, 2, 3] = height_m(points)
    return Trajectory(np.arange(len(points)) / 10.0, map_from_vehicle)


def rounded(corners: FloatArray, radius_m: float) -> FloatArray:
    """The corners (N, 2) with an arc in place of each that turns by more than 30 degrees."""
    points = [corners[0]]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        into = (corner - before) / np.linalg.norm(corner - before)
        out = (after - corner) / np.linalg.norm(after - corner)
        turn = np.arctan2(into[0] * out[1] - into[1] * out[0], into @ out)
        if abs(turn) < np.deg2rad(30):
            points.append(corner)
            continue
        reach = radius_m * np.tan(abs(turn) / 2)
        left = np.array([-into[1], into[0]]) * np.sign(turn)
        centre = corner - reach * into + radius_m * left
        angles = np.linspace(0, turn, 40)
        spoke = -radius_m * left
        points += [
            centre
            + np.array(
                [spoke[0] * np.cos(a) - spoke[1] * np.sin(a), spoke[0] * np.sin(a) + spoke[1] * np.cos(a)]
            )
            for a in angles
        ]
    return np.array([*points, corners[-1]])


def main(folder: Path) -> None:
    """Write the site's map and paths."""
    folder.mkdir(parents=True, exist_ok=True)
    site = made_site()
    write_geojson(site.hd_map, folder / "map.geojson")
    for number, driven in enumerate(site.trajectories):
        write_tum(driven, folder / f"trajectory_{number}.tum")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
