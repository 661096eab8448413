"""Mapping as on the vehicle: marking by marking, without knowledge of later images.

A finished track becomes a marking, or joins the mapped one that it lies on. Map and extrinsics are updated
after each (:mod:`v2hdm.adjust.incremental`), under a model with pose errors as image noise. Whenever the map
has grown fourfold, and at the end, everything is re-linked and solved with pose errors, as in the batch: a
constant factor in cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.adjust import Observations, PoseSigma
from v2hdm.adjust.incremental import IncrementalMap, Sighted
from v2hdm.association.groups import (
    GATE_SIGMAS,
    LEAST_TOLERANCE_M,
    MAX_GATE_M,
    SHAPE_TOLERANCE,
    Association,
    group_kinds,
)
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.association.tracks import LEAST_SIGHTINGS, REFINED_SIGMA_RAD
from v2hdm.errors import AdjustError
from v2hdm.geometry.planar import align, diameters
from v2hdm.mapping.bundle import Model, control_points, drive_problem, known_lengths, observations_at
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import BoolArray, Camera, FloatArray, IntArray

Link = Callable[[Rig, bool], tuple[Association, BoolArray]]
"""Tracks under a rig, coarse or not, and the usable corners (S, 4)."""

Solve = Callable[[Association, BoolArray, Rig], Rig]
"""The rig solved from groups of sightings and their usable corners (S, 4), starting at another."""

_FIRST_LINK_MARKINGS = 12  # with as many, the extrinsics are better than the initial IPM
_LINK_GROWTH = 4
"""Growth of the map at which everything is re-linked and solved: over a drive, a third more work than the
last time alone."""

_LEAST_CORNERS = 3  # corners that determine a marking, a parallelogram


@dataclass
class _Place:
    """A mapped marking: index of each corner (4,), -1 for none, its images, and its preview."""

    corner: IntArray
    kind: int
    images: set[int]
    point: BoolArray
    preview: FloatArray


@dataclass(frozen=True)
class _Track:
    """The ``rows`` of one track, its observations, and its corners (4, 2), nan unless a point."""

    rows: IntArray
    kind: int
    observations: Observations
    corners_map: FloatArray


class IncrementalMapper:
    """Maps the tracks of a drive, one after the other."""

    def __init__(
        self,
        sightings: Sightings,
        rig: Rig,
        cameras: Mapping[str, Camera],
        position_sigma_m: float,
        options: MappingOptions,
        link: Link,
        solve: Solve,
        model: Model,
    ) -> None:
        """An empty map; ``model`` is that of single markings, without pose states."""
        self._sightings = sightings
        self._link = link
        self._solve = solve
        self._options = options
        self._floor_m = position_sigma_m
        self._model = model
        self._first_rig = rig
        self._drive = drive_problem(sightings, rig, cameras, model)
        self._begin(rig, 0)

    def run(self, progress: Callable[[str], None]) -> tuple[Association, Rig]:
        """Map all tracks as they end; returns the markings as groups, and the final rig.

        ``progress`` receives the map's size. Raises MappingError if nothing can be solved.
        """
        tracks, usable = self._link(self._rig, True)
        due = _FIRST_LINK_MARKINGS
        ended = False
        while not ended:
            association, ended = self._take_up_safely(tracks, usable, due)
            progress(f"associating again with {len(self._places)} markings mapped")
            present = replace(self._rig, cam_from_vehicle=self.grown.cam_from_vehicle)
            rig = self._solve(association, usable, present)
            tracks, usable = self._link(rig, False)
            self._begin(rig, len(self._places))
            due *= _LINK_GROWTH
        association, _ = self._take_up_safely(tracks, usable, len(self._sightings))
        return association, replace(self._rig, cam_from_vehicle=self.grown.cam_from_vehicle)

    def _begin(self, rig: Rig, count: int) -> None:
        """Start an empty map from ``rig``; its first ``known`` markings are solved together."""
        self._rig = rig
        self._known = count
        # Only the IPM that the first map starts from, and all that it locates, may be far off.
        self._coarse = rig is self._first_rig
        read_out_s = None if rig.read_out_s is None else np.maximum(rig.read_out_s, 0.0)
        drive = replace(
            self._drive,
            cam_from_vehicle=rig.cam_from_vehicle,
            map_from_vehicle=rig.map_from_vehicle,
            read_out_s=read_out_s,
        )
        self.grown = IncrementalMap(drive, replace(self._model.solver, coarse=self._coarse))
        self._places: list[_Place] = []
        self._centres = np.zeros((0, 2))

    def _take_up_safely(self, tracks: Association, usable: BoolArray, most: int) -> tuple[Association, bool]:
        """:meth:`_take_up`; if known tracks are unsolvable together, without the harmful ones."""
        try:
            return self._take_up(tracks, usable, most)
        except AdjustError:
            self._begin(self._rig, 0)
            return self._take_up(tracks, usable, most)

    def _take_up(self, tracks: Association, usable: BoolArray, most: int) -> tuple[Association, bool]:
        """Map tracks up to ``most`` markings; returns them as groups, and whether the drive ended."""
        number = np.full(len(self._sightings), -1, dtype=np.int64)
        shift = tracks.shift.copy()
        tracked = np.flatnonzero(tracks.group >= 0)
        tracked = tracked[np.argsort(tracks.group[tracked], kind="stable")]
        begins = np.flatnonzero(np.diff(tracks.group[tracked])) + 1
        members = np.split(tracked, begins) if len(tracked) else []
        kinds = group_kinds(tracks, self._sightings)
        for rows in sorted(members, key=lambda rows: int(rows[-1])):
            if len(self._places) >= most:
                return Association(number, shift, len(self._places)), False
            track = self._track(rows, int(kinds[tracks.group[rows[0]]]), tracks, usable)
            if track is None:
                continue
            marking, turn = self._same_as(track)
            if self._take(track, marking, turn):
                number[rows] = len(self._places) - 1 if marking is None else marking
                shift[rows] = (shift[rows] + turn) % 4
        return Association(number, shift, len(self._places)), True

    def _take(self, track: _Track, marking: int | None, turn: int) -> bool:
        """Map a track as part of ``marking``, or as a new one if None; returns whether it succeeded."""
        corner = (track.observations.corner - turn) % 4
        is_point = np.isfinite(track.corners_map).all(axis=1)
        place = (
            _Place(np.full(4, -1, dtype=np.int64), track.kind, set(), np.asarray(is_point), track.corners_map)
            if marking is None
            else self._places[marking]
        )
        numbers = place.corner.copy()
        further = np.setdiff1d(corner, np.flatnonzero(numbers >= 0))
        numbers[further] = np.count_nonzero(numbers >= 0) + np.arange(len(further))
        turned_map = track.corners_map[(np.arange(4) + turn) % 4]
        sighted = Sighted(replace(track.observations, corner=numbers[corner]))
        if not self._coarse:
            kind = self._sightings.kinds[place.kind]
            sizes = self._options.known_sizes
            poses = PoseSigma(self._floor_m)
            lengths = known_lengths(sizes, [kind], turned_map[None], numbers[None])
            control = control_points(self._options.survey, turned_map[None], numbers[None], poses)
            sighted = replace(sighted, lengths=lengths, control=control)
        count = len(self._places)
        number = count if marking is None else marking
        if count < self._known:
            self.grown.add(number, sighted)
        else:
            try:
                self.grown.observe(number, sighted)
            except AdjustError:
                return False
        place.corner = numbers
        place.point |= np.isfinite(turned_map).all(axis=1)
        place.images |= set(self._sightings.image[track.rows].tolist())
        if marking is None:
            self._places.append(place)
            self._centres = np.vstack([self._centres, np.nanmean(track.corners_map, axis=0)])
            if len(self._places) == self._known:
                self.grown.adjust()
        return True

    def _corners(self, marking: int) -> FloatArray:
        """Corners (4, 2) of a marking under the present extrinsics, nan unless seen as a point."""
        place = self._places[marking]
        if not self.grown.is_solved(marking):
            return place.preview
        out = np.full((4, 2), np.nan)
        is_seen = (place.corner >= 0) & place.point
        out[is_seen] = self.grown.corners_map(marking)[place.corner[is_seen]]
        return out

    def _track(self, rows: IntArray, kind: int, tracks: Association, usable: BoolArray) -> _Track | None:
        """Observations in ``rows`` of corners seen twice; None if they do not determine a marking."""
        order = tracks.corner_order()[rows]
        which, corner = np.nonzero(np.take_along_axis(usable[rows], order, axis=1))
        twice = np.bincount(corner, minlength=4) >= 2
        if len(rows) < LEAST_SIGHTINGS or np.count_nonzero(twice) < _LEAST_CORNERS:
            return None
        which = which[twice[corner]]
        corner = corner[twice[corner]]
        row = rows[which]
        own_corner = order[which, corner]
        points = np.bincount(corner[self._sightings.valid[row, own_corner]], minlength=4) > 0
        if np.count_nonzero(points) < 2:
            return None
        present, dense = np.unique(corner, return_inverse=True)
        at = (row, own_corner)
        observations = observations_at(self._sightings, at, dense.astype(np.int64), self._model)
        corners = np.full((4, 2), np.nan)
        try:
            corners[present] = self.grown.preview(Sighted(observations))
        except AdjustError:
            return None
        if not np.isfinite(corners[present]).all():
            return None
        corners[~points] = np.nan
        return _Track(rows, kind, replace(observations, corner=corner), corners)

    def _same_as(self, track: _Track) -> tuple[int | None, int]:
        """The mapped marking at a track's position, if any: its corner c is the track's (c + turn) mod 4."""
        corners = track.corners_map
        valid = np.asarray(np.isfinite(corners).all(axis=1))
        images = set(self._sightings.image[track.rows].tolist())
        size_m = float(diameters(np.nan_to_num(corners), valid))
        tolerance_m = max(SHAPE_TOLERANCE * size_m, LEAST_TOLERANCE_M)
        # Tolerance between two sightings of one marking: pose errors, and the extrinsic's remaining error.
        middle = np.nanmean(corners, axis=0)
        frame = self._sightings.frame[track.rows]
        away = middle - self._rig.map_from_vehicle[frame, :2, 3]
        range_m = float(np.median(np.linalg.norm(away, axis=1)))
        height_m = float(np.median(self._rig.height_m[self._sightings.camera[track.rows]]))
        floor_m = np.hypot(self._floor_m, REFINED_SIGMA_RAD * range_m**2 / height_m)
        gate_m = float(min(GATE_SIGMAS * np.sqrt(2) * floor_m, MAX_GATE_M))
        best: tuple[float, int | None, int] = (gate_m, None, 0)
        in_reach = np.linalg.norm(self._centres - middle, axis=1) < gate_m + size_m
        for marking in np.flatnonzero(in_reach).tolist():
            place = self._places[marking]
            if place.kind != track.kind or not images.isdisjoint(place.images):
                continue
            mapped = self._corners(marking)
            whole = np.asarray(np.isfinite(mapped).all(axis=1))
            aligned = align(np.nan_to_num(mapped), whole, np.nan_to_num(corners), valid)
            off_m = float(np.linalg.norm(aligned.offset))
            if off_m < best[0] and aligned.deformation_m < tolerance_m:
                best = (off_m, marking, int(aligned.shift))
        return best[1], best[2]
