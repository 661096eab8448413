"""How probable it is that a quadrilateral is a whole marking, and which of its sides to trust.

The network in ``judge.onnx`` takes each reading alone: numbers about a fitted quadrilateral, and a picture of
it in its own frame, where every marking of a class looks alike (as Faster R-CNN's region of interest, Ren et
al., NeurIPS 2015): what sets a worn marking off from a fleck of sun is left. It gives log odds, and how far
each side may be off for reasons that the fit's residuals do not show: worn ends, seams along a side, shadows,
something in front. Then a logistic function, whose weights are in ``confidence.json``, takes each among the
others of its image. Both files belong to the paint network.

A site's markings are painted from few stencils: the diamonds of a field are of one size and lie one way,
dashes are as long as each other and follow one another in a row, or an arc where the way bends.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from v2hdm.catalogue import LINE, OTHER, SYMBOL, Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import NetworkOutput, as_probability, open_session
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.fit import OPEN_SIGMA, STATISTICS, TYPICAL_BLUR_PX, Fit, fit_quadrilaterals
from v2hdm.detection.quads.patch import ImageQuads, Patches, grey_of, log_light
from v2hdm.detection.quads.propose import Proposal, Proposals, open_sides
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.planar import Quad, cross
from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE, BoolArray, FloatArray, MarkingDetection

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

_AROUND = 0.6
_BEFORE = 0.3
_BESIDE = 1.0
"""How far a picture reaches beyond the corners, in parts of the sides: of a diamond; of all else along its
longer sides and across them."""

_FINER = 2  # so many samples of the image per element, in each direction
_GREY_GAIN = 2.0
_COLOUR_GAIN = 2.0
_ODDS_GAIN = 1 / 3  # bring the channels to about one
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

    ``quads`` are in the image, ``ground`` on the ground, m, NaN above the horizon; ``proposals`` are their
    paint.
    """
    sides = np.sort(np.nan_to_num(ground.length, nan=1.0), axis=1)
    log_sides = np.log(np.clip(sides, *_SIZE_LIMITS_M))
    inside, beside = _paint_odds(output, quads)
    lines = catalogue.of_family(LINE)
    symbols = catalogue.of_family(SYMBOL, OTHER)
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
    marking = shown // 2
    diamond = shown % 2 == 1
    length = np.nan_to_num(ground.length, nan=1.0)
    lengthwise = length[:, 0] + length[:, 2] >= length[:, 1] + length[:, 3]
    ordered = quads.long_first(lengthwise).corners[marking]
    quads = quads.take(marking)
    output = patches.output
    points = quads.px(_points(ordered, diamond, SIZE))
    fine = patches.light_at(quads.px(_points(ordered, diamond, _FINER * SIZE)))
    fine = fine.reshape(-1, SIZE, _FINER, SIZE, _FINER, 3)
    # Added slice by slice: a mean over two axes takes ten times as long.
    bgr = np.zeros_like(fine[:, :, 0, :, 0])
    for i, j in np.ndindex(_FINER, _FINER):
        bgr += fine[:, :, i, :, j]
    bgr /= np.float32(_FINER**2)
    logs = log_light(bgr)
    grey, blueness = (
        plane - np.median(plane, axis=(1, 2), keepdims=True)
        for plane in (log_light(grey_of(bgr)), logs[..., 0] - logs[..., 2])
    )
    odds = output.odds_at(points)
    shares = output.shares_at(points)
    names = catalogue.of_family(SYMBOL, OTHER)
    symbols = [k for k, name in enumerate(output.classes) if name in names]
    shared = {
        "log_grey": np.float32(_GREY_GAIN) * grey,
        "blueness": np.float32(_COLOUR_GAIN) * blueness,
        "paint_odds": np.float32(_ODDS_GAIN) * odds,
        "line_share": shares[output.classes.index(LANE_LINE)],
        "symbol_share": shares[symbols].sum(axis=0),
        "outside": patches.outside(points),
    }
    views = np.empty((len(readings), len(CHANNELS), SIZE, SIZE), dtype=np.float32)
    for name, planes in shared.items():
        views[:, CHANNELS.index(name)] = planes[of_reading]
    own = [output.classes.index(kind) for _, kind in readings]
    views[:, CHANNELS.index("own_share")] = shares[own, of_reading]
    return views, np.where(lengthwise, 0, 1)[marking][of_reading]


def _points(corners: FloatArray, diamond: np.ndarray, size: int) -> np.ndarray:
    """Where (M, size, size, 2) the elements of pictures lie, the first corner near the first of them."""
    first, second, third, fourth = corners.swapaxes(0, 1)
    # Heckbert, "Fundamentals of Texture Mapping and Image Warping" (1989), 2.2.3: from the unit square.
    surplus = first - second + third - fourth
    one = second - third
    other = fourth - third
    cross = _cross(one, other)
    cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
    g = _cross(surplus, other) / cross
    h = _cross(one, surplus) / cross
    to_px = np.empty((len(corners), 3, 3))
    to_px[:, :2] = np.stack([second - first + g * second, fourth - first + h * fourth, first], axis=-1)
    to_px[:, 2] = np.column_stack([g, h, np.ones(len(g))])
    placed = to_px.astype(np.float32) @ _grids(size)[diamond.astype(np.intp)]
    placed[:, :2] /= np.maximum(placed[:, 2:], np.float32(0.05))
    return np.moveaxis(placed[:, :2].reshape(-1, 2, size, size), 1, -1)


@cache
def _grids(size: int) -> np.ndarray:
    """Elements (2, 3, size * size) of pictures, (a, b, 1) in sides of a marking, for others and diamonds."""
    step = (np.arange(size) + 0.5) / size
    grids = np.ones((2, 3, size, size), dtype=np.float32)
    for grid, beyond in zip(grids, ((_BEFORE, _BESIDE), (_AROUND, _AROUND)), strict=True):
        grid[:2] = np.meshgrid(*(step * (1 + 2 * margin) - margin for margin in beyond))
    return grids.reshape(2, 3, -1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., :1] * b[..., 1:] - a[..., 1:] * b[..., :1])


JUDGE_INPUTS = ("views", "evidence", "shape")
JUDGE_OUTPUTS = ("odds", "log_side_sigma")

COMPANY = ("alike", "most_alike", "unlike", "surest_other", "in_line")
"""Names of the columns of :func:`company`, in order.

Of the others of its class, weighed by their probability: how many are like it, how much so is the likest, how
many are not, and how probable is the surest. Of dashes also: how probable is the surest one that follows in
its line after a gap; 0 for other classes.
"""

AMONG = ("alone", *COMPANY)  # features of a reading among others: its own log odds, and their company

SHAPES = (DIAMOND, LANE_DASH, "bar")  # diamonds, lane dashes, and whatever else has four corners

COMPANIES = (STOP_LINE, *SHAPES)
"""Whose company is weighed apart: the bars of a crosswalk are many and alike, a stop line keeps none."""

_LOG_SIZE_SIGMA = 0.2
_DIRECTION_SIGMA = 0.15
"""Markings of one stencil, as a single image shows them, differ by so much in log size and by so many rad."""

_BEND_RADIUS_M = 20.0  # and by the angle that a bend of this radius turns by between them
_MOST = 3.0  # more company than this adds nothing
_APART_M = 0.3  # nearer quadrilaterals are readings of the same paint
_LEAST_GAP = 0.5
_LONGEST_GAP_M = 15.0  # dashes of a line are at least so many of their lengths apart, and at most so far

_BESIDE_M = 0.3
_BESIDE_SHARE = 0.02
"""A line's dashes are so far at most beside an arc between them, and so much of their distance."""

_POINT_SHARE = 0.125
"""Largest standard deviation of a point, in parts of its marking's longer diagonal: two of these are a
deviation at which sightings are no longer taken for one shape (`association.shape_tolerance`)."""

_STRIP_PX = np.array([2.5, 4.5, 6.5, 8.5])
"""So far from an end, and from the long sides, the ground about it is looked at; nearer the paint blurs."""

_ASPECT = 2.0  # longer than that a marking has ends, which things hide a part at a time
_HIDDEN = 0.05
_BORDER = 0.003
_STAIN = 0.02
"""Shares of ends behind a thing, at the border of a shadow or a patch all across, and of spots of the ground
that are unlike the next one."""

_UNLIKE = np.array([0.8, 0.3])
_ALIKE = np.array([0.3, 0.15])
"""Standard deviations of log grey and of log blue over red: a thing's from the ground, and its own parts'."""

_EVEN = np.array([0.08, 0.05])
_GRAIN = 0.25
"""Bare ground differs from the next by so much, and by this share of its own scatter.

With these, 89 of 100 ends of dashes that boxes hid by more than 25 cm are known, and 5 that none hid are held
to be, in renders in which boxes stand beside every second dash.
"""

_TURNED_RAD = 0.15
_SHARPEST_RADIUS_M = 12.0
_MOST_TURNED_RAD = 0.9
"""They differ by so much in direction at most, where the way is straight, where it bends, and altogether."""


@dataclass(frozen=True)
class Readings:
    """R readings of M fitted quadrilaterals, each of one as one class: the input of the classifier."""

    fit: Fit
    quadrilateral: np.ndarray  # (R,) index of each
    kinds: list[str]  # its class
    evidence: FloatArray  # (R, F) for the network
    views: np.ndarray  # (R, C, S, S) for the network
    ground: FloatArray  # (R, 4, 2) corners, m
    first_side: np.ndarray  # (R,) the quadrilateral's side that is the first in a view
    hidden_ends: BoolArray  # (M, 4) ends of what is seen of it rather than of its paint
    # by quadrilateral around a piece, those around its parts: one or the others are markings
    parts: Mapping[int, Sequence[int]]


def read_markings(
    image_bgr: np.ndarray, found: Proposals, catalogue: Catalogue, blur_px: float | None
) -> Readings | None:
    """Fit the proposals with four corners and gather the evidence for their classes; None for none."""
    camera = found.camera
    output = found.output
    tried = [(proposal, kinds) for proposal in found.pieces if (kinds := proposal.kinds(catalogue))]
    if not tried:
        return None
    chosen = [proposal for proposal, _ in tried]
    start = np.stack([p.corners_pinhole_px for p in chosen if p.corners_pinhole_px is not None])
    start_px = camera.distort(start.reshape(-1, 2)).reshape(start.shape)
    own = np.array([(p.index, p.index + p.blob.parts) for p in chosen])
    patches = Patches(image_bgr, camera, output, found.owner, own)
    cut = open_sides(start_px, camera)
    fit = fit_quadrilaterals(patches, camera, start_px, cut, blur_px or TYPICAL_BLUR_PX)
    quads = ImageQuads.of(camera, fit.corners_px)
    ground = Quad(camera.unproject(fit.corners_px))
    rows = [(m, kind) for m, (_, kinds) in enumerate(tried) for kind in kinds]
    evidence = gather(fit, output, quads, ground, chosen, rows, catalogue)
    views, first_side = rectified_views(patches, quads, ground, rows, catalogue)
    at = np.array([m for m, _ in rows], dtype=np.intp)
    kinds = [kind for _, kind in rows]
    place = {p.index: m for m, p in enumerate(chosen)}
    parts = {
        m: among
        for m, p in enumerate(chosen)
        if (among := [place[p.index + k] for k in range(1, 1 + p.blob.parts) if p.index + k in place])
    }
    hidden = hidden_ends(patches, quads, ground)
    return Readings(fit, at, kinds, evidence, views, ground.corners[at], first_side, hidden, parts)


def hidden_ends(patches: Patches, quads: ImageQuads, ground: Quad) -> BoolArray:
    """Which sides (M, 4) are ends of long markings at which something hides the rest of the paint.

    Where paint ends, the ground beside it goes on; where a thing stands before it, it ends with the paint. So
    the ground before the end, on both sides, is compared with what lies beyond: stained, shaded, or a thing
    of any tone.
    """
    longer = np.roll(ground.length, 1, axis=1) + np.roll(ground.length, -1, axis=1)
    hidden = longer > 2 * _ASPECT * ground.length
    marking, end = np.nonzero(hidden)
    if not len(marking):
        return np.asarray(hidden)
    own = quads.take(marking)
    first, last, after, before = own.corners[np.arange(len(end)), (end + np.arange(4)[:, None]) % 4]
    inward = before - first + after - last
    long_px = np.linalg.norm(inward, axis=-1)[:, None] / 2
    inward = inward[:, None] / np.maximum(2 * long_px, 1e-6)[..., None]
    # Along the end: to one side of it, its paint, to the other; across it: beyond and before.
    aside = own.tangent[np.arange(len(end)), end][:, None] * _STRIP_PX[:, None]
    on_it = first[:, None] + (last - first)[:, None] * _GRID[1:5, None]
    along = np.stack([first[:, None] - aside, on_it, last[:, None] + aside], axis=1)
    depth = np.minimum(_STRIP_PX, long_px / 2)[..., None] * inward
    across = np.stack([-_STRIP_PX[:, None] * inward, depth], axis=1)
    points = along[:, :, None, :, None] + across[:, None, :, None]
    points = own.px(points.reshape(len(end), -1, len(_STRIP_PX), 2))
    bgr = patches.light_at(points)
    logs = log_light(bgr)
    light = np.stack([log_light(grey_of(bgr)), logs[..., 0] - logs[..., 2]], axis=-1)
    light = light.reshape(len(end), 3, 2, -1, 2)
    bare_ground = light[:, ::2, 1].reshape(len(end), -1, 2)
    sigma = np.hypot(_EVEN, _GRAIN * bare_ground.std(axis=1))[:, None]
    off = np.median(light[:, :, 0], axis=2) - np.median(bare_ground, axis=1)[:, None]
    paint = off[:, 1]
    beside = off[:, ::2]
    spots = np.logaddexp(np.log(1 - _STAIN) + _normal(off, sigma), np.log(_STAIN) + _normal(off, _UNLIKE))
    wide = _normal(beside - paint[:, None], np.hypot(sigma, _ALIKE))
    other = _normal(paint, np.hypot(sigma[:, 0], _UNLIKE))
    thing = other + np.logaddexp(np.log(0.5) + wide, np.log(0.5) + spots[:, ::2]).sum(axis=1)
    bare = np.logaddexp(np.log(1 - _BORDER) + spots.sum(axis=1), np.log(_BORDER) + other + wide.sum(axis=1))
    seen = ~patches.outside(points).any(axis=(1, 2))
    hidden[marking, end] = seen & (thing - bare > np.log(1 / _HIDDEN - 1))
    return np.asarray(hidden)


def _normal(off: FloatArray, sigma: FloatArray) -> FloatArray:
    """Log density (...) of independent normal deviations (..., 2)."""
    return np.asarray((-0.5 * (off / sigma) ** 2 - np.log(sigma)).sum(axis=-1) - np.log(2 * np.pi))


def find_markings(
    readings: Readings | None, camera: RoadCamera, options: DetectorOptions
) -> list[MarkingDetection]:
    """The quadrilaterals that are likely enough to be whole markings, each as its likeliest class."""
    if readings is None:
        return []
    odds, side_sigma_px = classify_alone(readings.evidence, readings.views, readings.kinds)
    score = classify_among(odds, readings.ground, readings.kinds)
    # The reading of each quadrilateral with the highest score; of equals the likelier.
    order = np.lexsort((-np.arange(len(score)), score))
    best = np.zeros(int(readings.quadrilateral.max()) + 1, dtype=np.intp)
    best[readings.quadrilateral[order]] = order
    turned = (np.arange(4) - readings.first_side[best, None]) % 4
    corners_px = readings.fit.corners_px
    side_sigma_px = np.take_along_axis(side_sigma_px[best], turned, axis=1)
    # Its paint may go on behind the thing for any length.
    length_px = readings.fit.quad.length.max(axis=1)[:, None]
    side_sigma_px = np.where(readings.hidden_ends, OPEN_SIGMA * length_px, side_sigma_px)
    covariance = readings.fit.covariance_px(side_sigma_px)
    valid = _are_points(covariance, corners_px, camera) & camera.inside(corners_px, options.border_px)
    left_out: set[int] = set()
    for whole, parts in readings.parts.items():
        if whole in left_out:
            continue
        surest = max(score[best[m]] for m in parts)
        left_out.update(parts if score[best[whole]] >= surest else [whole])
    return [
        MarkingDetection(readings.kinds[row], float(score[row]), corners_px[m], covariance[m], valid[m])
        for m, row in enumerate(best.tolist())
        if score[row] >= options.min_confidence and m not in left_out
    ]


def _are_points(covariance_px: FloatArray, corners_px: FloatArray, camera: RoadCamera) -> BoolArray:
    """Which corners (M, 4, 2) lie at a place and not just on a line, for the marking's size on the ground."""
    pinhole_px = camera.undistort(corners_px.reshape(-1, 2))
    ground = camera.ground(pinhole_px).reshape(corners_px.shape)
    # What the lens does to a pixel's size is little beside the share.
    by_px = camera.ground_jacobian(pinhole_px).reshape(-1, 4, 2, 2)
    corner = np.arange(4)
    own = covariance_px.reshape(-1, 4, 2, 4, 2)[:, corner, :, corner].swapaxes(0, 1)
    variance_m2 = np.trace(by_px @ own @ by_px.swapaxes(2, 3), axis1=2, axis2=3)
    largest_m2 = ((ground[:, :2] - ground[:, 2:]) ** 2).sum(axis=2).max(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(variance_m2 <= _POINT_SHARE**2 * largest_m2[:, None])


def classify_alone(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Log odds (R,) of each reading alone, and how far each side in its view may be off, px, (R, 4)."""
    given = (views, evidence.astype(np.float32), one_hot(kinds))
    inputs = dict(zip(JUDGE_INPUTS, given, strict=True))
    odds, log_sigma = _session(JUDGE_FILE).run(list(JUDGE_OUTPUTS), inputs)
    return odds.astype(np.float64), np.exp(log_sigma.astype(np.float64))


def classify_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (R,) of all readings of an image, whose log odds alone are (R,), corners (R, 4, 2), m."""
    fitted = _confidence(CONFIDENCE_FILE)
    weights, bias = zip(*(fitted[shape_of(kind, COMPANIES)] for kind in kinds), strict=True)
    features = features_among(odds, ground, kinds)
    return as_probability((features * np.array(weights)).sum(axis=1) + np.array(bias))


def features_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (R, 6) :data:`AMONG` of readings, of the log odds (R,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


def shape_of(kind: str, shapes: Sequence[str] = SHAPES) -> str:
    """The one of ``shapes`` that a class with four corners has."""
    return kind if kind in shapes else shapes[-1]


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (R, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


_session = cache(partial(open_session, threads=1))


@cache
def _confidence(path: Path) -> dict[str, tuple[FloatArray, float]]:
    """Weights (F,) and bias of the logistic function of each of :data:`COMPANIES`."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([part["weights"][name] for name in AMONG]), float(part["bias"]))
        for shape, part in fitted.items()
    }


def company(ground: FloatArray, kinds: Sequence[str], probability: FloatArray) -> FloatArray:
    """The :data:`COMPANY` (M, 5) of quadrilaterals.

    ``ground`` (M, 4, 2) are corners, m, NaN above the horizon, ``probability`` (M,) is that of each one's
    being a marking, as far as it shows on its own.
    """
    kind = np.array(kinds)
    size, axis, centre = _shapes(ground, kind)
    apart = centre[None] - centre[:, None]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    weight = np.where((kind[:, None] == kind) & (distance > _APART_M), probability, 0.0)
    weight[kind == STOP_LINE] = 0.0
    log_size = np.log(size)
    misfit = ((log_size[:, None] - log_size) ** 2).sum(axis=2) / _LOG_SIZE_SIGMA**2
    # Of axes that have no sense of direction.
    turned = np.arccos(np.clip(np.abs(axis @ axis.T), 0.0, 1.0))
    may_turn = np.hypot(_DIRECTION_SIGMA, distance / _BEND_RADIUS_M)
    alike = weight * np.exp(-0.5 * (misfit + (turned / may_turn) ** 2))
    in_line = (kind == LANE_DASH)[:, None] & _follows(apart, axis, size[:, 1], turned)
    columns = (
        np.minimum(alike.sum(axis=1), _MOST),
        alike.max(axis=1, initial=0.0),
        np.minimum((weight - alike).sum(axis=1), _MOST),
        weight.max(axis=1, initial=0.0),
        np.where(in_line, weight, 0.0).max(axis=1, initial=0.0),
    )
    return np.column_stack(columns)


def _shapes(ground: FloatArray, kind: np.ndarray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Short and long extent (M, 2), m, direction (M, 2) of the longer, centre (M, 2); diamonds' diagonals."""
    ground = np.nan_to_num(ground)
    diagonals = ground[:, [2, 3]] - ground[:, [0, 1]]
    quad = Quad(ground)
    along = quad.tangent * quad.length[..., None]
    sides = along[:, :2] - along[:, 2:]
    extents = np.where((kind == DIAMOND)[:, None, None], diagonals, sides / 2)
    size = np.hypot(extents[..., 0], extents[..., 1])
    longer = extents[np.arange(len(extents)), size.argmax(axis=1)]
    axis = longer / np.maximum(size.max(axis=1), 1e-9)[:, None]
    return np.clip(np.sort(size, axis=1), 0.01, 100.0), axis, ground.mean(axis=1)


def _follows(apart: FloatArray, axis: FloatArray, length: FloatArray, turned: FloatArray) -> np.ndarray:
    """Which (M, M) follow each along an arc: its chord makes equal and opposite angles with both tangents."""
    distance = np.hypot(apart[..., 0], apart[..., 1])
    beside = 0.5 * distance * np.abs(_angle(axis[:, None], apart) + _angle(axis[None], apart))
    gap = distance - (length[:, None] + length) / 2
    sharpest = np.minimum(_TURNED_RAD + distance / _SHARPEST_RADIUS_M, _MOST_TURNED_RAD)
    on_arc = (beside < _BESIDE_M + _BESIDE_SHARE * distance) & (turned < sharpest)
    return np.asarray(on_arc & (gap >= _LEAST_GAP * length[:, None]) & (gap < _LONGEST_GAP_M))


def _angle(axis: FloatArray, chord: FloatArray) -> FloatArray:
    """From axes of no sense of direction to chords (..., 2), rad, at most a right angle either way."""
    along = (axis * chord).sum(axis=-1)
    return np.asarray(np.arctan2(cross(axis, chord) * np.where(along < 0, -1.0, 1.0), np.abs(along)))
