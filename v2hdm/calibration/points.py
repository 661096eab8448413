"""Surveyed ground points and their pixels, from a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import BoolArray, CameraInfo, FloatArray
from v2hdm.store.files import read_text

COLUMNS = ("u", "v", "x", "y")
"""Pixel (centre of the first at 0, 0) and place in the vehicle frame (x forward, y left, m)."""

LEAST_POINTS = 4  # a homography has eight degrees of freedom, a point two coordinates
_ALIASES: Mapping[str, str] = {"u_px": "u", "v_px": "v", "x_m": "x", "y_m": "y"}
_NAME = "name"


@dataclass(frozen=True)
class SurveyedPoints:
    """N ground points: ``points_px`` (N, 2) as recorded, ``points_vehicle`` (N, 2) m.

    ``names`` identify points in messages, by name and line of the file, ``labels`` in a picture.
    """

    path: Path
    names: tuple[str, ...]
    labels: tuple[str, ...]
    points_px: FloatArray
    points_vehicle: FloatArray


def read_points(path: Path) -> SurveyedPoints:
    """Read the CSV file at ``path``: names of columns in its first line, then a point a line.

    Columns are :data:`COLUMNS` and, if wanted, ``name``, parted by commas, semicolons, tabs or blanks. Raises
    DriveError where the file is missing, a column is, or a cell does not parse; with the line.
    """
    lines = [(n, line) for n, line in enumerate(read_text(path, DriveError).splitlines(), 1) if line.strip()]
    lines = [(n, line) for n, line in lines if n == lines[0][0] or not line.lstrip().startswith("#")]
    if not lines:
        raise DriveError(f"{path}: is empty; expected the columns {', '.join(COLUMNS)} and a line a point")
    title = lines[0][1].lstrip("\ufeff# ")
    separator = next((mark for mark in ";,\t" if mark in title), None)
    columns = _columns(_split(title, separator), path)
    names, labels, rows = [], [], []
    for number, line in lines[1:]:
        cells = _split(line, separator)
        if len(cells) != len(columns):
            raise DriveError(
                f"{path}: line {number}: {len(cells)} cells under {len(columns)} columns; mend that line"
            )
        row = dict(zip(columns, cells, strict=True))
        name = row.get(_NAME, "")
        names.append(f"point {name} (line {number})" if name else f"the point of line {number}")
        labels.append(name or f"line {number}")
        rows.append([_number(row[column], f"{path}: line {number}: {column}") for column in COLUMNS])
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if len(table) < LEAST_POINTS:
        raise DriveError(
            f"{path}: {len(table)} points; {LEAST_POINTS} barely fix a camera, ten tell how well: survey more"
        )
    return SurveyedPoints(path, tuple(names), tuple(labels), table[:, :2], table[:, 2:])


def check_points(points: SurveyedPoints, info: CameraInfo) -> None:
    """Refuse points outside the image, and one that is there twice.

    Raises DriveError, which names the first.
    """
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
        for a, b in combinations(range(len(table)), 2):
            if np.array_equal(table[a], table[b]):
                raise DriveError(
                    f"{points.path}: {points.names[a]} and {points.names[b]} have the same {what}; drop or "
                    "mend one of them"
                )


def _columns(header: list[str], path: Path) -> list[str]:
    """The columns' names as ours, in the order of the file."""
    columns = [_ALIASES.get(name.strip().lower(), name.strip().lower()) for name in header]
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
            raise DriveError(
                f"{path}: column '{name}' is not known ({', '.join(COLUMNS)} and {_NAME} are); {hint}"
            )
    return columns


def _split(line: str, separator: str | None) -> list[str]:
    cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
    return [cell.strip() for cell in cells]


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        comma = "; write a decimal point" if "," in cell else ""
        raise DriveError(f"{where}: '{cell}' is not a number{comma}; mend that line") from None
    if not np.isfinite(value):
        raise DriveError(f"{where}: '{cell}' is not a finite number; drop or mend that line")
    return value
