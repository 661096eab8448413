"""Proposals: connected pieces of paint, the classes each may be of, and a quadrilateral around it.

The class of a proposal is a matter of odds, never of a rule: the network's share of each class times how well
the size on the ground suits it. All classes with four corners that are not negligible are handed to the
classifier.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, pairwise

import cv2
import numpy as np

from v2hdm.catalogue import OTHER, SHIPPED, SYMBOL, Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import NetworkOutput, as_probability
from v2hdm.geometry.planar import following, is_convex_px, quad_from_hull, rectangle_size, signed_area
from v2hdm.records import BoolArray, FloatArray, IntArray

_MIN_CELLS = 5  # blobs of fewer cells are noise: their outline is not worth four corners
_LEAST_SHARE = 0.15
_LEAST_SYMBOL_SHARE = 0.25
"""Where two groups of classes hold this much of a blob, two markings touch. The head is more of an arrow."""

_SURE = 2.0
_DOUBTFUL = -2.0
"""Log odds at which paint is sure, and down to which it is in doubt.

Markings that nearly touch come apart in sure paint; doubtful paint joins parts of one that a shadow divides.
"""

_LEAST_SURE = 0.2
_MOST_SURE = 0.6
"""A piece of doubtful paint is of use if this much of it is likely, and news if no more than that."""

_MOST_PARTS = 12  # parts that are looked at of one piece: more are the grains of bad light
_OUTLINE_SCALE = 4
_EDGE_SIGMA_PX = 2.0
_REACH_PX = 6.0
_STEP_PX = 0.5
"""How far the network's outline is from an edge of paint; how far, and in what steps, that is looked for."""

_EDGE_PX = 2.0
_LEAST_CONTRAST = 0.25
"""Half the width of an edge in the image, px: its blur. And the share of an outline's median contrast that
there is at an edge: beside paint that is half worn there is half of it, where paint runs on there is none."""

_BESIDE = 4  # points of an outline, px apart, to each side that its direction and its light are taken from

_LEAST_CERTAINTY = 0.3  # least mean probability of paint of a piece; below it one in fifty is a marking
_LEAST_CLASS_SHARE = 0.02  # least share of a class, by network and size, with which it is proposed
_CLASS_DOUBT = 0.05  # share of its certainty about classes that the network may give to wrong ones
_GROUP_DOUBT = 0.1
"""Share of a group's certainty that each of its classes may have: seen from near by a dash is like a line."""

_VOTES = 3.0
"""Independent opinions that the network's classes over a piece are worth: 1.5 to 3 find the same arrows in
130 photographs for validation, 1 loses small ones."""

_SYMBOL_ODDS = float(np.log(859 / 5548))  # arrows among other labelled markings of the photographs
_NAMED_ODDS = float(np.log(0.79 / 0.01))
_MISSED_ODDS = float(np.log(0.99 / 0.21))
"""Log odds by a vote for and against a symbol: of arrows .79 of the paint is named so, of lines .01.

Shares of 39 arrows and 62 lines of 24 px and more, on photographs.
"""

_NAMED_OF_SYMBOL = {"diamond": 0.4, "lane": 0.1}
_SELDOM_NAMED = 0.02
_NAMED_RIGHTLY = 0.8
"""Shares of an arrow's paint that are named of these groups, and of any other; of a marking's, of its own.

Of 160 views of arrows in rendered port 2, whose shafts are taken for dashes less often than in photographs.
"""

_TOUCHING = float(np.log(0.02))  # log odds of an arrow that touches other paint: a guess

_LEAST_FILL = 0.5  # least share of a quadrilateral that its piece of paint fills: a triangle fills half
_BORDER_PX = 3.0  # a side this near to the image's border is cut by it: outlines are coarser than this


@dataclass(frozen=True)
class Blob:
    """One connected piece of paint; one that may be several markings comes whole, followed by its parts."""

    class_score: dict[str, float]  # mean probability of each class
    level: np.ndarray  # (h, w) float32, positive inside
    origin_px: FloatArray  # of element (0, 0), recorded px; others are ``stride`` apart
    stride: int
    outline_px: FloatArray  # (N, 2) zero crossings of ``level``, recorded px, in no order
    touches_symbol: bool = False  # split off a piece another part of which is a symbol or other paint
    parts: int = 0
    traced: bool = True  # lanes are, in pieces of likely paint or parts of one class

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.class_score, key=self.class_score.__getitem__)


@dataclass(frozen=True)
class Proposal:
    """A piece of paint as the classifier's candidate."""

    blob: Blob
    index: int
    share: Mapping[str, float]  # of each class, by network and size
    outline_vehicle: FloatArray  # (N, 2) m, on the ground
    corners_pinhole_px: FloatArray | None  # (4, 2) of the tightest quadrilateral, if any
    fill: float  # share of that

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.share, key=self.share.__getitem__)

    @property
    def certainty(self) -> float:
        """Mean probability of paint."""
        return sum(self.blob.class_score.values())

    def score_of(self, kinds: Iterable[str]) -> float:
        """Mean probability of some classes, by the network alone."""
        return sum(self.blob.class_score.get(kind, 0.0) for kind in kinds)

    def symbol_score(self, kind: str) -> float:
        """Probability of a symbol of a class.

        The network names parts of an arrow a dash, but hardly ever a dash an arrow: a few independent votes
        are weighed by how often each is right and wrong. What is hardly paint, or of another size, votes
        against it.
        """
        share = min(self.score_of([kind]), self.certainty * self.share.get(kind, 0.0))
        odds = _SYMBOL_ODDS + _VOTES * (share * _NAMED_ODDS - (1 - share) * _MISSED_ODDS)
        return float(self.certainty * as_probability(np.array(odds)))

    def is_one_symbol(self, parts: Sequence[Proposal], catalogue: Catalogue) -> bool:
        """Whether it is likelier to be a symbol as a whole than with a part that is another marking.

        A shaft may be taken for a dash, and a head for a diamond, but hardly either for a stop line.
        """
        cells = np.count_nonzero(self.blob.level > 0)
        odds = -_TOUCHING
        alike = catalogue.of_family(SYMBOL, OTHER)
        for part in parts:
            if not part.blob.parts and part.blob.kind not in alike:
                named = _NAMED_OF_SYMBOL.get(catalogue.classes[part.blob.kind].group, _SELDOM_NAMED)
                share = np.count_nonzero(part.blob.level > 0) / cells
                odds += _VOTES * share * float(np.log(named / _NAMED_RIGHTLY))
        return odds > 0

    def kinds(self, catalogue: Catalogue) -> list[str]:
        """The classes with four corners that it may be of, the likeliest first."""
        if self.corners_pinhole_px is None or self.fill < _LEAST_FILL:
            return []
        found = {k: share for k, share in self.share.items() if catalogue.classes[k].cornered}
        return sorted((k for k in found if found[k] >= _LEAST_CLASS_SHARE), key=lambda k: -found[k])


@dataclass(frozen=True)
class Proposals:
    """One image between network and fit: its ``pieces``, and ``owner`` (h, w), 1 + the index of each's."""

    camera: RoadCamera
    output: NetworkOutput
    pieces: Sequence[Proposal]
    owner: np.ndarray


def propose(
    blobs: Sequence[Blob], camera: RoadCamera, catalogue: Catalogue, max_range_m: float
) -> list[Proposal]:
    """The proposals of one image's pieces of paint."""
    if not blobs:
        return []
    points_px = np.concatenate([blob.outline_px for blob in blobs])
    outlines = camera.undistort(points_px)
    on_ground = camera.ground(outlines)
    count = np.array([len(blob.outline_px) for blob in blobs])
    begins = np.cumsum(count) - count
    range_m = camera.range_m(np.add.reduceat(on_ground, begins) / count[:, None])
    whole = np.logical_and.reduceat(camera.inside(points_px, _BORDER_PX), begins)
    grounds, pinhole = (np.split(points, begins[1:]) for points in (on_ground, outlines))
    size_m = np.array([rectangle_size(ground) for ground in grounds])
    shares = _shares(blobs, size_m, catalogue, whole, camera.log_size_sigma(range_m))
    each = enumerate(zip(blobs, shares, grounds, _tightest(pinhole, camera, max_range_m), strict=True))
    return [
        Proposal(blob, index, share, ground, *start)
        for index, (blob, share, ground, start) in each
        if sum(blob.class_score.values()) >= _LEAST_CERTAINTY
    ]


def open_sides(corners_px: FloatArray, camera: RoadCamera) -> BoolArray:
    """Which sides (M, 4) of quadrilaterals (M, 4, 2), recorded px, the image's border cuts."""
    return ~camera.inside((corners_px + following(corners_px)) / 2, _BORDER_PX)


def _shares(
    blobs: Sequence[Blob], size_m: FloatArray, catalogue: Catalogue, whole: BoolArray, log_sigma: FloatArray
) -> list[dict[str, float]]:
    """Share of each class of the catalogue in every blob, by network and size (B, 2), length and width."""
    names = [name for name in blobs[0].class_score if name in catalogue.classes]
    score = np.array([[blob.class_score[name] for name in names] for blob in blobs])
    certainty = np.array([max(sum(blob.class_score.values()), 1e-9) for blob in blobs])[:, None]
    described = [catalogue.classes[name] for name in names]
    alike = np.array([[one.group == other.group for other in described] for one in described])
    odds = score / certainty + _CLASS_DOUBT / len(names) + _GROUP_DOUBT * (score @ alike) / certainty
    size = [one.size_log_likelihood(*size_m.T, whole=whole, log_sigma=log_sigma) for one in described]
    likely = odds * np.exp(np.stack(size, axis=1))
    likely /= np.maximum(likely.sum(axis=1, keepdims=True), 1e-12)
    return [dict(zip(names, row, strict=True)) for row in likely.tolist()]


def _tightest(
    outlines: Sequence[FloatArray], camera: RoadCamera, max_range_m: float
) -> list[tuple[FloatArray | None, float]]:
    """The tightest quadrilateral around each outline (N, 2), pinhole px, None for none, and its share."""
    hulls = [cv2.convexHull((outline - outline[0]).astype(np.float32)) for outline in outlines]
    quads = [quad_from_hull(hull) for hull in hulls]
    there = [k for k, quad in enumerate(quads) if quad is not None]
    found: list[tuple[FloatArray | None, float]] = [(None, 0.0)] * len(outlines)
    if not there:
        return found
    corners = np.array([quads[k] for k in there]) + np.array([outlines[k][0] for k in there])[:, None]
    ground = camera.ground(corners.reshape(-1, 2)).reshape(corners.shape)
    usable = is_convex_px(corners) & (camera.range_m(ground.mean(axis=1)) <= max_range_m)  # nan is not
    for k, quad in zip(compress(there, usable), corners[usable], strict=True):
        area_px2 = float(cv2.contourArea(np.asarray(quads[k], dtype=np.float32)))
        found[k] = quad, cv2.contourArea(hulls[k]) / max(area_px2, 1e-6)
    return found


class _Groups:
    """Groups of classes, the ``least_share`` (G,) of a blob for each to be present, and the ``symbols``."""

    def __init__(self, classes: Sequence[str], catalogue: Catalogue) -> None:
        names = [catalogue.classes[name].group for name in classes]
        self.of_class = np.array([names.index(name) for name in names], dtype=np.int64)
        self.symbols = catalogue.of_family(SYMBOL, OTHER)
        self.least_share = np.full(len(names), _LEAST_SHARE)
        self.least_share[self.of_class[np.isin(classes, self.symbols)]] = _LEAST_SYMBOL_SHARE


def find_blobs(
    output: NetworkOutput, reach_px: int = 0, catalogue: Catalogue = SHIPPED
) -> tuple[list[Blob], np.ndarray]:
    """Blobs of paint below image row ``reach_px``, and 1 + the index of each element's (h, w) int16."""
    # A frame of no paint around it lets every outline close.
    level = cv2.copyMakeBorder(output.paint, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1.0)
    contours, piece = _connected(level, (reach_px - output.top) / output.stride + 1)
    groups = _Groups(output.classes, catalogue)
    cells, score, votes = _class_scores(output, piece, level, len(contours), groups)
    outlines = _outlines(level, piece, len(contours))
    owner = np.zeros_like(piece)
    blobs: list[Blob] = []
    wholes, stats, whole_of = _doubtful(level, contours, cells)
    first_of_whole: dict[int, int] = {}
    for index in np.argsort(whole_of, kind="stable").tolist():
        if cells[index] < _MIN_CELLS:
            continue
        label = int(whole_of[index])
        if label and label not in first_of_whole:
            first_of_whole[label] = len(blobs)
            box = _framed(*stats[label, : cv2.CC_STAT_AREA].tolist())
            raised = level[box] - np.float32(_DOUBTFUL)
            blobs.append(replace(_blob(wholes[box] == label, raised, output, box), traced=False))
        box = _framed(*cv2.boundingRect(contours[index]))
        inside = piece[box] == index + 1
        parts = _split(inside, level[box], output, box, groups, votes[index])
        scores = dict(zip(output.classes, score[:, index].tolist(), strict=True))
        outline_px = _origin_px(output, 0, 0) + output.stride * outlines[index]
        signed = _signed(inside, level[box])
        origin_px = _origin_px(output, box[0].start, box[1].start)
        whole = Blob(scores, signed, origin_px, output.stride, outline_px, parts=len(parts))
        blobs.append(replace(whole, traced=not any(part.traced for part in parts)))
        owner[box][inside] = len(blobs)
        for part in parts:
            blobs.append(part)
            owner[box][part.level > 0] = len(blobs)
        if label:
            first = first_of_whole[label]
            blobs[first] = replace(blobs[first], parts=len(blobs) - 1 - first)
    return blobs, owner[1:-1, 1:-1]


def _framed(x: int, y: int, width: int, height: int) -> tuple[slice, slice]:
    """Rows and columns of a box with one element around it."""
    return slice(y - 1, y + height + 1), slice(x - 1, x + width + 1)


def _origin_px(output: NetworkOutput, row: int, column: int) -> FloatArray:
    """Recorded px (2,) of an element of the framed ``paint``."""
    first = (output.stride - 1) / 2 - output.stride
    return np.array([first + output.stride * column, first + output.top + output.stride * row])


def _doubtful(
    level: np.ndarray, contours: Sequence[np.ndarray], cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, IntArray]:
    """Labels (h, w) of doubtful paint, their statistics, the label of each piece (B,), 0 if the same area."""
    doubtful = (level > _DOUBTFUL).view(np.uint8)
    doubtful[[0, -1]] = 0
    doubtful[:, [0, -1]] = 0
    # Labels of 16 bits take a third of the time.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(doubtful, ltype=cv2.CV_16U)
    if not contours:
        return labels, stats, np.zeros(0, dtype=np.int64)
    at = np.array([contour[0, 0] for contour in contours])
    own = labels[at[:, 1], at[:, 0]].astype(np.int64)
    sure = np.bincount(own, cells, len(stats)) / np.maximum(stats[:, cv2.CC_STAT_AREA], 1)
    several = np.bincount(own, minlength=len(stats)) > 1
    unclear = (several | (sure < _MOST_SURE)) & (sure > _LEAST_SURE)
    return labels, stats, np.where(unclear[own], own, 0)


def _connected(level: np.ndarray, least_row: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Contours of paint that reaches ``least_row``, and a map of 1 + the number of each, holes filled."""
    contours, _ = cv2.findContours((level > 0).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    kept = [c for c in contours if len(c) >= 4 and c[:, 0, 1].max() + 1 >= least_row]
    piece = np.zeros(level.shape, dtype=np.int16)
    for index, contour in enumerate(kept):
        cv2.drawContours(piece, [contour], -1, index + 1, cv2.FILLED)
    return kept, piece


def _class_scores(
    output: NetworkOutput, piece: np.ndarray, level: np.ndarray, count: int, groups: _Groups
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Sizes (B,) of pieces in cells, mean probability (K, B) of each class, votes (B, G) of groups."""
    at = np.flatnonzero(piece > 0)
    own = piece.ravel()[at] - 1
    cells = np.bincount(own, minlength=count)
    share = 1 / np.maximum(cells, 1)
    certainty = np.bincount(own, as_probability(level.ravel()[at]), count) * share
    i, j = np.divmod(at, piece.shape[1])
    probability = output.class_probability(i - 1, j - 1)
    score = np.stack([np.bincount(own, plane, count) for plane in probability]) * share
    several = len(groups.least_share)
    best = own * several + groups.of_class[probability.argmax(axis=0)]
    votes = np.bincount(best, minlength=count * several).reshape(count, several)
    return cells, certainty * score, votes / np.maximum(cells, 1)[:, None]


def _outlines(level: np.ndarray, piece: np.ndarray, count: int) -> list[FloatArray]:
    """Points (N, 2), (column, row), of each piece's outline: where the level falls to zero beside it."""
    pieces = piece.ravel()
    levels = level.ravel()
    columns = piece.shape[1]
    points = []
    owners = []
    # The frame is empty, so that the step from the end of one row to the start of the next crosses nothing.
    for step in (columns, 1):
        here = np.flatnonzero(pieces[:-step] != pieces[step:])
        fraction = levels[here] / (levels[here] - levels[here + step])
        i, j = np.divmod(here, columns)
        points.append(np.column_stack([j, i + fraction] if step == columns else [j + fraction, i]))
        owners.append(np.maximum(pieces[here], pieces[here + step]))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(1, count + 2)).tolist()
    ordered = np.concatenate(points).astype(np.float64)[order]
    return [ordered[begin:end] for begin, end in pairwise(ends)]


def _split(
    inside: BoolArray,
    level: np.ndarray,
    output: NetworkOutput,
    box: tuple[slice, slice],
    groups: _Groups,
    votes: FloatArray,
) -> list[Blob]:
    """The parts of a piece (h, w) of different groups, by their ``votes`` (G,), or else of sure paint."""
    present = np.flatnonzero(votes >= groups.least_share)
    levels = [level - _SURE]
    if len(present) > 1:
        levels = [np.minimum(level, _lead(output, groups.of_class == group, box)) for group in present]
    masks = []
    for own_level in levels:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(((own_level > 0) & inside).view(np.uint8))
        large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= _MIN_CELLS)[:_MOST_PARTS].tolist()
        masks += [(labels == label, own_level) for label in large if label]
    if len(masks) < 2:
        return []
    parts = [_blob(mask, own_level, output, box) for mask, own_level in masks]
    touches = any(part.kind in groups.symbols for part in parts)
    return [replace(part, touches_symbol=touches, traced=len(present) > 1) for part in parts]


def _blob(mask: BoolArray, level: np.ndarray, output: NetworkOutput, box: tuple[slice, slice]) -> Blob:
    """The blob of a mask (h, w), a box of the framed ``paint``."""
    rows, columns = np.nonzero(mask)
    probability = output.class_probability(rows + box[0].start - 1, columns + box[1].start - 1)
    scores = probability.mean(axis=1) * as_probability(level[mask]).mean()
    signed = _signed(mask, level)
    origin_px = _origin_px(output, box[0].start, box[1].start)
    outline_px = origin_px + output.stride * _outlines(signed, mask.astype(np.int16), 1)[0]
    named = dict(zip(output.classes, scores.tolist(), strict=True))
    return Blob(named, signed, origin_px, output.stride, outline_px)


def _lead(output: NetworkOutput, mine: BoolArray, box: tuple[slice, slice]) -> np.ndarray:
    """By how many logits the best class of ``mine`` (K,) leads the rest, on the paint's elements in a box."""
    scale = output.kind_scale
    near = tuple(slice(max(int((p.start - 2) / scale) - 1, 0), int(p.stop / scale) + 2) for p in box)
    kinds = output.kinds[:, *near]
    lead = kinds[mine].max(axis=0) - kinds[~mine].max(axis=0)
    v, u = (
        (np.arange(part.start, part.stop, dtype=np.float32) - 0.5) / np.float32(scale) - (0.5 + first.start)
        for part, first in zip(box, near, strict=True)
    )
    return cv2.remap(lead, *np.meshgrid(u, v), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _signed(mask: BoolArray, level: np.ndarray) -> np.ndarray:
    """A level (h, w) that is positive in the mask only: holes filled, other blobs in the same box emptied."""
    return np.asarray(np.where(mask, np.maximum(level, 1e-3), np.minimum(level, -1e-3)))


def outline_polygon(blob: Blob) -> FloatArray:
    """The soft outline as a closed polygon (N, 2) in recorded px, to a fifth of an element."""
    size = blob.level.shape[1] * _OUTLINE_SCALE, blob.level.shape[0] * _OUTLINE_SCALE
    fine = cv2.resize(blob.level, size, interpolation=cv2.INTER_LINEAR)
    if np.count_nonzero(fine > 0) < _OUTLINE_SCALE**2:  # hardly paint, and none between the cells' centres
        fine = cv2.resize(blob.level, size, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours((fine > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len)
    polygon = cv2.approxPolyDP(longest, 0.2 * _OUTLINE_SCALE, closed=True).reshape(-1, 2)
    cells = (polygon + 0.5) / _OUTLINE_SCALE - 0.5
    return np.asarray(blob.origin_px + blob.stride * cells)


def on_edges(outline_px: FloatArray, bgr: np.ndarray) -> tuple[FloatArray, BoolArray]:
    """An outline (N, 2), recorded px, of bright paint, moved to where the light falls fastest nearby.

    Returns:
        The outline (M, 2), and which of its sides (M,), each from its point to the next, lie along an edge:
        none does where other paint or the image's border cuts the paint.
    """
    ring = np.vstack([outline_px, outline_px[:1]])
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    wanted = np.linspace(0.0, at[-1], max(round(float(at[-1])), 3), endpoint=False)
    points = np.column_stack([np.interp(wanted, at, axis) for axis in ring.T])
    ahead = np.roll(points, -_BESIDE, axis=0) - np.roll(points, _BESIDE, axis=0)
    outward = ahead @ [[0.0, -1.0], [1.0, 0.0]] * np.sign(signed_area(points))
    outward /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    off_px = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    x, y = np.moveaxis((points[:, None] + off_px[:, None] * outward[:, None]).astype(np.float32), 2, 0)
    light = cv2.remap(bgr, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).mean(axis=2)
    light = _with_neighbours(light).mean(axis=0)
    fall = np.maximum(-np.gradient(light, axis=1), 0.0)
    best = (fall**2 * np.exp(-0.5 * (off_px / _EDGE_SIGMA_PX) ** 2)).argmax(axis=1)
    from_edge_px = np.abs(off_px - off_px[best][:, None])
    fall = np.where(from_edge_px <= 2 * _STEP_PX, fall, 0.0)
    moved_px = fall @ off_px / np.maximum(fall.sum(axis=1), 1e-6)
    moved = points + np.median(_with_neighbours(moved_px), axis=0)[:, None] * outward
    # The ratio of the paint's light to the ground's is that of both materials, in the sun and in shadows.
    ratio = (-np.gradient(np.log(light + 1.0), axis=1) * (from_edge_px <= _EDGE_PX)).sum(axis=1)
    lit = np.median(_with_neighbours(ratio, round(_REACH_PX)), axis=0) > _LEAST_CONTRAST * np.median(ratio)
    moved = moved.astype(np.float32)
    fewer = cv2.approxPolyDP(moved, _STEP_PX / 2, closed=True)[:, 0]
    kept = np.flatnonzero((moved[:, None] == fewer).all(axis=2).any(axis=1))
    first = int(kept[0])
    share = np.add.reduceat(np.roll(lit, -first), kept - first) / np.diff(kept, append=first + len(lit))
    return moved[kept].astype(np.float64), share > 0.5


def _with_neighbours(values: np.ndarray, reach: int = _BESIDE - 1) -> np.ndarray:
    """Values (N, ...) along a closed outline, and those beside them, (K, N, ...)."""
    return np.stack([np.roll(values, k, axis=0) for k in range(-reach, reach + 1)])
