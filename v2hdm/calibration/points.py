"""Surveyed ground points and their pixels, from a CSV file, and how well they agree with a mounting."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from v2hdm.calibration.fit import STATED_AS, UNKNOWNS, Fit, SeenPoints, fit_mountings
from v2hdm.errors import DriveError, shown
from v2hdm.geometry.ipm import (
    apply_in_front,
    facing_ipm,
    homography_jacobian,
    ipm_from_extrinsic,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.io.rows import read_rows
from v2hdm.io.trajectory import parse_number
from v2hdm.records import BoolArray, CameraInfo, FloatArray
from v2hdm.verdict.verdict import Finding, Status, judge, passed

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
    names = []
    labels = []
    rows = []
    for number, cells in lines:
        row = dict(zip(columns, cells, strict=True))
        name = row.get(_NAME, "")
        names.append(f"point {name} (line {number})" if name else f"the point of line {number}")
        labels.append(name or f"line {number}")
        rows.append([parse_number(row[column], f"{path}: line {number}: {column}") for column in COLUMNS])
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if len(table) < LEAST_POINTS:
        raise DriveError(f"{path}: {len(table)} points; {LEAST_POINTS} barely suffice: survey more")
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
        hint = "fix it, or give the intrinsics for this image"
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
            a = first[same.ravel()[again[0]]]
            b = again[0]
            raise DriveError(
                f"{points.path}: {points.names[a]} and {points.names[b]} have the same {what}; drop or fix "
                "one of them"
            )


def _columns(header: list[str], path: Path) -> list[str]:
    """The columns' names as ours, in the order of the file."""
    columns = [_ALIASES.get(name.lower(), name.lower()) for name in header]
    for column in COLUMNS:
        if columns.count(column) != 1:
            raise DriveError(
                f"{path}: {'no' if column not in columns else 'more than one'} column '{column}'; the first "
                f"line must name {', '.join(COLUMNS)} (pixel right and down, m forward and left); it has: "
                f"{', '.join(header)}"
            )
    for name in columns:
        if name not in (*COLUMNS, _NAME):
            hint = "points must lie on the ground; drop it" if name in ("z", "z_m") else "drop it"
            raise DriveError(
                f"{path}: column {shown(name)} is not one of {', '.join(COLUMNS)}, {_NAME}; {hint}"
            )
    return columns


CHANCE = 1e-3  # probability with which a right calibration raises a finding

# Standard deviation up to which a start serves the mapping, which copes with IPMs decimetres off, m.
_WELL_KNOWN_M = 0.3

# Relative error of the focal length from which it is another lens or image size, not a poor calibration.
_FOCAL_OFF = 0.05
_FOCAL_ROUNDS = 3  # rounds in which a focal length that is off is estimated again from where it led
_RIVAL = float(np.log(100.0))  # log odds up to which another mounting explains the points nearly as well
_AROUND = 12  # places on the circle of known_around


@dataclass(frozen=True)
class Residuals:
    """N points under a mounting."""

    off_px: FloatArray  # (N, 2) recorded less predicted pixel
    off_m: FloatArray  # (N, 2) where the IPM puts the pixel less where it was surveyed, nan above the horizon
    sigmas: FloatArray  # (N,) distance from what all others predict
    probability: FloatArray  # (N,) of a right point being as far off by chance
    known_m: FloatArray  # (N,) sigma of the IPM there, in the direction known worst


def residuals(fit: Fit) -> Residuals:
    """The residuals of every point, wrong ones included."""
    points = fit.points
    info = points.info
    mounting = fit.cam_from_vehicle
    predicted, depth = project_ground(info.intrinsic, mounting, points.points_vehicle)
    off_px = np.where(depth[:, None] > 0, points.points_px - distort_points(info, predicted), np.nan)
    in_view = points.points_vehicle[int(np.argmax(np.where(depth > 0, fit.right, -1.0)))]
    ipm = facing_ipm(ipm_from_extrinsic(info, mounting), in_view)
    off_m = apply_in_front(ipm, undistort_points(info, points.points_px)) - points.points_vehicle
    sigmas, probability = _held_out(fit)
    return Residuals(off_px, off_m, sigmas, probability, known_ground(fit, points.points_vehicle))


def known_ground(fit: Fit, places_vehicle: FloatArray) -> FloatArray:
    """Standard deviation (M,) of the IPM at places (M, 2), m, the worst way; inf behind the camera."""
    mounting = fit.cam_from_vehicle
    count = len(places_vehicle)
    places = replace(
        fit.points,
        points_px=np.zeros((count, 2)),
        pinhole_px=np.zeros((count, 2)),
        by_pinhole=np.broadcast_to(np.eye(2), (count, 2, 2)),
        points_vehicle=places_vehicle,
    )
    slopes = places.jacobian(mounting)
    by_ground = homography_jacobian(
        pinhole_px_from_ground(fit.points.info.intrinsic, mounting), places_vehicle
    )
    in_front = np.isfinite(by_ground).all(axis=(1, 2))
    sigma_m = np.full(count, np.inf)
    by_mounting = np.linalg.inv(by_ground[in_front]) @ slopes[in_front]
    covariance_m2 = by_mounting @ fit.covariance @ np.swapaxes(by_mounting, 1, 2)
    sigma_m[in_front] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2)[:, -1], 0.0))
    return sigma_m


def known_around(fit: Fit) -> float:
    """The worst of :func:`known_ground` at the right points and on a circle around them."""
    right = fit.points.points_vehicle[fit.is_right]
    radius = np.ptp(right, axis=0).max() / 2
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    middle = (right.min(axis=0) + right.max(axis=0)) / 2
    circle = middle + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    sigma_m = known_ground(fit, np.vstack([right, circle]))
    in_front = sigma_m[np.isfinite(sigma_m)]
    return float(in_front.max()) if len(in_front) else np.inf


def _held_out(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """How far each point is, r' cov^-1 r, from the others' prediction, under the noise that they show.

    The covariance is q V - J C J' of a point that took part, of another q V + J C J'.
    """
    slopes = fit.points.jacobian(fit.cam_from_vehicle)
    stated = fit.points.covariance(fit.cam_from_vehicle)
    by_mounting = slopes @ (fit.covariance / fit.factor) @ np.swapaxes(slopes, 1, 2)
    residual = fit.points.residual_px(fit.cam_from_vehicle)
    took_part = np.where(fit.is_right, -1.0, 1.0)[:, None, None]
    inverse = np.linalg.pinv(stated + took_part * by_mounting, rcond=1e-9, hermitian=True)
    square = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    of_stated = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(stated), residual)
    total = float(of_stated[fit.is_right].sum())
    count = 2.0 * (fit.is_right.sum() - fit.is_right)
    free = np.maximum(count - UNKNOWNS, 0.0) + STATED_AS
    others = (np.maximum(total - np.where(fit.is_right, square, 0.0), 0.0) + STATED_AS) / free
    ratio = square / others
    return np.sqrt(ratio), np.asarray(fdtrc(2, free, np.maximum(ratio, 0.0) / 2))


class Scatter(NamedTuple):
    """By how much the right points scatter more than stated, and the chance of that or more."""

    ratio: float
    limit: float
    probability: float


def scatter(fit: Fit, chance: float) -> Scatter:
    """The chi-square of the right points against the noise as stated; ``limit`` belongs to ``chance``."""
    residual = fit.points.residual_px(fit.cam_from_vehicle)[fit.is_right]
    stated = fit.points.covariance(fit.cam_from_vehicle)[fit.is_right]
    total = float(np.einsum("ni,nij,nj->", residual, np.linalg.inv(stated), residual))
    free = max(2 * len(residual) - UNKNOWNS, 1)
    limit = float(np.sqrt(chdtri(free, chance) / free))
    return Scatter(float(np.sqrt(total / free)), limit, float(chdtrc(free, total)))


class Lens(NamedTuple):
    """Whether the points agree with the intrinsics."""

    probability: float  # of as large a disagreement by chance, both focal lengths freed
    focal: float  # share by which the points want the focal length longer
    focal_sigma: float  # standard deviation of that share


def lens(fit: Fit) -> Lens:
    """Test the intrinsics: a homography has two degrees of freedom more than a mounting."""
    freed = _freed(fit)
    probability = freed.probability
    total = 1 + freed.focal
    points = fit.points
    for _ in range(_FOCAL_ROUNDS if abs(freed.focal) > freed.focal_sigma else 0):
        intrinsic = points.info.intrinsic.copy()
        intrinsic[:2, :2] *= total
        info = replace(points.info, intrinsic=intrinsic)
        longer = SeenPoints.of(points.points_px, points.points_vehicle, info, points.noise)
        fits = fit_mountings(longer, starts=1)
        if not fits:
            break
        freed = _freed(fits[0])
        total *= 1 + freed.focal
    return Lens(probability, total - 1, freed.focal_sigma)


def _freed(fit: Fit) -> Lens:
    """The lens as one linear step from a fit shows it."""
    points = fit.points
    right = fit.is_right
    stated = np.asarray(np.linalg.inv(points.covariance(fit.cam_from_vehicle)[right]), dtype=np.float64)
    slopes = points.jacobian(fit.cam_from_vehicle)[right]
    residual = points.residual_px(fit.cam_from_vehicle)[right]
    from_centre = points.points_px[right] - points.info.intrinsic[:2, 2]
    # Longer by a share, a focal length moves the predicted pixel away from the centre by that share.
    by_both_focals = np.zeros((len(residual), 2, 2))
    by_both_focals[:, [0, 1], [0, 1]] = from_centre
    gain = _gain_of(by_both_focals, stated, slopes, residual).decrease
    total = float(np.einsum("ni,nij,nj->", residual, stated, residual))
    free = max(2 * len(residual) - UNKNOWNS - 2, 0) + STATED_AS
    noise = (max(total - gain, 0.0) + STATED_AS) / free
    focal = _gain_of(from_centre[..., None], stated, slopes, residual)
    return Lens(
        probability=float(fdtrc(2, free, max(gain, 0.0) / 2 / noise)),
        focal=float(focal.step[0]),
        focal_sigma=float(np.sqrt(noise / focal.information[0, 0])),
    )


class _Gain(NamedTuple):
    """The gain by K further unknowns beside a mounting."""

    decrease: float  # of the cost
    step: FloatArray  # (K,) their values
    information: FloatArray  # (K, K) that is left on them, the mounting freed


def _gain_of(more: FloatArray, stated: FloatArray, slopes: FloatArray, residual: FloatArray) -> _Gain:
    """The gain by unknowns that have derivatives ``more`` (N, 2, K), beside a mounting's ``slopes``."""
    of_more = np.einsum("nij,nik,njl->kl", stated, more, more)
    shared = np.einsum("nij,nik,njl->kl", stated, more, slopes)
    mounting = np.einsum("nij,nik,njl->kl", stated, slopes, slopes)
    pull_of_more = np.einsum("nij,nik,nj->k", stated, more, residual)
    pull = np.einsum("nij,nik,nj->k", stated, slopes, residual)
    through = shared @ np.linalg.pinv(mounting)
    information = of_more - through @ shared.T
    force = pull_of_more - through @ pull
    step = -np.linalg.pinv(information, hermitian=True) @ force
    return _Gain(float(-step @ force), step, information)


def judge_fit(points: SurveyedPoints, fits: Sequence[Fit], residuals: Residuals) -> Iterator[Finding]:
    """The findings on the most likely of ``fits``."""
    fit = fits[0]
    about = fits[0].points.info.name
    yield from _wrong_points(points, fits, residuals, about)
    spread = scatter(fit, CHANCE)
    says = f"the points scatter {spread.ratio:.2g} times as much as --pixel-sigma and --survey-sigma state"
    yield judge(
        "scatter", about, spread.ratio, spread.limit, "",
        fine=says,
        wrong=f"{says}, and the sigmas were increased by that: measure again, or state the actual errors",
        status=Status.WARN,
    )  # fmt: skip
    yield _intrinsics(fit, about)
    worst = known_around(fit)
    yield judge(
        "known ground", about, min(worst, 1e6), _WELL_KNOWN_M, "m",
        fine=f"the IPM is known to {100 * worst:.1f} cm or better around the points",
        wrong=f"the IPM is known to {worst:.2g} m only around the points: survey more of them, near and far, "
        "left and right; points along one line do not determine a camera",
    )  # fmt: skip


def _wrong_points(
    points: SurveyedPoints, fits: Sequence[Fit], residuals: Residuals, about: str
) -> Iterator[Finding]:
    """The findings on points that contradict the others."""
    fit = fits[0]
    total = len(points.names)
    named = np.flatnonzero(~fit.is_right | (residuals.probability < CHANCE / total)).tolist()
    for k in named:
        how_far = _how_far(residuals.off_px[k], residuals.off_m[k])
        share = "gets no weight" if not fit.is_right[k] else "still has weight"
        says = (
            f"{points.names[k]} contradicts the others by {residuals.sigmas[k]:.0f} sigmas "
            f"({how_far}) and {share}: check its pixel and its place"
        )
        yield Finding("point", Status.WARN, float(residuals.sigmas[k]), None, "sigma", says, about)
    if not named:
        yield passed("point", about, "no point contradicts the others", 0.0, "points")
    count = int(fit.is_right.sum())
    if count < max(LEAST_POINTS, (total + 1) // 2):
        says = (
            f"of {total} points only {count} agree on a mounting: check the columns, which pixel belongs to "
            "which place, and the intrinsics"
        )
        yield Finding("agreement", Status.FAIL, float(count), None, "points", says, about)
    rivals = [rival for rival in fits[1:] if fit.log_posterior - rival.log_posterior < _RIVAL]
    if rivals and named:
        other = [points.names[k] for k in np.flatnonzero(~rivals[0].is_right)]
        says = (
            "the wrong point cannot be found: another mounting explains the points equally well, without "
            f"{' and '.join(other) or 'leaving one out'}; survey more points"
        )
        yield Finding("rival", Status.FAIL, None, None, "", says, about)


def _intrinsics(fit: Fit, about: str) -> Finding:
    """The finding on the intrinsics."""
    tested = lens(fit)
    focal = tested.focal
    sigma = tested.focal_sigma
    far = abs(focal) > _FOCAL_OFF
    recovery = (
        "were the pixels read from an image of another size, or is this another camera's file?"
        if far
        else "recalibrate the lens, or check that the images were not resized"
    )
    size = f"{100 * focal:+.1f} +- {100 * sigma:.1f} %"
    return judge(
        "intrinsics", about, -np.log10(max(tested.probability, 1e-99)), -np.log10(CHANCE), "",
        fine=f"the points agree with the intrinsics (focal length {size})",
        wrong=f"the points contradict the intrinsics: they imply a focal length {size} longer; {recovery}",
        status=Status.FAIL if far else Status.WARN,
    )  # fmt: skip


def _how_far(off_px: FloatArray, off_m: FloatArray) -> str:
    """How far a point (2,) is off in the image and on the ground."""
    pixels = float(np.hypot(off_px[0], off_px[1]))
    metres = float(np.hypot(off_m[0], off_m[1]))
    if not np.isfinite(pixels):
        return "its place is behind the camera"
    if not np.isfinite(metres):
        return f"{pixels:.1f} px, and its pixel is above the horizon"
    return f"{pixels:.1f} px, {f'{metres:.2f} m' if metres >= 1 else f'{100 * metres:.1f} cm'} on the ground"
