"""A port made from its configuration: scene, vehicle, drive, and one image of it at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, FloatArray, GeodeticOrigin, HdMap
from v2hdm.simulate.port.alter import Alteration, alter
from v2hdm.simulate.port.calibration import ManualCalibration, cam_from_vehicle, survey_camera
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.disturbance import DrivenPoses, drive_along
from v2hdm.simulate.port.layout import build_layout
from v2hdm.simulate.port.route import Route, build_route
from v2hdm.simulate.port.yard import MovingTruck, build_scene, moving_trucks
from v2hdm.simulate.render.optics import Motion, Optics
from v2hdm.simulate.render.renderer import Rendered, Renderer
from v2hdm.simulate.render.scene import Box

ORIGIN = GeodeticOrigin(latitude_deg=29.95, longitude_deg=122.05, altitude_m=12.0, epoch=2026.0)

# Independent random streams of one seed, so that a change to one part leaves the others alone.
_LAYOUT, _YARD, _TRUCKS, _POSES, _CALIBRATION, _IMAGES, _ALTERED = range(7)


@dataclass(frozen=True)
class Port:
    """Everything of a rendered drive but the pictures."""

    config: PortConfig
    route: Route
    renderer: Renderer
    trucks: tuple[MovingTruck, ...]
    hd_map: HdMap
    cameras: dict[str, Camera]
    cam_from_vehicle: dict[str, FloatArray]
    driven: DrivenPoses
    alterations: tuple[Alteration, ...] = ()

    def cam_from_map(self, camera: str, frame: int) -> FloatArray:
        """Where a camera (4 x 4) truly was at an image."""
        return np.asarray(self.cam_from_vehicle[camera] @ np.linalg.inv(self.driven.map_from_vehicle[frame]))

    def moving_boxes(self, frame: int) -> tuple[Box, ...]:
        """The moving trucks at the time of an image."""
        stamp = float(self.driven.stamp_s[frame])
        return tuple(box for truck in self.trucks for box in truck.boxes(self.route, stamp))

    def picture(self, camera: str, frame: int) -> Rendered:
        """Render an image and its labels: a function of the configuration, the camera and the frame alone."""
        number = sorted(self.cameras).index(camera)
        rng = np.random.default_rng([*_visit_seed(self.config, _IMAGES), number, frame])
        exposure, lens = self.config.exposure, self.config.cameras[camera]
        optics = Optics(
            psf_sigma_px=lens.psf_sigma_px,
            vignetting=lens.vignetting,
            mean_level=exposure.level * float(np.exp(rng.normal(0.0, exposure.level_sigma))),
            full_well_electrons=exposure.full_well_electrons,
            read_noise=exposure.read_noise,
        )
        return self.renderer.render(
            self.cameras[camera].info,
            self.cam_from_map(camera, frame),
            rng,
            optics,
            self._motion(camera, frame),
            self.moving_boxes(frame),
        )

    def jpeg(self, image_bgr: NDArray[np.uint8]) -> bytes:
        """The file that the vehicle would have recorded of a picture (H, W, 3)."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.exposure.jpeg_quality]
        encoded, data = cv2.imencode(".jpg", image_bgr, quality)
        if not encoded:
            raise DriveError(
                f"port '{self.config.name}': an image cannot be coded as JPEG; check the OpenCV installation"
            )
        return data.tobytes()

    def _motion(self, camera: str, frame: int) -> Motion:
        """The camera's motion on its way along the route, in its own frame."""
        stamp = self.driven.stamp_s[frame : frame + 1]
        speed = float(self.route.speed_at(stamp)[0])
        station = self.route.station_at(stamp)
        yaw_rate = speed * float(np.interp(station[0], self.route.station_m, self.route.curvature))
        extrinsic = self.cam_from_vehicle[camera]
        centre = camera_centre(extrinsic)
        turning = np.array([0.0, 0.0, yaw_rate])
        velocity = extrinsic[:3, :3] @ (np.array([speed, 0.0, 0.0]) + np.cross(turning, centre))
        return Motion(
            velocity_cam=_triple(velocity),
            angular_velocity_cam=_triple(extrinsic[:3, :3] @ turning),
            exposure_s=self.config.exposure.exposure_s,
        )


_SHORTEST_ROUTE_M = 25.0
"""What stands in the way does so at least 12 m from either end."""


def _visit_seed(config: PortConfig, part: int) -> list[int]:
    """The seed of a stream that is drawn anew at every visit."""
    return [config.seed, part, *([-1 % 2**32, config.visit] if config.visit else [])]


def surveyed_cameras(config: PortConfig) -> dict[str, tuple[Camera, ManualCalibration]]:
    """The cameras of a port as the mapper gets to know them, and the manual calibration of each.

    Raises:
        ConfigError: the points of the calibration cannot be used.
    """
    rng = np.random.default_rng([config.seed, _CALIBRATION])
    return {
        name: survey_camera(name, config.cameras[name], config.calibration, config.initial_ipm, rng)
        for name in sorted(config.cameras)
    }


def build_port(config: PortConfig) -> Port:
    """Build a port; equal configurations give equal ports.

    Raises:
        ConfigError: when values are out of range or contradict each other.
    """
    _check(config)

    def stream(part: int) -> np.random.Generator:
        return np.random.default_rng([config.seed, part])

    def anew(part: int) -> np.random.Generator:
        return np.random.default_rng(_visit_seed(config, part))

    route = build_route(config.route)
    if route.length_m < _SHORTEST_ROUTE_M:
        raise ConfigError(
            f"port '{config.name}', route.pieces: {route.length_m:g} m in all; "
            f"give {_SHORTEST_ROUTE_M:g} m or more"
        )
    layout = build_layout(config.paint, route, stream(_LAYOUT))
    layout, alterations = alter(layout, config.altered, config.paint, route, stream(_ALTERED))
    scene = build_scene(config.surface, config.yard, route, stream(_YARD), config.seed)
    cameras = {name: camera for name, (camera, _) in surveyed_cameras(config).items()}
    return Port(
        config=config,
        route=route,
        renderer=Renderer(
            replace(scene, paints=tuple(layout.paints)), (*PAINT_CLASSES, *config.paint.stencils)
        ),
        trucks=moving_trucks(config.yard, route, anew(_TRUCKS)),
        hd_map=layout.hd_map(ORIGIN),
        cameras=cameras,
        cam_from_vehicle={name: cam_from_vehicle(config.cameras[name].mount) for name in cameras},
        driven=drive_along(route, config.route, config.disturbance, anew(_POSES)),
        alterations=tuple(alterations),
    )


def _check(config: PortConfig) -> None:
    """Refuse what would fail far from its cause."""
    rules: list[tuple[Any, str]] = [
        (config.cameras, "cameras: none given; add at least one"),
        (
            config.initial_ipm in ("calibrated", "estimated"),
            "initial_ipm: choose 'calibrated' or 'estimated'",
        ),
        (config.visit >= 0, "visit: must be 0 or more"),
        (
            min(config.altered.moved, config.altered.removed, config.altered.added) >= 0,
            "altered: numbers must be 0 or more",
        ),
        (len(config.altered.moved_by_m) == 2, "altered.moved_by_m: give the least and the largest distance"),
        (config.route.pieces, "route.pieces: empty; give [length_m, turn_deg] pieces"),
        (
            all(len(p) == 2 and p[0] > 0 for p in config.route.pieces),
            "route.pieces: each is [length_m > 0, turn_deg]",
        ),
        (config.route.speed_mps > 0, "route.speed_mps: must be positive"),
        (config.route.image_spacing_m > 0, "route.image_spacing_m: must be positive"),
        (config.route.pose_rate_hz > 0, "route.pose_rate_hz: must be positive"),
        (len(config.surface.slab_m) == 2, "surface.slab_m: give length and width, or [0, 0]"),
        (0 <= config.surface.wet_fraction < 1, "surface.wet_fraction: must be within 0 and 1"),
        (config.paint.diamond_spacing_m > 1, "paint.diamond_spacing_m: must be more than 1 m"),
        (len(config.calibration.points_ahead_m) >= 4, "calibration.points_ahead_m: give at least 4 points"),
        (50 <= config.exposure.jpeg_quality <= 100, "exposure.jpeg_quality: must be within 50 and 100"),
    ]
    for name, stencil in config.paint.stencils.items():
        key = f"paint.stencils.{name}"
        rules += [
            (name not in PAINT_CLASSES, f"{key}: there is a class of this name; give another"),
            (stencil.spacing_m > 1, f"{key}.spacing_m: must be more than 1 m"),
            (
                stencil.shapes_m and all(map(_is_convex, stencil.shapes_m)),
                f"{key}.shapes_m: each is a convex polygon of three or more points [ahead, left] in m",
            ),
        ]
    for holds, message in rules:
        if not holds:
            raise ConfigError(f"port '{config.name}', {message}")


def _is_convex(shape: list[list[float]]) -> bool:
    """Whether points make up a convex polygon that turns one way and once around."""
    if len(shape) < 3 or any(len(point) != 2 for point in shape) or not np.isfinite(shape).all():
        return False
    side = np.roll(shape, -1, axis=0) - np.array(shape)
    following = np.roll(side, -1, axis=0)
    turn = np.arctan2(
        side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0], (side * following).sum(axis=1)
    )
    one_way = (turn > 0).all() or (turn < 0).all()
    return bool(one_way and np.isclose(abs(turn.sum()), 2 * np.pi))


def _triple(vector: FloatArray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
