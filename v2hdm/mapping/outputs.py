"""What an optimisation estimates besides map and mountings: poses, clocks, how errors hang together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.adjust import Fault
from v2hdm.mapping.markings.conclude import Optimised
from v2hdm.mapping.remedy import Outcome
from v2hdm.mapping.results import AdjustedPoses, ClockOffset
from v2hdm.mapping.sightings.table import frames_of
from v2hdm.records import FloatArray, IntArray


def adjusted_poses(outcome: Outcome) -> AdjustedPoses:
    """The poses of all frames of the drive."""
    drive, sightings, bundle = outcome.inputs.drive, outcome.inputs.sightings, outcome.bundle
    sigma = np.tile(bundle.model.pose_sigma.by_state(), (len(sightings.stamp_s), 1))
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
    )


def clock_offsets(outcome: Outcome) -> dict[str, ClockOffset]:
    """Each camera's clock offset: what its images were posed anew by, and what the solve estimates beyond."""
    evidence = outcome.evidence
    applied_s = {image.camera: image.clock_offset_s for image in outcome.inputs.drive.images}
    clocks = {}
    for name in outcome.inputs.sightings.cameras:
        beyond_s, sigma_s = evidence.clock_s.get(name, (0.0, 0.0))
        if name not in evidence.clock_s:
            # Of each camera, and of all of them together: a clock of its own may differ by both.
            tested = [one for one in evidence.suspects if one.fault is Fault.CLOCK and name in one.cameras]
            sigma_s = float(np.sqrt(sum(one.sigma**2 for one in tested))) if tested else float("inf")
        clocks[name] = ClockOffset(applied_s.get(name, 0.0) + beyond_s, sigma_s)
    return clocks


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
