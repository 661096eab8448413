"""The joint optimisation: from sightings under a coarse IPM to a map and the cameras' extrinsics.

A coarse IPM misplaces markings by more than they lie apart, so associating and solving take turns:
tracks along the drive are solved with steep rays only, which a wrong extrinsic hurts least; under
the extrinsic found, the tracks are linked anew and those that coincide are merged; then everything
is solved together, and again without the observations that contradict the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from v2hdm.adjust import Status
from v2hdm.errors import MappingError
from v2hdm.geometry.ground import extrinsic_from_ipm
from v2hdm.mapping.acceptance import Candidates, judge
from v2hdm.mapping.association import Association, fuse_groups, same_groups
from v2hdm.mapping.bundle import Bundle, coarse_model, full_model, solve_bundle
from v2hdm.mapping.location import Located, Rig, build_rig, locate
from v2hdm.mapping.merge import group_kinds, merge_groups
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import Exclusion
from v2hdm.mapping.sightings import Sightings
from v2hdm.mapping.tracks import Uncertainty, build_tracks
from v2hdm.mapping.views import Views, easy_views, project_ground
from v2hdm.records import (
    CORNERED_CLASSES,
    BoolArray,
    Calibration,
    Camera,
    CameraInfo,
    FloatArray,
    Marking,
    PoseNoise,
)

IntArray = NDArray[np.int64]

STEEP_SINE = 0.15
"""Sine of a ray's depression from which the coarse stage uses it (unless most rays are flatter)."""

INLIER_GATE2 = 18.4
"""Squared Mahalanobis distance that one sound observation in 10,000 exceeds (2 degrees of freedom)."""


@dataclass(frozen=True)
class Optimised:
    """The outcome of the joint optimisation.

    ``rig`` holds the adjusted extrinsics and poses; ``association`` which sightings make up which
    candidate; reprojection errors are root mean squares over the same accepted observations, under
    the optimised and under the initial extrinsics.
    """

    bundle: Bundle
    markings: tuple[Marking, ...]
    excluded: tuple[Exclusion, ...]
    calibrations: Mapping[str, Calibration]
    reprojection_rmse_px: float
    initial_reprojection_rmse_px: float


class Optimiser:
    """Takes one set of cameras through association and solving."""

    def __init__(
        self,
        sightings: Sightings,
        views: Views,
        cameras: Mapping[str, Camera],
        pose_noise: PoseNoise,
        options: MappingOptions,
    ) -> None:
        self._sightings = sightings
        self._views = views
        self._cameras = {name: cameras[name] for name in sightings.cameras}
        self._pose_noise = pose_noise
        self._options = options
        self.initial_rig = initial_rig(self._cameras, sightings.map_from_vehicle)

    def initial_tracks(self) -> Association:
        """Sightings linked from image to image under the initial IPMs."""
        located = self._locate(self.initial_rig)
        return self._track(self.initial_rig, located, self._options.association.ipm_sigma_rad)

    def run(self, tracks: Association, progress: Callable[[str], None] | None = None) -> Optimised:
        """Optimise from ``tracks`` (see :meth:`initial_tracks`); ``progress`` gets each step's name."""
        tell = progress or _silent
        tell("coarse solve")
        bundle = self._solve_steep(tracks)
        for number in range(1, self._options.rounds + 1):
            tell(f"joint solve {number}")
            association = self._associate(bundle.rig)
            if same_groups(association, bundle.association):
                break
            bundle = self._solve(association, self._locate(bundle.rig).valid, bundle.rig)
        tell("final solve")
        gated, inlier = self._gate(bundle)
        final = self._solve(bundle.association, gated, bundle.rig)
        return self._conclude(final, bundle, inlier)

    def _locate(self, rig: Rig) -> Located:
        """Ground positions, restricted to the range within which observations are used."""
        located = locate(self._sightings, rig)
        with np.errstate(invalid="ignore"):
            located.valid[:] &= located.range_m <= self._options.max_range_m
        return located

    def _track(self, rig: Rig, located: Located, direction_rad: float) -> Association:
        noise = self._pose_noise
        uncertainty = Uncertainty(direction_rad, noise.roll_pitch_rad, noise.position_m)
        return build_tracks(self._sightings, located, rig, uncertainty, self._options.association)

    def _associate(self, rig: Rig) -> Association:
        """Tracks under an optimised ``rig``, merged across gaps, laps and cameras."""
        options = self._options.association
        located = self._locate(rig)
        tracks = self._track(rig, located, options.refined_sigma_rad)
        fused = fuse_groups(tracks, located, self._pose_noise.roll_pitch_rad)
        range_m = float(np.median(located.range_m[located.valid]))
        direction_m = options.refined_sigma_rad * range_m**2 / float(np.median(rig.height_m))
        return merge_groups(
            tracks,
            self._sightings,
            fused,
            floor_m=float(np.hypot(self._pose_noise.position_m, direction_m)),
            gate_sigmas=options.gate_sigmas,
            max_distance_m=options.max_gate_m,
            shape_tolerance=options.shape_tolerance,
        )

    def _solve_steep(self, tracks: Association) -> Bundle:
        located = self._locate(self.initial_rig)
        sine = np.where(located.valid, located.sine_depression, np.nan)
        threshold = min(STEEP_SINE, float(np.nanmedian(sine)))
        with np.errstate(invalid="ignore"):
            steep = located.valid & (sine >= threshold)
        return self._solve(tracks, steep, self.initial_rig, coarse=True)

    def _solve(self, association: Association, usable: BoolArray, rig: Rig, coarse: bool = False) -> Bundle:
        bundle = solve_bundle(
            self._sightings,
            association,
            usable,
            rig,
            self._cameras,
            coarse_model(rig, self._pose_noise, self._options)
            if coarse
            else full_model(self._pose_noise, self._options),
        )
        status = bundle.solution.status
        if status is Status.UNDETERMINED or not np.isfinite(bundle.solution.corners_map).all():
            raise MappingError(f"the joint optimisation failed ({status.value}): {status.advice}")
        return bundle

    def _gate(self, bundle: Bundle) -> tuple[BoolArray, BoolArray]:
        """Corners (S, 4) of accepted observations, and the verdict on each observation (K,)."""
        inlier = bundle.inliers(INLIER_GATE2)
        order = bundle.association.corner_order()
        usable = np.zeros_like(self._sightings.valid)
        row, corner = bundle.row[inlier], bundle.corner[inlier]
        usable[row, order[row, corner]] = True
        return usable, inlier

    def _conclude(self, final: Bundle, ungated: Bundle, inlier: BoolArray) -> Optimised:
        candidates, covariance = self._candidates(final, ungated, inlier)
        verdict = judge(candidates, self._options.acceptance)
        markings, excluded = [], []
        for group, reason in enumerate(verdict):
            kind = CORNERED_CLASSES[candidates.kind[group]]
            corners, count = candidates.corners_map[group], int(candidates.sightings[group])
            if reason is None:
                markings.append(Marking(kind, corners, count, covariance[group]))
            elif np.isfinite(corners).any():
                excluded.append(Exclusion(kind, np.nanmean(corners, axis=0), count, reason))
        if not markings:
            raise MappingError(_no_marking_message(excluded))
        accepted = np.array([reason is None for reason in verdict])[final.group]
        residual = final.solution.residual_px[accepted]
        return Optimised(
            bundle=final,
            markings=tuple(markings),
            excluded=tuple(excluded),
            calibrations=self._calibrations(final),
            reprojection_rmse_px=_rms(residual),
            initial_reprojection_rmse_px=_rms(self._initial_residuals(final)[accepted]),
        )

    def _candidates(self, final: Bundle, ungated: Bundle, inlier: BoolArray) -> tuple[Candidates, FloatArray]:
        association = final.association
        corners = final.corners_map
        covariance = corner_covariances(final)
        variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 4, 2).sum(axis=2)
        total = np.bincount(ungated.group, minlength=association.count)
        agreeing = np.bincount(ungated.group[inlier], minlength=association.count)
        seen = np.unique(np.stack([final.group, self._sightings.image[final.row]]), axis=1)
        easy = np.stack(easy_views(self._views, final.rig, list(self._cameras.values()), corners))
        found = np.isin(_pair_keys(easy), _pair_keys(seen))
        candidates = Candidates(
            kind=group_kinds(association, self._sightings),
            corners_map=corners,
            sigma_m=np.sqrt(np.max(variance, axis=1)),
            sightings=np.bincount(seen[0], minlength=association.count),
            inlier_share=agreeing / np.maximum(total, 1),
            easy_views=np.bincount(easy[0], minlength=association.count),
            easy_detections=np.bincount(easy[0, found], minlength=association.count),
        )
        return candidates, covariance

    def _calibrations(self, bundle: Bundle) -> dict[str, Calibration]:
        covariance = bundle.solution.extrinsic_covariance * max(1.0, bundle.solution.chi2_per_dof)
        return {
            name: Calibration(self._cameras[name].info, bundle.solution.cam_from_vehicle[c], covariance[c])
            for name, c in bundle.camera_index.items()
        }

    def _initial_residuals(self, bundle: Bundle) -> FloatArray:
        """Residuals (K, 2) of the bundle's observations under the initial extrinsics and poses."""
        located = locate(self._sightings, self.initial_rig)
        fused = fuse_groups(bundle.association, located, self._pose_noise.roll_pitch_rad)
        camera, frame = self._sightings.camera[bundle.row], self._sightings.frame[bundle.row]
        rig = self.initial_rig
        cam_from_map = rig.cam_from_vehicle[camera] @ np.linalg.inv(rig.map_from_vehicle[frame])
        points = fused.corners_map[bundle.group, bundle.corner]
        pixel, _ = project_ground(rig.intrinsic[camera], cam_from_map, points[:, None])
        own_corner = bundle.association.corner_order()[bundle.row, bundle.corner]
        return np.asarray(pixel[:, 0] - self._sightings.corners_pinhole_px[bundle.row, own_corner])


def initial_rig(cameras: Mapping[str, Camera], map_from_vehicle: FloatArray) -> Rig:
    """The extrinsics nearest to each camera's initial IPM, with the recorded poses (F, 4, 4)."""
    start = {
        name: nearest_extrinsic(camera.info, camera.ipm[camera.initial_ipm])
        for name, camera in cameras.items()
    }
    return build_rig({name: camera.info for name, camera in cameras.items()}, start, map_from_vehicle)


def nearest_extrinsic(info: CameraInfo, ipm: FloatArray) -> FloatArray:
    """The rigid ``cam_from_vehicle`` (4 x 4) that comes closest to an IPM (3 x 3)."""
    matrix = torch.from_numpy(np.asarray(ipm, dtype=np.float64))
    return np.asarray(extrinsic_from_ipm(torch.from_numpy(info.intrinsic), matrix).numpy())


def corner_covariances(bundle: Bundle) -> FloatArray:
    """Covariances (G, 8, 8), m^2, of each group's stacked corners; nan where a corner is missing.

    They are scaled by chi^2 per degree of freedom where that exceeds one: residuals larger than
    their stated noise make the map less certain than the noise model claims.
    """
    out = np.full((len(bundle.corner_index), 8, 8), np.nan)
    whole = np.flatnonzero((bundle.corner_index >= 0).all(axis=1))
    if len(whole):
        covariance = bundle.solution.corner_covariance(bundle.corner_index[whole])
        out[whole] = max(1.0, bundle.solution.chi2_per_dof) * covariance
    return out


def _pair_keys(pairs: IntArray) -> IntArray:
    """One number per column of ``pairs`` (2, P)."""
    return np.asarray(pairs[0] * (1 << 32) + pairs[1])


def _rms(residual_px: FloatArray) -> float:
    """Root mean square length of residuals (K, 2); those that cannot be projected are left out."""
    squared = np.sum(residual_px**2, axis=1)
    return float(np.sqrt(np.mean(squared[np.isfinite(squared)]))) if len(squared) else float("nan")


def _no_marking_message(excluded: Sequence[Exclusion]) -> str:
    reasons = [exclusion.reason for exclusion in excluded]
    commonest = max(set(reasons), key=reasons.count) if reasons else "nothing was seen twice"
    return (
        f"none of {len(reasons)} candidate markings could be accepted (most often: {commonest}); check the "
        "camera's IPM, the detector and that the drive passes its markings closely."
    )


def _silent(step: str) -> None:
    """Ignore progress."""
