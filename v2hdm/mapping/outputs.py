"""What an optimisation leaves besides map and mountings: poses, clocks, residuals, joint covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.adjust import Fault
from v2hdm.io.maps.evidence import Residuals
from v2hdm.mapping.markings.conclude import Optimised
from v2hdm.mapping.remedy import Outcome
from v2hdm.mapping.results import AdjustedPoses, ClockOffset
from v2hdm.mapping.sightings.table import frames_of
from v2hdm.records import FloatArray, IntArray, Marking


def adjusted_poses(outcome: Outcome) -> AdjustedPoses:
    """The poses of all frames of the drive."""
    drive, sightings, bundle = outcome.inputs.drive, outcome.inputs.sightings, outcome.bundle
    sigma = np.stack([one.by_state() for one in bundle.model.pose_sigma])[sightings.visit]
    used = np.unique(sightings.frame[bundle.row])
    if bundle.model.solver.pose_states:
        inflation = max(1.0, bundle.solution.chi2_per_dof)
        sigma[used] = np.sqrt(bundle.solution.covariance.poses() * inflation)
    seen = np.zeros(len(sightings.stamp_s), dtype=bool)
    seen[used] = True
    frames = frames_of(drive).frame_of_image
    return AdjustedPoses(
        stamp_s=sightings.stamp_s,
        before=sightings.map_from_vehicle,
        map_from_vehicle=bundle.rig.map_from_vehicle,
        sigma=sigma,
        seen=seen,
        frame={image.path: int(frame) for image, frame in zip(drive.images, frames, strict=True)},
        visit=sightings.visit,
    )


def clock_offsets(outcome: Outcome) -> tuple[dict[str, ClockOffset], ...]:
    """Of each visit each camera's clock offset: what its images were moved by, and the solve's beyond."""
    evidence, drive = outcome.evidence, outcome.inputs.drive
    applied_s = {(image.visit, image.camera): image.clock_offset_s for image in drive.images}
    suspects = [one for one in evidence.suspects if one.fault is Fault.CLOCK]
    out = []
    for visit, (place, estimated) in enumerate(zip(drive.visits, evidence.clock_s, strict=True)):
        clocks = {}
        for name in outcome.inputs.sightings.cameras:
            if (visit, name) not in applied_s:
                continue
            beyond_s, sigma_s = estimated.get(name, (0.0, 0.0))
            if name not in estimated:
                # Of each camera, and of all of them together: a clock of its own may differ by both.
                tested = [
                    one.sigma**2
                    for one in suspects
                    if name in one.cameras and one.about in ("", f"in {place.name}")
                ]
                sigma_s = float(np.sqrt(sum(tested))) if tested else float("inf")
            clocks[name] = ClockOffset(applied_s[visit, name] + beyond_s, sigma_s)
        out.append(clocks)
    return tuple(out)


@dataclass(frozen=True)
class JointCorners:
    """How the errors of an optimised map's corners hang together."""

    optimised: Optimised

    def covariance(self, marking: IntArray, corner: IntArray) -> FloatArray:
        """Joint covariance (2N, 2N), m^2, of corners (N,) of markings (N,), stacked x0, y0, x1, ...

        Within a marking it is what the map states. From one marking to another only the errors of the
        adjustment are shared, drift above all: a corner that was not seen shares those of one that was.
        """
        optimised, bundle = self.optimised, self.optimised.bundle
        index = bundle.corner_index[optimised.groups[marking]]
        number = np.where(
            index[np.arange(len(corner)), corner] >= 0,
            index[np.arange(len(corner)), corner],
            index.max(axis=1),
        )
        out = max(1.0, bundle.solution.chi2_per_dof) * bundle.solution.corner_covariance(number)
        rows = 2 * corner[:, None] + np.arange(2)
        for k in range(len(marking)):
            stated = optimised.markings[marking[k]].covariance_m2
            assert stated is not None
            for other in np.flatnonzero(marking == marking[k]):
                block = stated[np.ix_(rows[k], rows[other])]
                out[2 * k : 2 * k + 2, 2 * other : 2 * other + 2] = block
        # Put together from two sources, it may be negative along some direction, by a millimetre squared.
        values, vectors = np.linalg.eigh(out)
        return out if values[0] >= 0 else np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


@dataclass(frozen=True)
class StatedCorners:
    """The errors of the corners of markings from several maps, as far as each marking states them."""

    markings: Sequence[Marking]

    def covariance(self, marking: IntArray, corner: IntArray) -> FloatArray:
        """As :meth:`JointCorners.covariance`, but that nothing is shared from one marking to another."""
        out = np.zeros((2 * len(marking), 2 * len(marking)))
        rows = 2 * corner[:, None] + np.arange(2)
        for k, own in enumerate(marking.tolist()):
            stated = self.markings[own].covariance_m2
            assert stated is not None
            for other in np.flatnonzero(marking == own):
                out[2 * k : 2 * k + 2, 2 * other : 2 * other + 2] = stated[np.ix_(rows[k], rows[other])]
        return out


def residuals_of(outcome: Outcome, optimised: Optimised) -> Residuals:
    """Those of the observations that the solve accepted, of markings and of candidates left out."""
    drive, sightings, bundle = outcome.inputs.drive, outcome.inputs.sightings, optimised.bundle
    seen, row_image = np.unique(sightings.image[bundle.row], return_inverse=True)
    marking = np.zeros(bundle.association.count, dtype=np.int64)
    # The ids of a map whose markings have none yet: by their order, as its files number them.
    marking[optimised.groups] = np.arange(1, len(optimised.groups) + 1)
    own_corner = bundle.association.corner_order()[bundle.row, bundle.corner]
    images = [drive.images[i] for i in seen.tolist()]
    return Residuals(
        image=tuple(_below(image.path, drive.root) for image in images),
        camera=tuple(image.camera for image in images),
        taken_s=np.array([image.taken_s for image in images]),
        row_image=row_image.astype(np.int64),
        marking=marking[bundle.group],
        corner=bundle.corner,
        is_point=np.asarray(sightings.valid[bundle.row, own_corner]),
        observed_px=sightings.corners_pinhole_px[bundle.row, own_corner],
        residual_px=bundle.solution.residual_px,
        distance_sigma=np.sqrt(bundle.solution.mahalanobis2),
    )


def _below(path: Path, root: Path) -> str:
    """A path from ``root`` on, whole where it lies elsewhere."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
