"""A port without its paint: ground and its wear, container stacks, occluders, shadows and moving trucks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.records import FloatArray
from v2hdm.simulate.port.config import SurfaceConfig, YardConfig
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.render import scene as parts
from v2hdm.simulate.render.scene import RECTANGLE, Bgr, Box, box_footprint, placed

_CONTAINER_M = (12.19, 2.44, 2.59)  # length, width and height of a container of 40 feet (ISO 668)
_CONTAINER_COLOURS: tuple[Bgr, ...] = (
    (0.06, 0.07, 0.27), (0.30, 0.13, 0.04), (0.07, 0.20, 0.38), (0.11, 0.22, 0.08),
    (0.45, 0.46, 0.46), (0.04, 0.12, 0.33), (0.19, 0.17, 0.16), (0.27, 0.26, 0.05),
)  # fmt: skip

_RASTER_M = 0.05  # side of an element of the ground marks' raster
_RASTER_BORDER_M = 18.0  # width of that raster beyond the route's extent
_SUBPIXEL_BITS = 3  # fractional bits of OpenCV's coordinates


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
    """Build the scene of a port without its paint."""
    azimuth = np.deg2rad(yard.sun_azimuth_deg)
    elevation = np.deg2rad(yard.sun_elevation_deg)
    east = np.cos(azimuth) * np.cos(elevation)
    north = np.sin(azimuth) * np.cos(elevation)
    blue, green, red = (yard.sun_strength * channel for channel in parts.Light().sun_bgr)
    direction = (float(east), float(north), float(np.sin(elevation)))
    light = parts.Light(sun_direction_map=direction, sun_bgr=(blue, green, red))
    a = surface.albedo
    slab_m = (surface.slab_m[0], surface.slab_m[1])
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
    """Trucks that the vehicle meets, spread evenly over the drive."""
    trucks = []
    for k in range(yard.moving_trucks):
        speed = float(rng.uniform(3.0, 6.0))
        meeting_m = route.length_m * (k + rng.uniform(0.3, 0.9)) / yard.moving_trucks
        start = meeting_m * (1 + speed / route.speed_mps)
        colour = _colour(rng)
        seed = int(rng.integers(1 << 20))
        trucks.append(MovingTruck(float(start), speed, yard.moving_offset_m, colour, seed))
    return tuple(trucks)


def _colour(rng: np.random.Generator) -> Bgr:
    return _CONTAINER_COLOURS[int(rng.integers(len(_CONTAINER_COLOURS)))]


def _stacks(yard: YardConfig, route: Route, rng: np.random.Generator) -> list[Box]:
    """Rows of container stacks beside the route, where they keep clear of all of it."""
    boxes: list[Box] = []
    length, width, height = _CONTAINER_M
    for side in (-1.0, 1.0):
        for row in range(2):
            offset = side * (yard.stack_clearance_m + width / 2 + row * (width + 0.4) + rng.uniform(0, 1.5))
            for station in np.arange(4.0, route.length_m, length + 0.6):
                filled = rng.random() < yard.stack_fill / (1 + row)
                tall = int(rng.integers(1, 4))
                colours = rng.integers(len(_CONTAINER_COLOURS), size=3)
                centre, yaw = route.pose_at(station, offset)
                base = Box(centre_map=centre, size_m=_CONTAINER_M, yaw_rad=yaw)
                if not filled or not _keeps_clear(base, route, boxes, yard.stack_clearance_m - 0.5):
                    continue
                base = replace(base, corrugated=True)
                for level in range(tall):
                    colour = _CONTAINER_COLOURS[int(colours[level])]
                    seed = int(station * 10) + level
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
        offset_map = np.array(other.centre_map) - box.centre_map
        gap = np.hypot(offset_map[0], offset_map[1])
        along = abs(np.cos(other.yaw_rad - box.yaw_rad)) > 0.99
        if gap < (min(other.size_m[1], box.size_m[1]) if along else reach):
            return False
    return True


def _occluders(yard: YardConfig, route: Route, rng: np.random.Generator) -> list[Box]:
    """Parked trucks, barriers and lamp posts nearer to the route than the stacks."""
    boxes: list[Box] = []
    for _ in range(yard.parked_trucks):
        station = rng.uniform(12.0, route.length_m - 12.0)
        side = float(rng.choice([-1.0, 1.0]))
        centre, yaw = route.pose_at(station, side * rng.uniform(6.3, 7.4))
        boxes += _truck(centre, yaw, _colour(rng), int(rng.integers(1 << 20)))
    for count, size, (nearest_m, farthest_m), colour in (
        (yard.barriers, (1.3, 0.5, 0.85), (2.6, 5.0), (0.5, 0.5, 0.5)),
        (yard.lamp_posts, (0.22, 0.22, 11.0), (5.9, 8.0), (0.3, 0.3, 0.3)),
    ):
        for _ in range(count):
            station = rng.uniform(8.0, route.length_m - 8.0)
            side = float(rng.choice([-1.0, 1.0]))
            centre, yaw = route.pose_at(station, side * rng.uniform(nearest_m, farthest_m))
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
        length = rng.uniform(8.0, 30.0)
        width = rng.choice([0.15, 0.4, 0.9, 2.5])
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
        axes = (int(rng.uniform(6, 90)), int(rng.uniform(6, 60)))
        shade = int(rng.uniform(15, 60))
        turn_deg = float(rng.uniform(0, 180))
        cv2.ellipse(dark, (x, y), axes, turn_deg, 0, 360, shade, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    tracks = np.zeros_like(dark)
    for _ in range(int(40 * surface.tyre_marks)):
        start = rng.uniform(0.0, route.length_m)
        length = rng.gamma(2.0, 12.0)
        station = np.arange(start, min(start + length, route.length_m), 0.5)
        if len(station) < 2:
            continue
        drift = rng.normal(0.0, 1.2) + rng.normal(0.0, 0.02) * (station - start)
        shade = int(rng.uniform(8, 38))
        width = int(rng.integers(4, 8))
        for wheel in (-0.9, 0.9):
            points = pixels(route.points_at(station, drift + wheel))
            cv2.polylines(tracks, [points], False, shade, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    soft = cv2.GaussianBlur(cv2.add(dark, tracks), (0, 0), 1.2)
    factor = np.asarray(np.clip(128 - soft.astype(np.int16), 40, 128), dtype=np.uint8)
    return parts.GroundMarks(factor=factor, origin_map=(float(low[0]), float(low[1])), resolution_m=_RASTER_M)
