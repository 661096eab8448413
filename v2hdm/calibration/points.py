"""Surveyed ground points and their pixels, from a CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.importers.tables import read_rows
from v2hdm.io.trajectory import parse_number
from v2hdm.records import BoolArray, CameraInfo, FloatArray

COLUMNS = ("u", "v", "x", "y")  # pixel (centre of the first at 0, 0) and place, m forward and left
LEAST_POINTS = 4  # a homography has eight degrees of freedom, a point two coordinates
_ALIASES: Mapping[str, str] = {"u_px": "u", "v_px": "v", "x_m": "x", "y_m": "y"}
_NAME = "name"


@dataclass(frozen=True)
class SurveyedPoints:
    """N ground points, recorded px and vehicle frame (m), (N, 2); names for messages, labels for pictures."""

    path: Path
    names: tuple[str, ...]
    labels: tuple[str, ...]
    points_px: FloatArray
    points_vehicle: FloatArray


def read_points(path: Path) -> SurveyedPoints:
    """Read a CSV file: names of :data:`COLUMNS`, perhaps ``name``, then a point a line; raises DriveError."""
    header, lines = read_rows(path, ";,\t", "point")
    columns = _columns(header, path)
    names, labels, rows = [], [], []
    for number, cells in lines:
        row = dict(zip(columns, cells, strict=True))
        name = row.get(_NAME, "")
        names.append(f"point {name} (line {number})" if name else f"the point of line {number}")
        labels.append(name or f"line {number}")
        rows.append([parse_number(row[column], f"{path}: line {number}: {column}") for column in COLUMNS])
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if len(table) < LEAST_POINTS:
        raise DriveError(f"{path}: {len(table)} points; {LEAST_POINTS} barely fix a camera: survey more")
    return SurveyedPoints(path, tuple(names), tuple(labels), table[:, :2], table[:, 2:])


def check_points(points: SurveyedPoints, info: CameraInfo) -> None:
    """Raise DriveError, which names the first, for points outside the image or there twice."""
    size = np.array([info.width, info.height])

    def inside(points_px: FloatArray) -> BoolArray:
        return np.asarray(((points_px > -0.5) & (points_px < size - 0.5)).all(axis=1))

    outside = ~inside(points.points_px)
    if outside.any():
        k = int(np.argmax(outside))
        u, v = points.points_px[k]
        hint = "mend it, or name the intrinsics of this image"
        if inside(points.points_px[:, ::-1]).all():
            hint = "u and v look exchanged: u counts columns to the right, v rows down"
        raise DriveError(
            f"{points.path}: {points.names[k]}: pixel ({u:g}, {v:g}) lies outside the image of "
            f"{info.width} x {info.height}; {hint}"
        )
    for what, table in (("pixel", points.points_px), ("place on the ground", points.points_vehicle)):
        _, first, same = np.unique(table, axis=0, return_index=True, return_inverse=True)
        again = np.flatnonzero(first[same.ravel()] < np.arange(len(table)))
        if len(again):
            a, b = first[same.ravel()[again[0]]], again[0]
            raise DriveError(
                f"{points.path}: {points.names[a]} and {points.names[b]} have the same {what}; drop or mend "
                "one of them"
            )


def _columns(header: list[str], path: Path) -> list[str]:
    """The columns' names as ours, in the order of the file."""
    columns = [_ALIASES.get(name.lower(), name.lower()) for name in header]
    for column in COLUMNS:
        if columns.count(column) != 1:
            raise DriveError(
                f"{path}: {'no' if column not in columns else 'more than one'} column '{column}'; the first "
                f"line must name {', '.join(COLUMNS)} (pixel right and down, m forward and left); it says: "
                f"{', '.join(header)}"
            )
    for name in columns:
        if name not in (*COLUMNS, _NAME):
            hint = "points must lie on the ground; drop it" if name in ("z", "z_m") else "drop it"
            raise DriveError(f"{path}: column '{name}' is not one of {', '.join(COLUMNS)}, {_NAME}; {hint}")
    return columns
