"""The joint optimisation: from sightings under a coarse IPM to a map and the cameras' extrinsics.

A coarse IPM misplaces markings by more than they lie apart, so associating and solving take turns:
tracks along the drive are solved with steep rays only, which a wrong extrinsic hurts least; under
the extrinsic found, the tracks are linked anew and those that coincide are merged; then everything
is solved together, and again without the observations that contradict the rest.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from v2hdm.adjust import (
    PoseSigma,
    Problem,
    Status,
    estimate_noise,
    height_information,
    predicts_better,
    select_model,
)
from v2hdm.association.ground import Located, Views, locate
from v2hdm.association.groups import Association, attach, fuse_groups, in_view, merge_groups, same_groups
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.association.surface import Paths, Recorded, Surface
from v2hdm.association.tracks import Uncertainty, build_tracks
from v2hdm.errors import AdjustError, MappingError
from v2hdm.geometry.tensors import extrinsic_from_ipm
from v2hdm.mapping.bundle import (
    LEAST_OBSERVATIONS,
    VARIANCE_FACTORS,
    Bundle,
    coarse_model,
    full_model,
    pose_sigma_of,
    read_outs_s,
    solve_bundle,
    vehicle_twists,
)
from v2hdm.mapping.conclude import Evidence, Optimised, conclude
from v2hdm.mapping.incremental import IncrementalMapper
from v2hdm.mapping.lanes import Knots
from v2hdm.mapping.options import AUTO, CROSS_SECTION, SURFACE, MappingOptions
from v2hdm.records import BoolArray, Camera, FloatArray, Marking, PoseNoise, Road, largest_noise

_log = logging.getLogger(__name__)

_SETTLED_MODEL = "heave"
"""Pose model of the solves between which associations still change: it leaves no error of a pose out."""

_STEEP_SINE = 0.15
"""Sine of a ray's depression from which the coarse stage uses it (unless most rays are flatter)."""

_LOOSE_CLOCK_SIGMA_S = 0.3
"""How far clocks may be apart, s, once the drive has said that they are: half a period of a slow receiver."""


_GROUND_ROUNDS = 6
"""Solves over better and better ground, at most: four are enough for a crown of 4 %."""

_LANE_ROUNDS = 3
"""Solves with lanes: the stated variance of their points may be thirty times as large as the true one."""

_SETTLED_M = 2e-3
"""Change of the heights that are seen, root mean square, from which on the ground is settled."""


def silent(step: str) -> None:
    """Ignore progress."""


class Optimiser:
    """Takes one set of cameras through association and solving."""

    def __init__(
        self,
        sightings: Sightings,
        views: Views,
        cameras: Mapping[str, Camera],
        pose_noise: Sequence[PoseNoise],
        options: MappingOptions,
        road: Road | None = None,
    ) -> None:
        """``pose_noise`` is that of each visit; gates take the largest of each kind."""
        self._seen, self._views = sightings, views
        self.sightings = sightings
        """As if all that they show lay on a plane."""
        self.surface: Surface | None = None
        """That of the ground, where it is not a plane."""
        self._cameras = {name: cameras[name] for name in sightings.cameras}
        self._noise_of_visits = pose_noise
        self._pose_noise = largest_noise(self._noise_of_visits)
        self._pose_sigma = self._own_noise = tuple(pose_sigma_of(one) for one in self._noise_of_visits)
        self._options, self._recorded = options, Recorded.of(road, self._pose_noise)
        self.pose_model = _SETTLED_MODEL if options.pose_model == AUTO else options.pose_model
        """The pose model, one of :data:`v2hdm.adjust.MODELS`."""
        self._variance_factor = 1.0
        self.held_out: Mapping[str, float] = {}
        self.growth: tuple[tuple[Marking, ...], ...] = ()
        self.camera_names = sightings.cameras
        start = initial_rig(self._cameras, sightings.map_from_vehicle)
        self.initial_rig = rolling(start, self._cameras.values(), sightings, options.estimate_read_out)

    def initial_tracks(self) -> Association:
        """Sightings linked from image to image under the initial IPMs."""
        located = self._locate(self.initial_rig)
        return self._track(self.initial_rig, located, self._options.association.ipm_sigma_rad)

    def settle(self, tracks: Association, progress: Callable[[str], None] = silent) -> Bundle:
        """Associate and solve by turns, until it is settled which sightings are of one marking."""
        progress("coarse solve")
        bundle = self._solve_steep(tracks)
        for number in range(1, self._options.rounds + 1):
            progress(f"joint solve {number}")
            association = self._associate(bundle.rig)
            # The coarse solve takes the poses at their word, which no test of the inputs may rest on.
            if number > 1 and same_groups(association, bundle.association):
                break
            bundle = self._solve(association, self._usable(association, bundle.rig), bundle.rig)
            self._reweigh(bundle)
        bundle = self._fit_ground(bundle, progress)
        progress("noise of the poses")
        return self._weigh_poses(bundle)

    def finish(
        self,
        bundle: Bundle,
        progress: Callable[[str], None] = silent,
        find_knots: Callable[[Rig, Surface | None], Knots | None] = lambda rig, surface: None,
    ) -> Optimised:
        """Choose the pose model, leave out what contradicts ``bundle`` (see :meth:`settle`), and conclude.

        ``find_knots`` gives the knots of lanes that take part, by what is known of the rig without them.
        """
        if self._options.pose_model == AUTO:
            progress("choice of the pose model")
            self.pose_model = self._choose_pose_model(bundle)
        progress("final solve")
        inlier, usable = bundle.inliers, np.zeros_like(self.sightings.valid)
        usable[bundle.row[inlier], bundle.own_corner[inlier]] = True
        final = self._solve(bundle.association, usable, bundle.rig)
        knots = find_knots(final.rig, self.surface)
        if knots is not None and knots.count:
            progress("lanes")
            # By turns: how well lines are seen, only their residuals say.
            for _ in range(_LANE_ROUNDS):
                lanes = final.knots or knots, final.markings_map
                final = self._solve(final.association, usable, final.rig, lanes=lanes)
        return conclude(
            Evidence(self.sightings, self._views, self._cameras, final, bundle, inlier, usable),
            self.initial_rig,
            self._pose_noise.roll_pitch_rad,
            self._options.acceptance,
        )

    def clock_offsets_s(self, bundle: Bundle) -> list[dict[str, float]]:
        """By visit each camera's clock offset by a solve that expects none in particular, from ``bundle``."""
        model = full_model(self._pose_sigma, self._options, "clock", bundle.model.variance_factor)
        model = replace(model, clock_sigma_s=_LOOSE_CLOCK_SIGMA_S)
        usable = self._usable(bundle.association, bundle.rig)
        solved = solve_bundle(
            self.sightings, bundle.association, usable, bundle.rig, self._cameras, model
        ).solution
        return [
            {name: float(offset_s[c]) for name, c in bundle.camera_index.items()}
            for offset_s in solved.clock_offset_s.T
        ]

    def is_curved(self, bundle: Bundle) -> bool:
        """Whether ``bundle``, over a surface, predicts held-out observations better than the plane."""
        problem, own = self._as_stated(bundle), bundle.own_corner
        seen = replace(problem.observations, pinhole_px=self._seen.corners_pinhole_px[bundle.row, own])
        try:
            return predicts_better(problem, replace(problem, observations=seen), bundle.model.solver)
        except AdjustError as failure:
            _log.warning("the ground stays a plane, since no surface could be tried: %s", failure)
            return False

    def grow(self, progress: Callable[[str], None] = silent) -> Bundle:
        """Map one track after the other, as the vehicle would, and solve for all that the map rests on.

        ``progress`` is called with the size of the map. In place of :meth:`settle`.
        """

        def link(rig: Rig, coarse: bool) -> tuple[Association, BoolArray]:
            located, options = self._locate(rig), self._options.association
            direction_rad = options.ipm_sigma_rad if coarse else options.refined_sigma_rad
            tracks = self._track(rig, located, direction_rad)
            return tracks, self._usable(tracks, rig)

        def solve(association: Association, usable: BoolArray, rig: Rig) -> Rig:
            bundle = self._solve(association, usable, rig)
            self._reweigh(bundle)
            return bundle.rig

        mapper = IncrementalMapper(
            self.sightings,
            self.initial_rig,
            self._cameras,
            self._pose_noise.position_m,
            self._options,
            link,
            solve,
            coarse_model(self.initial_rig, self._noise_of_visits, self._options),
        )
        grown = mapper.run(progress)
        self.growth = tuple(mapper.growth)
        association = self._with_all_that_fit(grown.association, grown.rig)
        bundle = self._solve(association, self._usable(association, grown.rig), grown.rig)
        self._reweigh(bundle)
        return self._weigh_poses(self._fit_ground(bundle, progress))

    def _fit_ground(self, bundle: Bundle, progress: Callable[[str], None]) -> Bundle:
        """The solve over the ground that the drive shows, if it is not to be a plane."""
        if self._options.ground not in (CROSS_SECTION, SURFACE):
            return bundle
        progress("surface of the ground")
        surface = self._ground(bundle, None)
        for _ in range(_GROUND_ROUNDS):
            surface, _, step_m = self._better_ground(bundle, self._ground(bundle, surface))
            self.surface, self.sightings = surface, surface.flattened(self._seen, bundle.rig)
            association = self._associate(bundle.rig)
            bundle = self._solve(association, self._usable(association, bundle.rig), bundle.rig)
            self._reweigh(bundle)
            if step_m < _SETTLED_M:
                break
        _log.info("%s: %s", ", ".join(self.camera_names), surface.sentence)
        return bundle

    def _ground(self, bundle: Bundle, surface: Surface | None) -> Surface:
        """``surface``, or else the level, along the path that ``bundle`` found."""
        paths = Paths.of(bundle.rig.map_from_vehicle, self._seen.visit)
        spline = self._options.ground != CROSS_SECTION
        return Surface.level(paths, spline) if surface is None else replace(surface, paths=paths)

    def _better_ground(self, bundle: Bundle, surface: Surface) -> tuple[Surface, float, float]:
        """The likeliest ground from ``surface`` under ``bundle``, its gain, and the step of its heights."""
        points_map = bundle.solution.corners_map[bundle.problem.observations.corner]
        columns = surface.seen_columns(points_map, self._seen.frame[bundle.row])
        better, gain = surface.estimated(*height_information(bundle.solution, columns), self._recorded)
        step_m = columns @ (better.parameters - surface.parameters)
        return better, gain, float(np.sqrt(np.mean(step_m**2)))

    def ground_gain(self, bundle: Bundle) -> float:
        """How much better than its plane a surface would explain ``bundle``, less what noise would (AIC)."""
        return self._better_ground(bundle, self._ground(bundle, None))[1]

    def _locate(self, rig: Rig) -> Located:
        """Ground positions, restricted to the range within which sightings make groups."""
        located = locate(self.sightings, rig)
        with np.errstate(invalid="ignore"):
            near = located.range_m <= self._options.max_range_m
        return replace(located, valid=located.valid & near, informs=located.informs & near)

    def _usable(self, association: Association, rig: Rig) -> BoolArray:
        """Corners (S, 4) that a joint solve may use, given where their groups are."""
        jitter_rad = self._pose_noise.roll_pitch_rad
        return in_view(association, locate(self.sightings, rig), self.sightings, rig, jitter_rad)

    def _track(self, rig: Rig, located: Located, direction_rad: float) -> Association:
        noise = self._pose_noise
        uncertainty = Uncertainty(direction_rad, noise.roll_pitch_rad, noise.position_m)
        return build_tracks(self.sightings, located, rig, uncertainty, self._options.association)

    def _associate(self, rig: Rig) -> Association:
        """Tracks under an optimised ``rig``, merged across gaps, laps and cameras."""
        options = self._options.association
        located = self._locate(rig)
        tracks = self._track(rig, located, options.refined_sigma_rad)
        fused = fuse_groups(tracks, located, self._pose_noise.roll_pitch_rad)
        range_m = float(np.median(located.range_m[located.valid]))
        direction_m = options.refined_sigma_rad * range_m**2 / float(np.median(rig.height_m))
        merged = merge_groups(
            tracks,
            self.sightings,
            fused,
            floor_m=float(np.hypot(self._pose_noise.position_m, direction_m)),
            gate_sigmas=options.gate_sigmas,
            max_distance_m=options.max_gate_m,
            shape_tolerance=options.shape_tolerance,
        )
        return self._with_all_that_fit(merged, rig)

    def _with_all_that_fit(self, association: Association, rig: Rig) -> Association:
        """The groups with those sightings without one, however far off, that fit one of them alone."""
        jitter_rad = self._pose_noise.roll_pitch_rad
        fused = fuse_groups(association, self._locate(rig), jitter_rad)
        return attach(association, self.sightings, locate(self.sightings, rig), rig, fused, jitter_rad)

    def _solve_steep(self, tracks: Association) -> Bundle:
        located = self._locate(self.initial_rig)
        sine = np.where(located.valid, located.sine_depression, np.nan)
        threshold = min(_STEEP_SINE, float(np.nanmedian(sine)))
        with np.errstate(invalid="ignore"):
            steep = located.valid & (sine >= threshold)
        return self._solve(tracks, steep, self.initial_rig, coarse=True)

    def _solve(
        self,
        association: Association,
        usable: BoolArray,
        rig: Rig,
        coarse: bool = False,
        lanes: tuple[Knots, FloatArray] | None = None,
    ) -> Bundle:
        noises, options = self._noise_of_visits, self._options
        model = (
            coarse_model(rig, noises, options)
            if coarse
            else full_model(self._pose_sigma, options, self.pose_model, self._variance_factor)
        )
        bundle = solve_bundle(self.sightings, association, usable, rig, self._cameras, model, lanes)
        status = bundle.solution.status
        if status is Status.UNDETERMINED or not np.isfinite(bundle.solution.corners_map).all():
            raise MappingError(f"the joint optimisation failed ({status.value}): {status.advice}")
        return bundle

    def _weigh_poses(self, bundle: Bundle) -> Bundle:
        """The solve under the larger of the noise that was stated and that which ``bundle`` shows.

        The positions' stays as stated: images do not see what moves the vehicle and its map alike.
        """
        stated = tuple(pose_sigma_of(one) for one in self._noise_of_visits)
        self._own_noise = estimate_noise(replace(bundle.problem, pose_sigma=stated), bundle.solution)
        self._pose_sigma = tuple(_larger(one, own) for one, own in zip(stated, self._own_noise, strict=True))
        bundle = self._solve(bundle.association, self._usable(bundle.association, bundle.rig), bundle.rig)
        self._reweigh(bundle)
        return bundle

    @property
    def pose_noise(self) -> dict[str, float]:
        """How many times as large as stated the drive shows the noise of the poses to be, by kind."""
        own = [self._own_noise, [pose_sigma_of(one) for one in self._noise_of_visits]]
        kinds = ("position_m", "heading_rad", "roll_pitch_rad")
        totals = {kind: [max(getattr(one, kind) for one in sigmas) for sigmas in own] for kind in kinds}
        return {kind: found / stated for kind, (found, stated) in totals.items() if stated > 0}

    def _reweigh(self, bundle: Bundle) -> None:
        """Scale the observations' variances as their residuals under ``bundle`` say."""
        if len(bundle.row) >= LEAST_OBSERVATIONS:
            factor = self._variance_factor * bundle.solution.observation_factor
            self._variance_factor = float(np.clip(factor, *VARIANCE_FACTORS))

    def _as_stated(self, bundle: Bundle) -> Problem:
        """The problem of ``bundle`` from where that ended, with the detector's own covariances.

        What is left of errors that no model knows must not shrink with them.
        """
        seen = bundle.problem.observations
        stated = replace(seen, covariance_px=seen.covariance_px / bundle.model.variance_factor)
        return replace(bundle.problem, cam_from_vehicle=bundle.solution.cam_from_vehicle, observations=stated)

    def _choose_pose_model(self, bundle: Bundle) -> str:
        """The name of the model that predicts held-out observations best, from where ``bundle`` ended."""
        try:
            selection = select_model(self._as_stated(bundle), bundle.model.solver)
        except AdjustError as failure:
            _log.warning("the pose model stays %r, since none could be chosen: %s", _SETTLED_MODEL, failure)
            return _SETTLED_MODEL
        _log.info("%s: %s", ", ".join(self.camera_names), selection.sentence)
        self.held_out = selection.scores
        return selection.name


def _larger(stated: PoseSigma, own: PoseSigma) -> PoseSigma:
    """``stated``, with the noise of height, attitude or heading that a drive shows where that is larger."""
    kinds = {
        "height_m": ("height_m",),
        "roll_pitch_rad": ("roll_pitch_rad", "roll_pitch_drift"),
        "heading_rad": ("heading_rad", "heading_drift"),
    }
    larger = [names for kind, names in kinds.items() if getattr(own, kind) > getattr(stated, kind)]
    return replace(stated, **{name: getattr(own, name) for names in larger for name in names})


def initial_rig(cameras: Mapping[str, Camera], map_from_vehicle: FloatArray) -> Rig:
    """The extrinsics nearest to each camera's initial IPM, with the recorded poses (F, 4, 4)."""
    intrinsic = np.stack([camera.info.intrinsic for camera in cameras.values()])
    ipm = np.stack([camera.ipm[camera.initial_ipm] for camera in cameras.values()])
    start = extrinsic_from_ipm(torch.tensor(intrinsic), torch.tensor(ipm)).numpy()
    return Rig(intrinsic, start, map_from_vehicle)


def rolling(rig: Rig, cameras: Iterable[Camera], sightings: Sightings, estimate: bool) -> Rig:
    """``rig`` with its cameras' read-out times; as it is where all are 0 and none is to be estimated."""
    stated_s = read_outs_s(cameras)
    if stated_s is None and not estimate:
        return rig
    twists = vehicle_twists(sightings.map_from_vehicle, sightings.stamp_s, sightings.visit)
    read_out_s = np.zeros(len(rig.intrinsic)) if stated_s is None else stated_s
    return replace(rig, read_out_s=read_out_s, twist_vehicle=twists)
