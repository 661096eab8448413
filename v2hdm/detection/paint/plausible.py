"""What a blob can be, judged by its class scores and its size on the ground.

The initial IPM may be decimetres wrong, so sizes only rule out what is far off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.both_sides import LONGEST_DASH_M
from v2hdm.detection.paint.blobs import Blob
from v2hdm.records import (
    ARROW,
    CHEVRON,
    CORNERED_CLASSES,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_CLASSES,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    OUTLINED_CLASSES,
    STOP_LINE,
    FloatArray,
)

SYMBOLS = (*OUTLINED_CLASSES, OTHER_PAINT)
"""Paint without four corners that is no lane: arrows, chevrons, writing."""

_SIZE_LIMITS_M: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    DIAMOND: ((0.25, 5.0), (0.1, 3.0)),
    LANE_DASH: ((0.7, LONGEST_DASH_M), (0.03, 0.8)),
    LANE_LINE: ((0.3, np.inf), (0.03, np.inf)),
    STOP_LINE: ((0.8, 25.0), (0.12, 1.2)),
    CROSSWALK_BAR: ((0.8, 10.0), (0.15, 1.2)),
    ARROW: ((0.6, 9.0), (0.1, 4.0)),
    CHEVRON: ((0.5, 20.0), (0.1, 10.0)),
}
"""Least and largest length and width of each class: road codes have no dash below 1 m, and
letters have strokes of half a metre. A line's box is wide where the line bends. Other paint is
not reported at all."""

_DASH_LENGTH_M = 7.5
_DASH_SHARE = 0.25
"""A piece of lane paint that ends at both sides, no longer than that, is a dash even if the network
gives only this share of its lane score to dashes: seen locally, dash and line are the same paint."""

_SURE_DASH_SHARE = 0.5
"""With more than this share what is too long for one dash is tried as several."""

_LEAST_RIVAL_SHARE = 0.02
"""With this share another class is tried, too: all evidence decides between them."""

_DOUBT_ABOUT_CLASS = 0.05
"""So much of what the network gives all classes it may give the wrong ones."""

_LEAST_SHARE_OF_LINE = 0.02
"""What the network takes for a line is tried if it leaves any class with four corners this share: all that
had less came to nothing."""

_MOST_SHARE_OF_OTHERS = 0.5
_MOST_ELONGATED_DIAMOND = 5.0
"""Compact paint may be a diamond whatever the network takes it for, if lines and symbols have no more than
this share each and it is at most so many times as long as wide."""

_LEAST_SECOND_SHARE = 0.12
"""What the network takes for a symbol is tried as a quadrilateral if it leaves that class this share."""

_LEAST_ELONGATION = 3.0
"""Lane paint is at least this many times as long as wide; far diamonds look like dashes, but are not."""

_LEAST_SYMBOL_IN_HEAD = 0.12
"""What looks like a diamond may be the head of an arrow if the network sees this share of a symbol in it:
diamonds lie at the ends of dashes, too."""

_HEAD_REACH_M = 0.4
_HEAD_OVERLAP_M = 0.3
_HEAD_WIDENING = 1.7
"""The head of an arrow begins so far from the end of the shaft at most, and is so many times as wide."""

_BORDER_PX = 4.0
_TOUCHED_PX = 2.0
"""What comes this near to the image's border may go on beyond it, what comes so near does."""


@dataclass(frozen=True)
class Piece:
    """A blob of which is known how large it is on the ground, m, and whether it keeps off the image's border.

    Its length and width are those of the smallest rectangle around it; nan where it shows no ground. It is
    ``whole`` if the border can have no part in its shape, ``clear`` if it is not seen to touch it.
    """

    class_score: dict[str, float]
    touches_symbol: bool
    length_m: float
    width_m: float
    whole: bool
    clear: bool

    @classmethod
    def of(cls, blob: Blob, outline_vehicle: FloatArray, view: CameraView) -> Piece:
        """That of a blob with that outline on the ground (N, 2), m, as its camera sees it."""
        whole = bool(view.inside(blob.outline_px, _BORDER_PX).all())
        clear = whole or bool(view.inside(blob.outline_px, _TOUCHED_PX).all())
        return cls(blob.class_score, blob.touches_symbol, *_ground_size(outline_vehicle), whole, clear)

    @property
    def slim(self) -> bool:
        """Whether it is as long for its width as lane paint."""
        return self.length_m >= _LEAST_ELONGATION * self.width_m

    @property
    def lane_score(self) -> float:
        """The score of the classes of lanes together."""
        return sum(self.class_score.get(name, 0.0) for name in LANE_CLASSES)

    def fits(self, kind: str) -> bool:
        """Whether its size is that of a class."""
        if kind not in _SIZE_LIMITS_M:
            return False
        length, width = _SIZE_LIMITS_M[kind]
        return length[0] <= self.length_m <= length[1] and width[0] <= self.width_m <= width[1]

    def share_among_possible(self, kind: str) -> float:
        """The share that the network gives a class in those that its size and shape leave possible.

        Where it gives all of those next to nothing it knows nothing against any, and the share is nearly one.
        """
        possible = [name for name in self.class_score if name == kind or self._may_be(name)]
        doubt = _DOUBT_ABOUT_CLASS * sum(self.class_score.values())
        score = self.class_score.get(kind, 0.0) + doubt
        return score / max(sum(self.class_score[name] for name in possible) + doubt, 1e-9)

    def _may_be(self, kind: str) -> bool:
        """Whether its size and shape leave a class possible; symbols have no shape of their own."""
        if kind in LANE_CLASSES:
            return not self.whole or (self.slim and self.fits(kind))
        return kind not in CORNERED_CLASSES or self.fits(kind)

    def fitting(self, least_share: float = 0.0) -> list[str]:
        """Classes with four corners that are of its size and shape, of that share at least, by likelihood."""
        least = least_share * sum(self.class_score.values())
        fitting = [
            name
            for name in CORNERED_CLASSES
            if self.class_score.get(name, 0.0) >= least
            and self.fits(name)
            and (self.slim or name not in (LANE_DASH, STOP_LINE))
        ]
        return sorted(fitting, key=lambda name: -self.class_score.get(name, 0.0))


def plausible_kind(piece: Piece) -> tuple[str, float] | None:
    """The likeliest class that a blob's size on the ground allows, with its score; None for none.

    Where it does not allow the likeliest of all, that is the likeliest with four corners; but letters, whose
    strokes are like other markings, stay letters.
    """
    if piece.whole and piece.length_m < _LEAST_ELONGATION * piece.width_m:
        kind, score = _likeliest_compact(piece)
    else:
        kind, score = _likeliest(piece, piece.whole and piece.length_m <= _DASH_LENGTH_M)
    if kind == LANE_DASH and not piece.fits(LANE_DASH):
        kind = LANE_LINE
    if piece.fits(kind):
        return kind, score
    fitting = piece.fitting() if piece.whole and kind != OTHER_PAINT else []
    return (fitting[0], score) if fitting else None


def cornered_kind(piece: Piece, kind: str) -> str | None:
    """The class as which a blob, taken for ``kind``, is tried as a quadrilateral; None for none.

    Short lane paint that ends at both sides may be a dash although the network says line, or, if shorter than
    any dash, a slim diamond: seen locally they are alike. What the network takes for a dash but is too long
    is several, or one that runs on along something else, and what it takes for an arrow or a chevron may be
    what it thinks next likely: its shape and the image will tell.
    """
    if kind in CORNERED_CLASSES:
        return kind
    if kind in OUTLINED_CLASSES:
        return _second_choice(piece) if piece.whole else None
    dash_score = piece.class_score.get(LANE_DASH, 0.0)
    if piece.length_m > LONGEST_DASH_M and dash_score > _SURE_DASH_SHARE * piece.lane_score:
        return LANE_DASH
    if not piece.whole or not piece.length_m <= _DASH_LENGTH_M:
        return None
    if not piece.fitting(_LEAST_SHARE_OF_LINE):
        return None
    if piece.length_m < _SIZE_LIMITS_M[LANE_DASH][0][0]:
        return next(iter(piece.fitting()), None)
    return LANE_DASH if piece.fits(LANE_DASH) else None


def rival_kinds(piece: Piece, kind: str) -> list[str]:
    """The other classes with four corners that a quadrilateral, tried as ``kind``, may well be of."""
    if not piece.whole:
        return []
    return [name for name in piece.fitting(_LEAST_RIVAL_SHARE) if name != kind]


def unlikely_kinds(piece: Piece) -> list[str]:
    """The classes as which a blob that :func:`cornered_kind` rules out is tried if it fills a quadrilateral.

    Beside the classes that may well be, that is a diamond: the network takes many for short dashes.
    """
    if not piece.clear:
        return []
    found = piece.fitting(_LEAST_RIVAL_SHARE)
    whole_score = sum(piece.class_score.values())
    others = max(
        piece.class_score.get(LANE_LINE, 0.0),
        sum(piece.class_score.get(name, 0.0) for name in SYMBOLS),
    )
    compact = piece.fits(DIAMOND) and piece.length_m <= _MOST_ELONGATED_DIAMOND * piece.width_m
    if DIAMOND not in found and compact and others <= _MOST_SHARE_OF_OTHERS * whole_score:
        found.append(DIAMOND)
    return found


def _second_choice(piece: Piece) -> str | None:
    """The likeliest class with four corners, if a blob that is not taken for it may well be of it."""
    share = {
        name: score
        for name, score in piece.class_score.items()
        if name in CORNERED_CLASSES and (name == LANE_DASH) == piece.slim and piece.fits(name)
    }
    best = max(share, key=share.__getitem__, default=None)
    if best is None or piece.touches_symbol:
        return None
    return best if share[best] >= _LEAST_SECOND_SHARE * sum(piece.class_score.values()) else None


def may_be_head(blob: Blob) -> bool:
    """Whether a blob may be the head of an arrow that wear has parted from its shaft."""
    if blob.kind != DIAMOND:
        return blob.kind in SYMBOLS
    symbol = sum(blob.class_score.get(name, 0.0) for name in SYMBOLS)
    return symbol >= _LEAST_SYMBOL_IN_HEAD * sum(blob.class_score.values())


class Heads:
    """What may be the heads of arrows: numbers of blobs, with their outlines (N, 2) on the ground, m."""

    def __init__(self, outlines_vehicle: Mapping[int, FloatArray]):
        self._outlines = list(outlines_vehicle.items())
        count = [len(outline) for _, outline in self._outlines]
        points, first = np.concatenate([np.empty((0, 2)), *outlines_vehicle.values()]), np.cumsum([0, *count])
        # Of those without any ground the box is nan and near nothing.
        self._low, self._high = (
            extreme.reduceat(points, first[:-1]) if len(points) else points for extreme in (np.fmin, np.fmax)
        )

    def within(self, centre: FloatArray, reach_m: float) -> list[tuple[int, FloatArray]]:
        """Those whose bounding box comes within a square of half the side ``reach_m``."""
        near = ((self._low < centre + reach_m) & (self._high > centre - reach_m)).all(axis=1)
        found = [self._outlines[k] for k in np.flatnonzero(near)]
        known = [(blob, outline[np.isfinite(outline[:, 0])]) for blob, outline in found]
        return [(blob, outline) for blob, outline in known if len(outline) >= 3]


def head_of(outline_vehicle: FloatArray, heads_vehicle: Heads) -> int | None:
    """The blob that may be the head of an arrow of which a dash is the shaft; None for none.

    A head begins where the shaft ends, astride its axis, and is much wider.

    Args:
        outline_vehicle: outline (N, 2) of the dash on the ground, m.
        heads_vehicle: what may be heads.
    """
    points = outline_vehicle[np.isfinite(outline_vehicle).all(axis=1)]
    if len(points) < 3:
        return None
    centre, size, _ = box = cv2.minAreaRect(points.astype(np.float32))
    corners = cv2.boxPoints(box).astype(np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    axis = sides[int(np.argmax(np.linalg.norm(sides[:2], axis=1)))]
    axis = axis / np.linalg.norm(axis)
    half_m, width_m = max(size) / 2, min(size)
    across = np.array([-axis[1], axis[0]])
    for blob, head in heads_vehicle.within(np.array(centre), half_m + width_m + _HEAD_REACH_M):
        offset = head - np.array(centre)
        along, beside = np.abs(offset @ axis) - half_m, offset @ across
        begins = -_HEAD_OVERLAP_M < along.min() < _HEAD_REACH_M
        if begins and beside.min() < 0 < beside.max() and np.ptp(beside) > _HEAD_WIDENING * width_m:
            return blob
    return None


def _likeliest(piece: Piece, short: bool) -> tuple[str, float]:
    """The best class, lane classes taken together first; ``short`` paint is rather a dash than a line."""
    others = {name: score for name, score in piece.class_score.items() if name not in LANE_CLASSES}
    best_other = max(others, key=others.__getitem__, default="")
    lane_score = piece.lane_score
    if best_other and others[best_other] >= lane_score:
        return best_other, others[best_other]
    dash_share = piece.class_score.get(LANE_DASH, 0.0) / max(lane_score, 1e-9)
    return (LANE_DASH if dash_share > (_DASH_SHARE if short else _SURE_DASH_SHARE) else LANE_LINE), lane_score


def _likeliest_compact(piece: Piece) -> tuple[str, float]:
    """The best class but lanes, which its shape rules out; their score is paint, so the best takes it."""
    others = {name: score for name, score in piece.class_score.items() if name not in LANE_CLASSES}
    best = max(others, key=others.__getitem__, default=LANE_LINE)
    return best, others.get(best, 0.0) + piece.lane_score


def _ground_size(outline_vehicle: FloatArray) -> tuple[float, float]:
    """Length and width (m) of the smallest rectangle around the points on the ground (N, 2)."""
    seen = np.isfinite(outline_vehicle[:, 0])
    points = outline_vehicle if seen.all() else outline_vehicle[seen]
    if len(points) < 3:
        return np.nan, np.nan
    _, size, _ = cv2.minAreaRect(points.astype(np.float32))
    return float(max(size)), float(min(size))
