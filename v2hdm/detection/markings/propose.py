"""Proposals: of every piece of paint, the classes whose size it may have, and a quadrilateral around it.

The class of a proposal is a matter of odds, never of a rule: the network's share of each class times how well
the size on the ground suits it. All classes with four corners that are not negligible are handed to the
judge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from v2hdm.catalogue import OTHER, SYMBOL, Catalogue
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.markings.blobs import Blob
from v2hdm.geometry.planar import rectangle_size
from v2hdm.geometry.quadrilateral import following, is_convex_px, quad_from_hull
from v2hdm.records import BoolArray, FloatArray

_LEAST_CERTAINTY = 0.3
"""Least mean probability of paint of a piece; below it the judge finds one marking among fifty."""

_LEAST_SHARE = 0.02
"""Least share of a class, by network and size, with which it is proposed."""

_CLASS_DOUBT = 0.05
"""Share of its certainty about classes that the network may give to wrong ones."""

_GROUP_DOUBT = 0.1
"""Share of a group's certainty that each of its classes may have: seen from near by a dash is like a line."""

_LEAST_FILL = 0.5
"""Least share of a quadrilateral that its piece of paint fills: a triangle fills half."""

_BORDER_PX = 3.0
"""A side this near to the image's border is cut by it: the network's outline is coarser than this."""


@dataclass(frozen=True)
class Proposal:
    """A piece of paint: ``blob`` and its ``index``, the ``share`` of each class by network and size.

    ``length_m`` and ``width_m`` are those of the smallest rectangle around it on the ground, nan where it
    shows none. ``outline_vehicle`` (N, 2), m. ``corners_pinhole_px`` (4, 2) is the tightest quadrilateral
    around it, of which it fills ``fill``; None where there is none.
    """

    blob: Blob
    index: int
    share: Mapping[str, float]
    length_m: float
    width_m: float
    outline_vehicle: FloatArray
    corners_pinhole_px: FloatArray | None
    fill: float

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return max(self.share, key=self.share.__getitem__)

    @property
    def certainty(self) -> float:
        """Mean probability of paint."""
        return sum(self.blob.class_score.values())

    def kinds(self, catalogue: Catalogue) -> list[str]:
        """The classes with four corners that it may be of, the likeliest first."""
        if self.corners_pinhole_px is None or self.fill < _LEAST_FILL:
            return []
        found = [
            n for n, share in self.share.items() if catalogue.classes[n].cornered and share >= _LEAST_SHARE
        ]
        return sorted(found, key=lambda name: -self.share[name])


def propose(
    blobs: Sequence[Blob], view: CameraView, catalogue: Catalogue, max_range_m: float
) -> list[Proposal]:
    """The proposals of one image's pieces of paint."""
    if not blobs:
        return []
    outlines = view.undistort(np.concatenate([blob.outline_px for blob in blobs]))
    on_ground = view.ground(outlines)
    ends = np.cumsum([0, *(len(blob.outline_px) for blob in blobs)]).tolist()
    found = []
    for index, (blob, (begin, end)) in enumerate(zip(blobs, pairwise(ends), strict=True)):
        if sum(blob.class_score.values()) < _LEAST_CERTAINTY:
            continue
        ground = on_ground[begin:end]
        length_m, width_m = rectangle_size(ground)
        whole = bool(view.inside(blob.outline_px, _BORDER_PX).all())
        share = _shares(blob, length_m, width_m, catalogue, whole=whole)
        start = _tightest(outlines[begin:end])
        if start is not None and not _within(start[0], view, max_range_m):
            start = None
        corners, fill = start or (None, 0.0)
        found.append(Proposal(blob, index, share, length_m, width_m, ground, corners, fill))
    return found


def open_sides(corners_px: FloatArray, view: CameraView) -> BoolArray:
    """Which sides (M, 4) of quadrilaterals (M, 4, 2), recorded px, the image's border cuts."""
    return ~view.inside((corners_px + following(corners_px)) / 2, _BORDER_PX)


def _shares(
    blob: Blob, length_m: float, width_m: float, catalogue: Catalogue, *, whole: bool
) -> dict[str, float]:
    """Share of each class that the catalogue maps or tells apart."""
    certainty = max(sum(blob.class_score.values()), 1e-9)
    known = {name: score for name, score in blob.class_score.items() if name in catalogue.classes}
    groups: dict[str, float] = {}
    for name, score in known.items():
        group = catalogue.classes[name].group
        groups[group] = groups.get(group, 0.0) + score
    likely = {
        name: (
            score / certainty
            + _CLASS_DOUBT / len(known)
            + _GROUP_DOUBT * groups[catalogue.classes[name].group] / certainty
        )
        * float(np.exp(catalogue.classes[name].size_log_likelihood(length_m, width_m, whole=whole)))
        for name, score in known.items()
    }
    total = max(sum(likely.values()), 1e-12)
    return {name: value / total for name, value in likely.items()}


def _within(corners: FloatArray, view: CameraView, max_range_m: float) -> bool:
    """Whether a quadrilateral (4, 2), pinhole px, is convex, on the ground and in range."""
    if not is_convex_px(corners):
        return False
    ground = view.ground(corners)
    return bool(np.isfinite(ground).all() and view.range_m(ground.mean(axis=0)) <= max_range_m)


def _tightest(outline_pinhole_px: FloatArray) -> tuple[FloatArray, float] | None:
    """The tightest quadrilateral around the hull of an outline (N, 2), and how much of it the hull fills."""
    first = outline_pinhole_px[0]
    hull = cv2.convexHull((outline_pinhole_px - first).astype(np.float32))
    quad = quad_from_hull(hull)
    if quad is None:
        return None
    area_px2 = float(cv2.contourArea(quad.astype(np.float32)))
    return quad + first, cv2.contourArea(hull) / max(area_px2, 1e-6)


def symbol_share(proposal: Proposal, catalogue: Catalogue) -> float:
    """Share of symbols and other paint, by the network alone: they have no size of their own."""
    known = catalogue.classes
    scores = ((name, score) for name, score in proposal.blob.class_score.items() if name in known)
    share = sum(score for name, score in scores if known[name].family in (SYMBOL, OTHER))
    return share / max(proposal.certainty, 1e-9)
