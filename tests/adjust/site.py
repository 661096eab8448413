"""A synthetic site: a street of which each drive has a stretch, and shares its ends."""

from dataclasses import replace

import numpy as np

from tests.adjust.scene import exp, make_scene, pose_errors, project
from v2hdm.adjust import Drift, Observations, PoseSigma, Problem

DRIFTING = PoseSigma(0.02, 0.001, 0.003, 0.01, position_drift=Drift(0.018, 30.0))
SCATTERING = PoseSigma(0.03, 0.002, 0.003, 0.01)


def site(drives: int, frames: int, overlap: int, *, every_m: float = 2.0, seed: int = 3) -> Problem:
    """Drives of ``frames`` each, of which ``overlap`` at either end are those of the next drive, too.

    Poses of every second drive drift. Where they drive alone, corners are theirs alone.
    """
    stride = frames - overlap
    street = make_scene(
        seed, frames=drives * stride + overlap, every_m=every_m, start_error_deg=0.3, max_range_m=12.0
    )
    observations, poses = street.problem.observations, street.problem.map_from_vehicle
    sigmas = [(DRIFTING, SCATTERING)[number % 2] for number in range(drives)]
    parts = []
    for number, sigma in enumerate(sigmas):
        rng = np.random.default_rng(seed + 100 * number)
        frames_of_drive = slice(number * stride, number * stride + frames)
        true = poses[frames_of_drive] @ exp(pose_errors(poses[frames_of_drive], sigma, 0.5, rng))
        mine = np.flatnonzero(
            (observations.frame >= frames_of_drive.start) & (observations.frame < frames_of_drive.stop)
        )
        frame = observations.frame[mine] - frames_of_drive.start
        cam_from_map = street.cam_from_vehicle[observations.camera[mine]] @ np.linalg.inv(true)[frame]
        pixel = project(cam_from_map, street.corners_map[observations.corner[mine]])
        pixel = pixel + 0.7 * rng.standard_normal(pixel.shape)
        parts.append((mine, frame + number * frames, pixel))
    rows, frame, pixel = (np.concatenate(part) for part in zip(*parts, strict=True))
    often = np.bincount(observations.corner[rows], minlength=street.problem.corner_count) >= 2
    is_often = often[observations.corner[rows]]
    rows, frame, pixel = rows[is_often], frame[is_often], pixel[is_often]
    corner = (np.cumsum(often) - 1)[observations.corner[rows]]
    return replace(
        street.problem,
        map_from_vehicle=np.concatenate([poses[n * stride : n * stride + frames] for n in range(drives)]),
        observations=Observations(
            observations.camera[rows], frame, corner, pixel, observations.covariance_px[rows]
        ),
        corner_count=int(often.sum()),
        pose_sigma=tuple(sigmas),
        session=np.repeat(np.arange(drives), frames),
    )
