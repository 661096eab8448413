"""Everything beside the paint that a camera sees: what a network must learn not to take for paint.

Bright, upright and thin things matter most (trunks, signs, white vans), then bright things on the ground
(rails, joints, gutters): a network trained without them paints them all.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.simulate.render.scene import Bgr, Box, GroundMarks

Factor = NDArray[np.uint8]
Thing = Callable[[np.random.Generator, float, float], list[Box]]

_MARKS_M = (56.0, 28.0)  # length and width of the ground that has marks, m
_MARKS_RESOLUTION_M = 0.04  # ground per element of the marks, m
_BESIDE_M = (
    ((0.8, 0.15, 0.5), (4.0, 0.6, 1.1)),
    ((0.3, 0.2, 0.8), (1.2, 0.8, 2.5)),
    ((4.0, 2.0, 1.4), (7.0, 2.0, 2.6)),
)
"""The least and the largest size of barriers, cabinets and vans."""


def street_boxes(rng: np.random.Generator, road_half_m: float) -> tuple[Box, ...]:
    """Kerbs, pavements, buildings, trees, poles, signs and vehicles about a road ``2 road_half_m`` wide."""
    out: list[Box] = []
    for side in (-1, 1):
        edge = side * (road_half_m + rng.uniform(0, 4))
        if rng.random() < 0.6:
            out += _pavement(rng, edge, side)
        if rng.random() < 0.45:
            out += _buildings(rng, edge + side * rng.uniform(2, 12), side)
        if rng.random() < 0.5:
            out += _row(rng, edge + side * rng.uniform(0.4, 2.5), _tree)
        if rng.random() < 0.5:
            out += _row(rng, edge + side * rng.uniform(0.2, 1.5), _furniture)
        if rng.random() < 0.4:
            out += _row(rng, edge - side * 1.1, _vehicle)
    for _ in range(int(rng.poisson(0.8))):
        out += _vehicle(rng, float(rng.uniform(10, 50)), float(rng.uniform(-1, 1) * road_half_m))
    return tuple(out)


def port_boxes(rng: np.random.Generator) -> tuple[Box, ...]:
    """Stacks of containers, trucks, barriers and light masts about an open yard."""
    out: list[Box] = []
    for side in (-1, 1):
        if rng.random() < 0.6:
            out += _container_stack(rng, side * rng.uniform(5, 18))
        if rng.random() < 0.35:
            out += _row(rng, side * rng.uniform(4, 9), _furniture)
        if rng.random() < 0.25:
            out += _row(rng, side * rng.uniform(4, 8), _vehicle)
    for _ in range(int(rng.poisson(0.7))):
        out += _vehicle(rng, float(rng.uniform(12, 45)), float(rng.uniform(-8, 8)))
    return tuple(out)


def thing_to_stand_beside(rng: np.random.Generator) -> tuple[tuple[float, float, float], Bgr, bool]:
    """Size (length, depth, height in m), colour, and whether it is corrugated: of something on the ground."""
    kind = int(rng.choice(4, p=[0.4, 0.25, 0.2, 0.15]))
    if kind == 0:
        return (float(rng.choice([6.1, 12.2])), 2.44, 2.59), _albedo(rng, 0.05, 0.7, 0.5), True
    colour = _white(rng) if rng.random() < 0.5 else _albedo(rng)
    length, depth, height = (float(m) for m in rng.uniform(*_BESIDE_M[kind - 1]))
    return (length, depth, height), colour, False


def kerb_colours(rng: np.random.Generator) -> tuple[Bgr, Bgr]:
    """Colours of bright stones, and of the paving or grass behind them."""
    stone = _albedo(rng, 0.3, 0.8, 0.04)
    paving = rng.random() < 0.4
    return stone, _albedo(rng, 0.08, 0.4, 0.08) if paving else (0.05, float(rng.uniform(0.08, 0.2)), 0.1)


def ground_marks(rng: np.random.Generator) -> GroundMarks:
    """Tyre marks, cracks, repairs, rails, covers and spills: unlabelled, dark and up to twice as bright."""
    marks = plain_marks()
    factor = marks.factor
    if rng.random() < 0.2:
        _flecks(rng, factor)
    for side in (-1, 1):
        if rng.random() < 0.3:
            _verge(rng, factor, side)
    for _ in range(int(rng.poisson(1.5))):
        _patch(rng, factor)
    for _ in range(int(rng.poisson(2.0))):
        _tyre_marks(rng, factor)
    for _ in range(int(rng.poisson(2.0))):
        _crack(rng, factor)
    if rng.random() < 0.3:
        _rails(rng, factor)
    for _ in range(int(rng.poisson(1.5))):
        _cover(rng, factor)
    if rng.random() < 0.7:
        factor[:] = cv2.GaussianBlur(factor, (0, 0), float(rng.uniform(0.5, 1.4)))
    return marks


def plain_marks() -> GroundMarks:
    """Room for marks about the way, none yet."""
    columns, rows = (int(m / _MARKS_RESOLUTION_M) for m in _MARKS_M)
    factor = np.full((rows, columns), 128, dtype=np.uint8)
    return GroundMarks(factor=factor, origin_map=(-4.0, -_MARKS_M[1] / 2), resolution_m=_MARKS_RESOLUTION_M)


def _albedo(rng: np.random.Generator, low: float = 0.03, high: float = 0.8, saturation: float = 0.25) -> Bgr:
    grey = np.exp(rng.uniform(np.log(low), np.log(high)))
    blue, green, red = (float(c) for c in np.clip(grey * np.exp(rng.normal(0, saturation, 3)), 0.02, 0.9))
    return blue, green, red


def _white(rng: np.random.Generator) -> Bgr:
    return _albedo(rng, 0.55, 0.85, 0.04)


def _box(
    rng: np.random.Generator,
    at: tuple[float, float],
    size_m: tuple[float, float, float],
    albedo_bgr: Bgr,
    base_m: float = 0.0,
    yaw_rad: float = 0.0,
    corrugated: bool = False,
) -> Box:
    return Box(
        centre_map=at,
        size_m=size_m,
        yaw_rad=yaw_rad,
        albedo_bgr=albedo_bgr,
        base_m=base_m,
        corrugated=corrugated,
        seed=int(rng.integers(1 << 20)),
    )


def _row(rng: np.random.Generator, left: float, thing: Thing) -> list[Box]:
    """Several of a thing (a function of rng, x and y) along the road."""
    out: list[Box] = []
    along = rng.uniform(2, 14)
    while along < 60 and len(out) < 24:
        out += thing(rng, float(along), float(left + rng.normal(0, 0.3)))
        along += rng.uniform(4, 16)
    return out


def _pavement(rng: np.random.Generator, edge: float, side: int) -> list[Box]:
    """A kerb, lighter or darker than the pavement or verge behind it."""
    tall = rng.uniform(0.04, 0.16)
    deep = rng.uniform(1.5, 5)
    surface = _albedo(rng, 0.1, 0.5, 0.08) if rng.random() < 0.7 else (0.05, 0.16, 0.1)
    kerb = _albedo(rng, 0.15, 0.6, 0.04)
    return [
        _box(rng, (30.0, edge + side * (0.15 + deep / 2)), (70.0, deep, tall), surface),
        _box(rng, (30.0, edge + side * 0.075), (70.0, 0.15, tall + 0.005), kerb),
    ]


def _buildings(rng: np.random.Generator, left: float, side: int) -> list[Box]:
    out: list[Box] = []
    along = rng.uniform(-5, 10)
    while along < 70 and len(out) < 12:
        length = rng.uniform(6, 20)
        tall = rng.uniform(2.5, 14)
        out.append(
            _box(
                rng, (along + length / 2, left + side * 4), (length, 8.0, tall), _albedo(rng, 0.08, 0.7, 0.12)
            )
        )
        for _ in range(int(rng.integers(0, 3))):
            at = (along + rng.uniform(1, length - 1), left - side * 0.05)
            wide = rng.uniform(0.8, 2.5)
            high = rng.uniform(0.9, 2.2)
            out.append(_box(rng, at, (wide, 0.12, high), _albedo(rng), rng.uniform(0, 1.5)))
        along += length + rng.uniform(0, 8)
    return out


def _tree(rng: np.random.Generator, x: float, y: float) -> list[Box]:
    thick = float(rng.uniform(0.12, 0.6))
    bark = _albedo(rng, 0.05, 0.45, 0.08)
    out = [_box(rng, (x, y), (thick, thick, 5.0), bark, yaw_rad=float(rng.uniform(0, 1.5)))]
    if rng.random() < 0.6:
        crown = float(rng.uniform(2, 6))
        green = (0.03, float(rng.uniform(0.07, 0.2)), 0.05)
        out.append(
            _box(
                rng,
                (x, y),
                (crown, crown, 3.0),
                green,
                float(rng.uniform(2.2, 4.5)),
                float(rng.uniform(0, 1.5)),
            )
        )
    return out


def _furniture(rng: np.random.Generator, x: float, y: float) -> list[Box]:
    """A pole with or without a sign, a bollard, a person, a barrier or a cabinet."""
    kind = rng.integers(6)
    grey = _white(rng) if rng.random() < 0.5 else _albedo(rng)
    if kind in (0, 1):
        thin = float(rng.uniform(0.05, 0.2))
        pole = _box(rng, (x, y), (thin, thin, float(rng.uniform(2, 7))), grey)
        if kind == 0:
            return [pole]
        size = (0.05, float(rng.uniform(0.4, 1.5)), float(rng.uniform(0.4, 1.5)))
        return [pole, _box(rng, (x - 0.1, y), size, _white(rng) if rng.random() < 0.6 else _albedo(rng), 1.8)]
    if kind == 2:
        return [_box(rng, (x, y), (0.12, 0.12, float(rng.uniform(0.5, 1.1))), grey)]
    if kind == 3:
        legs = _box(rng, (x, y), (0.25, 0.4, 0.85), _albedo(rng, 0.03, 0.3))
        return [legs, _box(rng, (x, y), (0.3, 0.5, 0.85), _albedo(rng), 0.85)]
    if kind == 4:
        base = float(rng.choice([0.0, 0.45]))
        return [
            _box(rng, (x, y), (float(rng.uniform(2, 14)), 0.15, float(rng.uniform(0.25, 0.8))), grey, base)
        ]
    return [_box(rng, (x, y), (0.7, 0.7, 1.3), grey, yaw_rad=float(rng.uniform(0, 1.5)))]


def _vehicle(rng: np.random.Generator, x: float, y: float) -> list[Box]:
    """A car, van or truck out of a few boxes: body, cabin or load, wheels, bright plates."""
    kind = rng.integers(3)
    yaw = float(rng.normal(0, 0.05))
    colour = _white(rng) if rng.random() < 0.45 else _albedo(rng, 0.02, 0.6, 0.4)
    length, width, tall = ((4.3, 1.8, 0.6), (5.6, 2.0, 1.9), (9.0, 2.5, 2.9))[int(kind)]
    base = 0.3 if kind < 2 else 1.0
    rear = x - length / 2
    out = [
        _box(
            rng,
            (x, y),
            (length, width, tall),
            colour,
            base,
            yaw,
            corrugated=bool(kind == 2 and rng.random() < 0.6),
        )
    ]
    if kind == 0:
        out.append(_box(rng, (x, y), (2.3, 1.6, 0.55), (0.05, 0.05, 0.05), base + tall, yaw))
        out.append(_box(rng, (x, y), (1.7, 1.5, 0.04), colour, base + tall + 0.55, yaw))
    else:
        out.append(
            _box(
                rng, (rear - 0.02, y), (0.03, width * 0.8, tall * 0.3), _albedo(rng), base + 0.55 * tall, yaw
            )
        )
    for side in (-1, 1):
        for end in (-0.32, 0.32):
            wheel = (0.6, 0.22, 0.6)
            out.append(
                _box(
                    rng,
                    (x + end * length, y + side * (width / 2 - 0.12)),
                    wheel,
                    (0.03, 0.03, 0.03),
                    0.0,
                    yaw,
                )
            )
    if rng.random() < 0.6:
        out.append(_box(rng, (rear - 0.03, y), (0.02, 0.5, 0.12), _white(rng), base + 0.15, yaw))
    return out


def _container_stack(rng: np.random.Generator, left: float) -> list[Box]:
    out: list[Box] = []
    along = rng.uniform(0, 15)
    while along < 75 and len(out) < 14:
        length = float(rng.choice([6.1, 12.2]))
        for level in range(int(rng.integers(1, 4))):
            at = (float(along + length / 2), float(left))
            out.append(
                _box(
                    rng, at, (length, 2.44, 2.59), _albedo(rng, 0.05, 0.7, 0.5), 2.59 * level, corrugated=True
                )
            )
        along += length + rng.choice([0.4, rng.uniform(2, 15)])
    return out


def _point(rng: np.random.Generator, factor: Factor) -> tuple[int, int]:
    return int(rng.integers(factor.shape[1])), int(rng.integers(factor.shape[0]))


def _flecks(rng: np.random.Generator, factor: Factor) -> None:
    """Single spots of sun on shaded ground, all of about one size: the easiest thing to take for diamonds."""
    size = float(np.exp(rng.uniform(np.log(1.5), np.log(9.0))))
    noise = cv2.GaussianBlur(
        rng.standard_normal(factor.shape, np.float32),
        (0, 0),
        size,
        sigmaY=size * float(rng.uniform(0.5, 2.0)),
    )
    noise = noise / noise.std()
    lit = np.clip((noise - rng.uniform(0.7, 2.0)) / rng.uniform(0.1, 0.8), 0, 1)
    shade = rng.uniform(30, 90)
    factor[:] = (shade + lit * (rng.uniform(200, 255) - shade)).astype(np.uint8)


def _verge(rng: np.random.Generator, factor: Factor, side: int) -> None:
    """Rough ground from a line beside the road outwards, as of grass, leaves or gravel: specks in clumps."""
    rows, columns = factor.shape
    specks = cv2.GaussianBlur(
        rng.standard_normal((rows, columns), np.float32), (0, 0), float(rng.uniform(0.5, 2.0))
    )
    clumps = cv2.resize(rng.standard_normal((rows // 12, columns // 12), np.float32), (columns, rows))
    contrast = rng.uniform(0.15, 0.5)
    rough = np.exp(
        contrast * (specks / specks.std() + rng.uniform(0.2, 0.8) * clumps) + rng.uniform(-0.2, 0.3)
    )
    near_row, far_row = (rows / 2 + side * rng.uniform(1.5, 9, 2) / _MARKS_RESOLUTION_M).astype(int)
    edge = 0 if side < 0 else rows
    outline = np.array(
        [[0, edge], [0, near_row], [columns, near_row if rng.random() < 0.6 else far_row], [columns, edge]]
    )
    beyond = cv2.fillPoly(np.zeros_like(factor), [outline.astype(np.int32)], 1) > 0
    factor[beyond] = np.clip(128 * rough, 0, 255).astype(np.uint8)[beyond]


def _patch(rng: np.random.Generator, factor: Factor) -> None:
    """A repair of the surface: a quadrangle of another tone."""
    size = (float(rng.uniform(10, 250)), float(rng.uniform(10, 90)))
    corners = cv2.boxPoints((_point(rng, factor), size, float(rng.choice([0, rng.uniform(0, 90)]))))
    cv2.fillConvexPoly(factor, corners.astype(np.int32), int(128 * np.exp(rng.normal(0, 0.25))))


def _tyre_marks(rng: np.random.Generator, factor: Factor) -> None:
    """A pair of dark, curved tracks."""
    x = np.linspace(0, factor.shape[1], 24)
    y = rng.uniform(0, factor.shape[0]) + rng.normal(0, 0.15) * x + rng.normal(0, 1.5e-4) * x**2
    tone = int(rng.uniform(60, 118))
    thick = int(rng.integers(3, 8))
    for offset in (0, 1.6 / _MARKS_RESOLUTION_M):
        track = np.column_stack([x, y + offset]).astype(np.int32)
        cv2.polylines(factor, [track], False, tone, thick)


def _crack(rng: np.random.Generator, factor: Factor) -> None:
    """A crack, or its bright or tarry seal."""
    steps = rng.normal(0, 12, (int(rng.integers(5, 40)), 2)) + rng.normal(0, 14, 2)
    track = (np.cumsum(steps, axis=0) + _point(rng, factor)).astype(np.int32)
    tone = int(rng.uniform(40, 100) if rng.random() < 0.75 else rng.uniform(150, 200))
    cv2.polylines(factor, [track], False, tone, int(rng.integers(1, 3)))


def _rails(rng: np.random.Generator, factor: Factor) -> None:
    """Tram or crane rails or a gutter: long, straight, bright or dark, with a dark groove."""
    x = factor.shape[1]
    y = rng.uniform(0, factor.shape[0])
    rise = rng.normal(0, 0.1) * x
    tone = int(rng.choice([rng.uniform(50, 100), rng.uniform(165, 250)]))
    thick = int(rng.integers(1, 5))
    for offset in (0, 1.435 / _MARKS_RESOLUTION_M):
        ends = (0, int(y + offset)), (x, int(y + offset + rise))
        cv2.line(factor, *ends, int(rng.uniform(40, 90)), thick + 2)
        cv2.line(factor, *ends, tone, thick)


def _cover(rng: np.random.Generator, factor: Factor) -> None:
    """A manhole cover, an oil spill or a bright splash."""
    axes = (
        (int(rng.integers(5, 14)),) * 2
        if rng.random() < 0.6
        else tuple(int(a) for a in rng.integers(4, 40, 2))
    )
    tone = int(rng.uniform(50, 115) if rng.random() < 0.65 else rng.uniform(140, 200))
    cv2.ellipse(factor, _point(rng, factor), axes, float(rng.uniform(0, 180)), 0, 360, tone, -1)
