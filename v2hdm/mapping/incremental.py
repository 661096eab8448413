"""The drive mapped as it would be on the vehicle: marking by marking, with nothing known of what comes.

A track that the vehicle has left behind becomes a marking as soon as it ends: one of the map, where it lies
on it, or else a further one. Map and extrinsics are up to date after each (:mod:`v2hdm.adjust.incremental`).
Markings that follow one another share most of their images and so the errors of these images' poses: a few
dozen are solved together, as one unit, from which a marking is taken back out whenever another one joins.

The first tracks are linked under a coarse IPM. Whenever the map has doubled, and when the drive ends, what
has been seen so far is linked again under the extrinsics that it has led to: a constant share of the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.adjust.incremental import IncrementalMap, RigPrior, State
from v2hdm.adjust.marking_fit import MarkingObservations
from v2hdm.adjust.pose_errors import Noise
from v2hdm.errors import AdjustError
from v2hdm.geometry.quadrilateral import align, diameters
from v2hdm.geometry.rigid import exp
from v2hdm.mapping.association.groups import Association
from v2hdm.mapping.association.merge import group_kinds
from v2hdm.mapping.bundle import LEAST_OBSERVATIONS, VARIANCE_FACTORS, centre_priors, pose_sigma_of
from v2hdm.mapping.grown import Grown, Place, Taken, conclude_grown, corners_of, growth_step
from v2hdm.mapping.options import LEAST_SIGHTINGS, MappingOptions
from v2hdm.mapping.results import GrowthStep
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray, PoseNoise

Link = Callable[[Rig, bool], tuple[Association, BoolArray]]
"""Tracks under a rig, coarse or not, and which corners (S, 4) may be used."""

_UNIT_MARKINGS = 30
"""Markings that are solved together; a road or yard shows fewer at a time."""

_FIRST_LINK_MARKINGS = 12
"""From so many the extrinsics are better than the IPM that they began with."""

_LEAST_CORNERS = 3
"""Corners that fix a marking: all are parallelograms."""

_GROWTH_STEP = 1.5
"""How many times as large the map is whenever it is kept to show how it grew."""


@dataclass(frozen=True)
class _Track:
    """The sightings ``rows`` of one track, what they say of the corners 0 to 3, and where these lie alone.

    Corners that none of them shows as a point are nan.
    """

    rows: IntArray
    kind: int
    seen: MarkingObservations
    corners_map: FloatArray


class IncrementalMapper:
    """Takes the tracks of a drive into a map, one after the other."""

    def __init__(
        self,
        sightings: Sightings,
        rig: Rig,
        cameras: Mapping[str, Camera],
        pose_noise: PoseNoise,
        options: MappingOptions,
        link: Link,
    ) -> None:
        """Begin with an empty map.

        Args:
            sightings: The table of sightings.
            rig: Extrinsics to start from, and the recorded poses.
            cameras: The rig's cameras, in its order.
            pose_noise: How far the recorded poses are off.
            options: Settings of the mapping.
            link: Finds the tracks.
        """
        self._sightings, self._link, self._rig = sightings, link, rig
        self._cameras, self._options = cameras, options
        centre, sigma = centre_priors(list(cameras.values()), rig.cam_from_vehicle)
        focal = rig.intrinsic
        intrinsic = np.column_stack([focal[:, 0, 0], focal[:, 1, 1], focal[:, :2, 2]])
        self._prior = RigPrior(intrinsic, rig.cam_from_vehicle, centre, sigma)
        self._noise = _noise(pose_noise, options)
        self._jitter_rad = float(np.hypot(pose_noise.roll_pitch_rad, pose_noise.heading_rad))
        self._floor_m = float(pose_noise.position_m)
        self._vehicle_from_map: FloatArray = np.asarray(np.linalg.inv(rig.map_from_vehicle), np.float64)
        step_m = np.linalg.norm(np.diff(rig.map_from_vehicle[:, :3, 3], axis=0), axis=1)
        self._travelled_m = np.concatenate([[0.0], np.cumsum(step_m)])
        self._names, self._variance_factor = sightings.cameras, 1.0
        self._growth: list[GrowthStep] = []
        self._begin(None, 0)

    def run(self, views: Views, progress: Callable[[str], None]) -> Grown:
        """Take up all tracks in the order in which they end, then judge the markings.

        Args:
            views: What the images show.
            progress: Told in words how large the map is whenever the drive is linked anew.

        Raises:
            MappingError: No marking is accepted.
        """
        tracks, usable = self._link(self._rig, True)
        due, ended = _FIRST_LINK_MARKINGS, False
        while not ended:
            ended = self._take_up_safely(tracks, usable, due)[1]
            progress(f"linking anew with {len(self._places)} markings mapped")
            self._reweigh()
            tracks, usable = self._link(self._present_rig(), False)
            self._begin(self.grown, len(self._places))
            due *= 2
        association, _ = self._take_up_safely(tracks, usable, len(self._sightings))
        if self.grown.markings:
            self.grown.linearise()
        taken = Taken(
            sightings=self._sightings,
            association=association,
            usable=usable,
            views=views,
            cameras=self._cameras,
            initial_rig=self._rig,
            jitter_rad=self._jitter_rad,
            floor_px=self._options.model_floor_px,
            variance_factor=self._variance_factor,
        )
        return conclude_grown(
            self.grown, self._places, self._present_rig(), taken, self._growth, self._options.acceptance
        )

    def _begin(self, before: IncrementalMap | None, known: int) -> None:
        """An empty map with the extrinsics that the one ``before`` found, which had ``known`` markings.

        So many need not be up to date one by one again: they are solved a unit at a time.
        """
        self.grown = IncrementalMap(self._prior, self._noise)
        if before is not None:
            self.grown.state = State.empty(self._prior, before.state.tangents)
        self._start, self._known = before, known
        self._places: list[Place] = []
        self._centres = np.zeros((0, 2))
        self._corner_counts: list[int] = []
        self._waiting: list[MarkingObservations] = []

    def _take_up_safely(self, tracks: Association, usable: BoolArray, most: int) -> tuple[Association, bool]:
        """:meth:`_take_up`; where a unit cannot be solved at once, without the tracks that spoil it."""
        try:
            return self._take_up(tracks, usable, most)
        except AdjustError:
            self._begin(self._start, 0)
            return self._take_up(tracks, usable, most)

    def _take_up(self, tracks: Association, usable: BoolArray, most: int) -> tuple[Association, bool]:
        """Take tracks into the map until it has ``most`` markings or the drive ends; and whether it did.

        Returns which marking (S,) of the map each sighting became part of, and its corners' order.
        """
        number = np.full(len(self._sightings), -1, dtype=np.int64)
        shift = tracks.shift.copy()
        rows = np.flatnonzero(tracks.group >= 0)
        rows = rows[np.argsort(tracks.group[rows], kind="stable")]
        members = np.split(rows, np.flatnonzero(np.diff(tracks.group[rows])) + 1) if len(rows) else []
        kinds = group_kinds(tracks, self._sightings)
        ended = True
        for own in sorted(members, key=lambda own: int(own[-1])):
            if len(self._places) >= most:
                ended = False
                break
            track = self._track(own, int(kinds[tracks.group[own[0]]]), tracks, usable)
            if track is None:
                continue
            marking, turn = self._same_as(track)
            if self._take(track, marking, turn):
                number[own] = len(self._places) - 1 if marking is None else marking
                shift[own] = (shift[own] + turn) % 4
        self._settle()
        return Association(number, shift, len(self._places)), ended

    def _take(self, track: _Track, marking: int | None, turn: int) -> bool:
        """Take a track into the map as a ``marking``, None for a further one; whether that went well."""
        corner = (track.seen.corner - turn) % 4
        place = self._further_place(track) if marking is None else self._places[marking]
        numbers = place.corner.copy()
        further = np.setdiff1d(corner, np.flatnonzero(numbers >= 0))
        numbers[further] = self._corner_counts[place.unit] + np.arange(len(further))
        observed = MarkingObservations(**dict(vars(track.seen), corner=numbers[corner]))
        newest = place.unit == len(self._corner_counts) - 1
        if newest and len(self._places) < self._known:
            self._waiting.append(observed)
        else:
            self._settle()
            try:
                self.grown.observe(place.unit, observed)
            except AdjustError:
                return False
        self._corner_counts[place.unit] += len(further)
        place.corner = numbers
        place.point |= np.isfinite(track.corners_map).all(axis=1)
        place.images |= set(self._sightings.image[track.rows].tolist())
        if marking is None:
            self._places.append(place)
            self._centres = np.vstack([self._centres, np.nanmean(track.corners_map, axis=0)])
            self._keep_step()
        return True

    def _further_place(self, track: _Track) -> Place:
        """A place for a marking that the map does not have, in the newest unit or, if it is full, another."""
        newest = len(self._corner_counts) - 1
        last = self._places[-_UNIT_MARKINGS:]
        if newest < 0 or sum(place.unit == newest for place in last) == _UNIT_MARKINGS:
            self._settle()
            self._corner_counts.append(0)
            newest += 1
        known = np.asarray(np.isfinite(track.corners_map).all(axis=1))
        return Place(newest, np.full(4, -1, dtype=np.int64), track.kind, set(), known, track.corners_map)

    def _settle(self) -> None:
        """Solve for what waits for its unit to be full."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            joined = waiting[0]
            for more in waiting[1:]:
                joined = joined.joined(more)
            self.grown.observe(len(self._corner_counts) - 1, joined)

    def _corners(self, marking: int) -> FloatArray:
        """Corners (4, 2) of a marking under the present extrinsics, nan where none was seen as a point."""
        place = self._places[marking]
        if self._waiting and place.unit == len(self._corner_counts) - 1:
            return place.preview
        return np.where(place.point[:, None], corners_of(self.grown, place), np.nan)

    def _track(self, rows: IntArray, kind: int, tracks: Association, usable: BoolArray) -> _Track | None:
        """What ``rows`` saw of corners that they saw twice; None where that fixes no marking."""
        order = tracks.corner_order()[rows]
        which, corner = np.nonzero(np.take_along_axis(usable[rows], order, axis=1))
        twice = np.bincount(corner, minlength=4) >= 2
        if len(rows) < LEAST_SIGHTINGS or np.count_nonzero(twice) < _LEAST_CORNERS:
            return None
        which, corner = which[twice[corner]], corner[twice[corner]]
        row, own = rows[which], order[which, corner]
        sightings, floor_px = self._sightings, self._options.model_floor_px
        known, dense = np.unique(corner, return_inverse=True)
        seen = MarkingObservations(
            camera=sightings.camera[row],
            corner=dense.astype(np.int64),
            frame=sightings.frame[row],
            travelled_m=self._travelled_m[sightings.frame[row]],
            vehicle_from_map=self._vehicle_from_map[sightings.frame[row]],
            pinhole_px=sightings.corners_pinhole_px[row, own],
            covariance_px=self._variance_factor
            * (sightings.covariance_px[row, own] + floor_px**2 * np.eye(2)),
        )
        corners = np.full((4, 2), np.nan)
        try:
            corners[known] = self.grown.preview(seen)
        except AdjustError:
            return None
        points = np.bincount(corner[sightings.valid[row, own]], minlength=4) > 0
        if np.count_nonzero(points) < 2:
            return None
        corners[~points] = np.nan
        return _Track(rows, kind, replace(seen, corner=corner), corners)

    def _same_as(self, track: _Track) -> tuple[int | None, int]:
        """The marking of the map that lies where a track does, None if none; and how to turn the track.

        Corner c of the marking is corner (c + turn) mod 4. Two things seen in one image are two markings.
        """
        corners = track.corners_map
        valid = np.asarray(np.isfinite(corners).all(axis=1))
        images = set(self._sightings.image[track.rows].tolist())
        size_m = float(diameters(np.nan_to_num(corners), valid))
        tolerance_m = max(self._options.association.shape_tolerance * size_m, 0.05)
        best: tuple[float, int | None, int] = (self._gate_m(track.rows), None, 0)
        near = np.linalg.norm(self._centres - np.nanmean(corners, axis=0), axis=1) < best[0] + size_m
        for marking in np.flatnonzero(near).tolist():
            place = self._places[marking]
            if place.kind != track.kind or not images.isdisjoint(place.images):
                continue
            mapped = self._corners(marking)
            whole = np.asarray(np.isfinite(mapped).all(axis=1))
            there = align(np.nan_to_num(mapped), whole, np.nan_to_num(corners), valid)
            off_m = float(np.linalg.norm(there.offset))
            if off_m < best[0] and there.deformation_m < tolerance_m:
                best = (off_m, marking, int(there.shift))
        return best[1], best[2]

    def _gate_m(self, rows: IntArray) -> float:
        """How far apart two sightings of one marking may lie: poses, and what is left of the extrinsic."""
        options, range_m = self._options.association, 0.5 * self._options.max_range_m
        height_m = float(np.median(self._rig.height_m[self._sightings.camera[rows]]))
        floor_m = np.hypot(self._floor_m, options.refined_sigma_rad * range_m**2 / height_m)
        return float(min(options.gate_sigmas * np.sqrt(2) * floor_m, options.max_gate_m))

    def _present_rig(self) -> Rig:
        """The extrinsics, and the poses of the frames as the units that saw most in them say."""
        poses, most = self._rig.map_from_vehicle.copy(), np.zeros(len(self._rig.map_from_vehicle))
        for unit in self.grown.markings.values():
            frames, count = np.unique(unit.observations.frame, return_counts=True)
            better = count > most[frames]
            chosen = frames[better]
            poses[chosen] = self._rig.map_from_vehicle[chosen] @ exp(unit.frame_state[better])
            most[chosen] = count[better]
        return Rig(self._rig.intrinsic, self.grown.cam_from_vehicle, poses)

    def _keep_step(self) -> None:
        """Keep the map as it is, if it has grown enough since the last time that it was kept."""
        count = len(self._places)
        if count > self._known and count >= _GROWTH_STEP * len(
            self._growth[-1].markings if self._growth else ()
        ):
            self._growth.append(growth_step(self.grown, self._places, self._names, self._sightings.kinds))

    def _reweigh(self) -> None:
        """Take the observations for as good as their residuals say, as the batch does."""
        observations = sum(len(one.observations.camera) for one in self.grown.markings.values())
        if observations >= LEAST_OBSERVATIONS:
            self.grown.linearise()
            factor = self._variance_factor * self.grown.variance().observations
            self._variance_factor = float(np.clip(factor, *VARIANCE_FACTORS))


def _noise(pose_noise: PoseNoise, options: MappingOptions) -> Noise:
    """The noise of the batch, in the arrays of the incremental map."""
    sigma = pose_sigma_of(pose_noise)
    drifts = sigma.drift_by_state()
    return Noise(
        sigma.by_state(),
        options.loss_scale,
        np.array([drift.sigma for drift in drifts]),
        np.array([drift.over_m for drift in drifts]),
    )
