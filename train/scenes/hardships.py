"""Hard cases, which networks have failed on and a training therefore shows more often than chance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from train.scenes.clutter import kerb_colours, plain_marks, thing_to_stand_beside
from train.scenes.paint import Bend, Brush, RoadPaint, arrow, crosswalk, rectangle, stop_line
from train.scenes.symbols import laid
from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.geometry.planar import inside_convex
from v2hdm.records import ARROW, CROSSWALK_BAR, STOP_LINE, FloatArray
from v2hdm.simulate.render.renderer import Optics
from v2hdm.simulate.render.scene import Bgr, Box, Ground, GroundMarks, Light, Paint, Shadow, box_footprint

_CROSSED_M = 22.0  # distance ahead, m, within which a shadow may cross a marking
_LONGEST_LEVEL = 0.9  # highest mean level of an overexposed image, of 1
_CAMERA_CLEARANCE_M = 3.5  # least distance of things beside markings from the camera, m
_KERB_M = 45.0  # distance ahead to which kerbs reach, m
_GUTTER_ALBEDO = (0.13, 0.3)  # of weathered concrete and stone, chosen; paint has 0.6 to 0.9
_SEAM_STEP_M = 0.25  # distance between the points of a seam, m
_BLEACHED_ALBEDO = (0.37, 0.52)
"""Albedo of sun-bleached concrete; fresh paint has 0.6 to 0.9."""

_BLEACHED_OVEREXPOSED = 0.5  # least share of images of bleached ground that are overexposed
_SHIFT = 4
"""Bits of fraction of the coordinates that OpenCV is given."""


@dataclass(frozen=True, kw_only=True)
class Hardships:
    """How much is added to random scenes; nothing else of them changes.

    :class:`train.config.DataConfig` says what the others mean.

    Attributes:
        shadows_on_paint: mean number of shadows that have an edge across a marking.
        aside: share of cameras that look to the side of the vehicle. What they see is another scene's worth,
            and its dashes and stop lines have changed names: see
            :func:`~train.scenes.scenes.training_sample`.
    """

    shadows_on_paint: float = 0.0
    things_beside: float = 0.0
    faint: float = 0.0
    seams: float = 0.0
    side_seams: float = 0.0
    pavements: float = 0.0
    bleached: float = 0.0
    overexposed: float = 0.0
    blue_shade: float = 0.0
    tight_bends: float = 0.0
    kerbs: float = 0.0
    gutters: float = 0.0
    joints: float = 0.0
    junctions: float = 0.0
    mountings: float = 0.0
    facing: float = 0.0
    stout: float = 0.0
    hollow: float = 0.0
    crossings: float = 0.0
    words: float = 0.0
    bays: float = 0.0
    boxes: float = 0.0
    users: float = 0.0
    others: float = 0.0
    give_way: float = 0.0
    far_stops: float = 0.0
    crosswalks: float = 0.0
    doubles: float = 0.0
    erased: float = 0.0
    litter: float = 0.0
    traffic: float = 0.0
    own_vehicle: float = 0.0
    rain: float = 0.0
    low_sun: float = 0.0
    dusk: float = 0.0
    sun_flecks: float = 0.0
    grounds: float = 0.0
    aside: float = 0.0


NONE = Hardships()


def shadows_on_paint(rng: np.random.Generator, paints: list[Paint], mean: float) -> tuple[Shadow, ...]:
    """Shadows laid so that an edge of each crosses a marking within sight, often nearly along its sides."""
    out = []
    for polygon in _some_within_sight(rng, paints, mean):
        side = polygon[1] - polygon[0]
        along = np.arctan2(side[1], side[0]) + rng.normal(0, 0.15)
        yaw = float(along if rng.random() < 0.5 else rng.uniform(0, np.pi))
        wide = float(rng.uniform(0.15, 0.8) if rng.random() < 0.5 else rng.uniform(1, 10))
        across = np.array([-np.sin(yaw), np.cos(yaw)])
        crossed = rng.dirichlet(np.ones(len(polygon))) @ polygon
        centre = crossed + across * wide / 2 * rng.choice([-1.0, 1.0])
        shape = rectangle(centre, float(rng.uniform(4, 40)), wide, yaw)
        softness = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
        out.append(Shadow(polygon_map=shape, transmission=float(rng.beta(1, 5)), softness_m=softness))
    return tuple(out)


def things_beside(rng: np.random.Generator, paints: Sequence[Paint], mean: float) -> tuple[Box, ...]:
    """Things that stand beside markings within sight, oftenest behind them as the camera sees it."""
    out = []
    for polygon in _some_within_sight(rng, paints, mean):
        centre = polygon.mean(axis=0)
        size_m, albedo_bgr, corrugated = thing_to_stand_beside(rng)
        bearing = float(np.arctan2(centre[1], centre[0]) + rng.normal(0, 0.9))
        away = np.array([np.cos(bearing), np.sin(bearing)])
        gap_m = float(rng.uniform(0.02, 0.7))
        reach_m = float(((polygon - centre) @ away).max()) + gap_m + size_m[1] / 2
        along_m = float(rng.uniform(-0.4, 0.4)) * size_m[0]
        x, y = centre + reach_m * away + along_m * np.array([away[1], -away[0]])
        box = Box(
            centre_map=(float(x), float(y)),
            size_m=size_m,
            yaw_rad=bearing + np.pi / 2,
            albedo_bgr=albedo_bgr,
            corrugated=corrugated,
            seed=int(rng.integers(1 << 20)),
        )
        if float(box_footprint(box)[:, 0].min()) > _CAMERA_CLEARANCE_M:
            out.append(box)
    return tuple(out)


def faint(rng: np.random.Generator, paints: Sequence[Paint], share: float) -> tuple[Paint, ...]:
    """These paints, or in a ``share`` of cases half of the markings among them nearly hidden by dirt."""
    if rng.random() >= share:
        return tuple(paints)
    dirt = {seed: rng.uniform(0.4, 0.8) for seed in {p.seed: None for p in paints} if rng.random() < 0.5}
    return tuple(replace(p, dirt=max(p.dirt, float(dirt.get(p.seed, 0.0)))) for p in paints)


def tight_bend(rng: np.random.Generator, share: float) -> Bend | None:
    """In a ``share`` of cases a bend of up to 120 degrees and a radius of 14 to 60 m that begins near by."""
    if rng.random() >= share:
        return None
    radius_m = float(np.exp(rng.uniform(np.log(14.0), np.log(60.0))))
    begins_m = float(rng.uniform(-10.0, 15.0))
    return Bend(
        float(rng.choice([-1.0, 1.0])) / radius_m,
        begins_m,
        begins_m + radius_m * float(rng.uniform(0.4, 2.1)),
    )


def clear_of(boxes: Iterable[Box], paints: Sequence[Paint]) -> tuple[Box, ...]:
    """The boxes that do not stand on the middle of a paint."""
    if not paints:
        return tuple(boxes)
    middles = np.array([paint.polygon_map.mean(axis=0) for paint in paints])
    return tuple(box for box in boxes if not inside_convex(box_footprint(box), middles).any())


def kerbs(rng: np.random.Generator, lines_map: Sequence[FloatArray], share: float) -> tuple[Box, ...]:
    """In a ``share`` of cases a kerb along one of the lines (N, 2, map), and the grass or paving behind it.

    Its stones are bright and where the grass has not grown over them or a driveway lowered them, they make a
    row of stretches that differ from dashes in nothing but their height.
    """
    if rng.random() >= share or not lines_map:
        return ()
    side = rng.choice([-1.0, 1.0])
    line = lines_map[int(rng.integers(len(lines_map)))]
    offset_m = side * (rng.uniform(0.2, 1.2) if rng.random() < 0.5 else rng.uniform(1.2, 4.5))
    wide_m = rng.uniform(0.06, 0.3)
    tall_m = rng.uniform(0.06, 0.2)
    behind_m = rng.uniform(1.0, 4.0)
    stone, behind = kerb_colours(rng)
    edge = _beside(line, np.full(len(line), offset_m))
    middle = _beside(line, np.full(len(line), offset_m + side * (wide_m + behind_m) / 2))
    out = [
        *_along(rng, middle, (4.0, 4.0), (0.0, 0.0), (behind_m, tall_m), behind),
        *_along(rng, edge, (0.8, 7.0), (0.02, 3.0), (wide_m, tall_m + 0.01), stone),
    ]
    return tuple(box for box in out if float(box_footprint(box)[:, 0].min()) > _CAMERA_CLEARANCE_M)


def gutters(rng: np.random.Generator, lines_map: Sequence[FloatArray], share: float) -> tuple[Box, ...]:
    """In a ``share`` of cases a strip of stones or concrete, level with the ground, along the way.

    It runs beside one of the lines (N, 2, map), or straight on where there are none, duller than paint, which
    it would be if it were as bright; joints part it.
    """
    if rng.random() >= share:
        return ()
    straight = np.column_stack([np.arange(0.0, _KERB_M, 0.5), np.zeros(int(_KERB_M * 2))])
    line = lines_map[int(rng.integers(len(lines_map)))] if lines_map else straight
    offset_m = rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 5.0)
    blue, green, red = (float(c) for c in rng.uniform(*_GUTTER_ALBEDO) * np.exp(rng.normal(0, 0.04, 3)))
    piece_m = rng.uniform(0.5, 4.0)
    section_m = (float(rng.uniform(0.2, 0.6)), float(rng.uniform(0.004, 0.02)))
    strip = _beside(line, np.full(len(line), offset_m))
    return tuple(_along(rng, strip, (piece_m, piece_m), (0.01, 0.05), section_m, (blue, green, red)))


def with_joints(
    rng: np.random.Generator, marks: GroundMarks | None, lines_map: Sequence[FloatArray], mean: float
) -> GroundMarks | None:
    """The marks of a ground and ``mean`` long seams along the way, apart from all lines of lanes."""
    along_m = np.arange(0.0, 50.0, 0.5)
    seams = []
    for _ in range(int(rng.poisson(mean))):
        straight = np.column_stack([along_m, rng.normal(0, 0.03) * along_m])
        line = lines_map[int(rng.integers(len(lines_map)))] if lines_map else straight
        wavy_m = rng.uniform(0, 0.02) * np.cumsum(rng.normal(0, 1, len(line)))
        seams.append(_beside(line, rng.choice([-1, 1]) * rng.uniform(0.4, 5) + wavy_m))
    return _with_strips(rng, marks, seams) if seams else marks


def _along(
    rng: np.random.Generator,
    line: FloatArray,
    lengths_m: tuple[float, float],
    gaps_m: tuple[float, float],
    section_m: tuple[float, float],
    albedo_bgr: Bgr,
) -> list[Box]:
    """Boxes along a line (N, 2), of a width and height, of lengths and at gaps between these bounds."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    out: list[Box] = []
    at = float(rng.uniform(0, 1))
    while at + lengths_m[1] < min(along[-1], _KERB_M):
        length = float(rng.uniform(*lengths_m))
        (x0, x1), (y0, y1) = (np.interp([at, at + length], along, line[:, axis]) for axis in (0, 1))
        box = Box(
            centre_map=(float(x0 + x1) / 2, float(y0 + y1) / 2),
            size_m=(float(np.hypot(x1 - x0, y1 - y0)), *section_m),
            yaw_rad=float(np.arctan2(y1 - y0, x1 - x0)),
            albedo_bgr=albedo_bgr,
            seed=int(rng.integers(1 << 20)),
        )
        out.append(box)
        at += length + float(rng.uniform(*gaps_m))
    return out


def with_junction(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with the approach to a junction instead of what was there."""
    if rng.random() >= share:
        return road
    return laid(road, *junction_approach(rng, brush, bend))


def junction_approach(rng: np.random.Generator, brush: Brush, bend: Bend) -> tuple[list[Paint], FloatArray]:
    """The approach to a junction: arrows in one to three lanes, their stop line, the crosswalk behind it.

    Returns:
        The paint, and the outline (4, 2, map) of the ground from the stop line to the end of the crosswalk.
    """
    lanes = int(rng.integers(1, 4))
    lane_m = rng.uniform(2.6, 3.8)
    right = rng.uniform(-1.5, -0.2) * lane_m
    stop_m = rng.uniform(5, 26)
    thick_m = rng.uniform(0.2, 0.6)
    shapes = [
        (STOP_LINE, shape + np.array([stop_m, right])) for shape in stop_line(rng, lanes * lane_m, thick_m)
    ]
    for lane in range(lanes):
        tip_m = stop_m - rng.uniform(1, 5)
        head = 1 if rng.random() < 0.5 else -1
        while rng.random() < 0.8 and tip_m > 5:
            parts = list(arrow(rng, lane_m))
            long_m = max(part[:, 0].max() for part in parts)
            tail = (tip_m - long_m if head > 0 else tip_m, right + (lane + 0.5) * lane_m)
            shapes += [(ARROW, head * part + tail) for part in parts]
            tip_m -= long_m + rng.uniform(4, 15)
    behind_m = stop_m + thick_m / 2 + rng.uniform(0.4, 2)
    beside_m = rng.uniform(0, 2 * lane_m, 2)
    extent_m = lanes * lane_m + beside_m.sum()
    bars = list(crosswalk(rng, extent_m)) if rng.random() < 0.8 else []
    long_m = np.ptp(bars[0][:, 0]) if bars else 0.0
    first = np.array([behind_m + long_m / 2, right - beside_m[0]])
    shapes += [(CROSSWALK_BAR, bar + first) for bar in bars]
    middle = np.array([(stop_m + behind_m + long_m) / 2, right - beside_m[0] + extent_m / 2])
    ground = rectangle(middle, behind_m + long_m - stop_m + 1, extent_m + 1)
    return [brush.paint(rng, kind, bend.to_map(shape)) for kind, shape in shapes], bend.to_map(ground)


def _some_within_sight(rng: np.random.Generator, paints: Sequence[Paint], mean: float) -> list[FloatArray]:
    """The polygons (N, 2) of some markings with corners that are near, ``mean`` of them on average."""
    crossable = [
        p for p in paints if p.kind in CORNERED_CLASSES and 1 < p.polygon_map[:, 0].mean() < _CROSSED_M
    ]
    count = int(rng.poisson(mean)) if crossable else 0
    return (
        [crossable[int(k)].polygon_map for k in rng.integers(len(crossable), size=count)] if crossable else []
    )


def with_seams(
    rng: np.random.Generator, marks: GroundMarks | None, lines_map: Iterable[FloatArray], share: float
) -> GroundMarks | None:
    """The marks of a ground and a seam beside a ``share`` of the lines (N, 2, map)."""
    beside = [line for line in lines_map if rng.random() < share]
    if not beside:
        return marks
    wavy = [rng.normal(0, 0.01) * np.cumsum(rng.normal(0, 1, len(line))) for line in beside]
    seams = (_beside(line, rng.normal(0, 0.12) + off) for line, off in zip(beside, wavy, strict=True))
    return _with_strips(rng, marks, seams)


def with_side_seams(
    rng: np.random.Generator, marks: GroundMarks | None, paints: Sequence[Paint], mean: float
) -> GroundMarks | None:
    """The marks of a ground and seams along a side of ``mean`` markings within sight, oftenest a long one."""
    seams = []
    for polygon in _some_within_sight(rng, paints, mean):
        sides = np.roll(polygon, -1, axis=0) - polygon
        lengths_m = np.linalg.norm(sides, axis=1)
        k = int(rng.choice(len(polygon), p=lengths_m / lengths_m.sum()))
        before_m, after_m = rng.exponential(1.0, 2)
        reach_m = before_m + lengths_m[k] + after_m
        along_m = np.linspace(-before_m, lengths_m[k] + after_m, 2 + int(reach_m / _SEAM_STEP_M))
        line = polygon[k] + along_m[:, None] * sides[k] / lengths_m[k]
        rough_m = rng.uniform(0, 0.012) * np.cumsum(rng.normal(0, 1, len(line)))
        seams.append(_beside(line, rng.normal(0, 0.03) + rough_m - rough_m.mean()))
    return _with_strips(rng, marks, seams) if seams else marks


def _with_strips(
    rng: np.random.Generator, marks: GroundMarks | None, strips_map: Iterable[FloatArray]
) -> GroundMarks:
    """The marks of a ground and narrow dark or bright strips along lines (N, 2, map)."""
    marks = plain_marks() if marks is None else marks
    factor = marks.factor.copy()
    for strip in strips_map:
        tone = rng.uniform(35, 110) if rng.random() < 0.75 else rng.uniform(145, 200)
        wide_px = int(rng.integers(1, 4))
        cv2.polylines(factor, [_sixteenths(strip, marks)], False, tone, wide_px, cv2.LINE_AA, _SHIFT)
    return replace(marks, factor=factor)


def with_pavements(
    rng: np.random.Generator, marks: GroundMarks | None, lines_map: Sequence[FloatArray], share: float
) -> GroundMarks | None:
    """The marks of a ground, in a ``share`` of cases with a strip of another tone beside a line (N, 2)."""
    if rng.random() >= share or not lines_map:
        return marks
    marks = plain_marks() if marks is None else marks
    line = lines_map[int(rng.integers(len(lines_map)))]
    edge_m = rng.choice([-1.0, 1.0]) * rng.uniform(0.0, 0.4)
    far_m = edge_m + rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 8.0)
    wavy_m = rng.uniform(0, 0.02) * np.cumsum(rng.normal(0, 1, len(line)))
    outline = np.vstack([_beside(line, edge_m + wavy_m), _beside(line, np.full(len(line), far_m))[::-1]])
    inside = np.zeros_like(marks.factor)
    cv2.fillPoly(inside, [_sixteenths(outline, marks)], 1, cv2.LINE_8, _SHIFT)
    tone = np.exp(rng.uniform(0.25, 0.7) * rng.choice([-1.0, 1.0]))
    factor = np.where(inside > 0, np.clip(marks.factor * tone, 0, 255).astype(np.uint8), marks.factor)
    return replace(marks, factor=factor)


def _beside(line: FloatArray, left_m: FloatArray) -> FloatArray:
    """The points ``left_m`` (N,) to the left of those of a line (N, 2)."""
    ahead = np.gradient(line, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.asarray(line + left_m[:, None] * left)


def _sixteenths(points_map: FloatArray, marks: GroundMarks) -> NDArray[np.int32]:
    """Points (N, 2) on the raster of marks as OpenCV draws them with :data:`_SHIFT` bits of fraction."""
    at = (points_map - marks.origin_map) / marks.resolution_m
    return np.round(at * (1 << _SHIFT)).astype(np.int32)


def blue_shade(rng: np.random.Generator, light: Light, share: float) -> Light:
    """This light, or in a ``share`` of cases with a sky that is up to twice as blue, and half as red."""
    if rng.random() >= share:
        return light
    tint = rng.uniform(0.2, 0.5)
    blue, green, red = light.sky_bgr
    return replace(light, sky_bgr=(blue * (1 + tint), green, red * (1 - tint)))


def bleached(rng: np.random.Generator, ground: Ground, share: float) -> Ground:
    """This ground, or in a ``share`` of cases nearly as light as paint is, in its own tint."""
    if rng.random() >= share:
        return ground
    lighter = rng.uniform(*_BLEACHED_ALBEDO) / max(ground.albedo_bgr)
    blue, green, red = (float(lighter * c) for c in ground.albedo_bgr)
    return replace(ground, albedo_bgr=(blue, green, red))


def overexposed(rng: np.random.Generator, optics: Optics, ground: Ground, share: float) -> Optics:
    """These optics, or in a ``share`` of cases, half of those of a bleached ground, exposing too long.

    Up to four times longer, that is.
    """
    if rng.random() >= (max(share, _BLEACHED_OVEREXPOSED) if _is_bleached(ground) else share):
        return optics
    return replace(optics, mean_level=float(min(optics.mean_level * rng.uniform(1.5, 4.0), _LONGEST_LEVEL)))


def _is_bleached(ground: Ground) -> bool:
    return max(ground.albedo_bgr) >= _BLEACHED_ALBEDO[0]
