"""What speaks for a quadrilateral being a whole marking: the image about its sides, the network, its shape.

A network that is sure of paint may be wrong about where it ends, or take a fleck of sun for it. A marking is
brighter than the ground along all of its sides, its sides end where they meet, and it has a marking's shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.foreground import Foreground
from v2hdm.detection.corners.grey import GreyBand, log_grey
from v2hdm.detection.corners.straight import Quads
from v2hdm.geometry.quadrilateral import preceding, side_frames, width
from v2hdm.records import BoolArray, FloatArray

FEATURES = (
    "odds_inside",
    "surest_inside",
    "paint_beside",
    "certainty",
    "share",
    "possible_share",
    "line_share",
    "symbol_share",
    "touches_symbol",
    "at_head",
    "four_corners",
    "support",
    "contrast",
    "weakest_side",
    "sharpness",
    "overexposed",
    "goes_on",
    "goes_furthest_on",
    "at_border",
    "log_width_px",
    "log_length",
    "log_width",
    "skew",
)
"""Names of the columns of :func:`gather`, in order.

From the network: log odds of paint inside, their mean and their ninth decile, and their mean beside that
side where they are highest; mean probability of paint over the blob, the share in it of the class, its share
among the classes that the blob's size leaves possible, the shares of lane lines and of symbols, whether the
blob was split off an arrow or a letter, and whether it ends where what may be the head of an arrow begins.
From the image: whether it gave four corners, the share of profiles across the sides that show paint inside,
the log of the typical step, the step of the weakest side in parts of that, how much of it is within a px of
the side, how much of the inside is overexposed, how far the steps go on beyond the corners, on the whole and
where they do so furthest, whether a corner is at the image's border, the log of the width in px. On the
ground, m: log of length and width, and of how much longer the longest side is than the shortest."""

CLAIMED = FEATURES[: FEATURES.index("four_corners")]
"""Those of the features that are the network's."""

_PROFILES = 12
_FAR_PX = 2.0
_NEAR_PX = 1.0
_ACROSS_SHARE = 0.35
"""Profiles compare the grey so far inside and outside a side; inside at most this share of the width."""

_BEYOND_PX = np.array([3.0, 4.5, 6.0])
"""Where a side's line is looked at beyond the corner."""

_RUNS_ON = 0.6
"""A step of this share of the side's own is the side's continuation: half the corners where there is one all
the way are off by half a px and more, of the others one in eight."""

_OVEREXPOSED = 0.99
"""Grey values that are not at the sensor's limit are below this."""

_RUNS_ON_AT_BOTH = 0.3
_LEAST_RATIO, _MOST_RATIO = 0.7, 1.5
"""Of sides outside these a tenth of the corners are off by 3 px and more, elsewhere one in two hundred."""

_LEAST_STEP = 0.05
_SUPPORT_SHARE = 0.4
"""A profile supports its side with a step above noise, and above this share of the typical one."""

_GRID = (np.arange(6) + 0.5) / 6
_SUREST = -4
"""Place of the ninth decile of what is found on that grid, in order."""

_BESIDE_PX = 2.5
_BORDER_PX = 6.0


@dataclass(frozen=True)
class Claim:
    """What the network claims of a blob: ``certainty`` that it is paint, and what classes share in that.

    ``share`` is the class's own, ``line_share`` that of lane lines, ``symbol_share`` that of arrows, chevrons
    and other paint; ``possible_share`` is the class's among those that the blob's size leaves possible.
    """

    certainty: float
    share: float
    line_share: float
    symbol_share: float
    touches_symbol: bool
    at_head: bool
    possible_share: float


@dataclass(frozen=True)
class Steps:
    """Steps of log grey from outside to inside across the sides of M quadrilaterals.

    ``along`` (M, 4, n) at profiles of each side, of which ``typical`` (M,) is the median; ``near`` (M,) that
    of the part of them within a px of the sides; ``by_side`` (M, 4) the median of each side; ``going_on``
    (M, 4, 2, k) how much of a side's step is still there, from -1 to 2, on its line's continuation beyond
    its start and its end. A step is 0 where it is unknown. ``overexposed`` (M,) is the share of the profiles'
    inner ends where the sensor was at its limit.
    """

    along: FloatArray
    typical: FloatArray
    near: FloatArray
    by_side: FloatArray
    going_on: FloatArray
    overexposed: FloatArray

    def take(self, rows: np.ndarray) -> Steps:
        """Those of some of the quadrilaterals."""
        return Steps(*(value[rows] for value in vars(self).values()))

    def runs_on(self) -> BoolArray:
        """Corners (M, 4) beyond which one of their two sides goes on, wherever it was looked at.

        Such a side is that of a shadow, of something before the ground, or of other paint, and where it
        meets the next is no corner of the marking.
        """
        start, end = np.moveaxis(self.going_on.min(axis=3) > _RUNS_ON, 2, 0)
        return np.asarray(start | preceding(end, -1))

    def uneven(self) -> BoolArray:
        """Corners (M, 4) of a side whose step is not that of the others, or runs on at both of its ends.

        Paint and ground differ by the same factor all around, in sun and in shade. A side where they differ
        less is that of worn paint, where they differ more, or the same beyond both corners, that of a shadow
        across the marking: in every image it is as sharp as the paint's own, and in the same wrong place.
        """
        ratio = self.by_side / np.maximum(self.typical, _LEAST_STEP)[:, None]
        both = self.going_on.min(axis=(2, 3)) > _RUNS_ON_AT_BOTH
        side = (ratio < _LEAST_RATIO) | (ratio > _MOST_RATIO) | both
        return np.asarray(side | preceding(side, -1))


def whole_ends(doubtful: BoolArray, length: FloatArray) -> BoolArray:
    """Corners (M, 4) that share a short side with one of ``doubtful`` (M, 4); ``length`` (M, 4) of the sides.

    The end of a dash is where it should be, or is not: what spoils one of its corners spoils the other.
    """
    first = length[:, 0] + length[:, 2] < length[:, 1] + length[:, 3]
    # Corners 0 and 1 are the ends of side 0, 1 and 2 those of side 1.
    partner = np.where(first[:, None], [1, 0, 3, 2], [3, 2, 1, 0])
    return np.asarray(doubtful | np.take_along_axis(doubtful, partner, axis=1))


def grey_steps(grey: GreyBand, quads: Quads) -> Steps:
    """Look across the sides of M quadrilaterals and across their continuations."""
    tangent, normal, length = side_frames(quads.corners)
    along = (np.arange(_PROFILES) + 0.5) / _PROFILES * length[..., None]
    beyond = np.concatenate([-_BEYOND_PX + 0 * length[..., None], length[..., None] + _BEYOND_PX], axis=-1)
    place = np.concatenate([along, beyond, along], axis=-1)
    inside_px = np.minimum(_FAR_PX, _ACROSS_SHARE * width(quads.corners))[:, None, None]
    near = np.arange(place.shape[-1]) >= _PROFILES + beyond.shape[-1]
    inside_px = np.where(near, np.minimum(_NEAR_PX, inside_px / 2), inside_px)
    outside_px = np.broadcast_to(np.where(near, _NEAR_PX, _FAR_PX), inside_px.shape)
    foot = quads.corners[:, :, None] + place[..., None] * tangent[:, :, None]
    across = np.stack([-inside_px, outside_px], axis=1)[..., None] * normal[:, None, :, None]
    points_px = quads.px(foot[:, None] + across).swapaxes(0, 1)
    values = grey.at_limit.sample(points_px.reshape(2, -1, 2)).reshape(2, *place.shape)
    logs = log_grey(values)
    steps = np.nan_to_num(logs[0] - logs[1]).astype(np.float64)
    first, second = _PROFILES, _PROFILES + beyond.shape[-1]
    along, near = steps[..., :first], steps[..., second:]
    typical, by_side = median(along.reshape(len(steps), -1)), median(along)
    whole = np.maximum(np.maximum(by_side, typical[:, None]), _LEAST_STEP)
    ratio = steps[..., first:second] / whole[..., None]
    going_on = np.minimum(np.maximum(ratio, -1.0), 2.0).reshape(*length.shape, 2, -1)
    overexposed = (values[0, ..., :first] > _OVEREXPOSED).mean(axis=(1, 2))
    return Steps(along, typical, median(near.reshape(len(steps), -1)), by_side, going_on, overexposed)


def median(values: FloatArray) -> FloatArray:
    """Median (...) of finite values (..., n); ``np.median`` takes many times as long on few values."""
    ordered, middle = np.sort(values, axis=-1), values.shape[-1] // 2
    return np.asarray((ordered[..., middle] + ordered[..., -1 - middle]) / 2)


def gather(
    steps: Steps,
    foreground: Foreground,
    view: CameraView,
    quads: Quads,
    ground: FloatArray,
    claims: list[Claim],
    valid: BoolArray,
) -> FloatArray:
    """The :data:`FEATURES` (M, F) of M quadrilaterals.

    Args:
        steps: what the image shows across their sides.
        foreground: what the network says of the image.
        view: the camera.
        quads: the quadrilaterals.
        ground: their corners on the ground (M, 4, 2), m; NaN above the horizon.
        claims: what the network claims of each one's blob.
        valid: (M, 4) which corners the image gave.
    """
    sides = np.sort(side_frames(ground)[2], axis=1)
    log_sides = np.log(np.clip(np.nan_to_num(sides, nan=1.0), 0.01, 100.0))
    log_width = np.log(np.clip(sides[:, :2].mean(axis=1), 0.01, 100.0))
    log_length = np.log(np.clip(sides[:, 2:].mean(axis=1), 0.01, 100.0))
    typical = np.maximum(steps.typical, _LEAST_STEP)
    good = steps.along > np.maximum(_SUPPORT_SHARE * typical, _LEAST_STEP)[:, None, None]
    going_on = median(steps.going_on)
    at_border = ~view.inside(quads.corners_px, _BORDER_PX).all(axis=1)
    inside, beside = _paint_odds(foreground, quads)
    sharpness = np.clip(steps.near / typical, 0.0, 1.2)
    log_width_px = np.log(np.maximum(width(quads.corners), 0.3))
    columns = {
        "odds_inside": inside.mean(axis=1),
        "surest_inside": np.sort(inside, axis=1)[:, _SUREST],
        "paint_beside": beside.mean(axis=2).max(axis=1),
        "certainty": np.array([claim.certainty for claim in claims]),
        "share": np.array([claim.share for claim in claims]),
        "possible_share": np.array([claim.possible_share for claim in claims]),
        "line_share": np.array([claim.line_share for claim in claims]),
        "symbol_share": np.array([claim.symbol_share for claim in claims]),
        "touches_symbol": np.array([claim.touches_symbol for claim in claims]),
        "at_head": np.array([claim.at_head for claim in claims]),
        "four_corners": valid.all(axis=1),
        "support": good.mean(axis=(1, 2)),
        "contrast": np.log(typical),
        "weakest_side": np.clip(steps.by_side.min(axis=1) / typical, -1.0, 1.5),
        "sharpness": sharpness,
        "overexposed": steps.overexposed,
        "goes_on": going_on.mean(axis=(1, 2)),
        "goes_furthest_on": going_on.max(axis=(1, 2)),
        "at_border": at_border,
        "log_width_px": log_width_px,
        "log_length": log_length,
        "log_width": log_width,
        "skew": np.minimum(log_sides[:, 3] - log_sides[:, 0], 2.0),
    }
    return np.nan_to_num(np.column_stack([columns[name] for name in FEATURES]).astype(np.float64))


def _paint_odds(foreground: Foreground, quads: Quads) -> tuple[FloatArray, FloatArray]:
    """Log odds of paint all over the inside (M, 36) of quadrilaterals, and beside each side (M, 4, 6)."""
    tangent, normal, length = side_frames(quads.corners)
    along = (_GRID * length[..., None])[..., None] * tangent[:, :, None]
    beside = quads.corners[:, :, None] + along + _BESIDE_PX * normal[:, :, None]
    inner = _inner_grid(quads.corners)
    odds = foreground.odds_at(quads.px(np.concatenate([inner, beside.reshape(len(beside), -1, 2)], axis=1)))
    return odds[:, : inner.shape[1]], odds[:, inner.shape[1] :].reshape(beside.shape[:-1])


def _inner_grid(corners: FloatArray) -> FloatArray:
    """Points (M, 36, 2) all over the inside of quadrilaterals (M, 4, 2), by bilinear interpolation."""
    a, b = (part.reshape(-1) for part in np.meshgrid(_GRID, _GRID))
    weight = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
    return np.asarray(weight @ corners)
