"""Random scenes for training the detector: ports, streets and bare ground in every light and state.

Nothing here is modelled on a particular place. Whatever may differ on a road or in a yard that nobody has
seen yet is drawn at random, far wider than the ports that :mod:`v2hdm.simulate` renders as drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from train.scenes.clutter import ground_marks, port_boxes, street_boxes
from train.scenes.hardships import (
    NONE,
    Hardships,
    bleached,
    blue_shade,
    clear_of,
    faint,
    gutters,
    kerbs,
    overexposed,
    shadows_on_paint,
    things_beside,
    tight_bend,
    with_joints,
    with_junction,
    with_pavements,
    with_seams,
    with_side_seams,
)
from train.scenes.paint import (
    Bend,
    Brush,
    Facing,
    RoadPaint,
    port_paint,
    random_brush,
    rectangle,
    street_paint,
)
from train.scenes.remains import litter, with_erased
from train.scenes.symbols import (
    with_bays,
    with_boxes,
    with_crossing,
    with_crosswalk,
    with_double,
    with_far_stop,
    with_give_way,
    with_hollow,
    with_other,
    with_sign,
    with_users,
    with_words,
)
from train.scenes.traffic import traffic
from train.scenes.views import TrainingView, mounted_otherwise, random_view, turned_aside
from train.scenes.weather import (
    Dapple,
    dusk,
    in_the_dark,
    low_sun,
    photo_tile,
    photographed,
    rain,
    sun_flecks,
)
from train.scenes.windscreen import before_lens
from v2hdm.catalogue import CORNERED_CLASSES, PAINT_CLASSES
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.records import SEEN_ACROSS, FloatArray
from v2hdm.simulate.render.renderer import Rendered, Renderer
from v2hdm.simulate.render.scene import Backdrop, Bgr, Box, Ground, GroundMarks, Light, Scene, Shadow

# The renderer keeps one tile per fleck size, so sizes come from a short list.
_NEAR_M = 0.3
_STEPS_BETWEEN = 5  # parts of each piece of a line that is projected through the lens
_LENS_TOLERANCE_PX = 1.0  # largest error of undistorting a point, px, whose place in the image is known
_TO_ONE_ASIDE = np.array(
    [0, *(1 + PAINT_CLASSES.index(SEEN_ACROSS.get(kind, kind)) for kind in PAINT_CLASSES)], dtype=np.uint8
)
"""By label, the answer for a camera on the vehicle's side: the detector knows how its cameras look, and turns
the names back, see :mod:`v2hdm.detection.network`."""

_FLECK_SIZES_M = tuple(float(s) for s in np.geomspace(0.12, 2.5, 10))  # sizes of flecks of sun, m


@dataclass(frozen=True)
class TrainingSample:
    """One rendered image with its labels.

    ``image`` (H, W, 3) uint8 BGR, ``labels`` (H, W) uint8 and ``hidden`` (H, W) bool are those of
    :class:`v2hdm.simulate.render.renderer.Rendered`. ``lanes_px`` are the centre lines (N, 2) of the lanes'
    lines in recorded pixels, from near to far, whatever stands in front of them; parts may be outside the
    image. ``unknown`` (H, W) bool is where nobody knows of paint, None where all is known.
    """

    image: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    hidden: NDArray[np.bool_]
    lanes_px: tuple[FloatArray, ...]
    unknown: NDArray[np.bool_] | None = None


def training_sample(
    seed: int,
    index: int,
    width: int,
    height: int,
    difficulty: float = 1.0,
    hardships: Hardships = NONE,
) -> TrainingSample:
    """Sample ``index`` of the endless, reproducible sequence that ``seed`` stands for.

    Where the camera looks aside, its labels exchange the stripes that it sees as each other, see
    :data:`v2hdm.records.SEEN_ACROSS`.

    Args:
        seed: Names the sequence; training and validation use different ones.
        index: Position in it.
        width: Image width, px.
        height: Image height, px.
        difficulty: 0 for fresh paint in plain light, 1 for everything at its worst now and then.
        hardships: What is added to the scene and done to its image.
    """
    rng = np.random.default_rng([seed, index])
    drawn = drawn_scene(rng, width, height, difficulty, hardships)
    rendered = drawn.rendered
    lines_px = (image_line(drawn.view, lane) for lane in drawn.lanes_map)
    lanes_px = tuple(lane for lane in lines_px if len(lane) > 1)
    labels = _TO_ONE_ASIDE[rendered.labels] if drawn.aside else rendered.labels
    return TrainingSample(rendered.image, labels, rendered.hidden, lanes_px)


@dataclass(frozen=True)
class DrawnScene:
    """A random scene, the lines (N, 2) of its lanes, a view of it and what that shows.

    The camera of an ``aside`` view looks to the side of the vehicle.
    """

    scene: Scene
    lanes_map: list[FloatArray]
    view: TrainingView
    aside: bool
    rendered: Rendered


def drawn_scene(
    rng: np.random.Generator, width: int, height: int, difficulty: float, hardships: Hardships
) -> DrawnScene:
    """A scene and a view of it by chance, rendered; arguments are those of :func:`training_sample`."""
    scene, lanes = random_scene(rng, difficulty, hardships)
    usual = random_view(rng, width, height)
    places = [paint.polygon_map.mean(axis=0) for paint in scene.paints if paint.kind in CORNERED_CLASSES]
    for_optics, for_view, for_mounting = rng.spawn(3)
    for_dark, for_weather, for_vehicle = for_mounting.spawn(3)
    ahead = mounted_otherwise(for_mounting, usual, hardships.mountings)
    view = turned_aside(for_view, ahead, places, hardships.aside)
    scene = _without_hidden_boxes(scene, view)
    optics = overexposed(for_optics, view.optics, scene.ground, hardships.overexposed)
    optics = in_the_dark(for_dark, optics, scene.light)
    before = before_lens(for_weather, for_vehicle, scene, hardships.own_vehicle)
    rendered = Renderer(scene).render(
        view.info, view.cam_from_map, rng, optics, view.motion, before_lens=before
    )
    return DrawnScene(scene, lanes, view, view is not ahead, rendered)


def image_points(view: TrainingView, points_map: FloatArray) -> FloatArray:
    """Recorded pixels (M, 2), in order, of the ground points (N, 2, map) in and about the image."""
    return _in_image(view, points_map)[0]


def image_line(view: TrainingView, line_map: FloatArray) -> FloatArray:
    """Recorded pixels (M, 2) of a line (N, 2, map), from near to far, as far as it is in and about the image.

    Its corners are half a metre apart, which may be half an image near the camera, so it is followed in
    shorter steps. Of a line that leaves and comes back it is the longest part.
    """
    corners = np.arange(len(line_map))
    steps = np.linspace(0, len(line_map) - 1, (len(line_map) - 1) * _STEPS_BETWEEN + 1)
    fine = np.column_stack([np.interp(steps, corners, line_map[:, axis]) for axis in (0, 1)])
    pixels, index = _in_image(view, fine)
    parts = np.split(pixels, np.flatnonzero(np.diff(index) > 1) + 1)
    return max(parts, key=len)


def _in_image(view: TrainingView, points_map: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Recorded pixels (M, 2) of the points (N, 2, map) in and about the image, and which they are."""
    pinhole, depth_m = project_ground(view.info.intrinsic, view.cam_from_map, points_map)
    index = np.flatnonzero(depth_m > _NEAR_M)
    pinhole = pinhole[index]
    pixels = distort_points(view.info, pinhole)
    reach = np.array([view.info.width, view.info.height])
    about = ((pixels > -0.5 * reach) & (pixels < 1.5 * reach)).all(axis=1)
    index = index[about]
    pinhole = pinhole[about]
    pixels = pixels[about]
    # Far outside the image the lens polynomial folds back into it.
    back = undistort_points(view.info, pixels)
    is_inverted = np.linalg.norm(back - pinhole, axis=1) < _LENS_TOLERANCE_PX
    return pixels[is_inverted], index[is_inverted]


def random_scene(
    rng: np.random.Generator, difficulty: float = 1.0, hardships: Hardships = NONE
) -> tuple[Scene, list[FloatArray]]:
    """A port (two in five), a street (half) or unpainted ground, seen from the map's origin along +x.

    Args:
        rng: Where chance comes from.
        difficulty: 0 for fresh paint in plain light, 1 for everything at its worst now and then.
        hardships: What is added to the scene, the rest of which stays the same.

    Returns:
        The scene, and the centre lines (N, 2, map) of its lanes' lines.
    """
    place = rng.choice(["port", "street", "bare"], p=[0.4, 0.5, 0.1])
    bend = Bend(float(rng.normal(0, 0.006)) if rng.random() < 0.4 else 0.0)
    for_shadows, for_ground, for_light, for_things, for_paint, for_bend, for_kerbs, for_junction = rng.spawn(
        8
    )
    # Streams of their own for what came later leave what was drawn before as it is.
    for_facing, for_symbols, for_remains, for_traffic, for_weather, for_grounds, for_signs, for_edges = (
        for_junction.spawn(8)
    )
    tight = tight_bend(for_bend, hardships.tight_bends)
    bend = tight or bend
    brush = random_brush(rng, difficulty)
    facing = Facing(for_facing, hardships.facing, hardships.stout)
    road, boxes = _road_and_boxes(rng, place, brush, bend, facing)
    junction = with_junction(for_junction, road, brush, bend, hardships.junctions)
    boxes = clear_of(boxes, junction.paints) if tight or junction is not road else boxes
    road = junction
    if place != "bare":
        road = _with_symbols(for_symbols, road, brush, bend, hardships)
        road = _with_signs(for_signs, road, brush, bend, hardships)
    ground = _ground(rng, place == "port", difficulty)
    shadows = _shadows(rng, difficulty)
    marks = _marked(for_ground, for_remains, ground.marks, road, hardships)
    marks = with_joints(for_edges, marks, road.lanes, hardships.joints)
    ground = photographed(for_grounds, bleached(for_ground, ground, hardships.bleached), hardships.grounds)
    dapples = _dapples(rng, difficulty)
    light = blue_shade(for_light, _light(rng), hardships.blue_shade)
    ground, light = _weathered(for_weather, ground, light, hardships)
    scene = Scene(
        ground=replace(ground, marks=marks),
        paints=faint(for_paint, road.paints, hardships.faint),
        boxes=(
            *boxes,
            *things_beside(for_things, road.paints, hardships.things_beside),
            *clear_of(kerbs(for_kerbs, road.lanes, hardships.kerbs), road.paints),
            *clear_of(gutters(for_edges, road.lanes, hardships.gutters), road.paints),
            *litter(for_remains, hardships.litter),
            *traffic(for_traffic, hardships.traffic),
        ),
        shadows=shadows + shadows_on_paint(for_shadows, road.paints, hardships.shadows_on_paint),
        shades=dapples + sun_flecks(for_weather, hardships.sun_flecks),
        light=light,
        backdrop=_backdrop(rng),
    )
    return scene, road.lanes


def _road_and_boxes(
    rng: np.random.Generator, place: str, brush: Brush, bend: Bend, facing: Facing
) -> tuple[RoadPaint, tuple[Box, ...]]:
    """The paint of a port, a street or bare ground, and the boxes that stand about it."""
    road_half_m = float(rng.uniform(2, 9))
    if place == "port":
        return port_paint(rng, brush, bend, facing), port_boxes(rng)
    if place == "street":
        return street_paint(rng, brush, bend, facing), street_boxes(rng, road_half_m)
    return RoadPaint(), street_boxes(rng, road_half_m) if rng.random() < 0.7 else port_boxes(rng)


def _with_symbols(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, hardships: Hardships
) -> RoadPaint:
    road = with_hollow(rng, road, brush, bend, hardships.hollow)
    road = with_words(rng, road, brush, bend, hardships.words)
    return with_crossing(rng, road, brush, bend, hardships.crossings)


def _with_signs(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, hardships: Hardships
) -> RoadPaint:
    # Each from a stream of its own: what one lays does not depend on the shares of the others.
    shares = (
        (with_double, hardships.doubles), (with_crosswalk, hardships.crosswalks),
        (with_far_stop, hardships.far_stops), (with_give_way, hardships.give_way),
        (with_boxes, hardships.boxes), (with_users, hardships.users), (with_bays, hardships.bays),
        (with_other, hardships.others),
    )  # fmt: skip
    for_sign, *streams = rng.spawn(1 + len(shares))
    for (lay, share), stream in zip(shares, streams, strict=True):
        road = lay(stream, road, brush, bend, share)
    return with_sign(for_sign, road, brush, bend)


def _marked(
    rng: np.random.Generator,
    for_remains: np.random.Generator,
    marks: GroundMarks | None,
    road: RoadPaint,
    hardships: Hardships,
) -> GroundMarks | None:
    """The marks of a ground with pavements, seams and remains of paint."""
    marks = with_pavements(rng, marks, road.lanes, hardships.pavements)
    marks = with_seams(rng, marks, road.lanes, hardships.seams)
    marks = with_side_seams(rng, marks, road.paints, hardships.side_seams)
    return with_erased(for_remains, marks, hardships.erased)


def _without_hidden_boxes(scene: Scene, view: TrainingView) -> Scene:
    """The scene less the boxes whose bounding sphere is outside the image: most of a street's, and costly."""
    if not scene.boxes:
        return scene
    size = np.array([box.size_m for box in scene.boxes])
    height = np.array([box.base_m for box in scene.boxes]) + size[:, 2] / 2
    centre = np.column_stack([[box.centre_map for box in scene.boxes], height])
    cam = centre @ view.cam_from_map[:3, :3].T + view.cam_from_map[:3, 3]
    radius = np.linalg.norm(size, axis=1) / 2
    k = view.info.intrinsic
    info = view.info
    in_view = cam[:, 2] > -radius
    for axis, pixels in ((0, info.width), (1, info.height)):
        low = (-k[axis, 2]) / k[axis, axis] - 0.1
        high = (pixels - k[axis, 2]) / k[axis, axis] + 0.1
        for slope, sign in ((low, 1), (high, -1)):
            in_view &= sign * (cam[:, axis] - slope * cam[:, 2]) / np.hypot(1, slope) > -radius
    return replace(scene, boxes=tuple(box for box, s in zip(scene.boxes, in_view, strict=True) if s))


def _ground(rng: np.random.Generator, port: bool, difficulty: float) -> Ground:
    concrete = rng.random() < (0.55 if port else 0.15)
    grey = rng.uniform(0.14, 0.36) if concrete else rng.uniform(0.05, 0.24)
    tint = np.exp(rng.normal(0, 0.05, 3)) * (0.97, 1.0, 1.03)
    texture = "concrete" if concrete else "asphalt"
    if rng.random() < 0.14:
        texture = str(rng.choice(["gravel", "grass", "brick"]))
    if texture == "grass":
        tint = np.array([rng.uniform(0.2, 0.7), 1.0, rng.uniform(0.6, 1.4)])
    blue, green, red = (float(c) for c in grey * tint)
    slabs = (concrete and rng.random() < 0.75) or rng.random() < 0.08
    return Ground(
        albedo_bgr=(blue, green, red),
        texture=texture if texture in ("concrete", "asphalt") else photo_tile(texture),
        contrast=float(rng.uniform(0.2, 0.6) if texture == "grass" else rng.uniform(0.04, 0.32)),
        stains=float(rng.uniform(0.03, 0.1 + 0.22 * difficulty)),
        slab_m=(float(rng.uniform(2, 9)), float(rng.uniform(2, 9))) if slabs else None,
        slab_yaw_rad=float(rng.normal(0, 0.05) if rng.random() < 0.6 else rng.uniform(0, 1.6)),
        joint_width_m=float(rng.uniform(0.006, 0.07)),
        joint_factor=float(rng.uniform(0.3, 0.8) if rng.random() < 0.65 else rng.uniform(1.2, 1.9)),
        wet_fraction=float(rng.uniform(0.05, 0.5)) if rng.random() < 0.16 * difficulty else 0.0,
        marks=ground_marks(rng) if rng.random() < 0.75 else None,
        seed=int(rng.integers(1 << 20)),
    )


def _weathered(
    rng: np.random.Generator, ground: Ground, light: Light, hardships: Hardships
) -> tuple[Ground, Light]:
    """Ground and light with a low sun, rain or dusk now and then."""
    light = low_sun(rng, light, hardships.low_sun)
    ground, light = rain(rng, ground, light, hardships.rain)
    return ground, dusk(rng, light, hardships.dusk)


def _light(rng: np.random.Generator) -> Light:
    """From deep overcast to hard, low sun; ratios of sun to skylight up to 15."""
    elevation = np.deg2rad(rng.uniform(12, 78))
    azimuth = rng.uniform(0, 2 * np.pi)
    direction = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    overcast = rng.random() < 0.25
    sun = rng.uniform(0.0, 0.4) if overcast else rng.uniform(0.8, 1.3)
    sky = rng.uniform(0.3, 0.7) if overcast else rng.uniform(0.09, 0.4)
    warm = rng.uniform(0.0, 0.25) * (1.0 - np.sin(elevation))
    blue = rng.uniform(0.0, 0.0 if overcast else 0.35)
    brightness = rng.uniform(0.4, 1.4)
    return Light(
        sun_direction_map=tuple(float(c) for c in direction),  # type: ignore[arg-type]
        sun_bgr=_tinted(sun, warm),
        sky_bgr=_tinted(sky, -blue),
        zenith_bgr=_tinted(0.55 * brightness, 0.0 if overcast else -0.4),
        horizon_bgr=_tinted(0.9 * brightness, 0.05),
    )


def _tinted(grey: float, warmth: float) -> Bgr:
    return float(grey * (1 - warmth)), float(grey), float(grey * (1 + warmth))


def _shadows(rng: np.random.Generator, difficulty: float) -> tuple[Shadow, ...]:
    """Shadows of what is out of view: buildings (wide) and poles, wires and gantries (narrow)."""
    out = []
    for _ in range(int(rng.poisson(4.0 * difficulty))):
        wide = rng.uniform(0.1, 0.7) if rng.random() < 0.55 else rng.uniform(1, 14)
        # Near the camera a shadow's edge crosses paint that is large in the image.
        centre = np.array([np.exp(rng.uniform(np.log(2), np.log(25))), rng.uniform(-8, 8)])
        polygon = rectangle(centre, rng.uniform(4, 60), wide, rng.uniform(0, np.pi))
        softness = float(np.exp(rng.uniform(np.log(0.02), np.log(0.6))))
        out.append(Shadow(polygon_map=polygon, transmission=float(rng.beta(1, 5)), softness_m=softness))
    return tuple(out)


def _dapples(rng: np.random.Generator, difficulty: float) -> tuple[Dapple, ...]:
    """The shade of trees, over all the ground or a part of it, perhaps of leaves and of boughs."""
    if rng.random() > 0.25 + 0.3 * difficulty:
        return ()
    region = None
    if rng.random() < 0.6:
        centre = np.array([rng.uniform(3, 40), rng.uniform(-6, 6)])
        region = rectangle(centre, rng.uniform(6, 40), rng.uniform(3, 20), rng.uniform(-0.4, 0.4))
    return tuple(
        Dapple(
            shaded=float(rng.uniform(0.25, 0.85) if rng.random() < 0.5 else rng.uniform(0.8, 0.97)),
            scale_m=float(rng.choice(_FLECK_SIZES_M)),
            transmission=float(rng.uniform(0.0, 0.3)),
            region_map=region,
            seed=int(rng.integers(1 << 20)),
        )
        for _ in range(int(rng.integers(1, 3)))
    )


def _backdrop(rng: np.random.Generator) -> Backdrop:
    return Backdrop(
        height_rad=float(rng.uniform(0.0, 0.3)),
        block_rad=float(rng.uniform(0.02, 0.2)),
        albedo_bgr=tuple(float(c) for c in rng.uniform(0.04, 0.5) * np.exp(rng.normal(0, 0.15, 3))),  # type: ignore[arg-type]
        haze_m=float(np.exp(rng.uniform(np.log(120), np.log(1500)))),
        seed=int(rng.integers(1 << 20)),
    )
