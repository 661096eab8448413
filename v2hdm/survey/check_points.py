r"""Check points: surveyed corners that no estimate has used, against the map.

Errors of a map's corners are correlated, since remaining GNSS drift moves all of them. The joint test of all
points therefore uses their joint covariance,

.. math:: T = e' (C_\text{map} + C_\text{survey})^{-1} e,

which is chi-square with one degree of freedom per coordinate if both covariances are right. T per degree of
freedom is the normalised estimation error squared (NEES), 1 on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.special import chdtrc, chdtri

from v2hdm.io.maps.features import features_of
from v2hdm.records import FloatArray, HDMap, JointCovariance
from v2hdm.store.files import replace_csv
from v2hdm.survey.match import match
from v2hdm.survey.read import SurveyedPoint

INSIDE = 0.95  # probability of the reported confidence ellipse

COLUMNS: tuple[str, ...] = (
    *("id", "description", "x_map_m", "y_map_m", "marking", "class", "corner"),
    *("dx_m", "dy_m", "distance_m", "sigma_x_m", "sigma_y_m", "map_sigma_x_m", "map_sigma_y_m"),
    *("normalised_error", "inside_95_percent", "dz_m", "not_compared_because"),
)
"""Differences are map minus survey; ``corner`` counts from 1. ``sigma_...`` combine map and survey.
``normalised_error`` is the Mahalanobis distance over both axes."""


@dataclass(frozen=True)
class CheckedPoint:
    """One check point and the nearest corner of the map."""

    point: SurveyedPoint
    marking: int
    marking_id: int  # in the map's files
    kind: str
    corner: int  # 0 to 3
    off_m: FloatArray  # (2,) map minus survey
    map_covariance_m2: FloatArray  # (2, 2)
    off_height_m: float | None  # map minus survey; None without both heights

    @property
    def covariance_m2(self) -> FloatArray:
        """Covariance (2, 2) of the difference."""
        return np.asarray(self.map_covariance_m2 + np.diag(self.point.sigma_m**2))

    @property
    def distance_m(self) -> float:
        """Horizontal distance."""
        return float(np.linalg.norm(self.off_m))

    @property
    def normalised(self) -> float:
        """Mahalanobis distance."""
        return float(np.sqrt(self.off_m @ np.linalg.solve(self.covariance_m2, self.off_m)))

    @property
    def is_inside(self) -> bool:
        """Whether it is inside its 95 % ellipse."""
        return bool(self.normalised**2 <= chdtri(2, 1 - INSIDE))


@dataclass(frozen=True)
class CheckTable:
    """Check points of a survey: ``compared`` ones with a map corner, ``unmatched`` ones with a reason.

    ``covariance_m2`` (2N, 2N) is the differences' joint covariance, stacked x0, y0, x1, ...
    """

    compared: tuple[CheckedPoint, ...]
    unmatched: tuple[tuple[SurveyedPoint, str], ...]
    covariance_m2: FloatArray

    @property
    def off_m(self) -> FloatArray:
        """Differences (N, 2), map minus survey."""
        return np.array([checked.off_m for checked in self.compared]).reshape(-1, 2)

    @property
    def rmse_m(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(np.sum(self.off_m**2, axis=1))))

    @property
    def squared(self) -> float:
        """T of all differences."""
        return squared(self.off_m.ravel(), self.covariance_m2)

    def figures(self) -> dict[str, Any]:
        """The figures in ``metrics.json``."""
        out: dict[str, Any] = {"points": len(self.compared) + len(self.unmatched)}
        out |= {"compared": len(self.compared), "unmatched": {p.id: why for p, why in self.unmatched}}
        if not self.compared:
            return out
        degrees = 2 * len(self.compared)
        rmse_x_m, rmse_y_m = (float(np.sqrt(np.mean(off_m**2))) for off_m in self.off_m.T)
        mean_x_m, mean_y_m = self.off_m.mean(axis=0).tolist()
        heights_m = np.array(
            [checked.off_height_m for checked in self.compared if checked.off_height_m is not None]
        )
        return out | {
            "rmse_m": self.rmse_m,
            "rmse_x_m": rmse_x_m,
            "rmse_y_m": rmse_y_m,
            "mean_x_m": mean_x_m,
            "mean_y_m": mean_y_m,
            "percentile_95_m": self._percentile_m(),
            "largest_m": max(checked.distance_m for checked in self.compared),
            "inside_95_percent": sum(checked.is_inside for checked in self.compared),
            "chi_square": self.squared,
            "degrees_of_freedom": degrees,
            "nees": self.squared / degrees,
            "probability": float(chdtrc(degrees, self.squared)),
            "height": {
                "compared": len(heights_m),
                "mean_z_m": float(np.mean(heights_m)),
                "rmse_z_m": float(np.sqrt(np.mean(heights_m**2))),
            }
            if len(heights_m)
            else {"compared": 0, "because": "the survey, or this drive's map, has no heights"},
        }

    @property
    def headline(self) -> str:
        """One line on all check points."""
        total = len(self.compared) + len(self.unmatched)
        if not self.compared:
            return f"check points: none of {total} has a map corner within reach"
        cm = 100 * self.off_m.mean(axis=0)
        inside = sum(checked.is_inside for checked in self.compared)
        return (
            f"check points: {len(self.compared)} of {total} compared, RMSE {100 * self.rmse_m:.1f} cm, mean "
            f"{cm[0]:+.1f} cm in x and {cm[1]:+.1f} cm in y, 95 % within {100 * self._percentile_m():.1f} "
            f"cm, {inside} of {len(self.compared)} inside what map and survey state for 95 %"
        )

    def _percentile_m(self) -> float:
        return float(np.percentile([checked.distance_m for checked in self.compared], 100 * INSIDE))


def squared(off_m: FloatArray, covariance_m2: FloatArray) -> float:
    """Squared Mahalanobis distance of stacked differences (2N,): chi-square with 2N degrees of freedom."""
    return float(off_m @ np.linalg.solve(covariance_m2, off_m))


def compare(
    hd_map: HDMap,
    points: Sequence[SurveyedPoint],
    reach_m: float,
    joint: JointCovariance,
    route_map: FloatArray,
) -> CheckTable:
    """Compare check points with a map's corners within ``reach_m``; ``route_map`` (F, 2) is the route."""
    corners = np.array([marking.corners_map for marking in hd_map.markings]).reshape(-1, 2)
    positions = np.array([point.position_map for point in points]).reshape(-1, 2)
    off_m, nearest = KDTree(corners).query(positions)
    route_m = KDTree(route_map).query(positions)[0]
    ids = [feature.id for feature in features_of(hd_map)]
    of_map = joint(nearest // 4, nearest % 4)
    of_survey = np.diag(np.concatenate([point.sigma_m**2 for point in points]))
    matched = match(positions, corners, reach_m, of_map + of_survey)
    compared = []
    unmatched = []
    for k, point in enumerate(points):
        if matched[k] < 0:
            corner_name = f"{hd_map.markings[nearest[k] // 4].kind} {ids[nearest[k] // 4]}"
            if off_m[k] > reach_m:
                nearest_m = f"{off_m[k]:.2f} m away, the route {route_m[k]:.0f} m"
                why = f"no corner within {reach_m:g} m: the nearest, of {corner_name}, is {nearest_m}"
            else:
                better = points[int(np.argmax(matched == nearest[k]))].id
                why = f"{better} fits the only corner within reach better, of {corner_name}"
            unmatched.append((point, why))
            continue
        marking, corner = divmod(int(matched[k]), 4)
        mapped = hd_map.markings[marking]
        height_m = point.height_m
        off_height_m = None
        if mapped.heights_m is not None and height_m is not None:
            off_height_m = float(mapped.heights_m[corner] - height_m)
        off = mapped.corners_map[corner] - point.position_map
        covariance = joint(np.array([marking]), np.array([corner]))
        compared.append(
            CheckedPoint(point, marking, ids[marking], mapped.kind, corner, off, covariance, off_height_m)
        )
    if not compared:
        return CheckTable((), tuple(unmatched), np.zeros((0, 0)))
    marking_of = np.array([checked.marking for checked in compared])
    corner_of = np.array([checked.corner for checked in compared])
    of_map = joint(marking_of, corner_of)
    of_survey = np.diag(np.concatenate([checked.point.sigma_m**2 for checked in compared]))
    return CheckTable(tuple(compared), tuple(unmatched), of_map + of_survey)


def write_check_points(table: CheckTable, path: Path) -> None:
    """Write the table as CSV to ``path``: one row per check point, compared ones first."""
    rows: list[Sequence[object]] = [COLUMNS]
    for checked in table.compared:
        point = checked.point
        sigma_m = np.sqrt(np.diag(checked.covariance_m2))
        map_sigma_m = np.sqrt(np.diag(checked.map_covariance_m2))
        cells: list[object] = [point.id, point.description, *_metres(point.position_map)]
        cells += [checked.marking_id, checked.kind, checked.corner + 1]
        cells += _metres([*checked.off_m, checked.distance_m, *sigma_m, *map_sigma_m])
        cells += [f"{checked.normalised:.3f}", "yes" if checked.is_inside else "no"]
        height = [] if checked.off_height_m is None else [checked.off_height_m]
        rows.append([*cells, *(_metres(height) or [""]), ""])
    for point, why in table.unmatched:
        empty = [""] * (len(COLUMNS) - 5)
        rows.append([point.id, point.description, *_metres(point.position_map), *empty, why])
    replace_csv(path, rows)


def _metres(values: Sequence[float] | FloatArray) -> list[str]:
    """Lengths as text, to 0.1 mm."""
    return [f"{value:.4f}" for value in values]
