"""Numbers that tell whether a quadrilateral is a whole marking: of the network, of the fit, of its shape.

Quadrilaterals and what lies about them as small pictures, each seen in the quadrilateral's own frame.

A homography takes the four corners to those of a rectangle, so that every marking of a class looks the same
wherever it lies in the image (Faster R-CNN's region of interest, Ren et al., NeurIPS 2015, along the
marking's own sides). Light and distance cancel; left is what tells a worn marking from a fleck of sun.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.catalogue import LINE, OTHER, SYMBOL, Catalogue
from v2hdm.detection.camera import CameraView
from v2hdm.detection.fit import STATISTICS, Fit
from v2hdm.detection.network import Foreground
from v2hdm.detection.patch import Quads, grey_of, linear_bgr, log_grey
from v2hdm.detection.propose import Proposal, symbol_share
from v2hdm.geometry.quadrilateral import following, side_frames, width
from v2hdm.records import DIAMOND, LANE_LINE, FloatArray

CLAIMED = (
    "odds_inside",
    "surest_inside",
    "paint_beside",
    "certainty",
    "share",
    "size_share",
    "line_share",
    "symbol_share",
    "touches_symbol",
)
"""The features that are claims of the network.

Log odds of paint inside, their mean and ninth decile, and their mean beside the side where they are highest;
mean probability of paint over the piece; share of the class by the network alone, and by network and size;
shares of lines and of symbols; whether the piece was split off a symbol.
"""

FEATURES = (
    *CLAIMED,
    *STATISTICS,
    "fill",
    "open_sides",
    "log_width_px",
    "log_length",
    "log_width",
    "skew",
)
"""Names of the columns of :func:`gather`, in order.

Besides the claims and the fit's statistics: how much of the starting quadrilateral the piece fills, how many
sides the border cuts, log of the width in px, log of length and width on the ground, m, and log of how much
longer the longest side is than the shortest.
"""

_GRID = (np.arange(6) + 0.5) / 6
_SUREST = -4
"""Place of the ninth decile among 36, in order."""

_BESIDE_PX = 2.5
"""Paint beside a side is looked for so far outside."""

_SIZE_LIMITS_M = (0.01, 100.0)


def gather(
    fit: Fit,
    foreground: Foreground,
    quads: Quads,
    ground: FloatArray,
    proposals: Sequence[Proposal],
    readings: Sequence[tuple[int, str]],
    catalogue: Catalogue,
) -> FloatArray:
    """The :data:`FEATURES` (R, F) of R readings, each of one of M quadrilaterals as one class.

    Args:
        fit: the quadrilaterals.
        foreground: what the network says of the image.
        quads: the fitted quadrilaterals in the image.
        ground: their corners on the ground (M, 4, 2), m; NaN above the horizon.
        proposals: the pieces of paint they come from.
        readings: index of the quadrilateral and class of each.
        catalogue: the classes.
    """
    sides = np.sort(np.nan_to_num(side_frames(ground)[2], nan=1.0), axis=1)
    log_sides = np.log(np.clip(sides, *_SIZE_LIMITS_M))
    inside, beside = _paint_odds(foreground, quads)
    lines = catalogue.of_family(LINE)
    shared = {
        "odds_inside": inside.mean(axis=1),
        "surest_inside": np.sort(inside, axis=1)[:, _SUREST],
        "paint_beside": beside.mean(axis=2).max(axis=1),
        "certainty": np.array([p.certainty for p in proposals]),
        "line_share": np.array(
            [sum(p.blob.class_score.get(n, 0.0) for n in lines) / p.certainty for p in proposals]
        ),
        "symbol_share": np.array([symbol_share(p, catalogue) for p in proposals]),
        "touches_symbol": np.array([float(p.blob.touches_symbol) for p in proposals]),
        **dict(zip(STATISTICS, fit.statistics.T, strict=True)),
        "fill": np.array([p.fill for p in proposals]),
        "open_sides": fit.open_sides.sum(axis=1).astype(np.float64),
        "log_width_px": np.log(np.maximum(width(quads.corners), 0.3)),
        "log_length": log_sides[:, 2:].mean(axis=1),
        "log_width": log_sides[:, :2].mean(axis=1),
        "skew": np.minimum(log_sides[:, 3] - log_sides[:, 0], 2.0),
    }
    rows = np.array([m for m, _ in readings], dtype=np.intp)
    columns = {name: value[rows] for name, value in shared.items()}
    columns["share"] = np.array(
        [proposals[m].blob.class_score.get(kind, 0.0) / proposals[m].certainty for m, kind in readings]
    )
    columns["size_share"] = np.array([proposals[m].share[kind] for m, kind in readings])
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


CHANNELS = ("log_grey", "blueness", "paint_odds", "own_share", "line_share", "symbol_share", "outside")
"""Of :func:`rectified_views`: log of the grey value over its median; log of blue over red, over its median;
log odds of paint; shares of the quadrilateral's own class, of lane lines and of symbols in what the network
takes it for; whether it is outside the image."""

CLAIMED_CHANNELS = CHANNELS[CHANNELS.index("paint_odds") : CHANNELS.index("outside")]
"""Those that are the network's."""

SIZE = 20
"""Rows and columns of a picture."""

_AROUND = 0.6
_BEFORE, _BESIDE = 0.3, 1.0
"""How far a picture reaches beyond the corners, in parts of the sides: of a diamond; of all else along its
longer sides and across them."""

_FINER = 2
"""So many samples of the image per element, in each direction."""

_GREY_GAIN, _COLOUR_GAIN, _ODDS_GAIN = 2.0, 2.0, 1 / 3
"""Bring the channels to about one."""


def rectified_views(
    image_bgr: np.ndarray,
    view: CameraView,
    foreground: Foreground,
    quads: Quads,
    ground: FloatArray,
    kinds: Sequence[str],
    catalogue: Catalogue,
) -> tuple[np.ndarray, np.ndarray]:
    """Pictures (M, C, 20, 20) float32, whose channels are :data:`CHANNELS`, and the side (M,) at their top.

    Args:
        image_bgr: (H, W, 3) uint8.
        view: the camera.
        foreground: what the network says of the image.
        quads: the quadrilaterals.
        ground: their corners on the ground (M, 4, 2), m; NaN above the horizon.
        kinds: the classes; columns run along the longer sides of all but diamonds.
        catalogue: all classes.
    """
    diamond = np.array(kinds) == DIAMOND
    length = np.nan_to_num(side_frames(ground)[2], nan=1.0)
    lengthwise = length[:, 0] + length[:, 2] >= length[:, 1] + length[:, 3]
    ordered = np.where(lengthwise[:, None, None], quads.corners, following(quads.corners))
    points = quads.px(_points(ordered, diamond, SIZE))
    fine = quads.px(_points(ordered, diamond, _FINER * SIZE))
    height, width = image_bgr.shape[:2]
    outside = ((points < 0) | (points > [width - 1, height - 1])).any(axis=-1)
    grey, blueness = _light(image_bgr, fine, view.camera.linear_response)
    odds = foreground.odds_at(points)
    shares = foreground.shares_at(points)
    own = shares[np.arange(len(kinds)), [foreground.classes.index(kind) for kind in kinds]]
    lines = shares[:, foreground.classes.index(LANE_LINE)]
    names = catalogue.of_family(SYMBOL, OTHER)
    symbols = shares[:, [k for k, name in enumerate(foreground.classes) if name in names]].sum(axis=1)
    planes = (_GREY_GAIN * grey, _COLOUR_GAIN * blueness, _ODDS_GAIN * odds, own, lines, symbols, outside)
    return np.stack(planes, axis=1).astype(np.float32), np.where(lengthwise, 0, 1)


def _points(corners: FloatArray, diamond: np.ndarray, size: int) -> FloatArray:
    """Where (M, size, size, 2) the elements of pictures lie, the first corner near the first of them."""
    along, across = (
        np.where(diamond, _AROUND, margin)[:, None] * [-1, 1] + [0, 1] for margin in (_BEFORE, _BESIDE)
    )
    step = (np.arange(size) + 0.5) / size
    a = (along[:, :1] + (along[:, 1:] - along[:, :1]) * step)[:, None, :, None]
    b = (across[:, :1] + (across[:, 1:] - across[:, :1]) * step)[:, :, None, None]
    first, second, third, fourth = (corners[:, None, None, corner] for corner in range(4))
    # Heckbert, "Fundamentals of Texture Mapping and Image Warping" (1989), 2.2.3: from the unit square.
    surplus = first - second + third - fourth
    one, other = second - third, fourth - third
    cross = _cross(one, other)
    cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
    g, h = _cross(surplus, other) / cross, _cross(one, surplus) / cross
    depth = np.maximum(1 + g * a + h * b, 0.05)
    return np.asarray((first + (second - first + g * second) * a + (fourth - first + h * fourth) * b) / depth)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., :1] * b[..., 1:] - a[..., 1:] * b[..., :1])


def _light(image_bgr: np.ndarray, points: FloatArray, linear_response: bool) -> tuple[FloatArray, FloatArray]:
    """Log grey and log of blue over red (M, SIZE, SIZE), over their medians, of finer ``points``."""
    u, v = (points[..., axis].astype(np.float32).reshape(-1, (_FINER * SIZE) ** 2) for axis in (0, 1))
    coded = cv2.remap(image_bgr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    bgr = linear_bgr(coded, linear_response)
    parts = bgr.reshape(len(points), SIZE, _FINER, SIZE, _FINER, 3).mean(axis=(2, 4))
    logs = log_grey(parts)
    grey, blueness = log_grey(grey_of(parts)), logs[..., 0] - logs[..., 2]
    return tuple(plane - np.median(plane, axis=(1, 2), keepdims=True) for plane in (grey, blueness))
