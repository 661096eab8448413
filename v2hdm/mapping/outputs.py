"""What an optimisation estimates besides map and mountings: the vehicle's poses and the cameras' clocks."""

from __future__ import annotations

import numpy as np

from v2hdm.adjust import Fault
from v2hdm.mapping.remedy import Outcome
from v2hdm.mapping.results import AdjustedPoses, ClockOffset
from v2hdm.mapping.sightings.table import frames_of


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
