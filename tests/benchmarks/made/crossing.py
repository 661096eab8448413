"""The site of ``examples/lanes`` as rendered drives: its lines as paint, seen by a camera on ten ways.

Lines are painted 15 cm wide, dashes of 3 m with gaps of 3 m, every stop line whole; diamonds lie amid the
lanes, as in a port. Ground, light and camera are those of the rendered port 1. No truth is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from examples.lanes.site import DRIVES, LINES, STOPS, even, rounded
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.geometry.planar import length_along, points_along
from v2hdm.io.description import DRIVE_FILE
from v2hdm.io.drive.writing import write_drive
from v2hdm.progress import Progress, silent
from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE, Drive, FloatArray, HDMap, Image
from v2hdm.simulate.port.build import ORIGIN, Port, cam_from_vehicle, surveyed_cameras
from v2hdm.simulate.port.config import PortConfig, SurfaceConfig, YardConfig
from v2hdm.simulate.port.route import Route, drive_along, pose_noise
from v2hdm.simulate.port.scene import build_scene
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Paint, Scene

_STEP_M = 0.05  # distance between the stations of a way, m, as of a port's route
_SMOOTH_M = 1.0  # standard deviation, m, of the Gaussian that eases a way into its arcs; chosen
_ARC_M = 9.0  # radius of the ways' arcs, m, as in the made site
_IMAGE_SPACING_M = 1.2  # way between two images, m; chosen: a rendered port has .9
_LINE_M = 0.15  # width of a line, m, as in a port
_DASH_M = 3.0  # length of a dash and of a gap, m, as in a port
_PIECE_M = 20.0  # longest piece of a line that is one polygon, m
_DIAMOND_M = 0.5 * np.array([[1.2, 0.0], [0.0, 0.6], [-1.2, 0.0], [0.0, -0.6]])  # port 1's, ahead and left
_DIAMOND_SPACING_M = 8.0  # way between two diamonds amid a lane, m; chosen
_DIAMOND_APART_M = 4.0  # least distance of two diamonds, m: ways share lanes; chosen
_WAYS, _POSES = 11, 12  # streams of a seed; a port's own are 0 to 9


def render_crossing(folder: Path, seed: int = 1, progress: Progress = silent) -> list[Path]:
    """Render the ten drives into ``folder``, one after the other; those that are there already stay."""
    config = _config(seed)
    ways = [_way(corners) for corners in DRIVES]
    renderer = Renderer(_scene(config, ways), PAINT_CLASSES)
    folders = []
    for number, way in enumerate(ways):
        drive_folder = folder / f"drive{number}"
        folders.append(drive_folder)
        progress("render", number, len(ways))
        if not (drive_folder / DRIVE_FILE).is_file():
            _render(replace(config, name=f"drive{number}", session=number), way, renderer, drive_folder)
    progress("render", len(ways), len(ways))
    return folders


def painted_lines(seed: int = 1) -> list[FloatArray]:
    """The corners (4, 2), m, of each dash and each piece of a line as rendered."""
    scene = _scene(_config(seed), [_way(corners) for corners in DRIVES])
    return [paint.polygon_map for paint in scene.paints if paint.kind in (LANE_LINE, LANE_DASH)]


def _config(seed: int) -> PortConfig:
    config = PortConfig(name="crossing", seed=seed)
    return replace(
        config,
        cameras={"front": config.cameras["front"]},
        route=replace(config.route, image_spacing_m=_IMAGE_SPACING_M),
        surface=replace(SurfaceConfig(), tyre_marks=0.0),
        yard=replace(
            YardConfig(), stack_fill=0.0, parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0
        ),
    )


def _way(corners: Sequence[tuple[float, float]]) -> Route:
    """The way of a drive around its corners."""
    points = even(rounded(np.array(corners, dtype=float), _ARC_M), _STEP_M)
    points = gaussian_filter1d(points, _SMOOTH_M / _STEP_M, axis=0, mode="nearest")
    station_m = length_along(points)
    ahead = np.gradient(points, axis=0)
    yaw_rad = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return Route(station_m, points, yaw_rad, np.gradient(yaw_rad, station_m), speed_mps=5.0)


def _scene(config: PortConfig, ways: Sequence[Route]) -> Scene:
    # Of the route that the ground is drawn along, only extent and points count.
    points = np.concatenate([way.points_map for way in ways])
    everywhere = Route(
        _STEP_M * np.arange(len(points)),
        points,
        np.concatenate([way.yaw_rad for way in ways]),
        np.concatenate([way.curvature for way in ways]),
        speed_mps=5.0,
    )
    rng = np.random.default_rng([config.seed, _WAYS])
    scene = build_scene(config.surface, config.yard, everywhere, rng, config.seed)
    return replace(scene, paints=(*_lines(rng), *_stop_lines(rng), *_diamonds(ways, rng)))


def _painted(kind: str, polygon_map: FloatArray, rng: np.random.Generator) -> Paint:
    """Paint as worn and dirty as in a port, on average."""
    wear, dirt = 0.14 * rng.gamma(2.0, 0.5), 0.2 * rng.gamma(2.0, 0.5)
    return Paint(
        kind=kind,
        polygon_map=polygon_map,
        wear=min(wear, 0.4),
        dirt=min(dirt, 0.7),
        seed=int(rng.integers(1 << 30)),
    )


def _lines(rng: np.random.Generator) -> list[Paint]:
    paints = []
    for kind, corners in LINES:
        line = np.array(corners, dtype=float)
        at_m = length_along(line)
        if kind == LANE_DASH:
            starts_m = np.arange(rng.uniform(0.0, _DASH_M), at_m[-1] - _DASH_M, 2 * _DASH_M)
            pieces = [(start_m, start_m + _DASH_M) for start_m in starts_m]
        else:
            ends_m = np.unique(np.concatenate([at_m, np.arange(0.0, at_m[-1], _PIECE_M)]))
            pieces = list(pairwise(ends_m))
        for begin_m, end_m in pieces:
            begin, end = points_along(line, np.array([begin_m, end_m]))
            paints.append(_painted(LANE_LINE if kind == LANE_LINE else LANE_DASH, _ribbon(begin, end), rng))
    return paints


def _ribbon(begin: FloatArray, end: FloatArray) -> FloatArray:
    """The corners (4, 2) of a straight piece of a line, counter-clockwise."""
    ahead = (end - begin) / np.linalg.norm(end - begin)
    left = 0.5 * _LINE_M * np.array([-ahead[1], ahead[0]])
    return np.array([begin - left, end - left, end + left, begin + left])


def _stop_lines(rng: np.random.Generator) -> list[Paint]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return [
        _painted(STOP_LINE, np.array(middle) + np.array(half) * corners, rng) for middle, half, _ in STOPS
    ]


def _diamonds(ways: Sequence[Route], rng: np.random.Generator) -> list[Paint]:
    paints: list[Paint] = []
    centres = [np.array(middle) for middle, _, _ in STOPS]
    for way in ways:
        for station_m in np.arange(_DIAMOND_SPACING_M / 2, way.length_m, _DIAMOND_SPACING_M):
            (x, y), yaw_rad = way.pose_at(float(station_m), float(rng.normal(0.0, 0.08)))
            if min(np.linalg.norm(np.array([x, y]) - centre) for centre in centres) < _DIAMOND_APART_M:
                continue
            centres.append(np.array([x, y]))
            turn = np.array([[np.cos(yaw_rad), np.sin(yaw_rad)], [-np.sin(yaw_rad), np.cos(yaw_rad)]])
            paints.append(_painted(DIAMOND, _DIAMOND_M @ turn + centres[-1], rng))
    return paints


def _render(config: PortConfig, way: Route, renderer: Renderer, folder: Path) -> None:
    cameras = surveyed_cameras(config)
    rng = np.random.default_rng([config.seed, _POSES, config.session])
    driven = drive_along(way, config.route, config.disturbance, rng)
    extrinsics = {name: cam_from_vehicle(config.cameras[name].mount) for name in cameras}
    port = Port(config, way, renderer, (), HDMap((), (), ORIGIN), {}, cameras, extrinsics, driven)
    images = []
    for frame, stamp_s in enumerate(driven.stamp_s.tolist()):
        for name in cameras:
            path = folder / name / "images" / f"{frame:06d}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.is_file():
                path.write_bytes(port.jpeg(port.picture(name, frame).image))
            images.append(Image(name, stamp_s, path, driven.map_from_vehicle[frame]))
    noise = pose_noise(config.disturbance, config.route.speed_mps)
    drive = Drive(config.name, folder, cameras, images, noise, ORIGIN)
    write_drive(folder, drive, driven.recorded)
