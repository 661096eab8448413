"""Whether markings of a drive's images stay where they are on the ground as the vehicle moves.

Paint is seen again at its place from the next poses. Upright things move otherwise in the image, as in plane
and parallax (Irani and Anandan, PAMI 20, 1998); wheels move with their vehicle, clouds mirrored in a bonnet
and reflections on a windscreen with the camera. Each other image that should show a marking is a vote, by how
often paint, and how often other things, are detected again where a marking should be.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.horizons import BODY_SIGMA_RAD
from v2hdm.geometry.rigid import inverse
from v2hdm.records import BoolArray, FloatArray, MarkingDetection

_PAINT_AGAIN = 0.75
"""Probability that paint is detected again as its class: .94 and .99 on two drives, unless things hide it."""

_OTHER_AGAIN = 0.15  # probability that something else is detected at that place: two of one sort in a row
_EASY = 0.8  # share of the range within which paint is detected so often
_SIGMAS = 3.0  # standard deviations within which a marking counts as the one at a place
_SIZE_SIGMA = 0.12  # standard deviation of a marking's centre in its size: a part of it may be hidden
STATED_SIGMA_RAD = float(np.deg2rad(1.0))  # standard deviation of the pitch that a drive states of a camera

_APART_M = 1.0  # way of the vehicle, m, from which another image votes
_VOTES = 6  # images that vote at most: more err together
_BEFORE = 40  # images before that are kept
_AFTER = 5  # images after that an image waits for
_BORDER_PX = 20.0  # a marking this near to the border of another image may be cut by it


@dataclass(frozen=True)
class View:
    """The markings of one image, with its camera and pose."""

    map_from_vehicle: FloatArray  # (4, 4)
    camera: RoadCamera
    markings: Sequence[MarkingDetection]
    mounting_sigma_rad: float = STATED_SIGMA_RAD
    reach_m: float = np.inf  # range within which markings are looked for

    def polygon_px(self, number: int) -> FloatArray:
        """The outline (N, 2) of one marking."""
        marking = self.markings[number]
        return marking.outline_px if len(marking.outline_px) else marking.corners_px

    def stay(self, others: Iterable[View]) -> BoolArray:
        """Which markings (M,) likelier lie on the ground than not, by ``others`` of the same camera."""
        voters = [view for view in others if self._distance_m(view) >= _APART_M]
        return np.array([self._stays(number, voters) for number in range(len(self.markings))], dtype=np.bool_)

    def _distance_m(self, other: View) -> float:
        return float(np.linalg.norm(self.map_from_vehicle[:3, 3] - other.map_from_vehicle[:3, 3]))

    def _stays(self, number: int, voters: Sequence[View]) -> bool:
        votes = [vote for view in voters if (vote := self._vote(number, view)) is not None]
        chosen = np.linspace(0, len(votes) - 1, min(_VOTES, len(votes))).round().astype(int)
        score = float(np.clip(self.markings[number].score, 0.01, 0.99))
        odds = np.log(score / (1 - score)) + sum(votes[k] for k in chosen.tolist())
        return bool(odds > 0)

    def _vote(self, number: int, view: View) -> float | None:
        """Log likelihood ratio of paint, by what another image shows at its place; None if it cannot tell."""
        polygon_px = self.polygon_px(number)
        ground = self.camera.unproject(polygon_px[np.isfinite(polygon_px).all(axis=1)])
        if not len(ground) or not np.isfinite(ground).all():
            return None
        other_from_vehicle = inverse(view.map_from_vehicle) @ self.map_from_vehicle
        moved = (ground @ other_from_vehicle[:2, :2].T) + other_from_vehicle[:2, 3]
        expected_px = view.camera.project(moved)
        # Behind the camera the projection comes back elsewhere, above the horizon as nan.
        returned = np.abs(view.camera.unproject(expected_px) - moved).max() < 0.1
        if not (returned and view.camera.inside(expected_px, _BORDER_PX).all()):
            return None
        mask = view.camera.camera.own_vehicle
        column, row = np.round(expected_px.mean(axis=0)).astype(int).tolist()
        if mask is not None and mask[row, column]:
            return None
        size_px = float(np.ptp(expected_px, axis=0).max())
        # Places are wrong by d^2 / h times the pitch's error; one pixel there is d^2 / (f h).
        range_m = [
            float(camera.range_m(at.mean(axis=0)))
            for camera, at in ((self.camera, ground), (view.camera, moved))
        ]
        if range_m[1] > _EASY * view.reach_m:
            return None
        by_mounting = self.mounting_sigma_rad * ((range_m[0] / range_m[1]) ** 2 - 1)
        focal_px = float(view.camera.info.intrinsic[1, 1])
        sigma_px = np.hypot(focal_px * np.hypot(BODY_SIGMA_RAD, by_mounting), _SIZE_SIGMA * size_px)
        kind = self.markings[number].kind
        centres = [view.polygon_px(k).mean(axis=0) for k, m in enumerate(view.markings) if m.kind == kind]
        off = np.array(centres).reshape(-1, 2) - expected_px.mean(axis=0)
        sigmas = float(np.linalg.norm(off, axis=1).min(initial=np.inf)) / sigma_px
        if sigmas > _SIGMAS:
            return float(np.log((1 - _PAINT_AGAIN) / (1 - _OTHER_AGAIN)))
        # A normal density over that of anywhere in reach.
        return float(np.log(_PAINT_AGAIN / _OTHER_AGAIN * _SIGMAS**2 / 2) - sigmas**2 / 2)


Image = TypeVar("Image")


def settled(
    images: Iterable[Image], view_of: Callable[[Image], tuple[str, View]]
) -> Iterator[tuple[Image, BoolArray]]:
    """The images of a drive in order, and of each which markings (M,) stay on the ground.

    ``view_of`` tells an image's camera and view. An image waits until a few of its camera have followed it.
    """
    waiting: deque[tuple[Image, str, View]] = deque()
    before: dict[str, deque[View]] = {}

    def release() -> tuple[Image, BoolArray]:
        image, name, view = waiting.popleft()
        earlier = before.setdefault(name, deque(maxlen=_BEFORE))
        stay = view.stay([*earlier, *(other for _, camera, other in waiting if camera == name)])
        earlier.append(view)
        return image, stay

    for image in images:
        name, view = view_of(image)
        waiting.append((image, name, view))
        while sum(camera == waiting[0][1] for _, camera, _ in waiting) > _AFTER:
            yield release()
    while waiting:
        yield release()
