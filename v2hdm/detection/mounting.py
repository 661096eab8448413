"""How a camera of which little is known is mounted, from the lines that its images show.

Lines along a road are parallel on the ground and meet in one point of the horizon: points of several images,
beside each other, also show the roll. A first network run on half the resolution finds crossings of lanes'
lines and the edges of paint; each is one of the road's or any other. The horizon has a posterior on a grid of
pitch and roll, whose prior is the stated or a usual mounting; an image's own moves about it with the
vehicle's body. Focal length and height stay as uncertain as their priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from v2hdm.detection.lanes.chains import find_chains
from v2hdm.detection.lanes.curves import NEIGHBOURS
from v2hdm.detection.lanes.lines import crossing_sigma_px
from v2hdm.detection.network import Network, anchor_rows, as_probability, crossings
from v2hdm.geometry.lens import undistort_points
from v2hdm.records import BoolArray, CameraInfo, FloatArray

BODY_SIGMA_RAD = np.deg2rad(0.35)
"""Standard deviation of a body's pitch on its suspension: .3 to .4 degrees in 106 photographs of one camera,
and .1 to .4 in `docs/kitti.md`."""

_SCALE = 2  # factor by which an image is reduced: a sixth of the time, and a third less certain
_LEAST_CROSSINGS = 4  # least number of crossings that are a line
_LEAST_EDGE_PX = 6.0  # least length of a paint's edge, in elements of the paint
_EDGE_SIGMA_PX = 0.45  # standard deviation of the ends of a paint's edge, in elements of the paint
_EDGE_WEIGHT = 0.3  # weight of an edge: a marking has two in several pieces each, which err together
_FLAT = 0.12  # least sine of an edge's rise: flatter ones are of stop lines and of shadows across the road

# Standard deviation of the directions of one road's lines; 0.012 rad in lanes/curves, whose camera is known.
_PARALLEL_SIGMA_RAD = 0.015

_SHARE = 0.4  # share of the lines that keep to the road: kerbs, arrows, letters and façades need not
_POINT_SIGMA_PX = 1.5  # standard deviation of the lines through a vanishing point about it, px
_SILENT = 0.05  # share of images whose lines are of something else

_AHEAD_RAD = np.deg2rad(6.0)  # standard deviation of a road's direction about the camera's axis
_AHEAD_SHARE = 0.85  # share of the images in which the road leads ahead so closely
_ASIDE_RAD = np.deg2rad(30.0)  # standard deviation of a road's direction in the other images

_PITCH_STEP_RAD = np.deg2rad(0.4)  # distance between the pitches of the grid
_ROLL_STEP_RAD = np.deg2rad(0.75)  # distance between the rolls of the grid
_COLUMN_STEP_RAD = np.deg2rad(1.25)  # distance between the bearings of vanishing points that are looked at
_SIGMAS = 4.0  # standard deviations of the prior that the grid reaches from its mean
_REACH_RAD = np.deg2rad(40.0)  # largest bearing of vanishing points that are looked at
_STEEPEST_RAD = np.deg2rad(80.0)  # steepest pitch that is told from others: lines look parallel from above


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
    """The lines that the network shows in an image (H, W, 3) uint8; DetectorError where it cannot be run."""
    half = cv2.resize(image_bgr, None, fx=1 / _SCALE, fy=1 / _SCALE, interpolation=cv2.INTER_AREA)
    output = network.run(half)
    points_px, odds = crossings(anchor_rows(output.lanes, network, 0, _SCALE))
    pinhole_px = undistort_points(info, points_px)
    chains = [chain for chain in find_chains(points_px, odds) if len(chain) >= _LEAST_CROSSINGS]
    lines = [_fitted(pinhole_px[chain], _SCALE * crossing_sigma_px(odds[chain])) for chain in chains]
    edges = _edges(output.paint, _SCALE * network.info.paint_stride, info)
    all_lines = Lines.joined([*lines, edges])
    return all_lines.where(np.abs(all_lines.direction[:, 1]) > _FLAT)


def _edges(paint: np.ndarray, unit_px: float, info: CameraInfo) -> Lines:
    """The straight edges of paint, of which there are log odds (h, w), ``unit_px`` to an element."""
    level = np.round(255 * as_probability(paint)).astype(np.uint8)
    segments = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE).detect(level)[0]
    ends = np.zeros((0, 2, 2)) if segments is None else segments.reshape(-1, 2, 2).astype(np.float64)
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > _LEAST_EDGE_PX
    ends_px = undistort_points(info, (unit_px * (ends[long] + 0.5) - 0.5).reshape(-1, 2)).reshape(-1, 2, 2)
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


class MountingEstimate:
    """The posterior of a camera's pitch and roll, from image to image."""

    def __init__(self, info: CameraInfo, prior: Mounting):
        self.info = info
        self._prior = prior
        self._centre_px = info.intrinsic[:2, 2]
        self._focal_px = float(info.intrinsic[1, 1])
        pitch_sigma, roll_sigma = prior.sigma_rad
        self._pitch = _grid(prior.pitch_rad, pitch_sigma, _PITCH_STEP_RAD)
        self._roll = _grid(prior.roll_rad, roll_sigma, _ROLL_STEP_RAD)
        pitch_off = (self._pitch - prior.pitch_rad)[:, None] / pitch_sigma
        roll_off = (self._roll - prior.roll_rad) / roll_sigma
        self._log_belief: FloatArray = -0.5 * (pitch_off**2 + roll_off**2)

    @property
    def mounting(self) -> Mounting:
        """The mounting as known by now; its standard deviations leave out an image's own pitch."""
        belief = np.exp(self._log_belief - self._log_belief.max())
        belief /= belief.sum()
        pitch, pitch_sigma = _moments(belief.sum(axis=1), self._pitch, _PITCH_STEP_RAD)
        roll, roll_sigma = _moments(belief.sum(axis=0), self._roll, _ROLL_STEP_RAD)
        return replace(self._prior, pitch_rad=pitch, roll_rad=roll, sigma_rad=(pitch_sigma, roll_sigma))

    def add(self, lines: Lines) -> None:
        """Take in an image's lines."""
        if not len(lines.weight):
            return
        bearing = np.arange(-_REACH_RAD, _REACH_RAD + _COLUMN_STEP_RAD / 2, _COLUMN_STEP_RAD)
        columns = self._focal_px * np.tan(bearing)
        ahead, aside = (np.exp(-0.5 * (bearing / sigma) ** 2) / sigma for sigma in (_AHEAD_RAD, _ASIDE_RAD))
        prior = _AHEAD_SHARE * ahead + (1 - _AHEAD_SHARE) * aside
        rise = np.abs(np.tan(self._roll)).max() * columns.max() / self._focal_px
        spare = int(np.ceil(rise / _PITCH_STEP_RAD))
        pitch_of_row = self._pitch[0] + _PITCH_STEP_RAD * np.arange(-spare, len(self._pitch) + spare)
        rows = -self._focal_px * np.tan(np.clip(pitch_of_row, -_STEEPEST_RAD, _STEEPEST_RAD))
        points = self._log_likelihood(lines, columns, rows) + np.log(prior)
        # The horizon of each pitch and roll, through the columns.
        level = np.tan(np.clip(self._pitch, -_STEEPEST_RAD, _STEEPEST_RAD))
        up = level[:, None, None] + np.tan(self._roll)[:, None] * columns / self._focal_px
        place = (np.arctan(up) - pitch_of_row[0]) / _PITCH_STEP_RAD
        first = np.clip(np.floor(place).astype(np.intp), 0, len(pitch_of_row) - 2)
        share = np.clip(place - first, 0, 1)
        column = np.arange(len(columns))
        on_horizon = (1 - share) * points[first, column] + share * points[first + 1, column]
        likelihood = np.exp(on_horizon - on_horizon.max()).sum(axis=2)
        body = np.exp(-0.5 * ((self._pitch[:, None] - self._pitch) / BODY_SIGMA_RAD) ** 2)
        moved = (body / body.sum(axis=1, keepdims=True)) @ likelihood
        self._log_belief = self._log_belief + np.log((1 - _SILENT) * moved / moved.mean() + _SILENT)

    def _log_likelihood(self, lines: Lines, columns: FloatArray, rows: FloatArray) -> FloatArray:
        """Log likelihood (R, C) of vanishing points, px from the principal point, over that of none."""
        total = np.zeros((len(rows), len(columns)), dtype=np.float32)
        point = (lines.point_px - self._centre_px).astype(np.float32)
        parallel_px = _PARALLEL_SIGMA_RAD * self._focal_px * lines.direction[:, 1]
        variance_px2 = (lines.sigma_px**2 + _POINT_SIGMA_PX**2 + parallel_px**2).astype(np.float32)
        direction = lines.direction.astype(np.float32)
        turned = (lines.sigma_rad**2).astype(np.float32)
        u = columns.astype(np.float32)
        v = rows.astype(np.float32)[:, None]
        for k, weight in enumerate(lines.weight.tolist()):
            across = u - point[k, 0]
            down = v - point[k, 1]
            nearer = 1 / np.maximum(across**2 + down**2, np.float32(1))
            variance = turned[k] + variance_px2[k] * nearer
            sine2 = (across * direction[k, 1] - down * direction[k, 0]) ** 2 * nearer
            # Over directions that are all alike likely: pi / sqrt(2 pi).
            ratio = np.exp(-0.5 * sine2 / variance) * np.float32(np.sqrt(np.pi / 2)) / np.sqrt(variance)
            total += np.float32(weight) * np.log(np.float32(_SHARE) * ratio + np.float32(1 - _SHARE))
        return total.astype(np.float64)


def _grid(mean: float, sigma: float, step: float) -> FloatArray:
    """Values ``step`` apart, as many to either side of a mean as reach ``_SIGMAS`` standard deviations."""
    reach = int(np.ceil(_SIGMAS * sigma / step))
    return np.asarray(mean + step * np.arange(-reach, reach + 1))


def _moments(share: FloatArray, values: FloatArray, step: float) -> tuple[float, float]:
    """Mean and standard deviation of values ``step`` apart, of which each has a share (N,)."""
    mean = float(share @ values)
    square = float(share @ values**2)
    return mean, float(np.sqrt(max(square - mean**2, 0) + step**2 / 12))
