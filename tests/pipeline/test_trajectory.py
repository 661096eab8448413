"""The adjusted trajectory as files: in the frame of the recorded poses, with sigmas."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.trajectory import read_tum
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.pipeline.result import write_trajectories
from v2hdm.records import Drive, FloatArray, Trajectory


def poses(height_m: float = 0.0, pitch_rad: float = 0.0, forward_m: float = 0.0) -> FloatArray:
    """Three poses a metre apart, moved along themselves by ``forward_m``."""
    out = np.tile(np.eye(4), (3, 1, 1))
    zero = np.zeros(3)
    out[:, :3, :3] = rotation_from_euler(zero, np.full(3, pitch_rad), zero)
    out[:, :3, 3] = np.column_stack([np.arange(3.0), zero, np.full(3, height_m)])
    moved = np.eye(4)
    moved[0, 3] = forward_m
    return np.asarray(out @ moved)


def test_poses_that_were_laid_flat_are_written_at_their_recorded_height(tmp_path: Path) -> None:
    stamp_s = np.array([10.0, 10.5, 11.0])
    recorded = Trajectory(stamp_s, poses(46.2, 0.02))
    drive = Drive("d", tmp_path, {}, (), recorded=recorded)
    sigma = np.tile([0.01, 0.02, 0.003, 1e-4, 2e-4, 3e-4], (3, 1))
    seen = np.array([True, False, True])
    visit = np.zeros(len(stamp_s), dtype=np.int64)
    adjusted = AdjustedPoses(stamp_s, poses(), poses(forward_m=0.05), sigma, seen, {}, visit)
    write_trajectories(adjusted, drive, tmp_path)
    got = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(got.stamp_s, stamp_s)
    np.testing.assert_allclose(got.map_from_vehicle, poses(46.2, 0.02, 0.05), atol=1e-8)
    header, first, second, _ = (tmp_path / "trajectory_sigma.csv").read_text().splitlines()
    assert header == "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"
    assert first == "10.000000000,1,0.01,0.02,0.003,0.0001,0.0002,0.0003"
    assert second.split(",")[1] == "0"
