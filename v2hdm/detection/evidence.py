"""The inputs of the classifier: numbers about a fitted quadrilateral, and a picture of it in its own frame.

A homography takes the four corners to those of a rectangle, so that every marking of a class looks the same
wherever it lies in the image (Faster R-CNN's region of interest, Ren et al., NeurIPS 2015, along the
marking's own sides). Light and distance cancel; left is what sets a worn marking off from a fleck of sun.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.catalogue import LINE, OTHER, SYMBOL, Catalogue
from v2hdm.detection.fit import STATISTICS, Fit
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.patch import ImageQuads, Patches, grey_of, log_light
from v2hdm.detection.propose import Proposal
from v2hdm.geometry.quadrilateral import Quad
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

FEATURES = (*CLAIMED, *STATISTICS, "fill", "open_sides", "log_width_px", "log_length", "log_width", "skew")
"""Names of the columns of :func:`gather`, in order.

Besides the claims and the fit's statistics: how much of the starting quadrilateral the piece fills, how many
sides the border cuts, log of the width in px, log of length and width on the ground, m, and log of how much
longer the longest side is than the shortest.
"""

CHANNELS = ("log_grey", "blueness", "paint_odds", "own_share", "line_share", "symbol_share", "outside")
"""Channels of :func:`rectified_views`: log of the grey value over its median; log of blue over red, over its
median; log odds of paint; the network's shares of the quadrilateral's own class, lane lines and symbols;
whether it is outside the image."""

CLAIMED_CHANNELS = CHANNELS[CHANNELS.index("paint_odds") : CHANNELS.index("outside")]
"""The channels that are the network's."""

SIZE = 20
"""Rows and columns of a picture."""

_AROUND = 0.6
_BEFORE, _BESIDE = 0.3, 1.0
"""How far a picture reaches beyond the corners, in parts of the sides: of a diamond; of all else along its
longer sides and across them."""

_FINER = 2  # so many samples of the image per element, in each direction
_GREY_GAIN, _COLOUR_GAIN, _ODDS_GAIN = 2.0, 2.0, 1 / 3  # bring the channels to about one
_GRID = (np.arange(6) + 0.5) / 6
_INNER = tuple(part.reshape(-1) for part in np.meshgrid(_GRID, _GRID))
_SUREST = -4  # place of the ninth decile among 36, in order
_BESIDE_PX = 2.5  # paint beside a side is looked for so far outside
_SIZE_LIMITS_M = (0.01, 100.0)


def gather(
    fit: Fit,
    output: NetworkOutput,
    quads: ImageQuads,
    ground: Quad,
    proposals: Sequence[Proposal],
    readings: Sequence[tuple[int, str]],
    catalogue: Catalogue,
) -> FloatArray:
    """The :data:`FEATURES` (R, F) of R readings, each the index of one of M quadrilaterals and a class.

    ``quads`` are those of the ``fit`` in the image, ``ground`` on the ground, m, NaN above the horizon;
    ``proposals`` are the pieces of paint they come from.
    """
    sides = np.sort(np.nan_to_num(ground.length, nan=1.0), axis=1)
    log_sides = np.log(np.clip(sides, *_SIZE_LIMITS_M))
    inside, beside = _paint_odds(output, quads)
    lines, symbols = catalogue.of_family(LINE), catalogue.of_family(SYMBOL, OTHER)
    shared = {
        "odds_inside": inside.mean(axis=1),
        "surest_inside": np.sort(inside, axis=1)[:, _SUREST],
        "paint_beside": beside.mean(axis=2).max(axis=1),
        "certainty": np.array([p.certainty for p in proposals]),
        "line_share": np.array([p.score_of(lines) / p.certainty for p in proposals]),
        "symbol_share": np.array([p.score_of(symbols) / max(p.certainty, 1e-9) for p in proposals]),
        "touches_symbol": np.array([float(p.blob.touches_symbol) for p in proposals]),
        **dict(zip(STATISTICS, fit.statistics.T, strict=True)),
        "fill": np.array([p.fill for p in proposals]),
        "open_sides": fit.open_sides.sum(axis=1).astype(np.float64),
        "log_width_px": np.log(np.maximum(quads.width, 0.3)),
        "log_length": log_sides[:, 2:].mean(axis=1),
        "log_width": log_sides[:, :2].mean(axis=1),
        "skew": np.minimum(log_sides[:, 3] - log_sides[:, 0], 2.0),
    }
    rows = np.array([m for m, _ in readings], dtype=np.intp)
    columns = {name: value[rows] for name, value in shared.items()}
    columns["share"] = np.array([proposals[m].score_of([k]) / proposals[m].certainty for m, k in readings])
    columns["size_share"] = np.array([proposals[m].share[kind] for m, kind in readings])
    return np.nan_to_num(np.column_stack([columns[name] for name in FEATURES]).astype(np.float64))


def _paint_odds(output: NetworkOutput, quads: ImageQuads) -> tuple[FloatArray, FloatArray]:
    """Log odds of paint all over the inside (M, 36) of quadrilaterals, and beside each side (M, 4, 6)."""
    along = (_GRID * quads.length[..., None])[..., None] * quads.tangent[:, :, None]
    beside = quads.corners[:, :, None] + along + _BESIDE_PX * quads.normal[:, :, None]
    inner = quads.at(*_INNER)
    odds = output.odds_at(quads.px(np.concatenate([inner, beside.reshape(len(beside), -1, 2)], axis=1)))
    return odds[:, : inner.shape[1]], odds[:, inner.shape[1] :].reshape(beside.shape[:-1])


def rectified_views(
    patches: Patches,
    quads: ImageQuads,
    ground: Quad,
    readings: Sequence[tuple[int, str]],
    catalogue: Catalogue,
) -> tuple[np.ndarray, np.ndarray]:
    """Pictures (R, C, 20, 20) float32, whose channels are :data:`CHANNELS`, and the side (R,) at their top.

    Columns run along the longer sides of all but diamonds; arguments are as of :func:`gather`.
    """
    # All readings of a quadrilateral as a diamond share a picture, and so do those as anything else.
    key = np.array([2 * m + (kind == DIAMOND) for m, kind in readings], dtype=np.intp)
    shown, of_reading = np.unique(key, return_inverse=True)
    marking, diamond = shown // 2, shown % 2 == 1
    length = np.nan_to_num(ground.length, nan=1.0)
    lengthwise = length[:, 0] + length[:, 2] >= length[:, 1] + length[:, 3]
    ordered = quads.long_first(lengthwise).corners[marking]
    quads, output = quads.take(marking), patches.output
    points = quads.px(_points(ordered, diamond, SIZE))
    bgr = patches.light_at(marking, quads.px(_points(ordered, diamond, _FINER * SIZE)))
    bgr = bgr.reshape(len(bgr), SIZE, _FINER, SIZE, _FINER, 3).mean(axis=(2, 4))
    logs = log_light(bgr)
    grey, blueness = (
        plane - np.median(plane, axis=(1, 2), keepdims=True)
        for plane in (log_light(grey_of(bgr)), logs[..., 0] - logs[..., 2])
    )
    odds, shares = output.odds_at(points), output.shares_at(points)
    lines = shares[:, output.classes.index(LANE_LINE)]
    names = catalogue.of_family(SYMBOL, OTHER)
    symbols = shares[:, [k for k, name in enumerate(output.classes) if name in names]].sum(axis=1)
    own = shares[of_reading, [output.classes.index(kind) for _, kind in readings]]
    shared = (_GREY_GAIN * grey, _COLOUR_GAIN * blueness, _ODDS_GAIN * odds, lines, symbols)
    planes = [plane[of_reading] for plane in (*shared, patches.outside(points))]
    planes.insert(CHANNELS.index("own_share"), own)
    first_side = np.where(lengthwise, 0, 1)[marking][of_reading]
    return np.stack(planes, axis=1).astype(np.float32), first_side


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
