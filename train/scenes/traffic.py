"""Vehicles and boards with pictures on their sides: stripes, windows, wheels, plates, writing.

Networks took the warning stripes of a lorry for a crosswalk, and its windows and wheels for arrows.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.records import FloatArray
from v2hdm.simulate.render.scene import Bgr, Box, Float32

Picture = NDArray[np.uint8]

_PX_PER_M = 50  # resolution of the pictures on a thing's sides, px per m
_SHIFT = 4  # bits of fraction of the coordinates that OpenCV is given
_CLEARANCE_M = 2.2
"""Distance of everything from the camera, which stands at the map's origin, m."""

_BLACK = (0.02, 0.02, 0.02)  # radiance, BGR, of black stripes and tyres
_RED = (0.05, 0.05, 0.5)  # radiance, BGR, of red stripes
_WHITE = (0.75, 0.78, 0.78)  # radiance, BGR, of white stripes
_YELLOW = (0.03, 0.5, 0.7)  # radiance, BGR, of yellow stripes
_GLASS = ((0.03, 0.03, 0.03), (0.12, 0.1, 0.08), (0.5, 0.42, 0.36))
"""Windows: dark ones, and those that mirror the sky."""


def traffic(rng: np.random.Generator, mean: float) -> tuple[Box, ...]:
    """Vehicles, boards, fences and striped kerbs ahead and beside, ``mean`` on average."""
    things = _lorry, _car, _bus, _board, _striped_kerb, _fence
    out: list[Box] = []
    for _ in range(int(rng.poisson(mean))):
        thing = things[int(rng.choice(6, p=[0.38, 0.26, 0.11, 0.11, 0.07, 0.07]))]
        ahead = rng.random() < 0.5
        x = float(np.exp(rng.uniform(np.log(3.5), np.log(25 if ahead else 14))))
        y = float(rng.normal(0, 0.8) if ahead else rng.choice([-1, 1]) * rng.uniform(2.3, 5.5))
        yaw = float(rng.normal(0, 0.06) if rng.random() < 0.85 else rng.uniform(-1.6, 1.6))
        boxes = thing(rng, x, y, yaw + (np.pi if rng.random() < 0.25 else 0.0))
        if all(_is_clear(box) for box in boxes):
            out += boxes
    return tuple(out)


def _is_clear(box: Box) -> bool:
    """Whether the camera stands outside of a box and some way from it."""
    cos = np.cos(box.yaw_rad)
    sin = np.sin(box.yaw_rad)
    x, y = box.centre_map
    off = np.abs([x * cos + y * sin, y * cos - x * sin]) - np.array(box.size_m[:2]) / 2
    return bool(np.hypot(*np.maximum(off, 0)) > _CLEARANCE_M)


def _plain(size_m: tuple[float, float], albedo_bgr: Bgr) -> Picture:
    """A picture of one colour, of a width and height."""
    columns, rows = (max(int(m * _PX_PER_M), 2) for m in size_m)
    return np.full((rows, columns, 3), np.clip(np.array(albedo_bgr) * 255, 0, 255), dtype=np.uint8)


def reflectance(
    picture: Picture, sides_m: FloatArray, along_m: Float32, up_m: Float32, footprint_m: Float32
) -> Float32:
    """Reflectance (3, h, w) of a picture that fills a side of a box; see :data:`scene.Picture`."""
    # Fewer texels than pixels would shimmer: the picture is first averaged to the size it is seen at.
    most = np.ceil(sides_m / max(float(np.median(footprint_m)), 1e-4)).astype(int)
    columns, rows = (int(n) for n in np.clip(most, 1, picture.shape[1::-1]))
    averaged = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
    u = along_m * np.float32(columns / sides_m[0]) - np.float32(0.5)
    v = np.float32(rows - 0.5) - up_m * np.float32(rows / sides_m[1])
    sampled = cv2.remap(averaged, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.moveaxis(sampled.astype(np.float32) * np.float32(1 / 255), 2, 0)


def _fill(picture: Picture, polygon_m: FloatArray, albedo_bgr: Bgr) -> None:
    """Fill a polygon (N, 2), metres from the lower left."""
    at = (np.asarray(polygon_m) * (1, -1) * _PX_PER_M + (0, len(picture)) - 0.5) * (1 << _SHIFT)
    colour = [float(c) * 255 for c in albedo_bgr]
    cv2.fillPoly(picture, [np.round(at).astype(np.int32)], colour, cv2.LINE_AA, _SHIFT)


def _rectangle(picture: Picture, left: float, low: float, wide: float, tall: float, albedo_bgr: Bgr) -> None:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (wide, tall) + (left, low)
    _fill(picture, corners, albedo_bgr)


def _stripes(
    rng: np.random.Generator, picture: Picture, left: float, low: float, wide: float, tall: float
) -> None:
    """Slanted or upright stripes of two colours in a rectangle, as of warning boards."""
    first_colour, second_colour = ((_RED, _WHITE), (_RED, _YELLOW), (_BLACK, _YELLOW), (_BLACK, _WHITE))[
        int(rng.choice(4, p=[0.45, 0.3, 0.15, 0.1]))
    ]
    rows = (len(picture) - int((low + tall) * _PX_PER_M), len(picture) - int(low * _PX_PER_M))
    columns = (
        int(left * _PX_PER_M), int((left + wide) * _PX_PER_M),
    )  # fmt: skip
    part = picture[max(rows[0], 0) : rows[1], max(columns[0], 0) : columns[1]]
    if not part.size:
        return
    stripes = _plain((wide, tall), first_colour)
    pitch = rng.uniform(0.2, 0.6) * (1.0 if max(wide, tall) < 1.2 else rng.uniform(1.0, 1.8))
    slope = rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.4) if rng.random() < 0.8 else 0.0
    chevron = slope != 0 and wide > 1 and rng.random() < 0.5
    for at in np.arange(-abs(slope) * tall - pitch, wide + abs(slope) * tall + pitch, pitch):
        bar = np.array(
            [[at, 0], [at + pitch / 2, 0], [at + pitch / 2 + slope * tall, tall], [at + slope * tall, tall]]
        )
        _fill(stripes, bar, second_colour)
    if chevron:
        half = stripes.shape[1] // 2
        stripes[:, -half:] = stripes[:, :half][:, ::-1]
    part[:] = stripes[: part.shape[0], : part.shape[1]] if stripes.shape == part.shape else cv2.resize(
        stripes, part.shape[1::-1], interpolation=cv2.INTER_AREA
    )  # fmt: skip


def _writing(
    rng: np.random.Generator, picture: Picture, left: float, low: float, wide: float, tall: float
) -> None:
    """A firm's name or a number, as capital letters at random."""
    letters = "".join(rng.choice(list("AEHIKLMNORSTUVXYZ0123456789"), int(rng.integers(2, 9))))
    scale = tall * _PX_PER_M / 22
    at = int(left * _PX_PER_M), len(picture) - int(low * _PX_PER_M)
    colour = [
        float(c) * 255 for c in (rng.uniform(0, 0.1, 3) if rng.random() < 0.4 else rng.uniform(0.1, 0.8, 3))
    ]
    clipped = picture[:, : int((left + wide) * _PX_PER_M)]
    cv2.putText(
        clipped, letters, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, max(int(scale * 3), 1), cv2.LINE_AA
    )


def _plate(rng: np.random.Generator, picture: Picture, middle: float, low: float) -> None:
    """A number plate, white or yellow, with a row of dark characters."""
    wide, tall = (0.52, 0.12) if rng.random() < 0.7 else (0.34, 0.22)
    _rectangle(picture, middle - wide / 2, low, wide, tall, _WHITE if rng.random() < 0.6 else _YELLOW)
    for k in range(6):
        _rectangle(
            picture, middle - 0.42 * wide + 0.14 * wide * k, low + 0.2 * tall, 0.09 * wide, 0.6 * tall, _BLACK
        )


def _wheel(rng: np.random.Generator, picture: Picture, middle: float, radius: float, rim: Bgr) -> None:
    """A tyre that stands on the ground, its arch and its rim: a plate, or spokes with dark gaps."""
    turn = np.linspace(0, 2 * np.pi, 20)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    hub = np.array([middle, radius])
    _fill(picture, circle * radius * 1.15 + hub, (0.03, 0.03, 0.03))
    spokes = int(rng.choice([0, 5, 6, 7, 8, 10], p=[0.4, 0.25, 0.1, 0.1, 0.05, 0.1]))
    reach = radius * rng.uniform(0.55, 0.75)
    _fill(picture, circle * reach + hub, rim)
    if spokes:
        _fill(picture, circle * 0.88 * reach + hub, (0.03, 0.03, 0.03))
        foot, tip = reach * rng.uniform([0.06, 0.06], [0.2, 0.3])
        for angle in rng.uniform(0, 2 * np.pi) + np.arange(spokes) * 2 * np.pi / spokes:
            spoke = np.array([[0, -foot], [0.95 * reach, -tip], [0.95 * reach, tip], [0, foot]])
            cos = np.cos(angle)
            sin = np.sin(angle)
            _fill(picture, spoke @ np.array([[cos, sin], [-sin, cos]]) + hub, rim)
    if not spokes or rng.random() < 0.5:
        _fill(picture, circle * radius * rng.uniform(0.1, 0.27) + hub, (0.05, 0.05, 0.05))


def _rim(rng: np.random.Generator) -> Bgr:
    """Bright aluminium half of the time."""
    grey = float(rng.uniform(0.4, 0.8) if rng.random() < 0.5 else rng.uniform(0.05, 0.4))
    return grey, grey, grey


def _bars(
    rng: np.random.Generator, picture: Picture, left: float, low: float, wide: float, tall: float
) -> None:
    """Upright bars side by side, as the straps of a curtain, the rods of doors, slats, or a plate."""
    bright = _WHITE if rng.random() < 0.5 else _colour(rng)
    if rng.random() < 0.5:
        _rectangle(picture, left, low, wide, tall, tuple(0.3 * c for c in _colour(rng)))  # type: ignore[arg-type]
    pitch = rng.uniform(0.12, 0.7)
    broad = pitch * rng.uniform(0.15, 0.6)
    for at in np.arange(left, left + wide - broad, pitch):
        _rectangle(picture, at, low, broad, tall, bright)


def _guard(rng: np.random.Generator, side: Picture, length: float) -> None:
    """The rails between the wheels of a lorry, before what is dark beneath it."""
    bright = _WHITE if rng.random() < 0.6 else _colour(rng)
    for low in rng.uniform(0.3, 0.5) + np.arange(int(rng.integers(1, 4))) * rng.uniform(0.15, 0.25):
        _rectangle(side, 0.32 * length, low, 0.4 * length, rng.uniform(0.05, 0.14), bright)


def _colour(rng: np.random.Generator) -> Bgr:
    """The colour of a vehicle: white, grey or black mostly."""
    grey = float(rng.choice([rng.uniform(0.5, 0.8), rng.uniform(0.02, 0.5)]))
    if rng.random() < 0.6:
        return grey, grey, grey
    blue, green, red = (float(c) for c in np.clip(grey * np.exp(rng.normal(0, 0.8, 3)), 0.02, 0.8))
    return blue, green, red


def _glass(rng: np.random.Generator) -> Bgr:
    return _GLASS[int(rng.integers(len(_GLASS)))]


def _lights(rng: np.random.Generator, picture: Picture, wide: float, low: float, front: bool) -> None:
    tall = rng.uniform(0.1, 0.35)
    broad = rng.uniform(0.15, 0.4)
    colour = (0.8, 0.85, 0.85) if front else (0.08, 0.06, float(rng.uniform(0.3, 0.8)))
    for left in (0.06, wide - broad - 0.06):
        _rectangle(picture, left, low, broad, tall, colour)


def _box(
    at: tuple[float, float],
    yaw: float,
    size_m: tuple[float, float, float],
    pictures: tuple[Picture | None, ...],
    albedo_bgr: Bgr,
    base_m: float = 0.0,
) -> Box:
    sides = tuple(None if picture is None else partial(reflectance, picture) for picture in pictures)
    return Box(
        centre_map=at, size_m=size_m, yaw_rad=yaw, albedo_bgr=albedo_bgr, base_m=base_m, pictures=sides
    )


def _lorry_front(rng: np.random.Generator, wide: float, tall: float, colour: Bgr) -> Picture:
    """The front of a lorry: windscreen, grille, lights and number plate."""
    front = _plain((wide, tall), colour)
    _rectangle(front, 0.08 * wide, 0.45 * tall, 0.84 * wide, 0.27 * tall, _glass(rng))
    _rectangle(front, 0.1 * wide, 0.15 * tall, 0.8 * wide, 0.2 * tall, (0.05, 0.05, 0.05))
    _lights(rng, front, wide, 0.6, front=True)
    _plate(rng, front, wide / 2, 0.45)
    return front


def _lorry(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A lorry, a trailer or a works vehicle: stripes at its rear; tape, wheels and writing on its sides."""
    length = float(rng.uniform(5, 13))
    wide = float(rng.uniform(2.1, 2.55))
    tall = float(rng.uniform(2.4, 4.0))
    colour = _colour(rng)
    rear = _plain((wide, tall), colour)
    side = _plain((length, tall), colour)
    bumper = rng.uniform(0.5, 1.1)
    _rectangle(rear, 0, 0, wide, bumper, (0.04, 0.04, 0.04))
    for left in (0.1, wide - 0.7):
        _rectangle(rear, left, 0, 0.6, 0.9 * bumper, (0.015, 0.015, 0.015))
    if rng.random() < 0.6:
        _rectangle(rear, wide / 2 - 0.02, bumper, 0.04, tall - bumper, tuple(0.5 * c for c in colour))  # type: ignore[arg-type]
    if rng.random() < 0.4:
        _rectangle(rear, 0.15 * wide, 0.62 * tall, 0.7 * wide, 0.25 * tall, _glass(rng))
    if rng.random() < 0.5:
        _writing(rng, rear, 0.1 * wide, rng.uniform(0.4, 0.8) * tall, 0.9 * wide, rng.uniform(0.15, 0.6))
    _lights(rng, rear, wide, bumper - 0.3, front=False)
    kind = rng.integers(6)
    if kind == 0:
        _stripes(rng, rear, 0.0, bumper, wide, rng.uniform(0.5, 1.0) * (tall - bumper))
    elif kind == 1:
        _stripes(rng, rear, 0.0, bumper - 0.35, wide, rng.uniform(0.14, 0.4))
    elif kind == 2:
        broad = rng.uniform(0.14, 0.45)
        for left in (0.0, wide - broad):
            _stripes(rng, rear, left, bumper, broad, min(rng.uniform(0.5, 2.0), tall - bumper))
    elif kind == 3:
        _stripes(rng, rear, 0.1, rng.uniform(0.3, 0.8) * tall, wide - 0.2, rng.uniform(0.2, 0.5))
    elif kind == 4:
        broad, low = rng.uniform([0.4, bumper - 0.4], [1.0, bumper + 1.0])
        _bars(rng, rear, wide * rng.uniform(0, 0.2), low, wide * min(broad, 0.8), rng.uniform(0.12, 1.5))
    _plate(rng, rear, wide / 2, bumper - 0.35)
    _rectangle(side, 0, 0, length, 0.85, (0.03, 0.03, 0.03))
    rim = _rim(rng)
    for middle in (0.12 * length, 0.12 * length + 1.3, 0.82 * length):
        _wheel(rng, side, middle, 0.5, rim)
    if rng.random() < 0.4:
        _guard(rng, side, length)
    if rng.random() < 0.3:
        _bars(
            rng,
            side,
            0.05 * length,
            rng.uniform(0.9, 1.2),
            0.8 * length,
            rng.uniform(0.3, 1.0) * (tall - 1.2),
        )
    _tape(rng, side, length, 0.9)
    if rng.random() < 0.5:
        _writing(rng, side, 0.1 * length, rng.uniform(0.4, 0.7) * tall, 0.8 * length, rng.uniform(0.3, 1.2))
    if rng.random() < 0.5:
        _rectangle(side, 0.84 * length, 0.5 * tall, 0.09 * length, 0.25 * tall, _glass(rng))
    front = _lorry_front(rng, wide, tall, colour)
    return [_box((x, y), yaw, (length, wide, tall), (side[:, ::-1], rear, side, front), colour, 0.02)]


def _tape(rng: np.random.Generator, side: Picture, length: float, low: float) -> None:
    """The reflecting tape along a trailer's side: in one piece or in dashes, of one or two colours."""
    if rng.random() < 0.3:
        return
    tall = rng.uniform(0.05, 0.15)
    piece = rng.uniform(0.25, 1.5)
    colours = ((_WHITE, _RED), (_WHITE, None), (_YELLOW, None), (_RED, None))[int(rng.integers(4))]
    for k, at in enumerate(np.arange(0, length, piece)):
        colour = colours[k % 2]
        if colour is not None:
            _rectangle(side, at, low, piece * 0.95, tall, colour)


def _car(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A car or a three-wheeler: body and cabin."""
    length = float(rng.uniform(2.6, 4.7))
    wide = float(rng.uniform(1.3, 1.85))
    tall = float(rng.uniform(0.75, 1.0))
    up = float(rng.uniform(0.45, 0.8))
    colour = _colour(rng)
    rim = _rim(rng)
    side = _plain((length, tall), colour)
    _rectangle(side, 0, 0, length, 0.25, (0.02, 0.02, 0.02))
    for middle in (0.18 * length, 0.8 * length):
        _wheel(rng, side, middle, 0.31, rim)
    _rectangle(side, 0.5 * length, 0.25, 0.015, tall - 0.25, tuple(0.4 * c for c in colour))  # type: ignore[arg-type]
    ends = []
    for front in (False, True):
        end = _plain((wide, tall), colour)
        _rectangle(end, 0, 0, wide, 0.25, (0.02, 0.02, 0.02))
        _lights(rng, end, wide, tall - 0.4, front)
        _plate(rng, end, wide / 2, float(rng.choice([0.3, 0.5])))
        ends.append(end)
    cabin = (0.55 * length, wide - 0.2)
    glass = _glass(rng)
    along = _plain((cabin[0], up), colour)
    across = _plain((cabin[1], up), colour)
    for left in (0.06, 0.52):
        _rectangle(along, left * cabin[0], 0.05, 0.42 * cabin[0], up - 0.12, glass)
    _rectangle(across, 0.08 * cabin[1], 0.05, 0.84 * cabin[1], up - 0.12, glass)
    back = -0.06 * length * np.array([np.cos(yaw), np.sin(yaw)])
    top = (float(x + back[0]), float(y + back[1]))
    return [
        _box((x, y), yaw, (length, wide, tall), (side[:, ::-1], ends[0], side, ends[1]), colour, 0.02),
        _box(top, yaw, (*cabin, up), (along[:, ::-1], across, along, across), colour, tall),
    ]


def _bus(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A bus or a van: rows of windows over a coloured band."""
    length = float(rng.uniform(4.5, 12))
    wide = float(rng.uniform(1.8, 2.5))
    tall = float(rng.uniform(1.9, 3.1))
    colour = _colour(rng)
    glass = _glass(rng)
    side = _plain((length, tall), colour)
    end = _plain((wide, tall), colour)
    if rng.random() < 0.6:
        band = _colour(rng)
        for picture in (side, end):
            _rectangle(picture, 0, rng.uniform(0.2, 0.4) * tall, 20, rng.uniform(0.05, 0.3), band)
    pitch = rng.uniform(0.7, 1.7)
    for left in np.arange(0.15, length - pitch, pitch):
        _rectangle(side, left, 0.5 * tall, 0.88 * pitch, 0.33 * tall, glass)
    _rectangle(end, 0.08 * wide, 0.52 * tall, 0.84 * wide, 0.33 * tall, glass)
    for picture in (side, end):
        _rectangle(picture, 0, 0, 20, 0.25, (0.02, 0.02, 0.02))
    rim = _rim(rng)
    for middle in (0.2 * length, 0.78 * length):
        _wheel(rng, side, middle, 0.42, rim)
    if rng.random() < 0.6:
        _writing(rng, side, 0.15 * length, 0.3 * tall, 0.6 * length, 0.3)
    rear = end.copy()
    front = end
    _lights(rng, rear, wide, 0.55, front=False)
    _lights(rng, front, wide, 0.45, front=True)
    for picture in (rear, front):
        _plate(rng, picture, wide / 2, 0.4)
    return [_box((x, y), yaw, (length, wide, tall), (side[:, ::-1], rear, side, front), colour, 0.02)]


def _board(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A works barrier or a row of beacons with stripes."""
    if rng.random() < 0.5:
        wide = float(rng.uniform(0.8, 3.0))
        tall = float(rng.uniform(0.2, 0.5))
        face = _plain((wide, tall), _WHITE)
        _stripes(rng, face, 0, 0, wide, tall)
        return [
            _box(
                (x, y),
                yaw,
                (0.06, wide, tall),
                (None, face, None, face),
                _WHITE,
                float(rng.uniform(0.1, 0.9)),
            )
        ]
    out = []
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    face = _plain((0.25, 1.0), _WHITE)
    _stripes(rng, face, 0, 0, 0.25, 1.0)
    for k in range(int(rng.integers(1, 5))):
        at = np.array([x, y]) + k * rng.uniform(1.5, 4) * ahead
        out.append(
            _box((float(at[0]), float(at[1])), yaw, (0.06, 0.25, 1.0), (None, face, None, face), _WHITE, 0.1)
        )
    return out


def _fence(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A railing of upright bars or a crash barrier, before dark or bright ground."""
    length = float(rng.uniform(4, 25))
    tall = float(rng.uniform(0.7, 1.3))
    bars, behind = (float(c) for c in rng.uniform(0.05, 0.75, 2))
    face = _plain((length, tall), (behind, behind, behind))
    if rng.random() < 0.6:
        pitch = rng.uniform(0.1, 0.4)
        for at in np.arange(0, length, pitch):
            _rectangle(face, at, 0, rng.uniform(0.2, 0.4) * pitch, tall, (bars, bars, bars))
    for low in (0.1, 0.5, 0.9):
        _rectangle(face, 0, low * tall, length, rng.uniform(0.03, 0.12), (bars, bars, bars))
    along = yaw if abs(yaw) < 0.3 else 0.0
    return [_box((x + length / 2, y), along, (length, 0.06, tall), (face, None, face), (bars, bars, bars))]


def _striped_kerb(rng: np.random.Generator, x: float, y: float, yaw: float) -> list[Box]:
    """A kerb or an island painted in blocks of black and white or yellow."""
    length = float(rng.uniform(6, 25))
    wide = float(rng.uniform(0.12, 1.5))
    tall = float(rng.uniform(0.1, 0.3))
    light = _WHITE if rng.random() < 0.6 else _YELLOW
    block = rng.uniform(0.3, 1.2)
    side = _plain((length, tall), (0.06, 0.06, 0.06))
    top = _plain((length, wide), (0.06, 0.06, 0.06))
    for at in np.arange(0, length, 2 * block):
        _rectangle(side, at, 0, block, tall, light)
        _rectangle(top, at, 0, block, wide, light)
    return [
        _box(
            (x + length / 2, y),
            0.0 if abs(yaw) > 0.3 else yaw,
            (length, wide, tall),
            (side, None, side, None, top),
            light,
        )
    ]
