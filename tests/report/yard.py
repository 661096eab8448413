"""A yard with surveyed points, some of them wrong."""

import numpy as np

from v2hdm.records import FloatArray, HDMap, IntArray, Marking
from v2hdm.survey.check_points import CheckTable, compare
from v2hdm.survey.read import SurveyedPoint

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


OWN_M, SHARED_M, SURVEY_M = 0.01, 0.03, 0.005


ROUTE = np.array([[-5.0, 0.0], [55.0, 0.0]])


def joint(marking: IntArray, corner: IntArray) -> FloatArray:
    """Corners that err by 1 cm each and by 3 cm all alike."""
    same = (marking[:, None] == marking) & (corner[:, None] == corner)
    return np.kron(OWN_M**2 * same + SHARED_M**2, np.eye(2))


def yard(rng: np.random.Generator | None = None, count: int = 12) -> HDMap:
    """Squares every 5 m along x, in error as :func:`joint` says."""
    shared = np.zeros(2) if rng is None else SHARED_M * rng.standard_normal(2)
    markings = []
    for k in range(count):
        scatter_m = np.zeros((4, 2)) if rng is None else OWN_M * rng.standard_normal((4, 2))
        markings.append(Marking("diamond", SQUARE + np.array([5.0 * k, 0.0]) + shared + scatter_m, 9))
    return HDMap(tuple(markings))


def point(x: float, y: float, name: str = "P", height_m: float | None = None) -> SurveyedPoint:
    return SurveyedPoint(name, np.array([x, y]), np.full(2, SURVEY_M), height_m, True, "by Kim")


def checked(hd_map: HDMap, *points: SurveyedPoint) -> CheckTable:
    return compare(hd_map, points, 0.25, joint, ROUTE)
