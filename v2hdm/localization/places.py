"""Where in a map a patch of seen markings may lie: the start from a rough position, or from none.

A patch is what the cameras saw within the last metres, laid out by the odometry. Each of its quadrilaterals,
put on each of the map's, is a place for all of them; the places are scored by how many others then lie on
markings of their class. What is only as likely as chance, or likely at two places, decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import SHIFTS
from v2hdm.geometry.rigid import inverse
from v2hdm.localization.belief import Plane
from v2hdm.localization.paint import Paint
from v2hdm.localization.seeing import Sighted, ground_points
from v2hdm.records import Calibration, FloatArray, IntArray

_RANGE_M = 14.0  # range, m, of detections in the patch: a pitching vehicle misplaces farther ones
_SAME_M = 0.5  # distance, m, of detections that are one marking
_PATCH_M = 25.0  # way, m, over which the odometry lays out a patch
_MOST = 40  # detections of a patch, the latest
_ANCHORS = 8  # of these that are put on the map's markings
_SHAPE_M = 0.25  # deviation of corners, m, of what may be one marking
_SLACK_M = 0.7  # distance, m, of a detection from its marking at a place of one pair
_SIGMA_M = 0.12  # standard deviation, m, of a detection's place in a patch that is in place
_SLACK_SIGMAS = 3.0  # of these, within which it lies on its marking
_REFINED = 60  # places that are refined
_APART_M, _APART_RAD = 0.5, 0.05  # between two places
_PARTS = 4_000_000  # distances that are computed at once
# Log likelihood of a detection that lies on a marking over that of one that lies anywhere: 0.85 of a
# bivariate normal of 12 cm, against one piece of unmapped paint in 50 m2.
_MATCHED = 5.5
_MISSED = 1.2  # minus the log of the share of markings in clear view that are hidden or not found: 0.3
_VIEW_M = 11.0  # distance, m, within which a marking in view is expected to be found
_VIEWS = 12  # looks of a patch that say what was in view


_ROUGH_M, _ROUGH_RAD = 5.0, np.deg2rad(20.0)  # one sigma of a rough position


class Prior(NamedTuple):
    """A rough position: x and y, m, and heading, rad, with standard deviations of both."""

    pose: FloatArray  # (3,)
    sigma_m: float
    sigma_rad: float


def rough_position(east_m: float, north_m: float, heading_deg: float) -> Prior:
    """A position of the map that is known to 5 m and 20 deg; headings count from east to north."""
    return Prior(np.array([east_m, north_m, np.deg2rad(heading_deg)]), _ROUGH_M, _ROUGH_RAD)


class Place(NamedTuple):
    """A place of a patch in the map."""

    map_from_local: FloatArray  # (3,) x, y, m, and turn, rad
    score: float  # log likelihood over that of chance
    matched: int
    quads: int
    word_score: float = 0.0  # the part of ``score`` that words give


@dataclass
class _Object:
    kind: str
    corners: FloatArray  # (4,) complex, in the local frame
    range_m: float
    way_m: float
    views: int = 1


class _View(NamedTuple):
    camera: str
    local_from_vehicle: FloatArray  # (3,)
    way_m: float


@dataclass
class Patch:
    """Markings seen lately, in the frame in which the odometry counts."""

    objects: list[_Object] = field(default_factory=list)
    views: list[_View] = field(default_factory=list)

    def add(
        self,
        quads: Sighted,
        camera: str,
        calibration: Calibration,
        local_from_vehicle: FloatArray,
        way_m: float,
    ) -> None:
        """Take the whole detections near the camera in an image taken at a pose (3,) of the odometry."""
        self.objects = [piece for piece in self.objects if way_m - piece.way_m < _PATCH_M]
        self.views = [view for view in self.views if way_m - view.way_m < _PATCH_M]
        if not self.views or way_m - self.views[-1].way_m > 1.0 or self.views[-1].camera != camera:
            self.views.append(_View(camera, local_from_vehicle, way_m))
        ground = ground_points(quads.corners_px, np.eye(4), Plane(), calibration)
        is_whole = quads.valid.all(axis=1) & np.isfinite(ground).all(axis=(1, 2))
        turn = np.exp(1j * local_from_vehicle[2])
        for row in np.flatnonzero(is_whole).tolist():
            corners = ground[row, :, 0] + 1j * ground[row, :, 1]
            range_m = float(abs(corners.mean()))
            if range_m < _RANGE_M:
                place = complex(local_from_vehicle[0], local_from_vehicle[1])
                self._take(_Object(quads.kinds[row], turn * corners + place, range_m, way_m))
        self.objects = self.objects[-_MOST:]

    def _take(self, newer: _Object) -> None:
        """Keep an object, or the view of it from nearer if it was seen before."""
        for piece in self.objects:
            if piece.kind == newer.kind and abs(piece.corners.mean() - newer.corners.mean()) < _SAME_M:
                piece.views += 1
                piece.way_m = newer.way_m
                if newer.range_m <= piece.range_m:
                    piece.corners = newer.corners
                    piece.range_m = newer.range_m
                return
        self.objects.append(newer)

    @property
    def sure(self) -> list[_Object]:
        """Objects that two images or more showed; those of a single image where there are no others."""
        several = [piece for piece in self.objects if piece.views > 1]
        return several or self.objects


WordScores = Callable[[FloatArray], FloatArray]
"""Log likelihoods (C,) of places (C, 3) of a patch by words, over those of chance."""


def _no_words(poses: FloatArray) -> FloatArray:
    return np.zeros(len(poses))


def search(
    patch: Patch,
    paint: Paint,
    calibrations: Mapping[str, Calibration],
    local_from_vehicle: FloatArray,
    prior: Prior | None,
    word_scores: WordScores = _no_words,
) -> list[Place]:
    """The places of a patch, the likeliest first; ``prior`` is the vehicle's at a pose of the odometry."""
    objects = patch.sure
    if len(objects) < 2 or not len(paint):
        return []
    if prior is None:
        numbers = np.arange(len(paint))
    else:
        numbers = paint.near(prior.pose[:2], 3 * prior.sigma_m + _PATCH_M + _RANGE_M)
    corners_map = paint.corners_map[numbers, :, 0] + 1j * paint.corners_map[numbers, :, 1]
    stacks = _Stacks(
        objects, corners_map, np.array([paint.looks_like(numbers, piece.kind) for piece in objects])
    )
    poses = stacks.by_pairs()
    poses = _allowed(poses, local_from_vehicle, prior)
    if not len(poses):
        return []
    likely = _MATCHED * stacks.count(poses, _SLACK_M) + word_scores(poses)
    poses = poses[np.argsort(-likely, kind="stable")[:_REFINED]]
    for slack_m in (_SLACK_M, _SLACK_M, _SLACK_SIGMAS * _SIGMA_M):
        poses = np.array([stacks.refined(pose, slack_m) for pose in poses])
    places = []
    distinct = _distinct(_allowed(poses, local_from_vehicle, prior), stacks)
    for pose in distinct:
        words = float(word_scores(pose[None])[0])
        squared, marking = stacks.nearest(pose)
        is_matched = squared < (_SLACK_SIGMAS * _SIGMA_M) ** 2
        score = _MATCHED * is_matched.sum() - 0.5 * float(squared[is_matched].sum()) / _SIGMA_M**2
        score -= _MISSED * _missed(patch, pose, paint, calibrations, numbers[marking[is_matched]])
        score += words - _surprise(pose, local_from_vehicle, prior)
        matched = len(np.unique(marking[is_matched]))
        places.append(Place(np.array(pose), float(score), matched, len(objects), words))
    return sorted(places, key=lambda place: -place.score)


@dataclass(frozen=True)
class _Stacks:
    """Objects (D) of a patch and markings (M) as complex corners."""

    objects: list[_Object]
    corners_map: FloatArray  # (M, 4) complex
    alike: FloatArray  # (D, M)

    def by_pairs(self) -> FloatArray:
        """Places (C, 3) that put one object on one marking."""
        rare = [len(np.flatnonzero(row)) for row in self.alike]
        order = np.lexsort(([piece.range_m for piece in self.objects], rare))[:_ANCHORS]
        detection, marking = np.nonzero(self.alike[order])
        corners = np.array([self.objects[n].corners for n in order.tolist()])[detection][:, SHIFTS]
        onto = self.corners_map[marking][:, None]
        middle = corners.mean(axis=2)
        centre = onto.mean(axis=2)
        centred = corners - middle[..., None]
        onto_centred = onto - centre[..., None]
        cross = (centred.conj() * onto_centred).sum(axis=2)
        turn = cross / np.maximum(np.abs(cross), 1e-12)
        off = np.sqrt((np.abs(onto_centred - turn[..., None] * centred) ** 2).mean(axis=2))
        fits = off < _SHAPE_M
        moved = (centre - turn * middle)[fits]
        return np.column_stack([moved.real, moved.imag, np.angle(turn[fits])])

    def count(self, poses: FloatArray, slack_m: float) -> IntArray:
        """How many objects lie on a marking at each place."""
        centres = np.array([piece.corners.mean() for piece in self.objects])
        markings = self.corners_map.mean(axis=1)
        out = np.zeros(len(poses), dtype=np.int64)
        size = max(1, _PARTS // max(1, len(markings)))
        for begin in range(0, len(poses), size):
            part = poses[begin : begin + size]
            for place, alike in zip(centres, self.alike, strict=True):
                at = np.exp(1j * part[:, 2]) * place + part[:, 0] + 1j * part[:, 1]
                if alike.any():
                    apart_m = np.abs(at[:, None] - markings[alike][None]).min(axis=1)
                    out[begin : begin + size] += apart_m < slack_m
        return out

    def nearest(self, pose: FloatArray) -> tuple[FloatArray, IntArray]:
        """The squared distance (D,), m2, of each object's corners from the nearest marking's, and its row."""
        corners = np.array([piece.corners for piece in self.objects])
        at = np.exp(1j * pose[2]) * corners + complex(pose[0], pose[1])
        apart_m = np.abs(at.mean(axis=1)[:, None] - self.corners_map.mean(axis=1)[None])
        apart_m = np.where(self.alike, apart_m, np.inf)
        row = apart_m.argmin(axis=1)
        shifted = at[:, SHIFTS] - self.corners_map[row][:, None]
        squared = (np.abs(shifted) ** 2).mean(axis=2).min(axis=1)
        return np.where(np.isfinite(apart_m.min(axis=1)), squared, np.inf), row

    def refined(self, pose: FloatArray, slack_m: float) -> FloatArray:
        """The place (3,) at which the objects lie best on the markings that they lie on."""
        corners = np.array([piece.corners for piece in self.objects])
        squared, row = self.nearest(pose)
        is_on = squared < slack_m**2
        if not is_on.any():
            return pose
        at = np.exp(1j * pose[2]) * corners[is_on] + complex(pose[0], pose[1])
        onto = self.corners_map[row[is_on]]
        shift = (np.abs(at[:, SHIFTS] - onto[:, None]) ** 2).sum(axis=2).argmin(axis=1)
        centred = np.take_along_axis(corners[is_on], SHIFTS[shift], axis=1).ravel()
        onto_centred = onto.ravel()
        cross = ((centred - centred.mean()).conj() * (onto_centred - onto_centred.mean())).sum()
        turn = cross / max(abs(cross), 1e-12)
        moved = onto_centred.mean() - turn * centred.mean()
        return np.array([moved.real, moved.imag, np.angle(turn)])


def vehicle_at(map_from_local: FloatArray, local_from_vehicle: FloatArray) -> FloatArray:
    """The vehicle's pose (..., 3) in the map of places (..., 3) of a patch."""
    c = np.cos(map_from_local[..., 2])
    s = np.sin(map_from_local[..., 2])
    x, y, turn = local_from_vehicle
    return np.stack(
        [
            map_from_local[..., 0] + c * x - s * y,
            map_from_local[..., 1] + s * x + c * y,
            map_from_local[..., 2] + turn,
        ],
        axis=-1,
    )


def _allowed(poses: FloatArray, local_from_vehicle: FloatArray, prior: Prior | None) -> FloatArray:
    """The places (C, 3) at which the vehicle is within three sigmas of where it should be."""
    if prior is None or not len(poses):
        return poses
    at = vehicle_at(poses, local_from_vehicle)
    apart_m = np.linalg.norm(at[:, :2] - prior.pose[:2], axis=1)
    turned = np.abs(_wrapped(at[:, 2] - prior.pose[2]))
    return np.asarray(poses[(apart_m < 3 * prior.sigma_m) & (turned < 3 * prior.sigma_rad)])


def _surprise(pose: FloatArray, local_from_vehicle: FloatArray, prior: Prior | None) -> float:
    if prior is None:
        return 0.0
    at = vehicle_at(pose, local_from_vehicle)
    off_sigmas = float(np.linalg.norm(at[:2] - prior.pose[:2])) / prior.sigma_m
    turned = float(_wrapped(at[2] - prior.pose[2])) / prior.sigma_rad
    return 0.5 * (off_sigmas**2 + turned**2)


def _distinct(poses: FloatArray, stacks: _Stacks) -> list[FloatArray]:
    """The distinct places: of several that are one, that which explains most."""
    if not len(poses):
        return []
    count = stacks.count(poses, _SLACK_SIGMAS * _SIGMA_M)
    middle = np.mean([piece.corners.mean() for piece in stacks.objects])
    at = np.exp(1j * poses[:, 2]) * middle + poses[:, 0] + 1j * poses[:, 1]
    chosen: list[int] = []
    for row in np.argsort(-count, kind="stable").tolist():
        apart_m = [abs(at[row] - at[other]) for other in chosen]
        turned = [abs(float(_wrapped(poses[row, 2] - poses[other, 2]))) for other in chosen]
        if not any(a < _APART_M and t < _APART_RAD for a, t in zip(apart_m, turned, strict=True)):
            chosen.append(row)
    return [poses[row] for row in chosen[:12]]


def _missed(
    patch: Patch, pose: FloatArray, paint: Paint, calibrations: Mapping[str, Calibration], matched: IntArray
) -> int:
    """How many markings were in clear view at a place, and are not in the patch."""
    in_view: set[int] = set()
    step = max(1, len(patch.views) // _VIEWS)
    for view in patch.views[::step]:
        at = vehicle_at(pose, view.local_from_vehicle)
        numbers = paint.near(at[:2], _VIEW_M + 3.0)
        if not len(numbers):
            continue
        calibration = calibrations[view.camera]
        offset = paint.corners_map[numbers, :, :2] - at[:2]
        c = np.cos(at[2])
        s = np.sin(at[2])
        vehicle = np.stack(
            [c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], axis=-1
        )
        cam = vehicle @ calibration.cam_from_vehicle[:3, :2].T + calibration.cam_from_vehicle[:3, 3]
        ahead = cam[..., 2] > 1.0
        px = (cam @ calibration.info.intrinsic.T)[..., :2] / np.where(ahead, cam[..., 2], 1.0)[..., None]
        size = np.array([calibration.info.width, calibration.info.height])
        inside = ahead & ((px > 0.05 * size) & (px < 0.95 * size)).all(axis=2)
        foot = inverse(calibration.cam_from_vehicle)[:2, 3]
        is_near = np.linalg.norm(vehicle - foot, axis=2) < _VIEW_M
        in_view |= set(numbers[(inside & is_near).all(axis=1)].tolist())
    return len(in_view - set(matched.tolist()))


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi)
