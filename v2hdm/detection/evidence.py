"""Inputs of the classifier: numbers about a fitted quadrilateral, and a picture of it in its frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from v2hdm.catalogue import LINE, Catalogue
from v2hdm.detection.company import LEAST_SIZE_M, MOST_SIZE_M
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.quads.fit import STATISTICS, Fit
from v2hdm.detection.quads.patch import ImageQuads, Patches, grey_of, log_light
from v2hdm.detection.quads.propose import Proposal
from v2hdm.geometry.planar import Quad, cross
from v2hdm.native import kernels
from v2hdm.records import DIAMOND, LANE_LINE, BoolArray, FloatArray

CLAIMED = (
    "odds_inside", "surest_inside", "paint_beside", "certainty", "share", "size_share", "line_share",
    "symbol_share", "touches_symbol",
)  # fmt: skip
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

SIZE = 20  # rows and columns of a picture

_AROUND = 0.6  # how far the picture of a diamond reaches beyond its corners, in parts of its sides
_BEFORE = 0.3  # how far the picture of any other marking reaches beyond its ends, in lengths
_BESIDE = 1.0  # how far the picture of any other marking reaches beyond its long sides, in widths
_FINER = 2  # samples of the image per element of a picture, in each direction

_GREY_GAIN = 2.0  # factor that brings the log grey of a picture to about one
_COLOUR_GAIN = 2.0  # factor that brings the blueness of a picture to about one
_ODDS_GAIN = 1 / 3  # factor that brings the log odds of paint to about one

_GRID = (np.arange(6) + 0.5) / 6  # places along a side, in parts of it, at which paint is looked for
_INNER_ALONG = np.tile(_GRID, 6)  # places (36,) all over a marking, in parts of its length
_INNER_ACROSS = np.repeat(_GRID, 6)  # the same places, in parts of its width
_SUREST = -4  # place of the ninth decile among the 36 places inside, in order
_BESIDE_PX = 2.5  # distance outside a side, px, at which paint beside it is looked for
_LEAST_WIDTH_PX = 0.3  # widths of markings in the image are clipped at this, px
_MOST_SKEW = 2.0  # log of how much longer the longest side is than the shortest, from which all are alike


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

    ``quads`` are in the image, ``ground`` on the ground, m, NaN above the horizon; ``proposals`` are their
    paint.
    """
    sides = np.sort(np.nan_to_num(ground.length, nan=1.0), axis=1)
    log_sides = np.log(np.clip(sides, LEAST_SIZE_M, MOST_SIZE_M))
    inside, beside = _paint_odds(output, quads)
    lines = catalogue.of_family(LINE)
    symbols = catalogue.of_any_shape
    of_quadrilateral = {
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
        "log_width_px": np.log(np.maximum(quads.width, _LEAST_WIDTH_PX)),
        "log_length": log_sides[:, 2:].mean(axis=1),
        "log_width": log_sides[:, :2].mean(axis=1),
        "skew": np.minimum(log_sides[:, 3] - log_sides[:, 0], _MOST_SKEW),
    }
    rows = np.array([m for m, _ in readings], dtype=np.intp)
    columns = {name: value[rows] for name, value in of_quadrilateral.items()}
    columns["share"] = np.array([proposals[m].score_of([k]) / proposals[m].certainty for m, k in readings])
    columns["size_share"] = np.array([proposals[m].share[kind] for m, kind in readings])
    return np.nan_to_num(np.column_stack([columns[name] for name in FEATURES]).astype(np.float64))


def _paint_odds(output: NetworkOutput, quads: ImageQuads) -> tuple[FloatArray, FloatArray]:
    """Log odds of paint all over the inside (M, 36) of quadrilaterals, and beside each side (M, 4, 6)."""
    along = (_GRID * quads.length[..., None])[..., None] * quads.tangent[:, :, None]
    beside = quads.corners[:, :, None] + along + _BESIDE_PX * quads.normal[:, :, None]
    inner = quads.at(_INNER_ALONG, _INNER_ACROSS)
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
    picture, of_reading = np.unique(key, return_inverse=True)
    marking = picture // 2
    is_diamond = picture % 2 == 1
    length = np.nan_to_num(ground.length, nan=1.0)
    lengthwise = length[:, 0] + length[:, 2] >= length[:, 1] + length[:, 3]
    ordered = quads.long_first(lengthwise).corners[marking]
    quads = quads.take(marking)
    output = patches.output
    points = quads.px(_points(ordered, is_diamond, SIZE))
    finer = quads.px(_points(ordered, is_diamond, _FINER * SIZE))
    class_index = [output.classes.index(kind) for _, kind in readings]
    first_side = np.where(lengthwise, 0, 1)[marking][of_reading]
    claims = _Claims.of(output, catalogue)
    compiled = kernels()
    if compiled is not None:
        own_class = np.array(class_index, dtype=np.intp)
        gains = (_GREY_GAIN, _COLOUR_GAIN, _ODDS_GAIN)
        views = compiled.views(
            patches.source, claims, points, finer, of_reading.astype(np.intp), own_class, *gains
        )
        return views, first_side
    bgr = _coarser(patches.light_at(finer))
    logs = log_light(bgr)
    odds = output.odds_at(points)
    shares = output.shares_at(points)
    planes_of = {
        "log_grey": np.float32(_GREY_GAIN) * _over_median(log_light(grey_of(bgr))),
        "blueness": np.float32(_COLOUR_GAIN) * _over_median(logs[..., 0] - logs[..., 2]),
        "paint_odds": np.float32(_ODDS_GAIN) * odds,
        "line_share": shares[claims.line],
        "symbol_share": shares[claims.is_symbol].sum(axis=0),
        "outside": patches.outside(points),
    }
    views = np.empty((len(readings), len(CHANNELS), SIZE, SIZE), dtype=np.float32)
    for name, planes in planes_of.items():
        views[:, CHANNELS.index(name)] = planes[of_reading]
    views[:, CHANNELS.index("own_share")] = shares[class_index, of_reading]
    return views, first_side


class _Claims(NamedTuple):
    """The network's planes of an image, for the compiled kernel."""

    paint: np.ndarray  # (h, w) float32 log odds
    kinds: np.ndarray  # (K, h', w') float32 logits
    stride: int  # px per element of paint
    kind_scale: float  # elements of paint per element of ``kinds``
    top: int  # the first image row
    line: int  # which class is lane lines
    is_symbol: BoolArray  # (K,) which classes are symbols

    @classmethod
    def of(cls, output: NetworkOutput, catalogue: Catalogue) -> _Claims:
        """The claims of an output."""
        return cls(
            paint=output.paint,
            kinds=output.kinds,
            stride=output.stride,
            kind_scale=output.kind_scale,
            top=output.top,
            line=output.classes.index(LANE_LINE),
            is_symbol=np.isin(output.classes, catalogue.of_any_shape),
        )


def _coarser(fine: np.ndarray) -> np.ndarray:
    """Radiance (M, 20, 20, 3) of the elements of pictures from that of ``_FINER`` times as many samples."""
    samples = fine.reshape(-1, SIZE, _FINER, SIZE, _FINER, 3)
    # Added slice by slice: a mean over two axes takes ten times as long.
    bgr = np.zeros_like(samples[:, :, 0, :, 0])
    for i, j in np.ndindex(_FINER, _FINER):
        bgr += samples[:, :, i, :, j]
    bgr /= np.float32(_FINER**2)
    return bgr


def _over_median(planes: np.ndarray) -> np.ndarray:
    """Planes (M, 20, 20) less their medians."""
    return np.asarray(planes - np.median(planes, axis=(1, 2), keepdims=True))


def _points(corners: FloatArray, is_diamond: np.ndarray, size: int) -> np.ndarray:
    """Where (M, size, size, 2) the elements of pictures lie, the first corner near the first of them."""
    first, second, third, fourth = corners.swapaxes(0, 1)
    # Heckbert, "Fundamentals of Texture Mapping and Image Warping" (1989), 2.2.3: from the unit square.
    surplus = first - second + third - fourth
    # Vectors from the third corner.
    to_second = second - third
    to_fourth = fourth - third
    determinant = cross(to_second, to_fourth)[:, None]
    determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
    g = cross(surplus, to_fourth)[:, None] / determinant
    h = cross(to_second, surplus)[:, None] / determinant
    to_px = np.empty((len(corners), 3, 3))
    to_px[:, :2] = np.stack([second - first + g * second, fourth - first + h * fourth, first], axis=-1)
    to_px[:, 2] = np.column_stack([g, h, np.ones(len(g))])
    placed = to_px.astype(np.float32) @ _grids(size)[is_diamond.astype(np.intp)]
    placed[:, :2] /= np.maximum(placed[:, 2:], np.float32(0.05))
    return np.moveaxis(placed[:, :2].reshape(-1, 2, size, size), 1, -1)


@cache
def _grids(size: int) -> np.ndarray:
    """Elements (2, 3, size * size) of pictures, (a, b, 1) in sides of a marking, for others and diamonds."""
    step = (np.arange(size) + 0.5) / size
    grids = np.ones((2, 3, size, size), dtype=np.float32)
    for grid, margins in zip(grids, ((_BEFORE, _BESIDE), (_AROUND, _AROUND)), strict=True):
        along, across = (step * (1 + 2 * margin) - margin for margin in margins)
        grid[:2] = np.meshgrid(along, across)
    return grids.reshape(2, 3, -1)
