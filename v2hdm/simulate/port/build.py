"""A port made from its configuration: cameras and their manual calibration, drive, and single images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import ConfigError, DriveError
from v2hdm.geometry.ipm import cam_from_mounting, project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.planar import winding
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, CameraFrames, CameraInfo, CentrePrior, FloatArray, GeodeticOrigin, HDMap
from v2hdm.simulate.port.config import CalibrationConfig, CameraConfig, MountConfig, PortConfig, SignsConfig
from v2hdm.simulate.port.paint import build_layout
from v2hdm.simulate.port.route import DrivenPoses, Route, build_relief, build_route, drive_along, stands
from v2hdm.simulate.port.scene import MovingTruck, build_scene, moving_trucks
from v2hdm.simulate.port.signs import add_signs
from v2hdm.simulate.render.letters import LETTERS
from v2hdm.simulate.render.relief import Relief
from v2hdm.simulate.render.renderer import Motion, Optics, Rendered, Renderer
from v2hdm.simulate.render.scene import Box, box_footprint, convex_hull, standing


def camera_info(name: str, config: CameraConfig) -> CameraInfo:
    """The intrinsics of a configured camera."""
    focal = config.focal_px
    du, dv = config.principal_offset_px
    u = (config.width - 1) / 2 + du
    v = (config.height - 1) / 2 + dv
    intrinsic = np.array([[focal, 0.0, u], [0.0, focal, v], [0.0, 0.0, 1.0]])
    distortion = tuple(float(d) for d in config.distortion)
    return CameraInfo(name, config.width, config.height, intrinsic, "plumb_bob", distortion)


def cam_from_vehicle(mount: MountConfig) -> FloatArray:
    """The extrinsic (4 x 4) of a mount: the camera looks along x, then turns by yaw, pitch and roll."""
    angles_rad = np.deg2rad([mount.roll_deg, mount.pitch_deg, mount.yaw_deg])
    return cam_from_mounting(np.array([mount.x_m, mount.y_m, mount.z_m]), angles_rad)


def calibrate(
    info: CameraInfo, mount: MountConfig, config: CalibrationConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Calibrate a camera by hand: survey points on the ground, click them in the image, solve.

    Returns ``vehicle_from_pinhole_px`` (3, 3) and its region (M, 2), the hull of the points, m. Raises
    ConfigError when a point lies outside the image, or the points do not determine a homography.
    """
    yaw = np.deg2rad(mount.yaw_deg)
    ahead, left = np.array(config.points_ahead_m, dtype=np.float64).T
    x = mount.x_m + ahead * np.cos(yaw) - left * np.sin(yaw)
    points = np.column_stack([x, mount.y_m + ahead * np.sin(yaw) + left * np.cos(yaw)])
    pinhole_px, _ = project_ground(info.intrinsic, cam_from_vehicle(mount), points)
    clicked_px = distort_points(info, pinhole_px)
    clicked_px = clicked_px + rng.normal(0.0, config.click_sigma_px, points.shape)
    surveyed = points + rng.normal(0.0, config.survey_sigma_m, points.shape)
    outside = (clicked_px < 0).any(axis=1) | (clicked_px > (info.width - 1, info.height - 1)).any(axis=1)
    if outside.any():
        first_ahead, first_left = config.points_ahead_m[int(np.argmax(outside))]
        problem = f"[{first_ahead:g}, {first_left:g}] is outside camera '{info.name}'"
        raise ConfigError(f"calibration.points_ahead_m: {problem}; move it or the mount")
    # Minimises errors in pixels: clicks err by more than the survey, and all alike.
    pinhole_from_vehicle, _ = cv2.findHomography(surveyed, undistort_points(info, clicked_px), 0)
    if pinhole_from_vehicle is None:
        raise ConfigError("calibration.points_ahead_m: these points do not fix a homography; spread them out")
    ipm = np.linalg.inv(pinhole_from_vehicle)
    unit_ipm = np.asarray(ipm / np.linalg.norm(ipm))
    return unit_ipm, convex_hull(surveyed)


_IPMS = ("calibrated", "estimated")

# The ports' place on the earth: chosen, on the coast of China; the epoch is that of the coordinates.
ORIGIN = GeodeticOrigin(latitude_deg=29.95, longitude_deg=122.05, altitude_m=12.0, epoch=2026.0)

# Independent random streams of one seed, so that a change to one part leaves the others alone.
_LAYOUT, _YARD, _TRUCKS, _POSES, _CALIBRATION, _IMAGES, _SIGNS = range(7)


@dataclass(frozen=True)
class Port:
    """A rendered drive without its pictures."""

    config: PortConfig
    route: Route
    renderer: Renderer
    trucks: tuple[MovingTruck, ...]
    hd_map: HDMap
    texts: Mapping[int, str]  # what the map's symbols say, by their number
    cameras: dict[str, Camera]
    cam_from_vehicle: dict[str, FloatArray]
    driven: DrivenPoses

    def cam_from_map(self, camera: str, frame: int) -> FloatArray:
        """The true pose ``cam_from_map`` (4, 4) of a camera at an image."""
        return np.asarray(self.cam_from_vehicle[camera] @ np.linalg.inv(self.driven.map_from_vehicle[frame]))

    def moving_boxes(self, frame: int) -> tuple[Box, ...]:
        """The moving trucks at the time of an image."""
        stamp = float(self.driven.stamp_s[frame])
        boxes = [box for truck in self.trucks for box in truck.boxes(self.route, stamp)]
        return tuple(standing(box, self.renderer.scene.relief) for box in boxes)

    def picture(self, camera: str, frame: int) -> Rendered:
        """Render an image and its labels: a function of the configuration, the camera and the frame alone."""
        number = sorted(self.cameras).index(camera)
        rng = np.random.default_rng([*_session_seed(self.config, _IMAGES), number, frame])
        exposure = self.config.exposure
        lens = self.config.cameras[camera]
        optics = Optics(
            psf_sigma_px=lens.psf_sigma_px,
            vignetting=lens.vignetting,
            mean_level=exposure.level * float(np.exp(rng.normal(0.0, exposure.level_sigma))),
            full_well_electrons=exposure.full_well_electrons,
            read_noise=exposure.read_noise,
        )
        info = self.cameras[camera].info
        pose = self.cam_from_map(camera, frame)
        boxes = self.moving_boxes(frame)
        return self.renderer.render(info, pose, rng, optics, self._motion(camera, frame), boxes)

    def jpeg(self, image_bgr: NDArray[np.uint8]) -> bytes:
        """The file that the vehicle would have recorded of a picture (H, W, 3)."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.exposure.jpeg_quality]
        encoded, data = cv2.imencode(".jpg", image_bgr, quality)
        if not encoded:
            raise DriveError(
                f"port '{self.config.name}': an image cannot be stored as JPEG; check the OpenCV installation"
            )
        return data.tobytes()

    def _motion(self, camera: str, frame: int) -> Motion:
        """The camera's motion on its way along the route, in its own frame."""
        stamp = self.driven.stamp_s[frame : frame + 1]
        extrinsic = self.cam_from_vehicle[camera]
        speed = float(self.route.speed_at(stamp)[0])
        station = self.route.station_at(stamp)
        yaw_rate = speed * float(np.interp(station[0], self.route.station_m, self.route.curvature))
        turning = np.array([0.0, 0.0, yaw_rate])
        moving = np.array([speed, 0.0, 0.0]) + np.cross(turning, camera_centre(extrinsic))
        velocity = extrinsic[:3, :3] @ moving
        (vx, vy, vz) = velocity.tolist()
        (wx, wy, wz) = (extrinsic[:3, :3] @ turning).tolist()
        exposure_s = self.config.exposure.exposure_s
        return Motion(velocity_cam=(vx, vy, vz), angular_velocity_cam=(wx, wy, wz), exposure_s=exposure_s)


_SHORTEST_ROUTE_M = 25.0  # least length of a route: obstacles keep 12 m from either end


def _session_seed(config: PortConfig, part: int) -> list[int]:
    """Seed of a random stream that differs from session to session."""
    return [config.seed, part, *([-1 % 2**32, config.session] if config.session else [])]


def surveyed_cameras(config: PortConfig) -> dict[str, Camera]:
    """A port's cameras as the mapper knows them: IPMs, a region, a surveyed centre. Raises ConfigError."""
    rng = np.random.default_rng([config.seed, _CALIBRATION])
    sigma = np.full(3, config.calibration.centre_sigma_m)
    surveyed = {}
    for name, camera in sorted(config.cameras.items()):
        info = camera_info(name, camera)
        mount = camera.mount
        calibrated, calibrated_roi = calibrate(info, mount, config.calibration, rng)
        borrowed, borrowed_roi = calibrate(info, camera.borrowed_mount, config.calibration, rng)
        prior = CentrePrior(np.array([mount.x_m, mount.y_m, mount.z_m]) + rng.normal(0.0, sigma), sigma)
        roi_vehicle = calibrated_roi if config.initial_ipm == "calibrated" else borrowed_roi
        ipm = {"calibrated": calibrated, "estimated": borrowed}
        surveyed[name] = Camera(
            info, ipm, config.initial_ipm, roi_vehicle, prior,
            frames=CameraFrames("base_link", f"{name}_optical_frame"),
        )  # fmt: skip
    return surveyed


def build_port(config: PortConfig) -> Port:
    """Build a port, the same from the same configuration; raises ConfigError for contradicting values."""
    _check(config)
    streams = {part: np.random.default_rng([config.seed, part]) for part in (_LAYOUT, _YARD)}
    anew = {part: np.random.default_rng(_session_seed(config, part)) for part in (_TRUCKS, _POSES)}
    route = build_route(config.route)
    if route.length_m < _SHORTEST_ROUTE_M:
        problem = f"{route.length_m:g} m in total; give {_SHORTEST_ROUTE_M:g} m or more"
        raise ConfigError(f"port '{config.name}', route.pieces: {problem}")
    layout = build_layout(config.paint, route, streams[_LAYOUT])
    scene = build_scene(config.surface, config.yard, route, streams[_YARD], config.seed)
    relief = build_relief(config.relief, route)
    boxes = tuple(standing(box, relief) for box in scene.boxes)
    if config.paint.signs != SignsConfig():
        footprints = [box_footprint(box) for box in boxes]
        add_signs(layout, config.paint, route, footprints, np.random.default_rng([config.seed, _SIGNS]))
    scene = replace(scene, paints=tuple(layout.paints), boxes=boxes, relief=relief)
    cameras = surveyed_cameras(config)
    classes = (*PAINT_CLASSES, *config.paint.stencils)
    return Port(
        config=config,
        route=route,
        renderer=Renderer(scene, classes),
        trucks=moving_trucks(config.yard, route, anew[_TRUCKS]),
        hd_map=_raised(layout.hd_map(ORIGIN), relief),
        texts=layout.texts,
        cameras=cameras,
        cam_from_vehicle={name: cam_from_vehicle(config.cameras[name].mount) for name in cameras},
        driven=drive_along(
            route, config.route, config.disturbance, anew[_POSES], partial(stands, relief) if relief else None
        ),
    )


def _raised(hd_map: HDMap, relief: Relief | None) -> HDMap:
    """The map with the heights of its ground."""
    if relief is None:
        return hd_map
    markings = (
        replace(marking, heights_m=relief.height_m(marking.corners_map)) for marking in hd_map.markings
    )
    lanes = (replace(lane, heights_m=relief.height_m(lane.points_map)) for lane in hd_map.lanes)
    symbols = (replace(symbol, heights_m=relief.height_m(symbol.outline_map)) for symbol in hd_map.symbols)
    return replace(hd_map, markings=tuple(markings), lanes=tuple(lanes), symbols=tuple(symbols))


def _check(config: PortConfig) -> None:
    """Refuse values that would fail far from their cause; raises ConfigError."""
    route = config.route
    pieces = route.pieces
    rules: list[tuple[Any, str]] = [
        (config.cameras, "cameras: none given; add at least one"),
        (config.initial_ipm in _IPMS, "initial_ipm: choose 'calibrated' or 'estimated'"),
        (config.session >= 0, "session: must be 0 or more"),
        (pieces, "route.pieces: empty; give [length_m, turn_deg] pieces"),
        (all(len(p) == 2 and p[0] > 0 for p in pieces), "route.pieces: each is [length_m > 0, turn_deg]"),
        (route.speed_mps > 0, "route.speed_mps: must be positive"),
        (route.image_spacing_m > 0, "route.image_spacing_m: must be positive"),
        (route.pose_rate_hz > 0, "route.pose_rate_hz: must be positive"),
        (len(config.surface.slab_m) == 2, "surface.slab_m: give length and width, or [0, 0]"),
        (0 <= config.surface.wet_fraction < 1, "surface.wet_fraction: must be within 0 and 1"),
        (config.paint.diamond_spacing_m > 1, "paint.diamond_spacing_m: must be more than 1 m"),
        (len(config.calibration.points_ahead_m) >= 4, "calibration.points_ahead_m: give at least 4 points"),
        (50 <= config.exposure.jpeg_quality <= 100, "exposure.jpeg_quality: must be within 50 and 100"),
    ]
    for text in config.paint.signs.words:
        unknown = "".join(sorted(set(text) - {*LETTERS, " "})) or ("" if text.split() else "nothing")
        rules.append((not unknown, f"paint.signs.words: '{text}' has {unknown}; use A to Z, 0 to 9 and -"))
    for name, stencil in config.paint.stencils.items():
        key = f"paint.stencils.{name}"
        rules += [
            (name not in PAINT_CLASSES, f"{key}: a class of this name exists; choose another"),
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
    points = len(shape) >= 3 and all(len(point) == 2 for point in shape) and np.isfinite(shape).all()
    return bool(points and winding(np.array(shape)))
