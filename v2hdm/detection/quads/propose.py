"""Proposals: connected pieces of paint, the classes each may be of, and a quadrilateral around it.

The class of a proposal is a matter of odds, never of a rule: the network's share of each class times how well
the size on the ground suits it. All classes with four corners that are not negligible are handed to the
classifier.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.quads.blobs import Blob
from v2hdm.geometry.planar import Quad, following, is_convex_px, quads_from_hulls, rectangle_size
from v2hdm.records import BoolArray, FloatArray

_LEAST_CERTAINTY = 0.3  # least mean probability of paint of a piece; below it one in fifty is a marking
_LEAST_CLASS_SHARE = 0.02  # least share of a class, by network and size, with which it is proposed

_NAMED_SHARE = 0.05  # share of a class by the network alone below which only the size speaks for it

_LEAST_UNNAMED_SHARE = 0.15
"""Least share of such a class, by network and size, with which it is proposed. Of 4,424 readings in 60 images
each of ports 1 and 2 and KITTI 0011, 19 % have less; the likeliest of them scores .296, below any
``min_confidence`` in use."""

_CLASS_DOUBT = 0.05  # share of its certainty about classes that the network may give to wrong ones

_GROUP_DOUBT = 0.1
"""Share of a group's certainty that each of its classes may have: seen from near by a dash is like a line."""

_DOUBTED = 2
"""Where a class has more others in its group, they share the doubt of so many: that a network tells more
symbols apart makes an arrow no less likely."""

_VOTES = 3.0
"""Independent opinions that the network's classes over a piece are worth: 1.5 to 3 find the same arrows in
130 photographs for validation, 1 loses small ones."""

_SYMBOL_ODDS = float(np.log(859 / 5548))  # arrows among other labelled markings of the photographs
_NAMED_ODDS = float(np.log(0.79 / 0.01))
"""Log odds by a vote for a symbol: of arrows 0.79 of the paint is named so, of lines 0.01.

Shares of 39 arrows and 62 lines of 24 px and more, on photographs.
"""

_MISSED_ODDS = float(np.log(0.99 / 0.21))
"""Log odds by a vote against a symbol: of lines 0.99 of the paint is named otherwise, of arrows 0.21."""

_NAMED_OF_SYMBOL = {"diamond": 0.4, "lane": 0.1}
"""Shares of an arrow's paint that are named of these groups.

Of 160 views of arrows in rendered port 2, whose shafts are taken for dashes less often than in photographs.
"""

_SELDOM_NAMED = 0.02  # share of an arrow's paint that is named of any other group, in the same views
_NAMED_RIGHTLY = 0.8  # share of a marking's paint that is named of its own group
_TOUCHING = float(np.log(0.02))  # log odds of an arrow that touches other paint: a guess

_LEAST_FILL = 0.5  # least share of a quadrilateral that its piece of paint fills: a triangle fills half
BORDER_PX = 3.0  # a side this near to the image's border is cut by it: outlines are coarser than this


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

    @cached_property
    def certainty(self) -> float:
        """Mean probability of paint."""
        return sum(self.blob.class_score.values())

    def score_of(self, kinds: Iterable[str]) -> float:
        """Mean probability of some classes, by the network alone."""
        return sum(self.blob.class_score.get(kind, 0.0) for kind in kinds)

    def symbol_kind(self, names: Sequence[str]) -> str:
        """The likeliest of some classes of symbols."""
        return max(names, key=lambda name: self.share.get(name, 0.0))

    def symbol_score(self, kind: str) -> float:
        """Probability of a symbol of a class.

        The network names parts of an arrow a dash, but hardly ever a dash an arrow: a few independent votes
        are weighed by how often each is right and wrong. What is hardly paint, or of another size, votes
        against it.
        """
        share = min(self.score_of([kind]), self.certainty * self.share.get(kind, 0.0))
        odds = _SYMBOL_ODDS + _VOTES * (share * _NAMED_ODDS - (1 - share) * _MISSED_ODDS)
        return self.certainty / (1 + math.exp(-odds))

    def is_one_symbol(self, parts: Sequence[Proposal], catalogue: Catalogue) -> bool:
        """Whether it is likelier to be a symbol as a whole than with a part that is another marking.

        A shaft may be taken for a dash, and a head for a diamond, but hardly either for a stop line.
        """
        cells = np.count_nonzero(self.blob.level > 0)
        odds = -_TOUCHING
        alike = catalogue.of_any_shape
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
        cornered = [kind for kind in self.share if catalogue.classes[kind].cornered]
        likely = [kind for kind in cornered if self.share[kind] >= self._least_share(kind)]
        return sorted(likely, key=lambda kind: -self.share[kind])

    def _least_share(self, kind: str) -> float:
        """The least share of a class, by network and size, with which it is proposed."""
        is_named = self.blob.class_score[kind] >= _NAMED_SHARE * self.certainty
        return _LEAST_CLASS_SHARE if is_named else _LEAST_UNNAMED_SHARE


@dataclass(frozen=True)
class Proposals:
    """One image between network and fit."""

    camera: RoadCamera
    output: NetworkOutput
    pieces: Sequence[Proposal]
    owner: np.ndarray  # (h, w) 1 + the index of the piece of each element of the paint, 0 for none


def propose(
    blobs: Sequence[Blob], camera: RoadCamera, catalogue: Catalogue, max_range_m: float
) -> list[Proposal]:
    """The proposals of one image's pieces of paint."""
    if not blobs:
        return []
    points_px = np.concatenate([blob.outline_px for blob in blobs])
    points_pinhole_px = camera.undistort(points_px)
    points_vehicle = camera.ground(points_pinhole_px)
    count = np.array([len(blob.outline_px) for blob in blobs])
    begins = np.cumsum(count) - count
    range_m = camera.range_m(np.add.reduceat(points_vehicle, begins) / count[:, None])
    whole = np.logical_and.reduceat(camera.inside(points_px, BORDER_PX), begins)
    outlines_vehicle = np.split(points_vehicle, begins[1:])
    # OpenCV computes in float32: far from the origin that is too coarse.
    first_px = points_pinhole_px[begins]
    from_first_px = (points_pinhole_px - np.repeat(first_px, count, axis=0)).astype(np.float32)
    outlines = np.split(from_first_px, begins[1:])
    hulls = [cv2.convexHull(outline, returnPoints=False)[:, 0] for outline in outlines]
    on_ground = np.logical_and.reduceat(np.isfinite(points_vehicle[:, 0]), begins).tolist()
    size_m = np.array(
        [
            # Straight lines are straight on the ground, unless they cross the horizon.
            rectangle_size(outline[hull] if is_on_ground else outline)
            for outline, hull, is_on_ground in zip(outlines_vehicle, hulls, on_ground, strict=True)
        ]
    )
    certainty = [sum(blob.class_score.values()) for blob in blobs]
    shares = _shares(blobs, np.array(certainty), size_m, catalogue, whole, camera.log_size_sigma(range_m))
    hulls_px = [outline[hull][:, None] for outline, hull in zip(outlines, hulls, strict=True)]
    tightest = _tightest(hulls_px, first_px, camera, max_range_m)
    return [
        Proposal(
            blob=blob,
            index=index,
            share=shares[index],
            outline_vehicle=outlines_vehicle[index],
            corners_pinhole_px=tightest[index].corners_pinhole_px,
            fill=tightest[index].fill,
        )
        for index, blob in enumerate(blobs)
        if certainty[index] >= _LEAST_CERTAINTY
    ]


def open_sides(corners_px: FloatArray, camera: RoadCamera) -> BoolArray:
    """Which sides (M, 4) of quadrilaterals (M, 4, 2), recorded px, the image's border cuts."""
    return ~camera.inside((corners_px + following(corners_px)) / 2, BORDER_PX)


def _shares(
    blobs: Sequence[Blob],
    certainty: FloatArray,
    size_m: FloatArray,
    catalogue: Catalogue,
    whole: BoolArray,
    log_sigma: FloatArray,
) -> list[dict[str, float]]:
    """Share of each class of the catalogue in every blob, by network and size (B, 2), length and width."""
    names = [name for name in blobs[0].class_score if name in catalogue.classes]
    score = np.array([[blob.class_score[name] for name in names] for blob in blobs])
    certainty = np.maximum(certainty, 1e-9)[:, None]
    classes = [catalogue.classes[name] for name in names]
    same_group = np.array([[first.group == second.group for second in classes] for first in classes])
    others = np.maximum(same_group.sum(axis=0) - 1, 1)
    doubt = _GROUP_DOUBT * np.where(np.eye(len(names), dtype=np.bool_), 1, np.minimum(1, _DOUBTED / others))
    odds = score / certainty + _CLASS_DOUBT / len(names) + score @ (doubt * same_group) / certainty
    length_m, width_m = size_m.T
    size_fit = [
        kind.size_log_likelihood(length_m, width_m, whole=whole, log_sigma=log_sigma) for kind in classes
    ]
    share = odds * np.exp(np.stack(size_fit, axis=1))
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-12)
    return [dict(zip(names, row, strict=True)) for row in share.tolist()]


class _Tightest(NamedTuple):
    """The tightest quadrilateral around an outline."""

    corners_pinhole_px: FloatArray | None = None  # (4, 2), None for none
    fill: float = 0.0  # share of it that the outline's convex hull fills


def _tightest(
    hulls: Sequence[np.ndarray], first_px: FloatArray, camera: RoadCamera, max_range_m: float
) -> list[_Tightest]:
    """The tightest quadrilateral around each hull (N, 1, 2) float32, pinhole px from ``first_px`` (B, 2)."""
    quads = quads_from_hulls(hulls)
    of_outline = [k for k, quad in enumerate(quads) if quad is not None]
    tightest = [_Tightest()] * len(hulls)
    if not of_outline:
        return tightest
    corners_px = np.array([quads[k] for k in of_outline]) + first_px[of_outline][:, None]
    ground = camera.ground(corners_px.reshape(-1, 2)).reshape(corners_px.shape)
    within_range = camera.range_m(ground.mean(axis=1)) <= max_range_m  # nan is not
    area_px2 = np.maximum(Quad(corners_px).area, 1e-6)
    usable = np.flatnonzero(is_convex_px(corners_px) & within_range)
    for place in usable.tolist():
        k = of_outline[place]
        tightest[k] = _Tightest(corners_px[place], cv2.contourArea(hulls[k]) / float(area_px2[place]))
    return tightest
