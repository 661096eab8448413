"""Symbols of convex parts: bicycles, people, and paint that has no class of its own.

Shapes run along the way (first axis) and to the left of it, upright for who drives along it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from v2hdm.records import FloatArray

_JOINTS = {
    "pedal": (0.23, -0.05), "saddle": (0.52, -0.17), "tip": (0.52, -0.08), "back": (0.52, -0.26),
    "head": (0.55, 0.2), "stem": (0.64, 0.18), "grip": (0.62, 0.32), "hip": (0.6, -0.17),
    "knee": (0.5, 0.04), "shoulder": (0.93, 0.03), "face": (1.09, 0.08),
}  # fmt: skip
"""Up and to the right, of a bicycle and its rider; a bicycle is 1 wide."""

_FRAME: tuple[str, ...] = ("rear pedal head tip pedal", "back tip rear", "front head stem grip")
_RIDER: tuple[str, ...] = ("shoulder hip knee pedal", "shoulder grip")

_LIMBS = (((0.0, 0.14), (0.45, 0.03)), ((0.48, 0.22), (0.78, 0.02)))
"""Up and aside, the ends of a leg and an arm of a person 1 tall."""

_SIDES = 10  # number of sides of the polygons that wheels and heads are


def user(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of a symbol of who may go there: a bicycle, people, or a wheelchair."""
    draw = (bicycle, people, wheelchair)[int(rng.choice(3, p=[0.7, 0.2, 0.1]))]
    yield from draw(rng)


def bicycle(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of a bicycle seen from its side, sometimes with a rider; 0.8 to 1.9 m wide."""
    place = _random_place(rng)
    thick = rng.uniform(0.05, 0.11)
    wheel = rng.uniform(0.2, 0.26)
    joints = {name: np.array(at) + rng.normal(0, 0.02, 2) for name, at in _JOINTS.items()}
    joints |= {"rear": np.array([wheel, wheel - 0.5]), "front": np.array([wheel, 0.5 - wheel])}
    has_rider = rng.random() < 0.35
    if has_rider:
        yield place(disc(joints["face"], 0.09))
    for hub in ("rear", "front"):
        for part in ring(joints[hub], wheel - thick / 2, thick):
            yield place(part)
    for line in _FRAME + _RIDER if has_rider else _FRAME:
        for start, end in pairwise(line.split()):
            yield place(bar(joints[start], joints[end], thick))


def people(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of a person on foot, half of the time with a child by the hand."""
    place = _random_place(rng)
    thick = rng.uniform(0.07, 0.11)
    for tall, left in [(1.0, 0.0)] if rng.random() < 0.5 else [(1.0, -0.2), (0.65, 0.25)]:
        foot = np.array([0.0, left])
        yield place(foot + tall * disc(np.array([0.92, 0.0]), 0.1))
        yield place(foot + tall * np.array([[0.43, -0.07], [0.78, -0.1], [0.78, 0.1], [0.43, 0.07]]))
        for limb in _LIMBS:
            for side in (-1, 1):
                start, end = np.array(limb) * (1, side)
                yield place(foot + tall * bar(start, end, thick))


def other_sign(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of paint without a class of its own: rings, crosses, corners of bays, zigzags, bumps."""
    draw = (_ring_sign, _cross, _corners, _zigzag, _bump)[int(rng.integers(5))]
    yield from draw(rng)


def _ring_sign(rng: np.random.Generator) -> Iterator[FloatArray]:
    """A ring or a disc, as of a speed limit, drawn out along the way."""
    radius = rng.uniform(0.5, 1.3)
    stretch = rng.uniform(1.0, 2.5)
    parts = (
        ring(np.zeros(2), radius, rng.uniform(0.1, 0.25))
        if rng.random() < 0.75
        else [disc(np.zeros(2), radius)]
    )
    for part in parts:
        yield part * (stretch, 1.0)


def _cross(rng: np.random.Generator) -> Iterator[FloatArray]:
    """A cross of two bars."""
    size = rng.uniform(0.5, 2.5)
    stretch = rng.uniform(1.0, 2.0)
    for side in (-1.0, 1.0):
        end = np.array([size, side * size]) / 2
        yield bar(-end, end, rng.uniform(0.1, 0.3)) * (stretch, 1.0)


def _corners(rng: np.random.Generator) -> Iterator[FloatArray]:
    """The corners of parking bays: Ls or Ts."""
    arm = rng.uniform(0.3, 1.0)
    thick = rng.uniform(0.08, 0.16)
    deep = rng.uniform(4.5, 6.0)
    is_tee = rng.random() < 0.5
    for k in range(int(rng.integers(2, 6))):
        along = k * deep
        yield bar(np.array([along, 0.0]), np.array([along, arm]), thick)
        yield bar(np.array([along - arm * is_tee, 0.0]), np.array([along + arm, 0.0]), thick)


def _zigzag(rng: np.random.Generator) -> Iterator[FloatArray]:
    """A zigzag along the side of the way, as before crossings and at stops."""
    pitch = rng.uniform(1.0, 2.5)
    wide = rng.uniform(0.25, 0.8)
    thick = rng.uniform(0.1, 0.18)
    corners = np.array([[k * pitch, wide * (k % 2)] for k in range(int(rng.integers(4, 9)))])
    for start, end in pairwise(corners):
        yield bar(start, end, thick)


def _bump(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Triangles or blocks side by side on a speed bump."""
    size = rng.uniform(0.3, 0.8)
    long = rng.uniform(0.5, 1.6)
    is_block = rng.random() < 0.5
    for k in range(int(rng.integers(3, 7))):
        left = (2 * k - 6) * size
        tip = np.array([[0.0, left], [long, left + size], [0.0, left + size]])
        block = np.array([[0.0, left], [long, left], [long, left + size], [0.0, left + size]])
        yield block if is_block else tip


def wheelchair(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of a wheelchair with who sits in it."""
    place = _random_place(rng)
    thick = rng.uniform(0.07, 0.12)
    for part in ring(np.array([0.3, -0.05]), 0.27, thick, 2 * np.pi * 0.7):
        yield place(part)
    yield place(disc(np.array([0.92, 0.0]), 0.09))
    for start, end in pairwise(np.array([[0.8, 0.0], [0.45, 0.0], [0.45, 0.35], [0.1, 0.45]])):
        yield place(bar(start, end, thick))


def disc(centre: FloatArray, radius: float) -> FloatArray:
    """A polygon (N, 2), counter-clockwise, that is nearly a disc."""
    turn = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    return np.asarray(centre + radius * np.column_stack([np.cos(turn), np.sin(turn)]))


def ring(centre: FloatArray, radius: float, thick: float, turn_rad: float = 2 * np.pi) -> list[FloatArray]:
    """Convex parts (4, 2) of a ring, or of an arc of it, whose line has a radius and a thickness."""
    turn = np.linspace(0, turn_rad, 1 + max(int(_SIDES * turn_rad / (2 * np.pi)), 3))
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    inner, outer = (centre + (radius + side * thick / 2) * around for side in (-1, 1))
    return [np.array([inner[k], outer[k], outer[k + 1], inner[k + 1]]) for k in range(len(turn) - 1)]


def bar(start: FloatArray, end: FloatArray, thick: float) -> FloatArray:
    """A bar (4, 2) from point to point, counter-clockwise."""
    ahead = (end - start) / np.linalg.norm(end - start)
    left = np.array([-ahead[1], ahead[0]]) * thick / 2
    return np.array([start - left, end - left, end + left, start + left])


def _random_place(rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """How parts (N, 2) of a figure of unit size become metres: drawn out along the way, perhaps mirrored."""
    wide_m = rng.uniform(0.8, 1.9)
    stretch = rng.uniform(0.9, 2.6)
    flip = int(rng.choice([-1, 1]))

    def place(part: FloatArray) -> FloatArray:
        return np.asarray((part * (wide_m * stretch, flip * wide_m))[::flip])

    return place
