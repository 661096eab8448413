"""Whether a quantity conforms to its limits, by its probability: right, off, or not to be told (JCGM 106)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import SHIFTS, turned_left
from v2hdm.records import FloatArray

CONFIDENCE = 0.99
"""Probability from which on a decision is made; between it and one minus it lies the guard band."""

_MISREAD = 0.2
"""Odds that the map, not the paint, is off where one end alone is: of 458 markings of a rendered port it took
the ends of two from other edges, half of a per cent; crews miss the length of one in fifty."""

_DRAWS = 4096  # of the corners' distribution, from which probabilities are counted: to half a per mille
_STANDARD = np.random.default_rng(106).standard_normal((_DRAWS, 8))  # the same for all: no decision is luck


class Fate(Enum):
    """The decision on a shape of a design, a marking of a map, or one of its quantities."""

    RIGHT = "right"
    OFF = "off"
    UNSURE = "unsure"  # too near a limit for its uncertainty
    MISSING = "missing"  # of the design, where images show bare ground
    NOT_INSPECTED = "not inspected"  # of the design, where too few images show the ground
    EXTRA = "extra"  # of the map alone


@dataclass(frozen=True)
class Quantity:
    """A measured quantity: its difference from the design or its value, its limits, and the decision."""

    name: str
    value: float
    sigma: float
    low: float
    high: float
    unit: str
    probability: float  # that it lies within its limits

    @property
    def fate(self) -> Fate:
        """Right, off or unsure."""
        return decided(self.probability)


class Tolerances(NamedTuple):
    """The largest differences from a design that conform.

    A marking may be turned until an end of it lies as far aside as its place may.
    """

    place_m: float = 0.05  # of its middle, along and across it
    size_m: float = 0.05  # of length and width


def decided(probability: float, confidence: float = CONFIDENCE) -> Fate:
    """The decision at the ``probability`` of conformity."""
    if probability >= confidence:
        return Fate.RIGHT
    return Fate.OFF if probability <= 1 - confidence else Fate.UNSURE


class Axes(NamedTuple):
    """Which sums of four corners are a shape's length and width, as vectors: weights (4,) of each."""

    length: FloatArray
    width: FloatArray


class Sizes(NamedTuple):
    """Length and width (...,) of quadrilaterals, m, and directions (..., 2) of their lengths."""

    length_m: FloatArray
    width_m: FloatArray
    ahead: FloatArray


_SIDES = np.array([[-0.5, 0.5, 0.5, -0.5], [-0.5, -0.5, 0.5, 0.5]])  # weights of corners: means of two sides
_DIAGONALS = np.array([[-1.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])  # weights of corners: both diagonals
_ALIKE_SIDES = 1.2  # largest ratio of the sides of a rhombus, which is measured along its diagonals
_ALIKE_DIAGONALS = 1.1  # largest ratio of the diagonals of a square, which is measured along its sides


def axes_of(corners: FloatArray) -> Axes:
    """The axes of a quadrilateral (4, 2): diagonals of a rhombus, else sides; the longer is its length."""
    sides_m = np.linalg.norm(_SIDES @ corners, axis=1)
    diagonals_m = np.linalg.norm(_DIAGONALS @ corners, axis=1)
    is_rhombus = sides_m.max() <= _ALIKE_SIDES * sides_m.min()
    is_rhombus &= diagonals_m.max() > _ALIKE_DIAGONALS * diagonals_m.min()
    weights, lengths_m = (_DIAGONALS, diagonals_m) if is_rhombus else (_SIDES, sides_m)
    longer = int(np.argmax(lengths_m))
    return Axes(weights[longer], weights[1 - longer])


def sizes_of(corners: FloatArray, axes: Axes) -> Sizes:
    """The sizes of quadrilaterals (..., 4, 2) along the axes of one of them."""
    along = np.einsum("c,...ci->...i", axes.length, corners)
    across = np.einsum("c,...ci->...i", axes.width, corners)
    length_m = np.linalg.norm(along, axis=-1)
    return Sizes(length_m, np.linalg.norm(across, axis=-1), along / length_m[..., None])


def drawn(corners: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Draws (D, 4, 2) of four corners (4, 2) with that covariance (8, 8)."""
    values, vectors = np.linalg.eigh((covariance_m2 + covariance_m2.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(corners + (_STANDARD @ root.T).reshape(-1, 4, 2))


class Judged(NamedTuple):
    """The quantities of a marking against its shape, and the probability that all of them conform."""

    quantities: tuple[Quantity, ...]
    probability: float


def judge(
    shape: FloatArray,
    corners: FloatArray,
    covariance_m2: FloatArray,
    turn: int,
    tolerance: Tolerances,
    has_size: bool,
) -> Judged:
    """Judge corners (4, 2) with a covariance (8, 8), m^2, against those of a shape (4, 2) of the design.

    Corner c of the shape is the marking's corner (c + ``turn``) mod 4. Without ``has_size`` its place and
    turn alone are judged.
    """
    every = np.concatenate([corners[None], drawn(corners, covariance_m2)])[:, SHIFTS[turn]]
    axes = axes_of(shape)
    result = _against(shape, every, axes, tolerance, has_size)
    if not has_size or decided(result.probability) is not Fate.OFF:
        return result
    misread = _one_end_conforms(shape, every[1:], axes, tolerance)
    return result._replace(probability=max(result.probability, _MISREAD * misread))


def _one_end_conforms(shape: FloatArray, every: FloatArray, axes: Axes, tolerance: Tolerances) -> float:
    """The probability that all conforms but how far one end reaches, which the map may have misread."""
    ahead = sizes_of(shape, axes).ahead
    ends = np.maximum(np.stack([axes.length, -axes.length]), 0.0)  # weights of the corners of either end
    off_m = np.einsum("ec,dci->dei", ends, every - shape)
    aside = np.abs(off_m @ turned_left(ahead)).max(axis=1) <= tolerance.place_m
    along = np.abs(off_m @ ahead).min(axis=1) <= tolerance.place_m
    return float(np.mean(aside & along))


def _against(
    shape: FloatArray, every: FloatArray, axes: Axes, tolerance: Tolerances, has_size: bool
) -> Judged:
    """The quantities of corners and draws of them (1 + D, 4, 2) against a shape's."""
    meant = sizes_of(shape, axes)
    built = sizes_of(every, axes)
    off_m = every.mean(axis=1) - shape.mean(axis=0)
    across = turned_left(meant.ahead)
    turned_deg = np.rad2deg(np.arctan2(built.ahead @ across, built.ahead @ meant.ahead))
    most_deg = float(np.rad2deg(np.arctan(2 * tolerance.place_m / meant.length_m)))
    values = [
        ("along", off_m @ meant.ahead, -tolerance.place_m, tolerance.place_m, "m"),
        ("across", off_m @ across, -tolerance.place_m, tolerance.place_m, "m"),
        ("turn", turned_deg, -most_deg, most_deg, "deg"),
    ]
    if has_size:
        values += [
            ("length", built.length_m - meant.length_m, -tolerance.size_m, tolerance.size_m, "m"),
            ("width", built.width_m - meant.width_m, -tolerance.size_m, tolerance.size_m, "m"),
        ]
    return judged(values)


def judged(values: Sequence[tuple[str, FloatArray, float, float, str]]) -> Judged:
    """Judge quantities: of each its name, value and draws (1 + D,), lower and upper limit, and unit."""
    within = [(low <= value[1:]) & (value[1:] <= high) for _, value, low, high, _ in values]
    quantities = tuple(
        Quantity(name, float(value[0]), float(value[1:].std()), low, high, unit, float(inside.mean()))
        for (name, value, low, high, unit), inside in zip(values, within, strict=True)
    )
    return Judged(quantities, float(np.all(within, axis=0).mean()))
