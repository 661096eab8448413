"""Lines as few smooth pieces: cubics for the course of a road, straight ones for its heights and widths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import cross, length_along, turned_left
from v2hdm.records import FloatArray

_COURSE_M = 0.002  # distance, m, within which the pieces of a course pass a line's vertices; chosen
_STRAIGHT_M = 1e-6  # deviation from its chord, m, below which a piece is straight
_SAMPLE_M = 0.5  # spacing of the points at which a course is known, m; chosen
_ROOT, _WEIGHT = np.polynomial.legendre.leggauss(12)  # for the length of a cubic, exact to 1e-6 m


class Piece(NamedTuple):
    """A cubic from a place in a direction: its own axes are forward u and left v, its parameter 0 to 1."""

    place: FloatArray  # (2,) m
    heading_rad: float
    u: tuple[float, float, float]  # coefficients of p, p^2 and p^3; that of 1 is 0
    v: tuple[float, float, float]
    length_m: float

    @property
    def is_straight(self) -> bool:
        """Whether it is a straight line."""
        return max(abs(coefficient) for coefficient in self.v) < _STRAIGHT_M

    def points(self, share: FloatArray) -> FloatArray:
        """The points (N, 2), m, at parameters (N,)."""
        powers = np.stack([share, share**2, share**3], axis=1)
        return self.place + np.stack([powers @ self.u, powers @ self.v], axis=1) @ self._axes

    def ahead(self, share: FloatArray) -> FloatArray:
        """The unit directions (N, 2) at parameters (N,)."""
        powers = np.stack([np.ones_like(share), 2 * share, 3 * share**2], axis=1)
        ahead = np.stack([powers @ self.u, powers @ self.v], axis=1) @ self._axes
        return np.asarray(ahead / np.linalg.norm(ahead, axis=1, keepdims=True))

    @property
    def _axes(self) -> FloatArray:
        cosine = np.cos(self.heading_rad)
        sine = np.sin(self.heading_rad)
        return np.array([[cosine, sine], [-sine, cosine]])


def _piece(place: FloatArray, end: FloatArray, start_ahead: FloatArray, end_ahead: FloatArray) -> Piece:
    """The cubic from one place and direction to another."""
    axes = np.stack([start_ahead, turned_left(start_ahead)])
    du, dv = (axes @ (end - place)).tolist()
    tu, tv = (axes @ end_ahead).tolist()
    speed = 2 * float(np.hypot(du, dv)) / (1 + float(np.sqrt(max((1 + tu) / 2, 0.0))))  # as along an arc
    u = (speed, 3 * du - 2 * speed - speed * tu, speed + speed * tu - 2 * du)
    v = (0.0, 3 * dv - speed * tv, speed * tv - 2 * dv)
    if max(map(abs, v)) < _STRAIGHT_M:
        u = (du, 0.0, 0.0)
        v = (0.0, 0.0, 0.0)
    share = (_ROOT + 1) / 2
    slopes = np.stack([np.ones_like(share), 2 * share, 3 * share**2], axis=1)
    length_m = float(np.hypot(slopes @ u, slopes @ v) @ _WEIGHT / 2)
    heading_rad = float(np.arctan2(start_ahead[1], start_ahead[0]))
    return Piece(place, heading_rad, u, v, length_m)


@dataclass(frozen=True)
class Course:
    """The course of a road: pieces end to end, each as the one before it ends."""

    pieces: tuple[Piece, ...]

    @classmethod
    def through(cls, points: FloatArray, ahead: FloatArray) -> Course:
        """The course along a polyline (N, 2), m, with unit directions (N, 2) at its vertices."""
        at_m = length_along(points)

        pieces = []
        pending = [(0, len(points) - 1)]
        while pending:
            first, last = pending.pop()
            piece = _piece(points[first], points[last], ahead[first], ahead[last])
            inner = np.arange(first + 1, last)
            share = (at_m[inner] - at_m[first]) / max(at_m[last] - at_m[first], 1e-12)
            off = points[inner] - piece.points(share)
            across_m = np.abs((off * turned_left(piece.ahead(share))).sum(axis=1))
            if across_m.max(initial=0.0) <= _COURSE_M:
                pieces.append(piece)
                continue
            worst = int(inner[np.argmax(across_m)])
            pending += [(worst, last), (first, worst)]  # the first one is next
        return cls(tuple(_merged(pieces)))

    @property
    def start_m(self) -> FloatArray:
        """The way (N + 1,) to the start of each piece, and to the end."""
        return np.concatenate([[0.0], np.cumsum([piece.length_m for piece in self.pieces])])

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(self.start_m[-1])

    @cached_property
    def stations(self) -> Stations:
        """Points along the whole course, its ends included."""
        s_m, points, ahead = [], [], []
        for piece, start_m in zip(self.pieces, self.start_m, strict=False):
            share = np.linspace(0.0, 1.0, max(int(np.ceil(piece.length_m / _SAMPLE_M)), 1) + 1)
            places = piece.points(share)
            way_m = length_along(places)
            s_m.append(start_m + way_m * piece.length_m / max(way_m[-1], 1e-12))
            points.append(places)
            ahead.append(piece.ahead(share))
        first = [slice(None)] + [slice(1, None)] * (len(s_m) - 1)
        return Stations(
            *(
                np.concatenate([part[k] for part, k in zip(parts, first, strict=True)])
                for parts in (s_m, points, ahead)
            )
        )


class Stations(NamedTuple):
    """Points of a course."""

    s_m: FloatArray  # (N,) the way there
    points: FloatArray  # (N, 2) m
    ahead: FloatArray  # (N, 2) unit directions

    def widths_m(self, border: FloatArray) -> FloatArray:
        """The distance (N,) from each to a polyline (M, 2) on the right, across the course."""
        if len(border) < 2:
            return np.asarray(np.linalg.norm(self.points - border[0], axis=1))
        step = np.diff(border, axis=0)
        longer = np.concatenate([border[:1] - _ahead(step, 0), border, border[-1:] + _ahead(step, -1)])
        widths_m = [
            _widths_m(self.points[k : k + _AT_ONCE], self.ahead[k : k + _AT_ONCE], longer)
            for k in range(0, len(self.points), _AT_ONCE)
        ]
        return np.concatenate(widths_m)


def _widths_m(points: FloatArray, ahead: FloatArray, border: FloatArray) -> FloatArray:
    """The same for neighbouring points (N, 2) and directions (N, 2)."""
    low = points.min(axis=0) - _WIDEST_M
    high = points.max(axis=0) + _WIDEST_M
    begin = border[:-1]
    end = border[1:]
    is_near = ((np.maximum(begin, end) >= low) & (np.minimum(begin, end) <= high)).all(axis=1)
    begin = begin[is_near] if is_near.any() else begin
    side = (end[is_near] if is_near.any() else end) - begin
    right = -turned_left(ahead)[:, None]
    offset = begin - points[:, None]
    area = cross(right, side)
    divisor = np.where(np.abs(area) < 1e-12, 1.0, area)
    away_m = cross(offset, side) / divisor
    part = cross(offset, right) / divisor
    is_met = (np.abs(area) >= 1e-12) & (part >= -1e-9) & (part <= 1 + 1e-9) & (away_m >= 0)
    met_m = np.where(is_met, away_m, np.inf).min(axis=1)
    along = np.clip(-(offset * side).sum(axis=2) / np.maximum((side**2).sum(axis=1), 1e-12), 0.0, 1.0)
    apart_m = np.linalg.norm(offset + along[..., None] * side, axis=2).min(axis=1)
    return np.asarray(np.where(met_m < 2 * apart_m + 1.0, met_m, apart_m))


_AT_ONCE = 64  # neighbouring points whose widths are computed at once; chosen
_WIDEST_M = 12.0  # reach, m, within which the other side of a lane lies; chosen
_LONGER_M = 3.0  # straight extension of a border beyond its ends, m, which may be askew; chosen


def _ahead(step: FloatArray, which: int) -> FloatArray:
    return np.asarray(step[which] / max(float(np.linalg.norm(step[which])), 1e-12) * _LONGER_M)


def _merged(pieces: list[Piece]) -> list[Piece]:
    """The pieces with straight ones that go on in one direction made one."""
    merged = pieces[:1]
    for piece in pieces[1:]:
        last = merged[-1]
        is_on = abs(np.sin(piece.heading_rad - last.heading_rad)) < _STRAIGHT_M
        if last.is_straight and piece.is_straight and is_on:
            length_m = last.length_m + piece.length_m
            merged[-1] = last._replace(u=(length_m, 0.0, 0.0), length_m=length_m)
        else:
            merged.append(piece)
    return merged


def thinned(at: FloatArray, values: FloatArray, tolerance: float) -> list[int]:
    """Few of N points, by Douglas and Peucker (1973), whose straight pieces pass all ``values`` (N,)."""
    vertices = {0, len(at) - 1}
    pending = [(0, len(at) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        inner = slice(first + 1, last)
        off = np.abs(values[inner] - np.interp(at[inner], at[[first, last]], values[[first, last]]))
        worst = first + 1 + int(np.argmax(off))
        if off.max() > tolerance:
            vertices.add(worst)
            pending += [(first, worst), (worst, last)]
    return sorted(vertices)


def linear_records(at: FloatArray, values: FloatArray, tolerance: float) -> list[tuple[float, float, float]]:
    """Starts, values and slopes of the straight pieces of :func:`thinned`."""
    vertices = thinned(at, values, tolerance)
    slopes = np.diff(values[vertices]) / np.diff(at[vertices])
    return list(zip(at[vertices[:-1]].tolist(), values[vertices[:-1]].tolist(), slopes.tolist(), strict=True))
