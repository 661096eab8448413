"""A site's design and a map of its paint, without pictures: the map's errors are drawn as it states them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from v2hdm.asbuilt.design import Design, DesignShape
from v2hdm.records import FloatArray, HDMap, Marking

OVER_M = 30.0  # correlation length, m, of the error that neighbours share
SHARED_M = 0.012  # standard deviation, m, of a coordinate of that
OWN_M = 0.005  # standard deviation, m, of a corner's coordinate alone

DASH = np.array([[-1.5, -0.075], [1.5, -0.075], [1.5, 0.075], [-1.5, 0.075]])
DIAMOND = np.array([[-0.5, 0.0], [0.0, -0.35], [0.5, 0.0], [0.0, 0.35]])


def layout(rows: int = 6, dashes: int = 20) -> Design:
    """Rows of dashes 9 m apart, with diamonds between the rows."""
    shapes = []
    for row in range(rows):
        for k in range(dashes):
            kind, outline = ("lane_dash", DASH) if row % 2 == 0 else ("diamond", DIAMOND)
            place = np.array([9.0 * k + 0.2 * row, 3.5 * row])
            shapes.append(DesignShape(f"{kind} {row}/{k}", kind, outline + place))
    return Design(tuple(shapes))


def moved(
    shape: DesignShape, east_m: float = 0.0, north_m: float = 0.0, turn_deg: float = 0.0
) -> DesignShape:
    """A shape turned about its middle and moved."""
    middle = shape.outline_map.mean(axis=0)
    return replace(
        shape, outline_map=turned(shape.outline_map - middle, turn_deg) + middle + [east_m, north_m]
    )


def turned(points: FloatArray, turn_deg: float) -> FloatArray:
    """Points (N, 2) turned about the origin."""
    angle = np.deg2rad(turn_deg)
    return points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def mapped(shapes: Sequence[DesignShape], seed: int) -> HDMap:
    """A map of painted shapes, its errors drawn from what it states."""
    rng = np.random.default_rng(seed)
    centres = np.array([shape.outline_map.mean(axis=0) for shape in shapes])
    apart_m = np.linalg.norm(centres[:, None] - centres, axis=2)
    root = np.linalg.cholesky(SHARED_M**2 * np.exp(-apart_m / OVER_M) + 1e-12 * np.eye(len(shapes)))
    common = root @ rng.standard_normal((len(shapes), 2))
    shift = np.tile(np.eye(2), (4, 1))
    covariance = SHARED_M**2 * shift @ shift.T + OWN_M**2 * np.eye(8)
    markings = [
        Marking(
            kind=shape.kind or "",
            corners_map=np.roll(shape.outline_map, rng.integers(4), axis=0)
            + common[k]
            + OWN_M * rng.standard_normal((4, 2)),
            sightings=20,
            covariance_m2=covariance,
            relative_sigma_m=OWN_M / 2,
            id=k + 1,
        )
        for k, shape in enumerate(shapes)
    ]
    return HDMap(tuple(markings), drift_over_m=OVER_M)
