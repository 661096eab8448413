"""The joint optimisation: from sightings under a coarse IPM to a map and the cameras' extrinsics.

A coarse IPM displaces markings by more than their spacing, so association and solves alternate: tracks along
the drive are solved with steep rays only, which suffer least from a wrong extrinsic; under the new extrinsic
they are re-linked and merged; then everything is solved jointly, and again without outliers.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.adjust import (
    MIN_DEPRESSION_SINE,
    PoseSigma,
    Problem,
    SolveOptions,
    Status,
    estimate_noise,
    predicts_better,
    select_model,
)
from v2hdm.association.ground import Located, Views, locate
from v2hdm.association.groups import Association, attach, fuse_groups, in_view, merge_groups, same_groups
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.association.tracks import IPM_SIGMA_RAD, REFINED_SIGMA_RAD, build_tracks
from v2hdm.errors import AdjustError, MappingError
from v2hdm.faults.sensitivity import height_information, moves_with_heights
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.lanes.knots import Knots
from v2hdm.mapping.bundle import (
    LEAST_OBSERVATIONS,
    VARIANCE_FACTORS,
    Bundle,
    coarse_model,
    full_model,
    pose_sigma_of,
    read_outs_s,
    solve_bundle,
)
from v2hdm.mapping.conclusion import FinalSolve, Optimised, conclude
from v2hdm.mapping.options import AUTO, SURFACE, MappingOptions
from v2hdm.records import BoolArray, Camera, FloatArray, PoseNoise, Road, largest_noise
from v2hdm.site.standing import Grey
from v2hdm.surface.paths import Paths
from v2hdm.surface.planes import with_planes_over
from v2hdm.surface.prior import Recorded
from v2hdm.surface.surface import Surface

_log = logging.getLogger(__name__)

SETTLED_MODEL = "heave"  # pose model of the solves between associations: it omits no error of a pose
_STEEP_SINE = 0.15  # least sine of a ray's depression in the coarse stage, unless most rays are flatter

_LOOSE_CLOCK_SIGMA_S = 0.3
"""Prior sigma of clock offsets, s, once a drive shows them: half a period of a slow receiver."""

_ROUGH_GAP = 3e-4
"""Decrease still possible, a fraction of the cost, at which solves before another end: a tenth of a sigma."""

_GROUND_ROUNDS = 6  # most solves over improving ground; four suffice for a crown of 4 %
_SETTLED_M = 1e-3  # RMS change of the observed heights at which the ground has converged


def silent(step: str) -> None:
    """Ignore progress."""


class _BetterGround(NamedTuple):
    """A more likely ground."""

    surface: Surface
    gain: float  # fall of the cost beyond that by noise
    step_m: float  # RMS change of the observed heights


class Optimiser:
    """Association and solves of one set of cameras."""

    def __init__(
        self,
        sightings: Sightings,
        views: Views,
        cameras: Mapping[str, Camera],
        pose_noise: Sequence[PoseNoise],
        options: MappingOptions,
        road: Road | None = None,
    ) -> None:
        """``pose_noise`` is by session; gates use the largest of each kind."""
        self._seen = sightings
        self.views = views
        self.sightings = sightings
        """The sightings, reduced to the plane."""
        self.surface: Surface | None = None
        """The ground, unless a plane."""
        self._cameras = {name: cameras[name] for name in sightings.cameras}
        self._noises = pose_noise
        self._pose_noise = largest_noise(pose_noise)
        self.stated_sigma = tuple(pose_sigma_of(noise) for noise in pose_noise)
        self._pose_sigma = self.estimated_sigma = self.stated_sigma
        self._options = options
        self._recorded = Recorded.of(road, self._pose_noise)
        self.pose_model = SETTLED_MODEL if options.pose_model == AUTO else options.pose_model
        """The pose model, one of :data:`v2hdm.adjust.MODELS`."""
        self._variance_factor = 1.0
        self.settled_gap = SolveOptions.gap_tolerance
        """Gap of the solve that settles, for whoever solves again to be had sooner."""
        self.held_out: Mapping[str, float] = {}
        self.camera_names = sightings.cameras
        start = initial_rig(self._cameras, sightings.map_from_vehicle)
        self.initial_rig = rolling(start, self._cameras.values(), sightings, options.estimate_read_out)

    def initial_tracks(self) -> Association:
        """Sightings linked from image to image under the initial IPMs."""
        located = self._locate(self.initial_rig)
        return self._track(self.initial_rig, located, IPM_SIGMA_RAD)

    def settle(self, tracks: Association, progress: Callable[[str], None] = silent) -> Bundle:
        """Alternate association and solves until the sightings' assignment to markings is stable."""
        progress("coarse solve")
        located = self._locate(self.initial_rig)
        sine = np.where(located.valid, located.depression_sine, -np.inf)
        least = _STEEP_SINE
        if located.valid.any():
            least = min(least, float(np.median(sine[located.valid])))
        bundle = self._solve(tracks, sine >= least, self.initial_rig, coarse=True)
        for number in range(1, self._options.rounds + 1):
            progress(f"joint solve {number}")
            association = self._associate(bundle.rig)
            # The coarse solve fixes the poses, on which no test of the inputs may rest.
            if number > 1 and same_groups(association, bundle.association):
                break
            bundle = self._solve_all(association, bundle.rig, gap=_ROUGH_GAP, is_near=number > 1)
        return self.settle_from(bundle, progress)

    def settle_from(
        self, bundle: Bundle, progress: Callable[[str], None] = silent, surface: Surface | None = None
    ) -> Bundle:
        """Settle ground and pose noise from a ``bundle`` of the same sightings.

        ``surface`` is its :meth:`likeliest_surface`, if known.
        """
        bundle = self._fit_ground(bundle, progress, surface)
        progress("noise of the poses")
        return self._weigh_poses(bundle)

    def finish(
        self,
        bundle: Bundle,
        progress: Callable[[str], None] = silent,
        find_knots: Callable[[Rig, Surface | None], Knots | None] = lambda rig, surface: None,
        grey: Grey | None = None,
    ) -> Optimised:
        """The candidates of :meth:`final_solve`, classified; raises MappingError if none is accepted."""
        return conclude(self.final_solve(bundle, progress, find_knots, grey), self._options.acceptance)

    def final_solve(
        self,
        bundle: Bundle,
        progress: Callable[[str], None] = silent,
        find_knots: Callable[[Rig, Surface | None], Knots | None] = lambda rig, surface: None,
        grey: Grey | None = None,
    ) -> FinalSolve:
        """Choose the pose model, and solve without the outliers of ``bundle`` from :meth:`settle`."""
        if self._options.pose_model == AUTO:
            progress("choice of the pose model")
            self.pose_model = self.choose_pose_model(bundle)
        progress("final solve")
        inlier = bundle.inliers
        usable = np.zeros_like(self.sightings.valid)
        usable[bundle.row[inlier], bundle.own_corner[inlier]] = True
        final = self._solve(bundle.association, usable, bundle.rig, is_near=True)
        knots = find_knots(final.rig, self.surface)
        if knots is not None and knots.count:
            progress("lanes")
            fit = final.solution.chi2_per_dof  # of markings: lines, whose variance is fitted, would dilute it
            count = int(final.corner_index.max(initial=-1)) + 1
            lanes = knots, final.solution.corners_map[:count]
            final = self._solve(final.association, usable, final.rig, lanes=lanes, is_near=True)
            final = replace(final, solution=replace(final.solution, chi2_per_dof=fit))
        return FinalSolve(
            bundle=self._with_errors_of_ground(final),
            ungated=bundle,
            inlier=inlier,
            usable=usable,
            sightings=self.sightings,
            views=self.views,
            cameras=self._cameras,
            initial_rig=self.initial_rig,
            jitter_rad=self._pose_noise.roll_pitch_rad,
            grey=grey,
            surface=self.surface,
        )

    def solve_alone(self, settled: Bundle, camera: str) -> Bundle:
        """The solve of what one camera observed of ``settled``, without the others.

        Raises MappingError where that camera saw no marking twice, AdjustError where the solve fails.
        """
        of_camera = self.sightings.camera[settled.row] == self.camera_names.index(camera)
        usable = np.zeros_like(self.sightings.valid)
        usable[settled.row[of_camera], settled.own_corner[of_camera]] = True
        return self._solve(settled.association, usable, settled.rig, is_near=True)

    def _with_errors_of_ground(self, bundle: Bundle) -> Bundle:
        """``bundle`` with covariances inflated by the uncertainty of its ground's heights."""
        if self.surface is None:
            return bundle
        frame = self._seen.frame[bundle.row]
        if bundle.knots is not None:
            frame = np.concatenate([frame, bundle.knots.frame])
        points_map = bundle.solution.corners_map[bundle.problem.observations.corner]
        held = moves_with_heights(bundle.solution, self.surface.seen_errors_m(points_map, frame))
        covariance = replace(bundle.solution.covariance, held=held)
        return replace(bundle, solution=replace(bundle.solution, covariance=covariance))

    def clock_offsets_s(self, bundle: Bundle) -> list[dict[str, float]]:
        """Clock offsets by session and camera from a solve with a weak prior, started at ``bundle``."""
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
        """Whether ``bundle``, on a surface, predicts held-out observations better than on the plane."""
        problem = self._as_stated(bundle)
        pinhole_px = self._seen.corners_pinhole_px[bundle.row, bundle.own_corner]
        flat = replace(problem, observations=replace(problem.observations, pinhole_px=pinhole_px))
        try:
            return predicts_better(problem, flat, bundle.model.solver)
        except AdjustError as failure:
            _log.warning("the ground stays a plane, since no surface could be fitted: %s", failure)
            return False

    def grow(self, progress: Callable[[str], None] = silent) -> Bundle:
        """Map track after track, as on the vehicle, in place of :meth:`settle`; then solve for all."""
        from v2hdm.mapping.incremental import IncrementalMapper

        def link(rig: Rig, coarse: bool) -> tuple[Association, BoolArray]:
            tracks = self._track(rig, self._locate(rig), IPM_SIGMA_RAD if coarse else REFINED_SIGMA_RAD)
            return tracks, self._usable(tracks, rig)

        mapper = IncrementalMapper(
            self.sightings,
            self.initial_rig,
            self._cameras,
            self._pose_noise.position_m,
            self._options,
            link,
            lambda association, usable, rig: self._solve_all(association, rig, usable).rig,
            coarse_model(self.initial_rig, self._noises, self._options),
        )
        association, rig = mapper.run(progress)
        association = self._with_all_that_fit(association, rig, locate(self.sightings, rig))
        bundle = self._solve_all(association, rig)
        return self.settle_from(bundle, progress)

    def _fit_ground(self, bundle: Bundle, progress: Callable[[str], None], surface: Surface | None) -> Bundle:
        """The solve on the drive's ground, unless a plane."""
        if self._options.ground != SURFACE:
            return bundle
        progress("surface of the ground")
        step_m = np.inf
        for number in range(_GROUND_ROUNDS):
            if number or surface is None:
                better = self._better_ground(bundle, surface)
                surface = better.surface
                step_m = better.step_m
            self.surface = surface
            self.sightings = surface.flattened(self._seen, bundle.rig)
            bundle = self._solve_all(self._associate(bundle.rig), bundle.rig)
            if step_m < _SETTLED_M:
                break
        if surface is not None:
            _log.info("%s: %s", ", ".join(self.camera_names), surface.sentence)
        return bundle

    def _better_ground(self, bundle: Bundle, surface: Surface | None) -> _BetterGround:
        """The most likely ground under ``bundle``, starting from ``surface`` or level."""
        paths = Paths.of(bundle.rig.map_from_vehicle, self._seen.session)
        surface = Surface.level(paths) if surface is None else replace(surface, paths=paths)
        points_map = bundle.solution.corners_map[bundle.problem.observations.corner]
        columns = surface.seen_columns(points_map, self._seen.frame[bundle.row])
        information, score = height_information(bundle.solution, columns)
        better, gain = surface.estimated(information, score, self._recorded)
        step_m = columns @ (better.parameters - surface.parameters)
        return _BetterGround(better, gain, float(np.sqrt(np.mean(step_m**2))))

    def likeliest_surface(self, bundle: Bundle) -> tuple[Surface, float]:
        """The most likely surface under ``bundle``, on the plane, and its gain.

        The gain is the improvement in cost over that expected from noise (AIC).
        """
        better = self._better_ground(bundle, None)
        return better.surface, better.gain

    def _locate(self, rig: Rig) -> Located:
        """Ground positions, restricted to the range within which sightings form groups."""
        return self._in_range(locate(self.sightings, rig))

    def _in_range(self, located: Located) -> Located:
        with np.errstate(invalid="ignore"):
            in_range = located.range_m <= self._options.max_range_m
        return replace(located, valid=located.valid & in_range, informs=located.informs & in_range)

    def _usable(self, association: Association, rig: Rig) -> BoolArray:
        """Corners (S, 4) that a joint solve may use, given the groups' positions.

        Their rays meet the ground under the poses of ``rig`` and under the recorded ones, from which a solve
        starts.
        """
        jitter_rad = self._pose_noise.roll_pitch_rad
        usable = in_view(association, locate(self.sightings, rig), self.sightings, rig, jitter_rad)
        recorded = replace(rig, map_from_vehicle=self.sightings.map_from_vehicle)
        meets_ground = locate(self.sightings, recorded).depression_sine > MIN_DEPRESSION_SINE
        return np.asarray(usable & meets_ground)

    def _track(self, rig: Rig, located: Located, direction_rad: float) -> Association:
        return build_tracks(self.sightings, located, rig, direction_rad, self._pose_noise)

    def _associate(self, rig: Rig) -> Association:
        """Tracks under an optimised ``rig``, merged across gaps, laps and cameras."""
        anywhere = locate(self.sightings, rig)
        located = self._in_range(anywhere)
        tracks = self._track(rig, located, REFINED_SIGMA_RAD)
        fused = fuse_groups(tracks, located, self._pose_noise.roll_pitch_rad)
        range_m = float(np.median(located.range_m[located.valid]))
        direction_m = REFINED_SIGMA_RAD * range_m**2 / float(np.median(rig.height_m))
        floor_m = float(np.hypot(self._pose_noise.position_m, direction_m))
        merged = merge_groups(tracks, self.sightings, fused, floor_m=floor_m)
        return self._with_all_that_fit(merged, rig, anywhere)

    def _with_all_that_fit(self, association: Association, rig: Rig, located: Located) -> Association:
        """The groups plus ungrouped sightings, ``located`` at any range, that fit exactly one of them."""
        jitter_rad = self._pose_noise.roll_pitch_rad
        fused = fuse_groups(association, self._in_range(located), jitter_rad)
        return attach(association, self.sightings, located, rig, fused, jitter_rad)

    def _solve(
        self,
        association: Association,
        usable: BoolArray,
        rig: Rig,
        coarse: bool = False,
        lanes: tuple[Knots, FloatArray] | None = None,
        gap: float = SolveOptions.gap_tolerance,
        is_near: bool = False,
    ) -> Bundle:
        """Solve; ``is_near`` says that the rig is from a solve of nearly the same."""
        noises = self._noises
        options = self._options
        model = (
            coarse_model(rig, noises, options)
            if coarse
            else full_model(self._pose_sigma, options, self.pose_model, self._variance_factor)
        )
        model = replace(model, solver=replace(model.solver, gap_tolerance=gap))
        cameras: Mapping[str, Camera] = self._cameras
        if self.surface is not None:
            cameras = with_planes_over(self.surface, cameras, rig.cam_from_vehicle, rig.map_from_vehicle)
        bundle = solve_bundle(self.sightings, association, usable, rig, cameras, model, lanes, is_near)
        status = bundle.solution.status
        if status is Status.UNDETERMINED or not np.isfinite(bundle.solution.corners_map).all():
            raise MappingError(f"the joint optimisation failed ({status.value}): {status.advice}")
        return bundle

    def _solve_all(
        self,
        association: Association,
        rig: Rig,
        usable: BoolArray | None = None,
        gap: float = SolveOptions.gap_tolerance,
        is_near: bool = False,
    ) -> Bundle:
        """Solve with the ``usable`` corners (S, 4), by default all, and refit the observations' variance."""
        usable = self._usable(association, rig) if usable is None else usable
        bundle = self._solve(association, usable, rig, gap=gap, is_near=is_near)
        if len(bundle.row) >= LEAST_OBSERVATIONS:
            factor = self._variance_factor * bundle.solution.observation_factor
            least, largest = VARIANCE_FACTORS
            self._variance_factor = float(np.clip(factor, least, largest))
        return bundle

    def _weigh_poses(self, bundle: Bundle) -> Bundle:
        """The solve under the larger of stated and estimated noise; positions', unobservable, as stated."""
        stated = self.stated_sigma
        estimated = estimate_noise(replace(bundle.problem, pose_sigma=stated), bundle.solution)
        self.estimated_sigma = estimated
        self._pose_sigma = tuple(map(larger_noise, stated, estimated))
        return self._solve_all(bundle.association, bundle.rig, gap=self.settled_gap, is_near=True)

    @property
    def variance_factor(self) -> float:
        """The residuals' variance over the detector's stated one, as the last solve shows it."""
        return self._variance_factor

    @property
    def pose_noise(self) -> dict[str, float]:
        """Estimated over stated pose noise, by kind."""

        def largest(sigmas: Sequence[PoseSigma], kind: str) -> float:
            return max(float(getattr(sigma, kind)) for sigma in sigmas)

        kinds = ("position_m", "heading_rad", "roll_pitch_rad")
        estimated = {kind: largest(self.estimated_sigma, kind) for kind in kinds}
        stated = {kind: largest(self.stated_sigma, kind) for kind in kinds}
        return {kind: estimated[kind] / stated[kind] for kind in kinds if stated[kind] > 0}

    def _as_stated(self, bundle: Bundle) -> Problem:
        """The problem of ``bundle``, from its end, with the detector's own covariances."""
        observations = bundle.problem.observations
        covariance_px = observations.covariance_px / bundle.model.variance_factor
        return replace(
            bundle.problem,
            cam_from_vehicle=bundle.solution.cam_from_vehicle,
            observations=replace(observations, covariance_px=covariance_px),
        )

    def choose_pose_model(self, bundle: Bundle) -> str:
        """Name of the model that best predicts held-out observations, from the end of ``bundle``."""
        try:
            selection = select_model(self._as_stated(bundle), bundle.model.solver)
        except AdjustError as failure:
            _log.warning("the pose model stays %r, since none could be selected: %s", SETTLED_MODEL, failure)
            return SETTLED_MODEL
        _log.info("%s: %s", ", ".join(self.camera_names), selection.sentence)
        self.held_out = selection.scores
        return selection.name


def larger_noise(stated: PoseSigma, estimated: PoseSigma) -> PoseSigma:
    """``stated`` with the ``estimated`` noise of height, attitude or heading where larger."""
    kinds = {
        "height_m": ("height_m",),
        "roll_pitch_rad": ("roll_pitch_rad", "roll_pitch_drift"),
        "heading_rad": ("heading_rad", "heading_drift"),
    }
    larger = [names for kind, names in kinds.items() if getattr(estimated, kind) > getattr(stated, kind)]
    return replace(stated, **{name: getattr(estimated, name) for names in larger for name in names})


def initial_rig(cameras: Mapping[str, Camera], map_from_vehicle: FloatArray) -> Rig:
    """Extrinsics nearest to each camera's initial IPM, with the recorded poses (F, 4, 4)."""
    intrinsic = np.stack([camera.info.intrinsic for camera in cameras.values()])
    return Rig(
        intrinsic, np.stack([initial_extrinsic(camera) for camera in cameras.values()]), map_from_vehicle
    )


def rolling(rig: Rig, cameras: Iterable[Camera], sightings: Sightings, estimate: bool) -> Rig:
    """``rig`` with its cameras' read-out times; unchanged if all are 0 and none is estimated."""
    stated_s = read_outs_s(cameras)
    if stated_s is None and not estimate:
        return rig
    twists = vehicle_twists(sightings.map_from_vehicle, sightings.stamp_s, sightings.session)
    read_out_s = np.zeros(len(rig.intrinsic)) if stated_s is None else stated_s
    return replace(rig, read_out_s=read_out_s, twist_vehicle=twists)
