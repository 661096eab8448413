"""One joint solve of groups of sightings, constrained by known sizes and surveyed corners."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.spatial import KDTree

from v2hdm.adjust import (
    MODELS,
    ControlPoints,
    Drift,
    GroundPlanes,
    KnownLengths,
    Observations,
    PoseSigma,
    Problem,
    Solution,
    SolveOptions,
    Verdict,
    solve,
    with_model,
)
from v2hdm.adjust.problem import ProblemPart
from v2hdm.association.ground import locate
from v2hdm.association.groups import Association, fuse_groups, group_kinds, known_elsewhere, line_only
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.errors import MappingError
from v2hdm.geometry.rigid import camera_centre
from v2hdm.geometry.twists import vehicle_twists
from v2hdm.lanes.knots import OPEN_END_PX, Knots
from v2hdm.mapping.options import MappingOptions, SizeOptions, SurveyOptions
from v2hdm.records import DIAMOND, HEAVE_SIGMA_M, BoolArray, Camera, FloatArray, IntArray, PoseNoise
from v2hdm.survey.match import match


def read_outs_s(cameras: Iterable[Camera]) -> FloatArray | None:
    """Stated read-out times (C,) of the cameras, s; None if all shutters are global."""
    stated_s = np.array([camera.read_out_s for camera in cameras])
    return stated_s if stated_s.any() else None


_UNSURVEYED_CENTRE_SIGMA_M = 0.3  # prior sigma, m, of an unsurveyed camera centre about that of a coarse IPM

LEAST_OBSERVATIONS = 200
"""Fewer residuals do not determine their variance."""

VARIANCE_FACTORS = (0.05, 20.0)
"""Limits of the correction of a detector's stated variance."""


@dataclass(frozen=True)
class Model:
    """The unknowns of a solve, and its noise besides the corners'.

    ``floor_px`` is added to every corner in quadrature, and the sum multiplied by ``variance_factor``.
    ``sizes`` and ``survey`` are the user's; ``clock_sigma_s`` is the prior of clock offsets, ``pose_sigma``
    that of each session's poses.
    """

    pose_sigma: tuple[PoseSigma, ...]
    floor_px: float
    solver: SolveOptions
    variance_factor: float = 1.0
    sizes: SizeOptions = field(default_factory=SizeOptions)
    survey: SurveyOptions = field(default_factory=SurveyOptions)
    clock_sigma_s: float = Problem.clock_sigma_s


@dataclass(frozen=True)
class Bundle:
    """A solved bundle and what its arrays refer to.

    ``rig`` has the adjusted extrinsics and poses, ``model`` states the unknowns. Observation k is corner
    ``corner`` (K,) of group ``group`` (K,) in row ``row`` (K,) of the sightings. ``corner_index`` (G, 4) is a
    corner's index in the solution, -1 with fewer than two observations. ``camera_index`` maps camera names to
    rows of the solution's extrinsics, ``frames`` (J,) are its poses'. Lanes are the problem's last corners
    and observations, in the order of ``knots``; the solution's values per observation are of the markings
    alone.
    """

    rig: Rig
    model: Model
    problem: Problem
    solution: Solution
    association: Association
    row: IntArray
    group: IntArray
    corner: IntArray
    corner_index: IntArray
    camera_index: Mapping[str, int]
    frames: IntArray
    knots: Knots | None = None

    @property
    def corners_map(self) -> FloatArray:
        """Adjusted corners (G, 4, 2), nan for corners outside the solution."""
        out = np.full((*self.corner_index.shape, 2), np.nan)
        solved = self.corner_index >= 0
        out[solved] = self.solution.corners_map[self.corner_index[solved]]
        return out

    @property
    def own_corner(self) -> IntArray:
        """Index (K,) of each observation's corner in its sighting."""
        return np.asarray(self.association.corner_order()[self.row, self.corner])

    @property
    def inliers(self) -> BoolArray:
        """Accepted observations (K,)."""
        return np.isin(self.solution.verdict, (Verdict.ACCEPTED, Verdict.UNCONFIRMED))


def full_model(
    pose_sigma: Sequence[PoseSigma], options: MappingOptions, poses: str, variance_factor: float = 1.0
) -> Model:
    """Every frame deviates from its recorded pose by the states of the pose model ``poses``."""
    solver = with_model(replace(_solver(options), coarse=False), MODELS[poses])
    sizes = options.known_sizes
    survey = options.survey
    return Model(tuple(pose_sigma), options.model_floor_px, solver, variance_factor, sizes, survey)


def pose_sigma_of(pose_noise: PoseNoise) -> PoseSigma:
    """Standard deviations of a drive's recorded poses, with heave."""
    return PoseSigma(
        position_m=pose_noise.position_m,
        heading_rad=pose_noise.heading_rad,
        roll_pitch_rad=pose_noise.roll_pitch_rad,
        height_m=HEAVE_SIGMA_M,
        position_drift=Drift(pose_noise.position_drift_m, pose_noise.position_drift_over_m),
        heading_drift=Drift(pose_noise.heading_drift_rad, pose_noise.heading_drift_over_m),
        roll_pitch_drift=Drift(pose_noise.roll_pitch_drift_rad, pose_noise.roll_pitch_drift_over_m),
        heading_slip=pose_noise.heading_slip,
    )


def coarse_model(rig: Rig, pose_noise: Sequence[PoseNoise], options: MappingOptions) -> Model:
    """Exact poses, with their errors as image noise: enough to separate markings."""
    focal_px = float(np.mean(rig.intrinsic[:, 0, 0]))
    turn_rad = max(float(np.hypot(noise.roll_pitch_rad, noise.heading_rad)) for noise in pose_noise)
    jitter_px = focal_px * turn_rad
    floor_px = float(np.hypot(options.model_floor_px, jitter_px))
    return Model(len(pose_noise) * (PoseSigma(),), floor_px, replace(_solver(options), pose_states=()))


def _solver(options: MappingOptions) -> SolveOptions:
    return SolveOptions(
        loss=options.loss,
        loss_scale=options.loss_scale,
        read_out=options.estimate_read_out,
        device=options.device,
    )


def solve_bundle(
    sightings: Sightings,
    association: Association,
    usable: BoolArray,
    rig: Rig,
    cameras: Mapping[str, Camera],
    model: Model,
    lanes: tuple[Knots, FloatArray] | None = None,
    is_near: bool = False,
) -> Bundle:
    """Estimate extrinsics, poses and the corners of all groups jointly, with ``lanes`` if any.

    Those are knots and the groups' approximate corners, which they need: rays to a knot have no common
    intersection. ``usable`` (S, 4), in the sightings' own order, selects corners. Extrinsics start from
    ``rig``, poses from the recorded ones, or those of a rig that ``is_near``, a solve of nearly the same.
    Raises MappingError if no corner was seen twice.
    """
    observed = _observed_corners(association, usable)
    row = observed.row
    corner_index = observed.corner_index
    if not len(row):
        raise MappingError(
            "no marking was seen in two images, so nothing can be optimised; drive past the markings "
            "more slowly or raise the image rate."
        )
    knots, corners_start = lanes or (None, None)
    on_line = known_elsewhere(association, sightings.valid & usable, usable)
    at = row, association.corner_order()[row, observed.corner]
    solved_corner = corner_index[observed.group, observed.corner]
    observations = observations_at(sightings, at, solved_corner, model, on_line)
    first = int(corner_index.max(initial=-1)) + 1
    if knots is not None:
        observations = _joined(observations, knots.observations(first))
    lengths, control = _constraints(sightings, association, usable, rig, corner_index, model)
    if knots is not None:
        held = knots.held(first)
        control = _held_also(control, held)
        corners_start = np.concatenate([corners_start, held.points_map])
    part = drive_problem(sightings, rig, cameras, model).seen_by(observations)
    twists = _twists(rig, sightings, part.frames)
    problem = replace(part.problem, lengths=lengths, control=control, twist_vehicle=twists)
    problem = replace(problem, corners_start=corners_start)
    if is_near:
        problem = replace(problem, poses_start=rig.map_from_vehicle[part.frames])
    solution = solve(problem, model.solver)
    return Bundle(
        rig=_adjusted(rig, sightings, solution, part),
        model=model,
        problem=problem,
        solution=solution if knots is None else _of_markings(solution, len(row)),
        association=association,
        row=row,
        group=observed.group,
        corner=observed.corner,
        corner_index=corner_index,
        camera_index={sightings.cameras[c]: k for k, c in enumerate(part.cameras.tolist())},
        frames=part.frames,
        knots=knots,
    )


def _twists(rig: Rig, sightings: Sightings, frames: IntArray) -> FloatArray:
    """Vehicle twists (J, 6) at the frames (J,) of a problem, along the path that ``rig`` was adjusted to.

    From pose to pose it errs less than the recorded one, whose noise would pass for motion that tells clocks.
    """
    return vehicle_twists(rig.map_from_vehicle[frames], sightings.stamp_s[frames], sightings.session[frames])


def _adjusted(rig: Rig, sightings: Sightings, solution: Solution, part: ProblemPart) -> Rig:
    """``rig`` with the solution's extrinsics and poses of the cameras and frames that are ``part`` of it."""
    cam_from_vehicle = rig.cam_from_vehicle.copy()
    map_from_vehicle = sightings.map_from_vehicle.copy()
    cam_from_vehicle[part.cameras] = solution.cam_from_vehicle
    map_from_vehicle[part.frames] = solution.map_from_vehicle
    adjusted = replace(rig, cam_from_vehicle=cam_from_vehicle, map_from_vehicle=map_from_vehicle)
    if rig.read_out_s is None:
        return adjusted
    read_out_s = rig.read_out_s.copy()
    read_out_s[part.cameras] = solution.read_out_s
    return replace(adjusted, read_out_s=read_out_s)


def observations_at(
    sightings: Sightings,
    at: tuple[IntArray, IntArray],
    corner: IntArray,
    model: Model,
    on_line: BoolArray | None = None,
) -> Observations:
    """Observations of ``corner`` (K,) by corners ``at`` (row, corner; K each) of the sightings.

    Corners ``on_line`` (S, 4) are observed across their line alone.
    """
    covariance_px = sightings.covariance_px[at]
    if on_line is not None:
        covariance_px[on_line[at]] = line_only(covariance_px[on_line[at]], OPEN_END_PX)
    return Observations(
        camera=sightings.camera[at[0]],
        frame=sightings.frame[at[0]],
        corner=corner,
        pinhole_px=sightings.corners_pinhole_px[at],
        covariance_px=model.variance_factor * (covariance_px + model.floor_px**2 * np.eye(2)),
        row_share=sightings.row_share[at],
    )


_OF_OBSERVATIONS = ("residual_px", "mahalanobis2", "verdict")
_Rows = TypeVar("_Rows", Observations, ControlPoints)


def _joined(rows: _Rows, more: _Rows) -> _Rows:
    """The ``rows``, then ``more`` of them."""
    added = vars(more)
    columns = {name: np.concatenate([column, added[name]]) for name, column in vars(rows).items()}
    return replace(rows, **columns)


def _held_also(control: ControlPoints | None, held: ControlPoints) -> ControlPoints:
    """Surveyed corners, if any, and the knots ``held``, which are held along axes of each."""
    if control is None:
        return held
    axes = np.tile([1.0, 0.0], (len(control.corner), 1))
    return _joined(replace(control, along=axes), held)


def _of_markings(solution: Solution, count: int) -> Solution:
    """The solution with values of its first ``count`` observations alone, which are of markings."""
    values = {name: getattr(solution, name)[:count] for name in _OF_OBSERVATIONS}
    return replace(solution, **values)


def drive_problem(sightings: Sightings, rig: Rig, cameras: Mapping[str, Camera], model: Model) -> Problem:
    """All cameras and frames of a drive with their priors, without observations."""
    none = np.zeros(0, dtype=np.int64)
    stated = [cameras[name] for name in sightings.cameras]
    # Camera centres are surveyed, or implied by the initial extrinsic.
    centre = camera_centre(rig.cam_from_vehicle)
    sigma = np.full_like(centre, _UNSURVEYED_CENTRE_SIGMA_M)
    for c, camera in enumerate(stated):
        if camera.centre_prior is not None:
            centre[c] = camera.centre_prior.centre_vehicle
            sigma[c] = camera.centre_prior.sigma_m
    return Problem(
        intrinsic=np.column_stack([rig.intrinsic[:, 0, 0], rig.intrinsic[:, 1, 1], rig.intrinsic[:, :2, 2]]),
        cam_from_vehicle=rig.cam_from_vehicle,
        map_from_vehicle=sightings.map_from_vehicle,
        observations=Observations(none, none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)),
        corner_count=0,
        centre_vehicle=centre,
        centre_sigma_m=sigma,
        pose_sigma=model.pose_sigma,
        twist_vehicle=vehicle_twists(sightings.map_from_vehicle, sightings.stamp_s, sightings.session),
        session=sightings.session,
        clock_sigma_s=model.clock_sigma_s,
        read_out_s=read_outs_s(stated),
        ground=_ground_of(stated),
    )


def _ground_of(cameras: Sequence[Camera]) -> GroundPlanes | None:
    """The ground that texture shows in the cameras, None if it shows none in any."""
    planes = [camera.ground_plane for camera in cameras]
    if not any(planes):
        return None
    out = GroundPlanes(*(np.zeros((len(planes), *shape)) for shape in ((4,), (3, 4), (2, 4))))
    for c, plane in enumerate(planes):
        if plane is not None:
            out.plane_cam[c] = plane.plane_cam
            out.root_information[c] = plane.root_information
            out.by_lens[c] = plane.by_lens
    return out


def _constraints(
    sightings: Sightings,
    association: Association,
    usable: BoolArray,
    rig: Rig,
    corner_index: IntArray,
    model: Model,
) -> tuple[KnownLengths | None, ControlPoints | None]:
    """Constraints from stated sizes and a survey; ``rig`` must be good enough to identify corners."""
    if not model.sizes.by_class_m and not model.survey.points:
        return None, None
    located = locate(sightings, rig)
    located = replace(located, valid=located.valid & usable, informs=located.informs & usable)
    fused = fuse_groups(association, located, jitter_rad=0.0)
    points_map = np.where(fused.valid[..., None], fused.corners_map, np.nan)
    # Surveyed points are matched under the least certain poses of all sessions.
    poses = max(model.pose_sigma, key=lambda sigma: sigma.position_m)
    kinds = group_kinds(association, sightings)
    return (
        known_lengths(model.sizes, [sightings.kinds[k] for k in kinds], points_map, corner_index),
        control_points(model.survey, points_map, corner_index, poses),
    )


class _Observed(NamedTuple):
    """The K observations of corners that were seen at least twice."""

    row: IntArray  # (K,) row in the sightings
    group: IntArray  # (K,) group of the row
    corner: IntArray  # (K,) corner of the group
    corner_index: IntArray  # (G, 4) number of each corner; -1 for one that was not seen twice


def _observed_corners(association: Association, usable: BoolArray) -> _Observed:
    """The observations of corners that at least two of the ``usable`` sightings (S, 4) see."""
    in_order = association.in_group_order(usable) & (association.group >= 0)[:, None]
    row, corner = np.nonzero(in_order)
    group = association.group[row]
    flat = group * 4 + corner
    number = np.full(4 * association.count, -1, dtype=np.int64)
    is_repeated = np.bincount(flat, minlength=4 * association.count) >= 2
    number[is_repeated] = np.arange(np.count_nonzero(is_repeated))
    observed = is_repeated[flat]
    return _Observed(row[observed], group[observed], corner[observed], number.reshape(-1, 4))


_DIAGONALS = (((0, 2),), ((1, 3),))
"""The pair of corners of each of a diamond's diagonals; the map decides which is the longer one."""

_SIDES = (((0, 1), (3, 2)), ((1, 2), (0, 3)))
"""Pairs of corners that are a marking's length or width apart; the map decides which."""


def known_lengths(
    sizes: SizeOptions, kind: Sequence[str], corners_map: FloatArray, corner_index: IntArray
) -> KnownLengths | None:
    """Distances between corners from stated sizes, None if there are none.

    For diamonds the sizes are of diagonals, for others of sides. A marking of another size is something else,
    or cut off, and unconstrained. ``kind`` (G,) is each group's class, ``corners_map`` (G, 4, 2) approximate,
    nan if unknown, ``corner_index`` (G, 4) the index in the adjustment, -1 for none.
    """
    lengths: list[tuple[int, int, float]] = []
    for name, size in sizes.by_class_m.items():
        spans = _DIAGONALS if name == DIAMOND else _SIDES
        for group in np.flatnonzero(np.array(kind) == name):
            corners = corners_map[group]
            distances_m = [[np.linalg.norm(corners[a] - corners[b]) for a, b in span] for span in spans]
            measured_m = np.array([np.mean(of_span_m) for of_span_m in distances_m])
            stated_m = np.array(size) if measured_m[0] >= measured_m[1] else np.array(size)[::-1]
            # Also false if a corner is unknown: then the longer direction is unknown too.
            if not (np.abs(measured_m - stated_m) <= sizes.tolerance * stated_m).all():
                continue
            for span, metres in zip(spans, stated_m, strict=True):
                ends = corner_index[group][np.array(span)]
                lengths += [(a, b, metres) for a, b in ends[(ends >= 0).all(axis=1)].tolist()]
    if not lengths:
        return None
    first, second, length_m = map(np.array, zip(*lengths, strict=True))
    return KnownLengths(first, second, length_m, np.full(len(lengths), sizes.sigma_m))


def control_points(
    survey: SurveyOptions, corners_map: FloatArray, corner_index: IntArray, poses: PoseSigma
) -> ControlPoints | None:
    """Corners of surveyed points, None if there are none; points out of reach are omitted.

    ``corners_map`` and ``corner_index`` are as in :func:`known_lengths`, ``poses`` the sigmas of recorded
    poses, whose drift neighbouring corners have in common.
    """
    points = np.array([point.position_map for point in survey.points], dtype=np.float64).reshape(-1, 2)
    sigma_m = np.array([point.sigma_m for point in survey.points], dtype=np.float64).reshape(-1, 2)
    mapped = (corner_index >= 0) & np.isfinite(corners_map).all(axis=-1)
    if not len(points) or not mapped.any():
        return None
    off_m, _ = KDTree(corners_map[mapped]).query(points)
    in_reach = np.flatnonzero(off_m <= survey.reach_m)
    covariance = _covariance(points[in_reach], sigma_m[in_reach], poses)
    corner_of = match(points[in_reach], corners_map[mapped], survey.reach_m, covariance)
    used = in_reach[corner_of >= 0]
    if not len(used):
        return None
    return ControlPoints(corner_index[mapped][corner_of[corner_of >= 0]], points[used], sigma_m[used])


def _covariance(points: FloatArray, sigma_m: FloatArray, poses: PoseSigma) -> FloatArray:
    """Joint covariance (2N, 2N), m^2, of corners minus points (N, 2), before the survey is applied."""
    drift = poses.position_drift
    apart_m = np.linalg.norm(points[:, None] - points, axis=-1)
    shared = drift.sigma**2 * np.exp(-apart_m / drift.over_m)
    single = (poses.position_m**2 - drift.sigma**2) * np.eye(len(points))
    return np.kron(shared + single, np.eye(2)) + np.diag(sigma_m.ravel() ** 2)


def name_of(survey: SurveyOptions, point_map: FloatArray) -> str:
    """Name of the survey's control point at ``point_map`` (2,)."""
    return next(point.id for point in survey.points if np.array_equal(point.position_map, point_map))


def without_corner(survey: SurveyOptions, control: ControlPoints | None) -> list[str]:
    """Names of the control points that ``control`` does not use."""
    used = set() if control is None else set(map(tuple, control.points_map.tolist()))
    return [point.id for point in survey.points if tuple(point.position_map) not in used]
