"""Whether a truck keeps to its lane where it is steered by the localiser's pose alone.

    python -m tests.benchmarks.closed_loop --seeds 5 --km 5 [--picture FILE] [--rendered METRES]

On both ports a truck (:mod:`tests.benchmarks.made.truck`) is to follow the trajectory that the mapping drive's
RTK recorded. It knows no position but that of the localiser, which has a map, calibrations and an odometry
with errors, and two cameras at 10 Hz whose detections come 120 ms late. They have the statistics of the
detector on renders (:mod:`v2hdm.simulate.survey.sightings`); with ``--rendered``, so many metres of each port
are driven on images that are rendered from where the truck is, and the shipped detector.

The localiser starts from a position known to 5 m and 20 deg, while a driver takes the truck along slowly. As
soon as it is sure, the truck drives by itself. Where it is not any more, the truck brakes to a stop, which is
counted, and the driver takes it on.

Printed for each lap: the way by itself, on it the largest distance of the truck's origin from the planned
path, the least way between its outline and the paint of a lane's border, how often it touched one, and the
stops.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from tests.benchmarks.made.follower import Follower, PlannedPath
from tests.benchmarks.made.live import calibrated, port_config, surveyed
from tests.benchmarks.made.truck import STEP_S, Truck, clearance_m
from v2hdm.geometry.rigid import heading_rad
from v2hdm.localization.localizer import Localizer, Pose, Status
from v2hdm.localization.motion import Motion
from v2hdm.localization.places import Prior, rough_position
from v2hdm.localization.seeing import Look
from v2hdm.records import Calibration, FloatArray, HDMap
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.survey.sightings import Paint, detect

PORTS = ("port1", "port2")
SPEED_M_S = 4.0
_IMAGE_STEPS = 5  # steps between two images: 10 Hz
_LATE_S = 0.12  # from an exposure until its detections are there, s
_ROUGH_M, _ROUGH_RAD = 5.0, np.deg2rad(20.0)
_MARGIN_M = 3.0  # of the path's ends, that are not driven
_BORDER_M = 0.02  # way between two points of a lane's border
_NEAR_M = 6.0  # way within which borders are looked at
_LONGEST_S = 400.0  # of a lap; a port's takes 100
_BY_HAND_M_S = 1.5  # speed at which a driver goes until the localiser is sure
_AT_REST_M_S = 0.05  # speed under which the truck stands
_LAP = 81  # stream of a seed

See = Callable[[str, FloatArray, float], Look]
"""The look of a camera from where the vehicle truly is (4, 4), at a time."""


@dataclass(frozen=True)
class Site:
    """A port with its planned path, and the borders (N, 2) of its lanes with half the width of their paint."""

    port: Port
    path: PlannedPath
    borders: cKDTree
    half_width_m: float


class Lap(NamedTuple):
    """A truck's way by itself (F steps)."""

    stamp_s: FloatArray
    poses: FloatArray  # (F, 3) x, y and heading, truly
    left_m: FloatArray  # (F,) of the planned path
    clearance_m: FloatArray  # (F,) from lane borders
    error_m: FloatArray  # (F,) of the localiser's place, across the way
    stops: int  # times that the localiser was not sure any more
    by_hand_m: float  # that a driver drove
    km: float  # of the F steps

    @property
    def collisions(self) -> int:
        """How often the truck began to touch a border."""
        touches = self.clearance_m < 0
        return int((touches[1:] & ~touches[:-1]).sum() + touches[:1].sum())


def site_of(name: str, seed: int) -> Site:
    """A port of its own layout, recorded by its mapping drive."""
    config = port_config(name)
    port = build_port(replace(config, seed=config.seed + 100 * seed))
    path = PlannedPath.recorded(port.driven.recorded.map_from_vehicle[:, :2, 3])
    points = []
    for lane in port.hd_map.lanes:
        way_m = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(lane.points_map, axis=0), axis=1))]
        )
        at_m = np.arange(0.0, way_m[-1], _BORDER_M)
        points.append(np.column_stack([np.interp(at_m, way_m, axis) for axis in lane.points_map.T]))
    return Site(port, path, cKDTree(np.concatenate(points)), 0.5 * config.paint.line_width_m)


def made_eyes(site: Site, rng: np.random.Generator) -> See:
    """Cameras whose detections have the statistics of the detector on renders."""
    paint = Paint.of(site.port.hd_map)

    def see(camera: str, map_from_vehicle: FloatArray, stamp_s: float) -> Look:
        cam_from_map = site.port.cam_from_vehicle[camera] @ np.linalg.inv(map_from_vehicle)
        shown = detect(paint, site.port.cameras[camera].info, cam_from_map, rng)
        return Look(camera, stamp_s, shown.markings)

    return see


def rough(truck: Truck, rng: np.random.Generator) -> Prior:
    """Where a truck is, within 5 m and 20 deg."""
    angle, radius_m = rng.uniform(0, 2 * np.pi), _ROUGH_M * np.sqrt(rng.random())
    x, y = truck.place_map + radius_m * np.array([np.cos(angle), np.sin(angle)])
    heading = truck.heading_rad + rng.uniform(-_ROUGH_RAD, _ROUGH_RAD)
    return rough_position(float(x), float(y), float(np.degrees(heading)))


@dataclass
class _Drive:
    """A truck on its way, and who steers it."""

    truck: Truck
    follower: Follower  # of the localiser's poses
    driver: Follower  # of what a person sees
    steer_rad: float = 0.0
    speed_m_s: float = 0.0
    is_by_hand: bool = True
    stops: int = 0
    by_hand_m: float = 0.0
    km: float = 0.0

    def steer(self, pose: Pose, odometry: Motion) -> None:
        """Choose the next step's steering and speed."""
        is_sure = pose.status == Status.TRACKING and pose.map_from_vehicle is not None
        self.stops += not is_sure and not self.is_by_hand and self.speed_m_s > 0
        if is_sure and pose.map_from_vehicle is not None:
            self.is_by_hand = False
            heading = float(heading_rad(pose.map_from_vehicle))
            place = pose.map_from_vehicle[:2, 3]
            self.steer_rad = self.follower.steer(place, heading, odometry.speed_m_s)
            self.speed_m_s = SPEED_M_S
            return
        self.is_by_hand |= self.truck.speed_m_s < _AT_REST_M_S
        self.speed_m_s = _BY_HAND_M_S * self.is_by_hand
        if self.is_by_hand:
            place, heading = self.truck.place_map, self.truck.heading_rad
            self.steer_rad = self.driver.steer(place, heading, self.truck.speed_m_s)
            self.follower.station_m = self.driver.station_m


def lap(
    site: Site, see: See, hd_map: HDMap, calibrations: dict[str, Calibration], rng: np.random.Generator,
    most_m: float = np.inf,
) -> Lap:  # fmt: skip
    """Drive along a site's path once, or so far."""
    at = int(np.searchsorted(site.path.station_m, _MARGIN_M))
    truck = Truck(rng, site.path.points_map[at].copy(), float(site.path.yaw_rad[at]))
    localizer = Localizer(hd_map, calibrations, rough(truck, rng))
    drive = _Drive(truck, Follower(site.path, _MARGIN_M), Follower(site.path, _MARGIN_M))
    last_m = min(site.path.length_m - _MARGIN_M, _MARGIN_M + most_m)
    coming: list[tuple[float, Look]] = []
    rows = []
    step = 0
    while drive.follower.station_m < last_m and truck.stamp_s < _LONGEST_S:
        step += 1
        truck.step(drive.steer_rad, drive.speed_m_s)
        if step % _IMAGE_STEPS == 0:
            true = truck.map_from_vehicle
            coming += [(truck.stamp_s + _LATE_S, see(name, true, truck.stamp_s)) for name in calibrations]
        looks = [look for due_s, look in coming if due_s <= truck.stamp_s]
        coming = [(due_s, look) for due_s, look in coming if due_s > truck.stamp_s]
        odometry = truck.odometry()
        pose = localizer.update(looks, [odometry])
        drive.steer(pose, odometry)
        way_m = truck.speed_m_s * STEP_S
        if drive.is_by_hand:
            drive.by_hand_m += way_m
            continue
        drive.km += way_m / 1000
        rows.append(_row(site, truck, pose.map_from_vehicle, drive.follower.station_m))
    table = np.array(rows).reshape(-1, 7)
    return Lap(
        table[:, 0], table[:, 1:4], table[:, 4], table[:, 5], table[:, 6], drive.stops, drive.by_hand_m,
        drive.km,
    )  # fmt: skip


def _row(site: Site, truck: Truck, located: FloatArray | None, about_m: float) -> list[float]:
    """A row of :class:`Lap`."""
    foot = site.path.foot(truck.place_map, truck.heading_rad, about_m)
    near = site.borders.data[site.borders.query_ball_point(truck.place_map, _NEAR_M)]
    room_m = clearance_m(truck, near) - site.half_width_m
    off = np.full(2, np.nan) if located is None else located[:2, 3] - truck.place_map
    aside_m = off[1] * np.cos(truck.heading_rad) - off[0] * np.sin(truck.heading_rad)
    return [truck.stamp_s, *truck.place_map, truck.heading_rad, foot.left_m, room_m, float(aside_m)]


def line(laps: list[Lap]) -> str:
    """The figures of laps as one line."""
    left_cm = 100 * np.concatenate([part.left_m for part in laps])
    error_cm = 100 * np.concatenate([part.error_m for part in laps])
    room_m = min(float(part.clearance_m.min(initial=np.inf)) for part in laps)
    return (
        f"{sum(part.km for part in laps):.2f} km, from the planned path {np.abs(left_cm).max():.1f} cm at most, "
        f"{np.sqrt((left_cm**2).mean()):.1f} cm RMS (localiser {np.sqrt(np.nanmean(error_cm**2)):.1f} across), "
        f"lane borders touched {sum(part.collisions for part in laps)} times, nearest {100 * room_m:.0f} cm, "
        f"stops {sum(part.stops for part in laps)}, by hand at first {max(part.by_hand_m for part in laps):.1f} m "
        "at most"
    )


def planned_line(site: Site) -> str:
    """How near a truck would come to the borders that follows its path to the millimetre."""
    rooms_m = []
    for place, yaw_rad in zip(site.path.points_map[30:-30:2], site.path.yaw_rad[30:-30:2], strict=True):
        truck = Truck(np.random.default_rng(0), place, float(yaw_rad))
        near = site.borders.data[site.borders.query_ball_point(place, _NEAR_M)]
        rooms_m.append(clearance_m(truck, near) - site.half_width_m)
    return f"the planned path itself: {site.path.length_m:.0f} m, nearest {100 * min(rooms_m):.0f} cm"


def main() -> None:
    """Print the figures of both ports."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--km", type=float, default=5.0, help="of all together")
    parser.add_argument("--picture", type=Path, help="file for the picture of docs/live.md")
    parser.add_argument("--rendered", type=float, metavar="METRES", help="of each port, on rendered images")
    parsed = parser.parse_args()
    least_km = parsed.km / parsed.seeds / len(PORTS)
    laps: list[Lap] = []
    for name in PORTS:
        for seed in range(parsed.first, parsed.first + parsed.seeds):
            site = site_of(name, seed)
            print(f"{name}, seed {seed}: {planned_line(site)}", flush=True)
            parts: list[Lap] = []
            while sum(part.km for part in parts) < least_km:
                begin_s = time.process_time()
                parts.append(_lap_of(site, name, seed, len(parts)))
                cpu_s = time.process_time() - begin_s
                print(f"  lap {len(parts)}: {line(parts[-1:])}, {cpu_s:.0f} s of CPU", flush=True)
            laps += parts
    print(f"all: {line(laps)}")


def _lap_of(site: Site, name: str, seed: int, number: int) -> Lap:
    """A lap with a map, calibrations and a truck of its own."""
    rng = np.random.default_rng([seed, _LAP, PORTS.index(name), number])
    true = site.port.hd_map
    hd_map = surveyed(true, np.zeros((len(true.markings), 4)), int(rng.integers(2**31)))
    lenses = {camera: item.info for camera, item in site.port.cameras.items()}
    calibrations = calibrated(lenses, site.port.cam_from_vehicle, rng)
    return lap(site, made_eyes(site, rng), hd_map, calibrations, rng)


if __name__ == "__main__":
    main()
