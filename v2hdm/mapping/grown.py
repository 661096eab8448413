"""From an incremental map to its outcome: the accepted markings, the calibrations, how it grew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.gating import as_of_point, noise_scale
from v2hdm.adjust.incremental import IncrementalMap
from v2hdm.adjust.observability import observed
from v2hdm.adjust.problem import on_line
from v2hdm.geometry.rigid import exp
from v2hdm.mapping.association.groups import Association
from v2hdm.mapping.markings.conclude import Observed, reprojected, residuals_under, root_mean_square
from v2hdm.mapping.markings.relative import with_relative_sigma
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.mapping.results import Exclusion, GrowthStep
from v2hdm.mapping.sightings.rig import Rig
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.mapping.sightings.views import Views
from v2hdm.mapping.site_model.places import Places
from v2hdm.mapping.site_model.verdict import Seen, judge
from v2hdm.records import BoolArray, Calibration, Camera, FloatArray, IntArray, Marking

# Squared distance that one sound observation in ten thousand exceeds (2 degrees of freedom).
_INLIER_SQUARED = 18.4


@dataclass
class Place:
    """Where a marking is kept: the unit, and which of its corners (4,) are the marking's, -1 if none.

    ``images`` are those that showed it, ``point`` (4,) the corners that they showed as points; ``preview``
    (4, 2) is where these lay before its unit was solved.
    """

    unit: int
    corner: IntArray
    kind: int
    images: set[int]
    point: BoolArray
    preview: FloatArray


@dataclass(frozen=True)
class Grown:
    """What the drive has left behind.

    ``rig`` holds the final extrinsics and poses; ``grown`` goes on with the next drive. Sightings are part
    of markings as ``association`` says, as far as their corners are ``usable`` (S, 4). Reprojection errors
    are root mean squares over the points among the accepted ``observations`` of accepted markings, under the
    final and the initial extrinsics.
    """

    grown: IncrementalMap
    rig: Rig
    association: Association
    usable: BoolArray
    observations: int
    variance_factor: float
    chi2_per_dof: float
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    calibrations: Mapping[str, Calibration]
    certainty: Mapping[str, str]
    reprojection_rmse_px: float
    initial_reprojection_rmse_px: float
    growth: tuple[GrowthStep, ...]


@dataclass(frozen=True)
class Taken:
    """Which sightings a map was grown from: the marking of each, and its usable corners (S, 4).

    ``initial_rig`` is where it began, ``jitter_rad`` how far the recorded attitude is off. ``floor_px`` was
    added in quadrature to the observations' covariances, and the sum taken ``variance_factor`` times.
    """

    sightings: Sightings
    association: Association
    usable: BoolArray
    views: Views
    cameras: Mapping[str, Camera]
    initial_rig: Rig
    jitter_rad: float
    floor_px: float
    variance_factor: float


def corners_of(grown: IncrementalMap, place: Place) -> FloatArray:
    """Corners (4, 2) of a marking under the present extrinsics, nan where unknown."""
    out = np.full((4, 2), np.nan)
    known = place.corner >= 0
    out[known] = grown.corners_map(place.unit)[place.corner[known]]
    return out


def solved_places(grown: IncrementalMap, places: Sequence[Place], scale: float = 1.0) -> Places:
    """All corners and their covariances, times ``scale``."""
    corners, covariance = np.full((len(places), 4, 2), np.nan), np.full((len(places), 8, 8), np.nan)
    by_unit = {unit: scale * one for unit, one in grown.corner_covariances().items()}
    for marking, place in enumerate(places):
        corners[marking] = corners_of(grown, place)
        known = np.flatnonzero(place.corner >= 0)
        rows, own = (2 * at[:, None] + np.arange(2) for at in (known, place.corner[known]))
        block = by_unit[place.unit][np.ix_(own.ravel(), own.ravel())]
        covariance[marking][np.ix_(rows.ravel(), rows.ravel())] = block
    return Places.seen(corners, covariance)


def growth_step(
    grown: IncrementalMap, places: Sequence[Place], names: Sequence[str], kinds: Sequence[str]
) -> GrowthStep:
    """The map as it is now; markings of which a corner is not known are left out.

    ``names`` are those of the cameras, ``kinds`` those of the classes that places are of.
    """
    solved = solved_places(grown, places)
    whole = np.flatnonzero(solved.known.all(axis=1)).tolist()
    markings = tuple(
        Marking(
            kind=kinds[places[m].kind],
            corners_map=solved.corners_map[m],
            sightings=len(places[m].images),
            covariance_m2=solved.covariance_m2[m],
        )
        for m in whole
    )
    return GrowthStep(markings, dict(zip(names, grown.cam_from_vehicle, strict=True)))


def conclude_grown(
    grown: IncrementalMap,
    places: Sequence[Place],
    rig: Rig,
    taken: Taken,
    growth: Sequence[GrowthStep],
    options: AcceptanceOptions,
) -> Grown:
    """Judge the markings as the batch does, and put the outcome together.

    Raises:
        MappingError: No marking is accepted.
    """
    association, names = taken.association, list(taken.cameras)
    corners_map = np.stack([corners_of(grown, place) for place in places] or [np.full((4, 2), np.nan)])
    seen = _observed(taken, corners_map)
    poses = _poses(grown, places, taken, seen)
    residual_px = reprojected(rig, poses, taken.sightings, association, seen, corners_map)
    agrees = _agrees(taken, seen, residual_px)
    scale = max(1.0, chi2_per_dof := grown.variance().all)
    judged = judge(solved_places(grown, places, scale), _evidence(places, rig, taken, seen, agrees), options)
    markings = _with_relative_sigma(grown, [places[m] for m in judged.accepted], judged.markings(), scale)
    accepted = agrees & np.isin(seen.group, judged.accepted)
    own_corner = association.corner_order()[seen.row, seen.corner]
    point = accepted & taken.sightings.valid[seen.row, own_corner]
    at_start = residuals_under(
        taken.initial_rig, taken.sightings, association, seen.only(point), taken.jitter_rad
    )
    covariance = grown.extrinsic_covariance
    known = observed(rig.cam_from_vehicle, covariance, grown.prior.centre_sigma_m)
    last = GrowthStep(markings, dict(zip(names, rig.cam_from_vehicle, strict=True)))
    return Grown(
        grown=grown,
        rig=rig,
        association=association,
        usable=taken.usable,
        observations=int(np.count_nonzero(accepted)),
        variance_factor=taken.variance_factor,
        chi2_per_dof=chi2_per_dof,
        markings=markings,
        excluded=judged.exclusions(),
        calibrations={
            name: Calibration(camera.info, rig.cam_from_vehicle[c], scale * covariance[c])
            for c, (name, camera) in enumerate(taken.cameras.items())
        },
        certainty={name: known[c].sentence(name) for c, name in enumerate(names)},
        reprojection_rmse_px=root_mean_square(residual_px[point]),
        initial_reprojection_rmse_px=root_mean_square(at_start),
        growth=(*(step for step in growth if len(step.markings) < len(markings)), last),
    )


def _evidence(places: Sequence[Place], rig: Rig, taken: Taken, seen: Observed, agrees: BoolArray) -> Seen:
    """What was seen of the places, of whose observations (K,) some ``agrees`` with the map."""
    return Seen(
        kind=np.array([place.kind for place in places], dtype=np.int64),
        sightings=taken.sightings,
        rig=rig,
        views=taken.views,
        cameras=tuple(taken.cameras.values()),
        row=seen.row,
        group=seen.group,
        accepted=agrees,
    )


def _with_relative_sigma(
    grown: IncrementalMap, places: Sequence[Place], markings: Sequence[Marking], scale: float
) -> tuple[Marking, ...]:
    """The markings with their relative standard deviations, beside others of their unit."""
    out = list(markings)
    for unit, formal in grown.corner_covariances().items():
        own = [m for m, place in enumerate(places) if place.unit == unit]
        covariance = scale * formal

        def joint(pairs: IntArray, covariance: FloatArray = covariance) -> FloatArray:
            rows = (2 * pairs[..., None] + np.arange(2)).reshape(len(pairs), -1)
            return np.asarray(covariance[rows[:, :, None], rows[:, None, :]])

        index = np.array([places[m].corner for m in own], dtype=np.int64).reshape(-1, 4)
        for m, marking in zip(
            own, with_relative_sigma([markings[m] for m in own], index, joint), strict=True
        ):
            out[m] = marking
    return tuple(out)


def _observed(taken: Taken, corners_map: FloatArray) -> Observed:
    """All observations of known corners (G, 4, 2)."""
    association = taken.association
    inside = association.in_group_order(taken.usable) & (association.group >= 0)[:, None]
    row, corner = np.nonzero(inside & np.isfinite(corners_map[association.group]).all(axis=2))
    return Observed(row, association.group[row], corner)


def _poses(grown: IncrementalMap, places: Sequence[Place], taken: Taken, seen: Observed) -> FloatArray:
    """The pose (K, 4, 4) of each observation, as the unit that its marking is part of has adjusted it."""
    frame = taken.sightings.frame[seen.row]
    unit = np.array([place.unit for place in places], dtype=np.int64)[seen.group]
    state = np.zeros((len(frame), 6))
    for number, settled in grown.markings.items():
        own = unit == number
        state[own] = settled.frame_state[np.searchsorted(settled.observations.frames.number, frame[own])]
    return np.asarray(taken.initial_rig.map_from_vehicle[frame] @ exp(state))


def _agrees(taken: Taken, seen: Observed, residual_px: FloatArray) -> BoolArray:
    """Which observations (K,) the map does not contradict."""
    own = taken.association.corner_order()[seen.row, seen.corner]
    noise = taken.sightings.covariance_px[seen.row, own] + taken.floor_px**2 * np.eye(2)
    noise = taken.variance_factor * noise
    squared = np.sum(residual_px * np.linalg.solve(noise, residual_px[..., None])[..., 0], axis=1)
    line = on_line(noise)
    squared[line] = as_of_point(squared[line])
    return np.asarray(squared < _INLIER_SQUARED * noise_scale(squared))
