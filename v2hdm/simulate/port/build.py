"""A port made from its configuration: scene, vehicle, manual calibration, drive, and single images."""

from __future__ import annotations

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
from v2hdm.records import Camera, CameraInfo, CentrePrior, FloatArray, GeodeticOrigin, HdMap
from v2hdm.simulate.port.config import (
    CalibrationConfig,
    CameraConfig,
    MountConfig,
    PortConfig,
    SurfaceConfig,
    YardConfig,
)
from v2hdm.simulate.port.paint import build_layout
from v2hdm.simulate.port.route import DrivenPoses, Route, build_relief, build_route, drive_along, stands
from v2hdm.simulate.render import scene as parts
from v2hdm.simulate.render.relief import Relief
from v2hdm.simulate.render.renderer import Motion, Optics, Rendered, Renderer
from v2hdm.simulate.render.scene import RECTANGLE, Bgr, Box, box_footprint, convex_hull, placed

_CONTAINER_M = (12.19, 2.44, 2.59)
_CONTAINER_COLOURS: tuple[Bgr, ...] = (
    (0.06, 0.07, 0.27), (0.30, 0.13, 0.04), (0.07, 0.20, 0.38), (0.11, 0.22, 0.08),
    (0.45, 0.46, 0.46), (0.04, 0.12, 0.33), (0.19, 0.17, 0.16), (0.27, 0.26, 0.05),
)  # fmt: skip
_RASTER_M = 0.05
_RASTER_BORDER_M = 18.0
_SUBPIXEL_BITS = 3


@dataclass(frozen=True)
class MovingTruck:
    """A truck that comes along the route from its far end, on the left of the vehicle's way."""

    start_m: float
    speed_mps: float
    offset_m: float
    colour: Bgr
    seed: int

    def boxes(self, route: Route, stamp_s: float) -> tuple[Box, ...]:
        """Its container and cab at a time, or nothing once it has left the route."""
        station = self.start_m - self.speed_mps * stamp_s
        if not 15.0 < station < route.length_m - 15.0:
            return ()
        centre, yaw = route.pose_at(station, self.offset_m)
        return _truck(centre, yaw + np.pi, self.colour, self.seed)


def _truck(centre_map: tuple[float, float], yaw_rad: float, colour: Bgr, seed: int) -> tuple[Box, ...]:
    """A container on a chassis with a cab before it, heading along ``yaw_rad``."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])

    def part(along: float, size: tuple[float, float, float], base: float, paint: Bgr, ribbed: bool) -> Box:
        x, y = np.array(centre_map) + along * ahead
        at: dict[str, Any] = {"centre_map": (float(x), float(y)), "yaw_rad": yaw_rad, "base_m": base}
        return Box(size_m=size, albedo_bgr=paint, corrugated=ribbed, seed=seed, **at)

    black: Bgr = (0.03, 0.03, 0.03)
    return (
        part(-1.2, (6.06, 2.44, 2.59), 1.2, colour, True),
        part(-1.2, (6.3, 0.9, 0.25), 0.95, black, False),
        part(-3.0, (2.4, 2.3, 0.95), 0.0, black, False),
        part(3.2, (1.9, 2.4, 2.6), 0.45, (0.55, 0.56, 0.57), False),
        part(3.2, (1.2, 2.3, 0.9), 0.0, black, False),
    )


def build_scene(
    surface: SurfaceConfig, yard: YardConfig, route: Route, rng: np.random.Generator, seed: int
) -> parts.Scene:
    """A port without its paint."""
    azimuth, elevation = np.deg2rad(yard.sun_azimuth_deg), np.deg2rad(yard.sun_elevation_deg)
    east, north = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)
    blue, green, red = (yard.sun_strength * channel for channel in parts.Light().sun_bgr)
    direction = (float(east), float(north), float(np.sin(elevation)))
    light = parts.Light(sun_direction_map=direction, sun_bgr=(blue, green, red))
    a, slab_m = surface.albedo, (surface.slab_m[0], surface.slab_m[1])
    ground = parts.Ground(
        albedo_bgr=(0.95 * a, a, 1.03 * a),
        texture=surface.texture,
        contrast=surface.contrast,
        stains=surface.stains,
        slab_m=slab_m if min(slab_m) > 0 else None,
        slab_yaw_rad=0.02,
        joint_width_m=surface.joint_width_m,
        wet_fraction=surface.wet_fraction,
        marks=_ground_marks(surface, route, rng),
        seed=seed,
    )
    return parts.Scene(
        ground=ground,
        boxes=(*_stacks(yard, route, rng), *_occluders(yard, route, rng)),
        shadows=tuple(_strips(yard, route, rng)),
        light=light,
        backdrop=parts.Backdrop(seed=seed, haze_m=yard.haze_m),
    )


def moving_trucks(yard: YardConfig, route: Route, rng: np.random.Generator) -> tuple[MovingTruck, ...]:
    """The trucks that the vehicle will meet, spread evenly over the drive."""
    trucks = []
    for k in range(yard.moving_trucks):
        speed = float(rng.uniform(3.0, 6.0))
        meeting_m = route.length_m * (k + rng.uniform(0.3, 0.9)) / yard.moving_trucks
        start = meeting_m * (1 + speed / route.speed_mps)
        colour, seed = _colour(rng), int(rng.integers(1 << 20))
        trucks.append(MovingTruck(float(start), speed, yard.moving_offset_m, colour, seed))
    return tuple(trucks)


def _colour(rng: np.random.Generator) -> Bgr:
    return _CONTAINER_COLOURS[int(rng.integers(len(_CONTAINER_COLOURS)))]


def _stacks(yard: YardConfig, route: Route, rng: np.random.Generator) -> list[Box]:
    """Rows of container stacks beside the route, wherever they keep clear of all of it."""
    boxes: list[Box] = []
    length, width, height = _CONTAINER_M
    for side in (-1.0, 1.0):
        for row in range(2):
            offset = side * (yard.stack_clearance_m + width / 2 + row * (width + 0.4) + rng.uniform(0, 1.5))
            for station in np.arange(4.0, route.length_m, length + 0.6):
                filled, tall = rng.random() < yard.stack_fill / (1 + row), int(rng.integers(1, 4))
                colours = rng.integers(len(_CONTAINER_COLOURS), size=3)
                centre, yaw = route.pose_at(station, offset)
                base = Box(centre_map=centre, size_m=_CONTAINER_M, yaw_rad=yaw)
                if not filled or not _keeps_clear(base, route, boxes, yard.stack_clearance_m - 0.5):
                    continue
                base = replace(base, corrugated=True)
                for level in range(tall):
                    colour, seed = _CONTAINER_COLOURS[int(colours[level])], int(station * 10) + level
                    boxes.append(replace(base, base_m=level * height, albedo_bgr=colour, seed=seed))
    return boxes


def _keeps_clear(box: Box, route: Route, others: list[Box], clearance_m: float) -> bool:
    corners = box_footprint(box)
    sides = np.roll(corners, -1, axis=0) - corners
    outline = np.vstack([corners + t * sides for t in (0.0, 0.25, 0.5, 0.75)])
    if float(route.distance_to(outline).min()) < clearance_m:
        return False
    reach = np.hypot(box.size_m[0], box.size_m[1]) / 2
    for other in others:
        gap = np.hypot(*(np.array(other.centre_map) - box.centre_map))
        along = abs(np.cos(other.yaw_rad - box.yaw_rad)) > 0.99
        if gap < (min(other.size_m[1], box.size_m[1]) if along else reach):
            return False
    return True


def _occluders(yard: YardConfig, route: Route, rng: np.random.Generator) -> list[Box]:
    """Parked trucks, barriers and lamp posts nearer to the route than the stacks."""
    boxes: list[Box] = []
    for _ in range(yard.parked_trucks):
        station, side = rng.uniform(12.0, route.length_m - 12.0), float(rng.choice([-1.0, 1.0]))
        centre, yaw = route.pose_at(station, side * rng.uniform(6.3, 7.4))
        boxes += _truck(centre, yaw, _colour(rng), int(rng.integers(1 << 20)))
    for count, size, offsets, colour in (
        (yard.barriers, (1.3, 0.5, 0.85), (2.6, 5.0), (0.5, 0.5, 0.5)),
        (yard.lamp_posts, (0.22, 0.22, 11.0), (5.9, 8.0), (0.3, 0.3, 0.3)),
    ):
        for _ in range(count):
            station, side = rng.uniform(8.0, route.length_m - 8.0), float(rng.choice([-1.0, 1.0]))
            centre, yaw = route.pose_at(station, side * rng.uniform(*offsets))
            yaw += rng.normal(0.0, 0.3)
            boxes.append(Box(centre_map=centre, size_m=size, yaw_rad=yaw, albedo_bgr=colour))
    return [box for box in boxes if float(route.distance_to(box_footprint(box)).min()) > 1.9]


def _strips(yard: YardConfig, route: Route, rng: np.random.Generator) -> list[parts.Shadow]:
    """Hard shadows of cranes, gantries and cables across the route."""
    strips = []
    for _ in range(yard.shadow_strips):
        centre, yaw = route.pose_at(rng.uniform(0.0, route.length_m), rng.uniform(-4.0, 4.0))
        yaw += rng.uniform(0.3, 2.8)
        axis = np.array([np.cos(yaw), np.sin(yaw)])
        across = np.array([-axis[1], axis[0]])
        length, width = rng.uniform(8.0, 30.0), rng.choice([0.15, 0.4, 0.9, 2.5])
        corners = RECTANGLE * (length / 2, width / 2)
        polygon = centre + corners[:, :1] * axis + corners[:, 1:] * across
        strips.append(parts.Shadow(polygon_map=polygon, softness_m=float(rng.uniform(0.03, 0.2))))
    return strips


def _ground_marks(surface: SurfaceConfig, route: Route, rng: np.random.Generator) -> parts.GroundMarks:
    """Tyre marks along the route, repaired patches and oil stains, as a raster of factors."""
    low = route.points_map.min(axis=0) - _RASTER_BORDER_M
    high = route.points_map.max(axis=0) + _RASTER_BORDER_M
    columns, rows = (int(n) for n in np.ceil((high - low) / _RASTER_M))
    dark = np.zeros((rows, columns), dtype=np.uint8)

    def pixels(points_map: FloatArray) -> NDArray[np.int32]:
        return np.asarray(np.round((points_map - low) / _RASTER_M * 2**_SUBPIXEL_BITS), dtype=np.int32)

    for _ in range(surface.patches):
        centre, yaw = route.pose_at(rng.uniform(0.0, route.length_m), rng.uniform(-5.0, 5.0))
        polygon = pixels(placed(RECTANGLE * rng.uniform(0.6, 3.0, 2), centre, yaw))
        cv2.fillPoly(dark, [polygon], int(rng.uniform(6, 26)), cv2.LINE_AA, _SUBPIXEL_BITS)
    for _ in range(surface.oil_stains):
        centre, _ = route.pose_at(rng.uniform(0.0, route.length_m), rng.normal(0.0, 3.5))
        x, y = pixels(np.array(centre)).tolist()
        axes, shade = (int(rng.uniform(6, 90)), int(rng.uniform(6, 60))), int(rng.uniform(15, 60))
        cv2.ellipse(dark, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA, 3)
    tracks = np.zeros_like(dark)
    for _ in range(int(40 * surface.tyre_marks)):
        start, length = rng.uniform(0.0, route.length_m), rng.gamma(2.0, 12.0)
        station = np.arange(start, min(start + length, route.length_m), 0.5)
        if len(station) < 2:
            continue
        drift = rng.normal(0.0, 1.2) + rng.normal(0.0, 0.02) * (station - start)
        shade, width = int(rng.uniform(8, 38)), int(rng.integers(4, 8))
        for wheel in (-0.9, 0.9):
            points = pixels(route.points_at(station, drift + wheel))
            cv2.polylines(tracks, [points], False, shade, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    soft = cv2.GaussianBlur(cv2.add(dark, tracks), (0, 0), 1.2)
    factor = np.asarray(np.clip(128 - soft.astype(np.int16), 40, 128), dtype=np.uint8)
    return parts.GroundMarks(factor=factor, origin_map=(float(low[0]), float(low[1])), resolution_m=_RASTER_M)


def camera_info(name: str, config: CameraConfig) -> CameraInfo:
    """The intrinsics of a configured camera."""
    focal = config.focal_px
    du, dv = config.principal_offset_px
    u, v = (config.width - 1) / 2 + du, (config.height - 1) / 2 + dv
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
    # Solved towards pixels, where the larger and equal errors are.
    pinhole_from_vehicle, _ = cv2.findHomography(surveyed, undistort_points(info, clicked_px), 0)
    if pinhole_from_vehicle is None:
        raise ConfigError("calibration.points_ahead_m: these points do not fix a homography; spread them out")
    ipm = np.linalg.inv(pinhole_from_vehicle)
    unit_ipm = np.asarray(ipm / np.linalg.norm(ipm))
    return unit_ipm, convex_hull(surveyed)


_IPMS = ("calibrated", "estimated")
ORIGIN = GeodeticOrigin(latitude_deg=29.95, longitude_deg=122.05, altitude_m=12.0, epoch=2026.0)

# Independent random streams of one seed, so that a change to one part leaves the others alone.
_LAYOUT, _YARD, _TRUCKS, _POSES, _CALIBRATION, _IMAGES = range(6)


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

    def cam_from_map(self, camera: str, frame: int) -> FloatArray:
        """Where a camera (4 x 4) truly was at an image."""
        return np.asarray(self.cam_from_vehicle[camera] @ np.linalg.inv(self.driven.map_from_vehicle[frame]))

    def moving_boxes(self, frame: int) -> tuple[Box, ...]:
        """The moving trucks at the time of an image."""
        stamp = float(self.driven.stamp_s[frame])
        boxes = [box for truck in self.trucks for box in truck.boxes(self.route, stamp)]
        return tuple(parts.standing(box, self.renderer.scene.relief) for box in boxes)

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
        info, pose = self.cameras[camera].info, self.cam_from_map(camera, frame)
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
        stamp, extrinsic = self.driven.stamp_s[frame : frame + 1], self.cam_from_vehicle[camera]
        speed, station = float(self.route.speed_at(stamp)[0]), self.route.station_at(stamp)
        yaw_rate = speed * float(np.interp(station[0], self.route.station_m, self.route.curvature))
        turning = np.array([0.0, 0.0, yaw_rate])
        moving = np.array([speed, 0.0, 0.0]) + np.cross(turning, camera_centre(extrinsic))
        velocity = extrinsic[:3, :3] @ moving
        (vx, vy, vz), (wx, wy, wz) = velocity.tolist(), (extrinsic[:3, :3] @ turning).tolist()
        exposure_s = self.config.exposure.exposure_s
        return Motion(velocity_cam=(vx, vy, vz), angular_velocity_cam=(wx, wy, wz), exposure_s=exposure_s)


_SHORTEST_ROUTE_M = 25.0  # what stands in the way does so at least 12 m from either end


def _visit_seed(config: PortConfig, part: int) -> list[int]:
    """The seed of a stream that is drawn anew at every visit."""
    return [config.seed, part, *([-1 % 2**32, config.visit] if config.visit else [])]


def _surveyed_cameras(config: PortConfig) -> dict[str, Camera]:
    """A port's cameras as the mapper knows them: IPMs, a region, a surveyed centre. Raises ConfigError."""
    rng = np.random.default_rng([config.seed, _CALIBRATION])
    sigma, surveyed = np.full(3, config.calibration.centre_sigma_m), {}
    for name, camera in sorted(config.cameras.items()):
        info, mount = camera_info(name, camera), camera.mount
        own, own_roi = calibrate(info, mount, config.calibration, rng)
        borrowed, borrowed_roi = calibrate(info, camera.borrowed_mount, config.calibration, rng)
        prior = CentrePrior(np.array([mount.x_m, mount.y_m, mount.z_m]) + rng.normal(0.0, sigma), sigma)
        roi_vehicle = own_roi if config.initial_ipm == "calibrated" else borrowed_roi
        ipm = {"calibrated": own, "estimated": borrowed}
        surveyed[name] = Camera(info, ipm, config.initial_ipm, roi_vehicle, prior)
    return surveyed


def build_port(config: PortConfig) -> Port:
    """Build a port; equal configurations give equal ports, values that contradict each other ConfigError."""
    _check(config)
    streams = {part: np.random.default_rng([config.seed, part]) for part in (_LAYOUT, _YARD)}
    anew = {part: np.random.default_rng(_visit_seed(config, part)) for part in (_TRUCKS, _POSES)}
    route = build_route(config.route)
    if route.length_m < _SHORTEST_ROUTE_M:
        problem = f"{route.length_m:g} m in total; give {_SHORTEST_ROUTE_M:g} m or more"
        raise ConfigError(f"port '{config.name}', route.pieces: {problem}")
    layout = build_layout(config.paint, route, streams[_LAYOUT])
    scene = build_scene(config.surface, config.yard, route, streams[_YARD], config.seed)
    relief = build_relief(config.relief, route)
    boxes = tuple(parts.standing(box, relief) for box in scene.boxes)
    scene = replace(scene, paints=tuple(layout.paints), boxes=boxes, relief=relief)
    cameras, classes = _surveyed_cameras(config), (*PAINT_CLASSES, *config.paint.stencils)
    return Port(
        config=config,
        route=route,
        renderer=Renderer(scene, classes),
        trucks=moving_trucks(config.yard, route, anew[_TRUCKS]),
        hd_map=_raised(layout.hd_map(ORIGIN), relief),
        cameras=cameras,
        cam_from_vehicle={name: cam_from_vehicle(config.cameras[name].mount) for name in cameras},
        driven=drive_along(
            route, config.route, config.disturbance, anew[_POSES], partial(stands, relief) if relief else None
        ),
    )


def _raised(hd_map: HdMap, relief: Relief | None) -> HdMap:
    """The map with the heights of its ground."""
    if relief is None:
        return hd_map
    markings = (replace(one, heights_m=relief.height_m(one.corners_map)) for one in hd_map.markings)
    lanes = (replace(one, heights_m=relief.height_m(one.points_map)) for one in hd_map.lanes)
    return replace(hd_map, markings=tuple(markings), lanes=tuple(lanes))


def _check(config: PortConfig) -> None:
    """Refuse what would fail far from its cause."""
    route, pieces = config.route, config.route.pieces
    rules: list[tuple[Any, str]] = [
        (config.cameras, "cameras: none given; add at least one"),
        (config.initial_ipm in _IPMS, "initial_ipm: choose 'calibrated' or 'estimated'"),
        (config.visit >= 0, "visit: must be 0 or more"),
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
