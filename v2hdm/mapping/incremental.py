"""The drive mapped as it would be on the vehicle: marking by marking, with nothing known of what comes.

A track that the vehicle has left behind becomes a marking as soon as it ends: one of the map, where it lies
on it, or else a further one. Map and extrinsics are up to date after each (:mod:`v2hdm.adjust.incremental`);
poses' errors are those of the marking's own images, so that accuracies are stated a little too well
where many markings share an image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust.incremental import IncrementalMap, RigPrior
from v2hdm.adjust.marking_fit import MarkingObservations, Noise
from v2hdm.errors import AdjustError, MappingError
from v2hdm.mapping.acceptance import Candidates, judge
from v2hdm.mapping.association import Association
from v2hdm.mapping.bundle import HEAVE_SIGMA_M, centre_priors
from v2hdm.mapping.conclude import exclusions, no_marking_message, pair_keys
from v2hdm.mapping.location import Rig
from v2hdm.mapping.merge import group_kinds
from v2hdm.mapping.options import AssociationOptions, MappingOptions
from v2hdm.mapping.results import Exclusion
from v2hdm.mapping.shapes import align, diameters
from v2hdm.mapping.sightings import Sightings
from v2hdm.mapping.views import Views, easy_views, project_ground
from v2hdm.records import CORNERED_CLASSES, BoolArray, Camera, FloatArray, Marking, PoseNoise

IntArray = NDArray[np.int64]

# Squared distance that one sound observation in ten thousand exceeds (2 degrees of freedom).
_INLIER_SQUARED = 18.4


@dataclass(frozen=True)
class Grown:
    """What the drive has left behind.

    ``rig`` holds the final extrinsics with the recorded poses; ``grown`` goes on with the next drive.
    """

    grown: IncrementalMap
    rig: Rig
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    residual_px: FloatArray


class IncrementalMapper:
    """Takes the tracks of a drive into a map, one after the other."""

    def __init__(
        self,
        sightings: Sightings,
        usable: BoolArray,
        rig: Rig,
        cameras: Mapping[str, Camera],
        pose_noise: PoseNoise,
        options: MappingOptions,
    ) -> None:
        """Begin with an empty map.

        Args:
            sightings: The table of sightings.
            usable: Which corners (S, 4) may be used.
            rig: Extrinsics to start from, and the recorded poses.
            cameras: The rig's cameras, in its order.
            pose_noise: How far the recorded poses are off.
            options: Settings of the mapping.
        """
        self._sightings, self._usable, self._rig = sightings, usable, rig
        self._cameras, self._options = list(cameras.values()), options
        centre, sigma = centre_priors(self._cameras, rig.cam_from_vehicle)
        focal = rig.intrinsic
        intrinsic = np.column_stack([focal[:, 0, 0], focal[:, 1, 1], focal[:, :2, 2]])
        white_m = np.sqrt(max(pose_noise.position_m**2 - pose_noise.position_drift_m**2, 0.0))
        tilt = pose_noise.roll_pitch_rad
        pose_sigma = np.array([white_m, white_m, HEAVE_SIGMA_M, tilt, tilt, pose_noise.heading_rad])
        self.grown = IncrementalMap(
            RigPrior(intrinsic, rig.cam_from_vehicle, centre, sigma),
            Noise(pose_sigma, options.loss_scale),
            pose_noise.position_drift_m,
        )
        self._jitter_rad = float(np.hypot(tilt, pose_noise.heading_rad))
        self._floor_m = float(pose_noise.position_m)
        self._vehicle_from_map: FloatArray = np.asarray(np.linalg.inv(rig.map_from_vehicle), np.float64)
        self._images: dict[int, set[int]] = {}
        self._kinds: dict[int, int] = {}

    def run(self, tracks: Association, views: Views) -> Grown:
        """Take up all ``tracks`` in the order in which they end, then judge the markings.

        Raises:
            MappingError: No marking is accepted.
        """
        association = self._take_up(tracks)
        rig = Rig(self._rig.intrinsic, self.grown.cam_from_vehicle, self._rig.map_from_vehicle)
        candidates, residual_px = self._candidates(association, rig, views)
        verdict = judge(candidates, self._options.acceptance)
        accepted = [group for group, reason in enumerate(verdict) if reason is None]
        excluded = exclusions(candidates, verdict)
        if not accepted:
            raise MappingError(no_marking_message(excluded))
        markings = tuple(
            Marking(
                CORNERED_CLASSES[candidates.kind[group]],
                candidates.corners_map[group],
                int(candidates.sightings[group]),
                self.grown.corner_covariance(group),
            )
            for group in accepted
        )
        return Grown(self.grown, rig, markings, tuple(excluded), residual_px)

    def _take_up(self, tracks: Association) -> Association:
        """Which marking (S,) of the map each sighting became part of, and its corners' order."""
        number = np.full(len(self._sightings), -1, dtype=np.int64)
        shift = tracks.shift.copy()
        last = np.zeros(tracks.count, dtype=np.int64)
        rows = np.flatnonzero(tracks.group >= 0)
        np.maximum.at(last, tracks.group[rows], rows)
        kinds = group_kinds(tracks, self._sightings)
        for track in np.argsort(last, kind="stable").tolist():
            own = np.flatnonzero(tracks.group == track)
            seen = self._observations(own, tracks)
            if seen is None:
                continue
            try:
                corners = self.grown.preview(seen)
                marking, turn = self._same_as(corners, int(kinds[track]), own)
                self.grown.observe(marking, _turned(seen, turn))
            except AdjustError:
                continue
            number[own], shift[own] = marking, (shift[own] + turn) % 4
            self._kinds[marking] = int(kinds[track])
            self._images.setdefault(marking, set()).update(self._sightings.image[own].tolist())
        return Association(number, shift, len(self.grown.markings))

    def _observations(self, rows: IntArray, tracks: Association) -> MarkingObservations | None:
        """What ``rows`` saw of their marking's corners; None where it was too little to map them all."""
        order = tracks.corner_order()[rows]
        which, corner = np.nonzero(np.take_along_axis(self._usable[rows], order, axis=1))
        often = np.bincount(corner, minlength=4).min() >= 2
        if len(rows) < self._options.acceptance.min_sightings or not often:
            return None
        row, own = rows[which], order[which, corner]
        sightings, floor_px = self._sightings, self._options.model_floor_px
        return MarkingObservations(
            camera=sightings.camera[row],
            corner=corner,
            frame=sightings.frame[row],
            vehicle_from_map=self._vehicle_from_map[sightings.frame[row]],
            pinhole_px=sightings.corners_pinhole_px[row, own],
            covariance_px=sightings.covariance_px[row, own] + floor_px**2 * np.eye(2),
        )

    def _same_as(self, corners: FloatArray, kind: int, rows: IntArray) -> tuple[int, int]:
        """The marking of the map that lies where ``corners`` do, or a new number; and how to turn them.

        Corner c of the marking is corner (c + turn) mod 4. Two things seen in one image are two markings.
        """
        options, images = self._options.association, set(self._sightings.image[rows].tolist())
        best, found = self._gate_m(options, rows), (len(self.grown.markings), 0)
        whole = np.ones(4, dtype=bool)
        size_m = float(diameters(corners, whole))
        for marking in self.grown.markings:
            if self._kinds[marking] != kind or not images.isdisjoint(self._images[marking]):
                continue
            there = align(self.grown.corners_map(marking), whole, corners, whole)
            off_m = float(np.linalg.norm(there.offset))
            if off_m < best and there.deformation_m < max(options.shape_tolerance * size_m, 0.05):
                best, found = off_m, (marking, int(there.shift))
        return found

    def _gate_m(self, options: AssociationOptions, rows: IntArray) -> float:
        """How far apart two sightings of one marking may lie: poses, and what is left of the extrinsic."""
        range_m = 0.5 * self._options.max_range_m
        height_m = float(np.median(self._rig.height_m[self._sightings.camera[rows]]))
        floor_m = np.hypot(self._floor_m, options.refined_sigma_rad * range_m**2 / height_m)
        return float(min(options.gate_sigmas * np.sqrt(2) * floor_m, options.max_gate_m))

    def _candidates(self, association: Association, rig: Rig, views: Views) -> tuple[Candidates, FloatArray]:
        """What the verdict rests on, and the residuals (K, 2), px, of the markings' observations."""
        sightings, count = self._sightings, association.count
        corners = (
            np.stack([self.grown.corners_map(m) for m in range(count)]) if count else np.zeros((0, 4, 2))
        )
        variance = np.array([np.diag(self.grown.corner_covariance(m)) for m in range(count)])
        usable = association.in_group_order(self._usable) & (association.group >= 0)[:, None]
        row, corner = np.nonzero(usable)
        group = association.group[row]
        own = association.corner_order()[row, corner]
        cam_from_map = (
            rig.cam_from_vehicle[sightings.camera[row]] @ self._vehicle_from_map[sightings.frame[row]]
        )
        focal = rig.intrinsic[sightings.camera[row]]
        pixel, _ = project_ground(focal, cam_from_map, corners[group, corner][:, None])
        residual = pixel[:, 0] - sightings.corners_pinhole_px[row, own]
        jitter_px = float(np.mean(rig.intrinsic[:, 0, 0])) * self._jitter_rad
        noise = sightings.covariance_px[row, own] + jitter_px**2 * np.eye(2)
        squared = np.sum(residual * np.linalg.solve(noise, residual[..., None])[..., 0], axis=1)
        agreeing = np.bincount(group[squared < _INLIER_SQUARED], minlength=count)
        seen = np.unique(np.stack([group, sightings.image[row]]), axis=1)
        easy = np.stack(easy_views(views, rig, self._cameras, corners))
        found = np.isin(pair_keys(easy), pair_keys(seen))
        candidates = Candidates(
            kind=np.array([self._kinds[m] for m in range(count)], dtype=np.int64),
            corners_map=corners,
            completed=np.zeros(count, dtype=bool),
            sigma_m=np.sqrt(variance.reshape(count, 4, 2).sum(axis=2).max(axis=1)),
            sightings=np.bincount(seen[0], minlength=count),
            inlier_share=agreeing / np.maximum(np.bincount(group, minlength=count), 1),
            easy_views=np.bincount(easy[0], minlength=count),
            easy_detections=np.bincount(easy[0, found], minlength=count),
        )
        return candidates, residual


def _turned(seen: MarkingObservations, turn: int) -> MarkingObservations:
    """``seen`` with corners renumbered: corner (c + turn) mod 4 becomes corner c."""
    parts = dict(vars(seen))
    parts["corner"] = (seen.corner - turn) % 4
    return MarkingObservations(**parts)
