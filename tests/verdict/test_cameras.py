"""Intrinsics, guess, survey and ROI of a camera against each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import CENTRE, camera, raised, with_k
from v2hdm.records import Camera, CentrePrior, FloatArray
from v2hdm.verdict.inputs.cameras import check_camera

Spoil = Callable[[Camera], Camera]


def roi(change: Callable[[FloatArray], FloatArray]) -> Spoil:
    return lambda described: replace(described, roi_vehicle=change(described.roi_vehicle))


def survey(xyz: FloatArray) -> Spoil:
    return lambda described: replace(described, centre_prior=CentrePrior(xyz, np.full(3, 0.02)))


WRONG: dict[str, tuple[Spoil, str, str]] = {
    "K of half the size": (
        lambda c: with_k(c, fx=450, fy=450, cx=319.5, cy=179.5), "principal point", "about 640 x 360",
    ),
    "principal point": (lambda c: with_k(c, cx=400.0), "principal point", "19 % of the width"),
    "focal in mm": (lambda c: with_k(c, fx=4.5, fy=4.5), "focal length", "not in mm"),
    "fx": (lambda c: with_k(c, fx=945.0), "square pixels", "945 and fy 900 differ by 5 %"),
    "fx and fy": (
        lambda c: with_k(c, fx=945.0, fy=945.0), "ipm against camera matrix", "most in the focal length",
    ),
    "cx of the IPM": (lambda c: with_k(c, cx=730.0), "ipm against camera matrix", "in the principal point"),
    "ROI behind": (roi(np.negative), "roi", "behind the camera"),
    "ROI aside": (roi(lambda points: points + np.array([0, 30])), "roi", "only 0 % of roi_vehicle"),
    "ROI tiny": (roi(lambda points: 0.05 * points + np.array([9, 0])), "roi", "enlarge it"),
    "ROI far": (roi(lambda points: points * [5, 1]), "roi range", "reaches 68 m"),
    "survey sign": (survey(CENTRE * [-1, 1, 1]), "survey against guess", "its x has the wrong sign"),
    "survey swapped": (survey(CENTRE[[1, 0, 2]]), "survey against guess", "x and y are swapped"),
    "survey in mm": (survey(1e3 * CENTRE), "survey against guess", "in millimetres"),
    "survey in feet": (survey(CENTRE / 0.3048), "survey against guess", "in feet"),
    "survey elsewhere": (survey(CENTRE + np.array([3, 0, 0])), "survey against guess", "by +3.0, "),
}  # fmt: skip


def test_a_good_camera_passes() -> None:
    assert not raised(check_camera("front", camera()))


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_camera_is_told(name: str) -> None:
    spoil, check, says = WRONG[name]
    told = raised(check_camera("front", spoil(camera())))
    assert says in told[check]


def test_a_guess_borrowed_from_a_sister_vehicle_is_fine() -> None:
    borrowed = camera(pitch_deg=20.0, centre=CENTRE + np.array([0.3, -0.2, 0.3]))
    assert not raised(check_camera("front", borrowed))


@pytest.mark.parametrize(
    ("centre", "check"), [(CENTRE * [1, 1, 20], "camera height"), (CENTRE * [1, 1, 0.05], "camera height")]
)
def test_a_guess_at_no_vehicle_s_height_is_told(centre: FloatArray, check: str) -> None:
    assert check in raised(check_camera("front", camera(centre=centre)))


def test_a_camera_without_survey_is_checked_without() -> None:
    findings = check_camera("front", replace(camera(), centre_prior=None))
    assert "survey against guess" not in {finding.check for finding in findings}
    assert not raised(findings)
