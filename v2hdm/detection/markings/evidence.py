"""Numbers that tell whether a quadrilateral is a whole marking: of the network, of the fit, of its shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.catalogue import LINE, Catalogue
from v2hdm.detection.markings.fit import STATISTICS
from v2hdm.detection.markings.fitted import Fit
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.markings.frames import Quads
from v2hdm.detection.markings.propose import Proposal, symbol_share
from v2hdm.geometry.quadrilateral import side_frames, width
from v2hdm.records import FloatArray

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
