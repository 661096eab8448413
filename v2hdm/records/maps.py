"""A map: markings, symbols, lanes, and the ground that they lie on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from v2hdm.doors import checked_class
from v2hdm.records.arrays import FloatArray
from v2hdm.records.poses import GeodeticOrigin


@dataclass(frozen=True)
class PaintLeft:
    """The ``share`` of a marking's paint that is left, 0 to 1; its change since an earlier map, if any."""

    share: float
    sigma: float
    change: float | None = None
    change_sigma: float | None = None

    def since(self, before: PaintLeft | None) -> PaintLeft:
        """The same, with the change since an earlier measurement."""
        if before is None:
            return self
        sigma = float(np.hypot(self.sigma, before.sigma))
        return replace(self, change=self.share - before.share, change_sigma=sigma)


ACCURACIES = ("A", "B", "C")
"""Accuracy of a marking or symbol, the best first: the 95 % radius of its worst corner is within the accuracy
goal, within twice the goal, or larger."""

UNSTATED_DRIFT_OVER_M = 30.0
"""Correlation length, m, of the error that a map's neighbouring markings share, in a map that states none."""

UNSTATED_SIGMA_M = 0.02
"""Standard deviation, m, of a corner's coordinate in a map that states none: drawn over an image."""


class Reading(NamedTuple):
    """A word's ``text`` and, where it may be another, its ``alternative``, with their probabilities."""

    text: str
    confidence: float
    alternative: str | None = None
    alternative_confidence: float | None = None


@dataclass(frozen=True)
class Marking:
    """One mapped marking."""

    kind: str
    corners_map: FloatArray  # (4, 2) m, counter-clockwise from above
    sightings: int
    covariance_m2: FloatArray | None = None  # (8, 8) of the stacked corners, if known
    # of a coordinate of its centre, given those of its neighbours: what they share cancels
    relative_sigma_m: float | None = None
    heights_m: FloatArray | None = None  # (4,) of the ground, None for z = 0
    id: int | None = None  # positive and unique; None until the map is written
    paint: PaintLeft | None = None  # None if no image shows enough of it
    heights_sigma_m: FloatArray | None = None  # (4,) where estimated
    accuracy: str | None = None  # of :data:`ACCURACIES`; None without covariance, or before a goal was set
    variety: str | None = None  # within its class, as :data:`GIVE_WAY`

    @property
    def corner_covariances_m2(self) -> FloatArray | None:
        """Covariance (4, 2, 2) of each corner alone, if known."""
        whole = self.covariance_m2
        return None if whole is None else whole.reshape(4, 2, 4, 2)[range(4), :, range(4), :]


@dataclass(frozen=True)
class Symbol:
    """One mapped symbol or area, as a :class:`Marking`; ``covariance_m2`` (2N, 2N), if known, is of vertices.

    Areas are rectangles. The outline of a crosswalk is four corners, the first two along ends of its bars.
    """

    kind: str
    outline_map: FloatArray  # (N, 2) m, counter-clockwise from above, in one order for all of a template
    sightings: int
    sigma_m: float | None = None  # of a coordinate
    heights_m: FloatArray | None = None
    id: int | None = None
    heights_sigma_m: FloatArray | None = None
    # (2N, 2N), None where sightings share an outline that no polygon explains
    covariance_m2: FloatArray | None = None
    accuracy: str | None = None
    # of a text, None where it is not read; then the outline begins at the lower left, as it is read
    reading: Reading | None = None
    parts: tuple[int, ...] = ()  # ids of the markings that it is composed of


@dataclass(frozen=True)
class Lane:
    """One mapped lane line: a polyline along its centre; heights and id as of a :class:`Marking`.

    A :data:`DOUBLE_LINE` runs midway between its two ``lines``, the classes of the left and the right one,
    whose centres are ``apart_m`` apart.
    """

    kind: str
    points_map: FloatArray  # (N, 2) m
    sightings: int
    heights_m: FloatArray | None = None
    id: int | None = None
    sigma_m: FloatArray | None = None  # (N,) of each vertex across, None unless adjusted
    heights_sigma_m: FloatArray | None = None
    lines: tuple[str, str] | None = None
    apart_m: float | None = None

    @property
    def painted(self) -> tuple[Lane, ...]:
        """The lines as they are painted: of a double one the left one, with its id, and the right one."""
        if self.lines is None or self.apart_m is None or len(self.points_map) < 2:
            return (self,)
        x, y = np.gradient(self.points_map, axis=0).T
        left = self.apart_m / 2 * np.column_stack([-y, x]) / np.maximum(np.hypot(x, y), 1e-9)[:, None]
        single = replace(self, lines=None, apart_m=None)
        return (
            replace(single, kind=self.lines[0], points_map=self.points_map + left),
            replace(single, kind=self.lines[1], points_map=self.points_map - left, id=None),
        )


@dataclass(frozen=True)
class GroundStrip:
    """The estimated ground along a path, a grid of heights."""

    points_map: FloatArray  # (N, 2) m of the path, ``step_m`` apart
    ahead: FloatArray  # (N, 2) unit vectors along it
    step_m: float
    left_m: FloatArray  # (M,) to its left, evenly rising
    heights_m: FloatArray  # (N, M) of the ground
    sigma_m: FloatArray  # (N, M) their standard deviations

    def points(self, left_m: float) -> FloatArray:
        """Points (N, 2) so far to the left of the path."""
        return self.points_map + left_m * np.column_stack([-self.ahead[:, 1], self.ahead[:, 0]])


@checked_class
@dataclass(frozen=True)
class HDMap:
    """Markings, lanes and symbols of a site in its map frame.

    ``drift_over_m`` is the correlation length of the error that neighbouring markings share, None if unknown;
    ``largest_id`` the largest id ever given, 0 if a present feature has it; ``ground`` the estimated surface
    by session.

    >>> marking = result.map.markings[0]
    >>> marking.corners_map.shape, marking.covariance_m2.shape
    ((4, 2), (8, 8))
    """

    markings: tuple[Marking, ...]
    lanes: tuple[Lane, ...] = ()
    origin: GeodeticOrigin | None = None
    symbols: tuple[Symbol, ...] = ()
    drift_over_m: float | None = None
    largest_id: int = 0
    ground: tuple[GroundStrip, ...] = ()

    @property
    def accuracies(self) -> list[str]:
        """The accuracy of each marking and symbol that states one."""
        graded: list[Marking | Symbol] = [*self.markings, *self.symbols]
        return [paint.accuracy for paint in graded if paint.accuracy is not None]

    def to_geodataframe(self) -> Any:
        """The features as a ``geopandas.GeoDataFrame``, one row each.

        Columns are id, layer, kind, sightings, accuracy (None for a lane) and geometry: longitude, latitude
        and ellipsoidal height, m (EPSG:4326), where the map has an origin, and metres of the frame ``map``
        otherwise.

        Raises:
            ModuleNotFoundError: geopandas is not installed; the message names the extra.

        >>> frame = result.map.to_geodataframe()
        >>> len(frame) == len(result.map.markings) + len(result.map.lanes) + len(result.map.symbols)
        True
        """
        from v2hdm.dataframe import geodataframe  # only those who ask for one load it

        return geodataframe(self)


@dataclass(frozen=True)
class Exclusion:
    """A candidate that the map of the set ``cameras`` left out: what, where (2,) in the map, and why."""

    kind: str
    position_map: FloatArray
    sightings: int
    reason: str
    cameras: str = ""
