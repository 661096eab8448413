"""The horizon of an image by the lines that it shows.

Lines along a road are parallel on the ground and meet in one point of the horizon: points of several images,
beside each other, also show the roll. The network finds crossings of lanes' lines and the edges of paint;
each is one of the road's or any other. What several images say together is in :mod:`.horizons`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from v2hdm.detection.lanes.chains import find_chains
from v2hdm.detection.lanes.curves import NEIGHBOURS
from v2hdm.detection.lanes.lines import crossing_sigma_px
from v2hdm.detection.network import AnchorRow, Network, NetworkOutput, anchor_rows, as_probability, crossings
from v2hdm.geometry.lens import undistort_points
from v2hdm.records import BoolArray, CameraInfo, FloatArray

_SCALE = 2  # reduction of an image: a sixth of the time, and a third less certain
_LEAST_CROSSINGS = 4  # least number of crossings that are a line
_LEAST_EDGE_PX = 6.0  # least length of a paint's edge, in elements of the paint
_EDGE_SIGMA_PX = 0.45  # standard deviation of the ends of a paint's edge, in elements of the paint
_EDGE_WEIGHT = 0.3  # weight of an edge: a marking has two in several pieces each, which err together
_FLAT = 0.12  # least sine of an edge's rise: flatter edges are stop lines and shadows across the road

# Standard deviation of the directions of one road's lines; 0.012 rad in lanes/curves, whose camera is known.
_PARALLEL_SIGMA_RAD = 0.015

_SHARE = 0.4  # share of the lines that keep to the road: kerbs, arrows, letters and façades need not
_POINT_SIGMA_PX = 1.5  # standard deviation of the lines through a vanishing point about it, px
_SILENT = 0.05  # share of images whose lines show something else

_AHEAD_RAD = np.deg2rad(6.0)  # standard deviation of a road's direction about the camera's axis
_AHEAD_SHARE = 0.85  # share of the images in which the road leads ahead so closely
_ASIDE_RAD = np.deg2rad(30.0)  # standard deviation of a road's direction in the other images

_LEAST_GROUND = 0.05  # share of an image's height that shows ground at least

_PITCH_STEP_RAD = np.deg2rad(0.4)  # distance between the pitches of the grid
_ROLL_STEP_RAD = np.deg2rad(0.75)  # distance between the rolls of the grid
_COLUMN_STEP_RAD = np.deg2rad(1.25)  # distance between the bearings of vanishing points that are looked at
_SIGMAS = 4.0  # standard deviations of the prior that the grid reaches from its mean
_REACH_RAD = np.deg2rad(40.0)  # largest bearing of vanishing points that are looked at
_STEEPEST_RAD = np.deg2rad(80.0)  # steepest pitch that lines determine: from above they look parallel


@dataclass(frozen=True)
class Mounting:
    """How a camera sits."""

    height_m: float
    pitch_rad: float  # down from the horizon
    roll_rad: float
    fov_rad: float  # horizontal
    sigma_rad: tuple[float, float]  # of pitch and roll
    log_focal_sigma: float = 0.0  # of the logarithm of the focal length


@dataclass(frozen=True)
class Lines:
    """N lines of an image."""

    point_px: FloatArray  # (N, 2) on each, pinhole
    direction: FloatArray  # (N, 2) unit
    sigma_px: FloatArray  # (N,) across
    sigma_rad: FloatArray  # (N,)
    weight: FloatArray  # (N,) how much each counts

    @classmethod
    def joined(cls, parts: Sequence[Lines]) -> Lines:
        """The lines of all ``parts``, in order."""
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
        )

    def where(self, is_chosen: BoolArray) -> Lines:
        """Some of the lines."""
        return Lines(**{name: array[is_chosen] for name, array in vars(self).items()})


def image_lines(network: Network, image_bgr: np.ndarray, info: CameraInfo) -> Lines:
    """The lines that a look in half the resolution shows of an image (H, W, 3) uint8.

    Raises DetectorError where the network cannot be run.
    """
    half = cv2.resize(image_bgr, None, fx=1 / _SCALE, fy=1 / _SCALE, interpolation=cv2.INTER_AREA)
    output = network.run(half)
    rows = anchor_rows(output.lanes, network, 0, _SCALE)
    return _lines(rows, output.paint, _SCALE * network.info.paint_stride, 0, info)


def output_lines(output: NetworkOutput, info: CameraInfo) -> Lines:
    """The lines in the network's output on the rows of an image that show road."""
    paint = cv2.resize(output.paint, None, fx=1 / _SCALE, fy=1 / _SCALE, interpolation=cv2.INTER_AREA)
    return _lines(output.anchors, paint, _SCALE * output.stride, output.top, info)


def _lines(
    rows: Sequence[AnchorRow], paint: np.ndarray, unit_px: float, top_px: int, info: CameraInfo
) -> Lines:
    """The lines of crossings and of edges of paint (h, w), log odds ``unit_px`` apart from a row on."""
    points_px, odds = crossings(rows)
    pinhole_px = undistort_points(info, points_px)
    chains = [chain for chain in find_chains(points_px, odds) if len(chain) >= _LEAST_CROSSINGS]
    lines = [_fitted(pinhole_px[chain], _SCALE * crossing_sigma_px(odds[chain])) for chain in chains]
    all_lines = Lines.joined([*lines, _edges(paint, unit_px, top_px, info)])
    return all_lines.where(np.abs(all_lines.direction[:, 1]) > _FLAT)


def _edges(paint: np.ndarray, unit_px: float, top_px: int, info: CameraInfo) -> Lines:
    """The straight edges of paint from its log odds (h, w); an element is ``unit_px`` wide."""
    level = np.round(255 * as_probability(paint)).astype(np.uint8)
    segments = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE).detect(level)[0]
    ends = np.zeros((0, 2, 2)) if segments is None else segments.reshape(-1, 2, 2).astype(np.float64)
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > _LEAST_EDGE_PX
    recorded_px = unit_px * (ends[long] + 0.5) - 0.5 + (0, top_px)
    ends_px = undistort_points(info, recorded_px.reshape(-1, 2)).reshape(-1, 2, 2)
    along = ends_px[:, 1] - ends_px[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1.0)
    sigma_px = np.full(len(length), _EDGE_SIGMA_PX * unit_px)
    return Lines(
        point_px=ends_px.mean(axis=1),
        direction=along / length[:, None],
        sigma_px=sigma_px,
        sigma_rad=2 * sigma_px / length,
        weight=np.full(len(length), _EDGE_WEIGHT),
    )


def _fitted(points_px: FloatArray, sigma_px: FloatArray) -> Lines:
    """The line through a chain of crossings (N, 2), which are off by ``sigma_px`` (N,) along their rows."""
    information = sigma_px**-2.0
    middle = information @ points_px / information.sum()
    across, down = (points_px - middle).T
    spread = max(float(information @ down**2), 1e-9)
    slope = float((information * down) @ across) / spread
    scatter = float(information @ (across - slope * down) ** 2) / len(points_px)
    upright = 1 / np.hypot(1, slope)  # neighbours err together, and across the line less than along its row
    variance = NEIGHBOURS * max(scatter, 1.0) * upright**2
    return Lines(
        point_px=middle[None],
        direction=(np.array([slope, 1.0]) * upright)[None],
        sigma_px=np.sqrt(variance / information.sum())[None],
        sigma_rad=(upright * np.sqrt(variance / spread))[None],
        weight=np.ones(1),
    )


class HorizonGrid:
    """Pitches (P,) and rolls (R,) of a camera about a ``prior``, and how likely lines make each."""

    def __init__(self, info: CameraInfo, prior: Mounting):
        self.info = info
        self.prior = prior
        self.pitch_rad = _grid(prior.pitch_rad, prior.sigma_rad[0], _PITCH_STEP_RAD)
        self.roll_rad = _grid(prior.roll_rad, prior.sigma_rad[1], _ROLL_STEP_RAD)
        self.variance_rad2 = _PITCH_STEP_RAD**2 / 12, _ROLL_STEP_RAD**2 / 12  # within a step

    @cached_property
    def prior_share(self) -> FloatArray:
        """The prior (P, R), whose sum is 1."""
        pitch_sigma, roll_sigma = self.prior.sigma_rad
        pitch_off = (self.pitch_rad - self.prior.pitch_rad)[:, None] / pitch_sigma
        roll_off = (self.roll_rad - self.prior.roll_rad) / roll_sigma
        share = np.exp(-0.5 * (pitch_off**2 + roll_off**2)) * self.shows_ground[:, None]
        return np.asarray(share / share.sum())

    @cached_property
    def shows_ground(self) -> FloatArray:
        """1 for pitches (P,) at which an image shows ground, 0 for others; 1 for all if it is none."""
        info = self.info
        steepest = np.clip(self.pitch_rad, -_STEEPEST_RAD, _STEEPEST_RAD)
        horizon_px = info.intrinsic[1, 2] - info.intrinsic[1, 1] * np.tan(steepest)
        is_shown = horizon_px < (1 - _LEAST_GROUND) * info.height
        return np.asarray(is_shown if is_shown.any() else ~is_shown, dtype=np.float64)

    def likelihood(self, lines: Lines) -> FloatArray:
        """How likely (P, R) pitch and roll make an image's lines; 1 in the mean, also for none."""
        if not len(lines.weight):
            return np.ones((len(self.pitch_rad), len(self.roll_rad)))
        bearing = self._bearing_rad
        ahead, aside = (np.exp(-0.5 * (bearing / sigma) ** 2) / sigma for sigma in (_AHEAD_RAD, _ASIDE_RAD))
        prior = _AHEAD_SHARE * ahead + (1 - _AHEAD_SHARE) * aside
        focal_px = float(self.info.intrinsic[1, 1])
        rows = -focal_px * np.tan(np.clip(self._pitch_of_row_rad, -_STEEPEST_RAD, _STEEPEST_RAD))
        log_points = self._of_points(lines, focal_px * np.tan(bearing), rows)
        points = (np.exp(log_points - log_points.max()) * prior).astype(np.float32)
        above, share = self._horizons
        steps = np.diff(points, axis=0).ravel()
        likelihood = (points.ravel()[above] + share * steps[above]).sum(axis=2, dtype=np.float64)
        return np.asarray((1 - _SILENT) * likelihood / likelihood.mean() + _SILENT)

    @cached_property
    def _bearing_rad(self) -> FloatArray:
        """Bearings (C,) of the vanishing points that are looked at."""
        return np.arange(-_REACH_RAD, _REACH_RAD + _COLUMN_STEP_RAD / 2, _COLUMN_STEP_RAD)

    @cached_property
    def _pitch_of_row_rad(self) -> FloatArray:
        """Elevations (Y,) of the vanishing points that are looked at, those of horizons of every roll."""
        rise = np.abs(np.tan(self.roll_rad)).max() * np.tan(self._bearing_rad).max()
        spare = int(np.ceil(rise / _PITCH_STEP_RAD))
        return np.asarray(
            self.pitch_rad[0] + _PITCH_STEP_RAD * np.arange(-spare, len(self.pitch_rad) + spare)
        )

    @cached_property
    def _horizons(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the horizon of each pitch and roll (P, R, C) meets each bearing.

        First the flat index (Y, C) of the vanishing point above, then the share of the way to the next one.
        """
        level = np.tan(np.clip(self.pitch_rad, -_STEEPEST_RAD, _STEEPEST_RAD))
        up = level[:, None, None] + np.tan(self.roll_rad)[:, None] * np.tan(self._bearing_rad)
        place = (np.arctan(up) - self._pitch_of_row_rad[0]) / _PITCH_STEP_RAD
        above = np.clip(np.floor(place).astype(np.intp), 0, len(self._pitch_of_row_rad) - 2)
        share = np.clip(place - above, 0, 1).astype(np.float32)
        return above * len(self._bearing_rad) + np.arange(len(self._bearing_rad)), share

    def _of_points(self, lines: Lines, columns: FloatArray, rows: FloatArray) -> FloatArray:
        """Log likelihood (R, C) of vanishing points, px from the principal point, over that of none."""
        total = np.zeros((len(rows), len(columns)), dtype=np.float32)
        focal_px = float(self.info.intrinsic[1, 1])
        point = (lines.point_px - self.info.intrinsic[:2, 2]).astype(np.float32)
        parallel_px = _PARALLEL_SIGMA_RAD * focal_px * lines.direction[:, 1]
        variance_px2 = (lines.sigma_px**2 + _POINT_SIGMA_PX**2 + parallel_px**2).astype(np.float32)
        direction = lines.direction.astype(np.float32)
        turned = (lines.sigma_rad**2).astype(np.float32)
        u = columns.astype(np.float32)
        v = rows.astype(np.float32)[:, None]
        for k, weight in enumerate(lines.weight.tolist()):
            across = u - point[k, 0]
            down = v - point[k, 1]
            distance2 = np.maximum(across**2 + down**2, np.float32(1))
            variance = turned[k] * distance2 + variance_px2[k]  # across the line, at the point
            off2 = (across * direction[k, 1] - down * direction[k, 0]) ** 2
            # Over directions that are all alike likely: pi / sqrt(2 pi).
            scale = np.float32(_SHARE * np.sqrt(np.pi / 2))
            ratio = np.exp(np.float32(-0.5) * off2 / variance) * np.sqrt(distance2 / variance)
            total += np.float32(weight) * np.log(scale * ratio + np.float32(1 - _SHARE))
        return total.astype(np.float64)


def _grid(mean: float, sigma: float, step: float) -> FloatArray:
    """Values ``step`` apart, as many to either side of a mean as reach ``_SIGMAS`` standard deviations."""
    reach = int(np.ceil(_SIGMAS * sigma / step))
    return np.asarray(mean + step * np.arange(-reach, reach + 1))
