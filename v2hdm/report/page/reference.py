"""The coordinate system of the document's coordinates, in words, and the coordinates themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.datums import is_same_datum, utm_of
from v2hdm.geometry.geodetic import LOCAL, Grid, system_of
from v2hdm.records import FloatArray, GeodeticOrigin, HDMap
from v2hdm.report.job import StatedJob
from v2hdm.report.page.facts import Facts

NOT_STATED = "not stated"


class Reference(NamedTuple):
    """Where the document's coordinates count from, in words; ``digits`` are those behind the point."""

    grid: Grid
    horizontal: str
    datum: str
    epoch: str
    vertical: str
    geoid: str
    axes: tuple[str, str]  # headings of the first and the second coordinate, with their unit
    digits: int

    def positions(self, points_map: FloatArray) -> FloatArray:
        """Points (N, 2) of the map in this system: (N, 2)."""
        flat = np.column_stack([points_map, np.zeros(len(points_map))])
        return self.grid.positions(flat)[:, :2]

    def words(self, points_map: FloatArray) -> list[tuple[str, str]]:
        """The same as text, rounded to a millimetre on the ground."""
        return [
            (f"{first:.{self.digits}f}", f"{second:.{self.digits}f}")
            for first, second in self.positions(points_map).tolist()
        ]


_LOCAL_AXES = ("east (m)", "north (m)")


def local_reference(facts: Facts) -> Reference:
    """The map's own frame."""
    return reference_of(replace(facts, job=replace(facts.job, crs=LOCAL)))


def reference_of(facts: Facts) -> Reference:
    """The system that the job asks for, else the site's UTM zone, else local metres.

    Raises MapFileError for a system that does not suit the map, or an epoch other than the drive's.
    """
    hd_map = facts.hd_map
    origin = None if hd_map is None else hd_map.origin
    where = f"{facts.folder}: crs of the report"
    chosen = facts.job.crs or (None if origin is None else utm_of(origin)) or LOCAL
    grid = Grid.of(chosen, origin, where, MapFileError)
    if grid.is_local:
        name = "local metres, east and north of the map's origin"
        if origin is None:
            horizontal = f"{name}, whose place on the earth the drive does not state"
        else:
            horizontal = f"{name} at {origin.latitude_deg:.8f}°, {origin.longitude_deg:.8f}°"
        axes = _LOCAL_AXES
        digits = 3
    else:
        system = system_of(grid.crs, where, MapFileError)
        horizontal = f"{system.name} ({grid.crs})"
        axes = ("longitude (°)", "latitude (°)") if system.is_geographic else _LOCAL_AXES
        digits = 8 if system.is_geographic else 3
    return Reference(
        grid,
        horizontal,
        _datum(origin),
        _epoch(origin, facts.job, f"{facts.folder}"),
        _vertical(hd_map, origin),
        _geoid(facts),
        axes,
        digits,
    )


def _datum(origin: GeodeticOrigin | None) -> str:
    """The datum of the drive's positions, as the drive states it."""
    if origin is None:
        return f"{NOT_STATED}: the drive has no position on the earth"
    names = {"WGS84": "World Geodetic System 1984", "ETRS89": "European Terrestrial Reference System 1989"}
    full = next((full for name, full in names.items() if is_same_datum(name, origin.datum)), None)
    named = f"{origin.datum} ({full})" if full else origin.datum
    return f"{named}, as the drive states it; no datum was transformed"


def _epoch(origin: GeodeticOrigin | None, stated: StatedJob, where: str) -> str:
    of_drive = None if origin is None else origin.epoch
    of_job = stated.job.epoch
    if of_drive is not None and of_job is not None and abs(of_drive - of_job) > _SAME_EPOCH:
        raise MapFileError(
            f"{where}: the drive's epoch is {of_drive:g}, the report's {of_job:g}; correct one of them"
        )
    epoch = of_drive if of_drive is not None else of_job
    return NOT_STATED if epoch is None else f"{epoch:g}"


_SAME_EPOCH = 0.01  # years: four days, in which no plate moves by a millimetre


def _vertical(hd_map: HDMap | None, origin: GeodeticOrigin | None) -> str:
    heights = []
    if hd_map is not None:
        heights += [marking.heights_m for marking in hd_map.markings]
        heights += [lane.heights_m for lane in hd_map.lanes]
    has_heights = any(heights_m is not None for heights_m in heights)
    if not has_heights:
        return "none: the poses have no heights, and the map lies in one plane"
    if origin is None:
        return "local: heights above the map's origin"
    return f"ellipsoidal heights of {origin.datum}"


def _geoid(facts: Facts) -> str:
    """The geoid's model, as people state it, and its height, as the drive does."""
    model = facts.job.job.geoid
    height_m = None if facts.reception is None else facts.reception.geoid_m
    if height_m is None:
        return model or f"{NOT_STATED} (none was used: heights are ellipsoidal)"
    raised = f"recorded heights above sea level were raised by {height_m:.3f} m"
    return f"{model or NOT_STATED}; {raised}"
