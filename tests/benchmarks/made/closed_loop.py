"""A van that drives through a port by the localiser's pose alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tests.benchmarks.made.follower import Follower, PlannedPath
from tests.benchmarks.made.live import port_config
from tests.benchmarks.made.van import STEP_S, Van, clearance_m
from v2hdm.detection.camera import camera_from_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.road import RoadDetector
from v2hdm.geometry.rigid import camera_centre, heading_rad, inverse
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import Motion
from v2hdm.localization.places import Prior, rough_position
from v2hdm.localization.pose import Pose, Status
from v2hdm.localization.seeing import Look
from v2hdm.records import Calibration, FloatArray, HDMap
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import SurveyConfig
from v2hdm.simulate.render.renderer import Motion as CameraMotion
from v2hdm.simulate.render.renderer import Optics
from v2hdm.simulate.render.scene import standing
from v2hdm.simulate.survey.sightings import Paint, detect

SPEED_M_S = 4.0
_IMAGE_STEPS = 5  # steps between two images: 10 Hz
_LATE_S = 0.12  # from an exposure until its detections are there, s
_ROUGH_M, _ROUGH_RAD = 5.0, np.deg2rad(20.0)
_MARGIN_M = 3.0  # of the path's ends, that are not driven
_BORDER_M = 0.02  # way between two points of a lane's border
_NEAR_M = 6.0  # way within which borders are looked at
_LONGEST_S = 400.0  # of a lap; a port's takes 100
_BY_HAND_M_S = 1.5  # speed at which a driver goes until the localiser is sure
_AT_REST_M_S = 0.05  # speed under which the van stands

See = Callable[[str, Van], Look]
"""The look of a camera on a van."""


@dataclass(frozen=True)
class Site:
    """A port with its planned path, and the lanes' borders (N, 2) with half their paint's width."""

    port: Port
    path: PlannedPath
    borders: cKDTree
    half_width_m: float


class Lap(NamedTuple):
    """A van's way by itself (F steps)."""

    stamp_s: FloatArray
    poses: FloatArray  # (F, 3) x, y and heading, truly
    left_m: FloatArray  # (F,) of the planned path
    clearance_m: FloatArray  # (F,) from lane borders
    error_m: FloatArray  # (F,) of the localiser's place, across the way
    located: FloatArray  # (F, 4, 4) the localiser's poses
    stops: int  # times that the localiser was not sure any more
    by_hand_m: float  # that a driver drove
    km: float  # of the F steps

    @property
    def collisions(self) -> int:
        """How often the van began to touch a border."""
        touches = self.clearance_m < 0
        return int((touches[1:] & ~touches[:-1]).sum() + touches[:1].sum())


def site_of(name: str, seed: int) -> Site:
    """A port of its own layout, recorded by its mapping drive."""
    config = port_config(name)
    port = build_port(replace(config, seed=config.seed + 100 * seed))
    path = PlannedPath.recorded(port.driven.recorded.map_from_vehicle[:, :2, 3])
    points = []
    for lane in port.hd_map.lanes:
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lane.points_map, axis=0), axis=1))])
        at_m = np.arange(0.0, way_m[-1], _BORDER_M)
        points.append(np.column_stack([np.interp(at_m, way_m, axis) for axis in lane.points_map.T]))
    return Site(port, path, cKDTree(np.concatenate(points)), 0.5 * config.paint.line_width_m)


def made_eyes(site: Site, rng: np.random.Generator) -> See:
    """Cameras whose detections have the statistics of the detector on renders."""
    paint = Paint.of(site.port.hd_map, SurveyConfig().correlation, rng)

    def see(camera: str, van: Van) -> Look:
        cam_from_map = site.port.cam_from_vehicle[camera] @ inverse(van.map_from_vehicle)
        shown = detect(paint, site.port.cameras[camera].info, cam_from_map, rng)
        return Look(camera, van.stamp_s, shown.markings)

    return see


def rendered_eyes(site: Site, calibrations: Mapping[str, Calibration], rng: np.random.Generator) -> See:
    """Cameras whose images are rendered, as JPEG, and the shipped detector."""
    detector = Detector.load()
    roads = {
        name: RoadDetector(detector, camera_from_calibration(calibration), calibration)
        for name, calibration in calibrations.items()
    }

    def see(camera: str, van: Van) -> Look:
        jpeg = site.port.jpeg(render(site, camera, van, rng))
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        road = roads[camera].detect(image)
        return Look.of(camera, van.stamp_s, road)

    return see


def render(site: Site, camera: str, van: Van, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image (H, W, 3) of a camera on a van, in motion and with its port's light and traffic."""
    config = site.port.config
    lens = config.cameras[camera]
    optics = Optics(
        psf_sigma_px=lens.psf_sigma_px,
        vignetting=lens.vignetting,
        mean_level=config.exposure.level * float(np.exp(rng.normal(0.0, config.exposure.level_sigma))),
        full_well_electrons=config.exposure.full_well_electrons,
        read_noise=config.exposure.read_noise,
    )
    extrinsic = site.port.cam_from_vehicle[camera]
    turning = np.array([0.0, 0.0, van.yaw_rate_rad_s])
    moving = np.array([van.speed_m_s, 0.0, 0.0]) + np.cross(turning, camera_centre(extrinsic))
    vx, vy, vz = (extrinsic[:3, :3] @ moving).tolist()
    wx, wy, wz = (extrinsic[:3, :3] @ turning).tolist()
    motion = CameraMotion(
        velocity_cam=(vx, vy, vz),
        angular_velocity_cam=(wx, wy, wz),
        exposure_s=config.exposure.exposure_s,
    )
    boxes = [box for oncoming in site.port.trucks for box in oncoming.boxes(site.port.route, van.stamp_s)]
    boxes = [standing(box, site.port.renderer.scene.relief) for box in boxes]
    info = site.port.cameras[camera].info
    cam_from_map = extrinsic @ inverse(van.map_from_vehicle)
    return site.port.renderer.render(info, cam_from_map, rng, optics, motion, tuple(boxes)).image


def rough(van: Van, rng: np.random.Generator) -> Prior:
    """Where a van is, within 5 m and 20 deg."""
    angle, radius_m = rng.uniform(0, 2 * np.pi), _ROUGH_M * np.sqrt(rng.random())
    x, y = van.place_map + radius_m * np.array([np.cos(angle), np.sin(angle)])
    heading = van.heading_rad + rng.uniform(-_ROUGH_RAD, _ROUGH_RAD)
    return rough_position(float(x), float(y), float(np.degrees(heading)))


@dataclass
class _Drive:
    """A van on its way, and who steers it."""

    van: Van
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
        self.is_by_hand |= self.van.speed_m_s < _AT_REST_M_S
        self.speed_m_s = _BY_HAND_M_S * self.is_by_hand
        if self.is_by_hand:
            place, heading = self.van.place_map, self.van.heading_rad
            self.steer_rad = self.driver.steer(place, heading, self.van.speed_m_s)
            self.follower.station_m = self.driver.station_m


def lap(
    site: Site, see: See, hd_map: HDMap, calibrations: Mapping[str, Calibration], rng: np.random.Generator,
    most_m: float = np.inf,
) -> Lap:  # fmt: skip
    """Drive along a site's path once, or so far."""
    at = int(np.searchsorted(site.path.station_m, _MARGIN_M))
    van = Van(rng, site.path.points_map[at].copy(), float(site.path.yaw_rad[at]))
    localizer = Localizer(hd_map, calibrations, rough(van, rng))
    drive = _Drive(van, Follower(site.path, _MARGIN_M), Follower(site.path, _MARGIN_M))
    last_m = min(site.path.length_m - _MARGIN_M, _MARGIN_M + most_m)
    coming: list[tuple[float, Look]] = []
    rows = []
    located = []
    step = 0
    while drive.follower.station_m < last_m and van.stamp_s < _LONGEST_S:
        step += 1
        van.step(drive.steer_rad, drive.speed_m_s)
        if step % _IMAGE_STEPS == 0:
            coming += [(van.stamp_s + _LATE_S, see(name, van)) for name in calibrations]
        looks = [look for due_s, look in coming if due_s <= van.stamp_s]
        coming = [(due_s, look) for due_s, look in coming if due_s > van.stamp_s]
        odometry = van.odometry()
        pose = localizer.update(looks, [odometry])
        drive.steer(pose, odometry)
        way_m = van.speed_m_s * STEP_S
        if drive.is_by_hand:
            drive.by_hand_m += way_m
            continue
        drive.km += way_m / 1000
        located.append(np.full((4, 4), np.nan) if pose.map_from_vehicle is None else pose.map_from_vehicle)
        rows.append(_row(site, van, located[-1], drive.follower.station_m))
    table = np.array(rows).reshape(-1, 7)
    return Lap(
        stamp_s=table[:, 0],
        poses=table[:, 1:4],
        left_m=table[:, 4],
        clearance_m=table[:, 5],
        error_m=table[:, 6],
        located=np.array(located).reshape(-1, 4, 4),
        stops=drive.stops,
        by_hand_m=drive.by_hand_m,
        km=drive.km,
    )


def room_m(site: Site, van: Van) -> float:
    """The way from a van's outline to the paint of the nearest border, m; negative where it touches one."""
    borders = site.borders.data[site.borders.query_ball_point(van.place_map, _NEAR_M)]
    return clearance_m(van, borders) - site.half_width_m


def _row(site: Site, van: Van, located: FloatArray, about_m: float) -> list[float]:
    """A row of :class:`Lap`."""
    foot = site.path.foot(van.place_map, van.heading_rad, about_m)
    off = located[:2, 3] - van.place_map
    aside_m = off[1] * np.cos(van.heading_rad) - off[0] * np.sin(van.heading_rad)
    return [
        van.stamp_s,
        *van.place_map,
        van.heading_rad,
        foot.left_m,
        room_m(site, van),
        float(aside_m),
    ]
