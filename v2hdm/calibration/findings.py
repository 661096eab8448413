"""The verdict on a pre-calibration, each finding with its cause and remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from v2hdm.calibration.fit import Fit
from v2hdm.calibration.points import LEAST_POINTS, SurveyedPoints
from v2hdm.calibration.residuals import Residuals, known_around, lens, scatter
from v2hdm.records import FloatArray
from v2hdm.verdict.judgement import judge, passed
from v2hdm.verdict.verdict import Finding, Status

CHANCE = 1e-3
"""Probability with which a right calibration raises a finding."""

WELL_KNOWN_M = 0.3
"""Standard deviation up to which a start serves the mapping, which copes with IPMs decimetres off, m."""

_FOCAL_OFF = 0.05
"""Error of the focal length from which it is another lens or image size, rather than a poor calibration."""

_RIVAL = float(np.log(100.0))
"""Log odds up to which another mounting explains the points nearly as well."""


def judge_fit(points: SurveyedPoints, fits: Sequence[Fit], residuals: Residuals) -> Iterator[Finding]:
    """The findings on the most likely of ``fits``."""
    fit, about = fits[0], fits[0].seen.info.name
    yield from _wrong_points(points, fits, residuals, about)
    spread = scatter(fit, CHANCE)
    yield judge(
        "scatter", about, spread.ratio, spread.limit, "",
        fine=f"the points scatter {spread.ratio:.2g} times as much as --pixel-sigma and --survey-sigma say",
        wrong=f"the points scatter {spread.ratio:.2g} times as much as --pixel-sigma and --survey-sigma say, "
        "and the sigmas have grown by that: measure again, or state the errors as they are",
        status=Status.WARN,
    )  # fmt: skip
    yield _intrinsics(fit, about)
    worst = known_around(fit)
    yield judge(
        "known ground", about, min(worst, 1e6), WELL_KNOWN_M, "m",
        fine=f"the IPM is known to {100 * worst:.1f} cm or better around the points",
        wrong=f"the IPM is known to {worst:.2g} m only around the points: survey more of them, near and far, "
        "left and right; points along one line fix no camera",
    )  # fmt: skip


def _wrong_points(
    points: SurveyedPoints, fits: Sequence[Fit], residuals: Residuals, about: str
) -> Iterator[Finding]:
    fit = fits[0]
    unlikely = residuals.probability < CHANCE / len(points.names)
    named = np.flatnonzero(~fit.is_right | unlikely).tolist()
    for k in named:
        how_far = _how_far(residuals.off_px[k], residuals.off_m[k])
        share = "counts for nothing" if not fit.is_right[k] else "still counts"
        yield Finding(
            "point", Status.WARN, float(residuals.sigmas[k]), None, "sigma",
            f"{points.names[k]} contradicts the others by {residuals.sigmas[k]:.0f} sigmas "
            f"({how_far}) and {share}: check its pixel and its place",
            about,
        )  # fmt: skip
    if not named:
        yield passed("point", about, "no point contradicts the others", 0.0, "points")
    count = int(fit.is_right.sum())
    if count < max(LEAST_POINTS, (len(points.names) + 1) // 2):
        yield Finding(
            "agreement", Status.FAIL, float(count), None, "points",
            f"of {len(points.names)} points only {count} agree on a mounting: check the columns, which pixel "
            "belongs to which place, and the intrinsics",
            about,
        )  # fmt: skip
    rivals = [one for one in fits[1:] if fit.log_posterior - one.log_posterior < _RIVAL]
    if rivals and named:
        other = [points.names[k] for k in np.flatnonzero(~rivals[0].is_right)]
        yield Finding(
            "rival", Status.FAIL, None, None, "",
            "which point is wrong cannot be told: another mounting explains the points as well, without "
            f"{' and '.join(other) or 'leaving one out'}; survey more points",
            about,
        )  # fmt: skip


def _intrinsics(fit: Fit, about: str) -> Finding:
    tested = lens(fit)
    focal, sigma = tested.focal
    far = abs(focal) > _FOCAL_OFF
    remedy = (
        "were the points clicked in an image of another size, or is this another camera's file?"
        if far
        else "calibrate the lens again, or check that the images were not resized"
    )
    return judge(
        "intrinsics", about, -np.log10(max(tested.probability, 1e-99)), -np.log10(CHANCE), "",
        fine=f"the points agree with the intrinsics (focal length {100 * focal:+.1f} +- {100 * sigma:.1f} %)",
        wrong=f"the points contradict the intrinsics: they want the focal length {100 * focal:+.1f} +- "
        f"{100 * sigma:.1f} % longer; {remedy}",
        status=Status.FAIL if far else Status.WARN,
    )  # fmt: skip


def _how_far(off_px: FloatArray, off_m: FloatArray) -> str:
    """How far a point (2,) is off in the image and on the ground."""
    pixels, metres = float(np.hypot(*off_px)), float(np.hypot(*off_m))
    if not np.isfinite(pixels):
        return "its place is behind the camera"
    if not np.isfinite(metres):
        return f"{pixels:.1f} px, and its pixel is above the horizon"
    return f"{pixels:.1f} px, {f'{metres:.2f} m' if metres >= 1 else f'{100 * metres:.1f} cm'} on the ground"
