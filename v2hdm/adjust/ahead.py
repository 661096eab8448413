"""Kernels compiled by numba meanwhile, in another process, unless cached: it takes half a minute of CPU."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from v2hdm.adjust.covariance import corner_gain
from v2hdm.adjust.kernels import kept_in
from v2hdm.adjust.problem import Observations, Problem, SolveOptions
from v2hdm.adjust.solve import solve

_DONE = "all"  # file beside the cached kernels: all of an adjustment's are there
_PROGRAM = "from v2hdm.adjust import ahead; ahead.compile_kernels()"


@contextmanager
def compiled_meanwhile(device: str) -> Iterator[None]:
    """Have the kernels of an adjustment on the CPU compiled by the end of the block, if numba does it."""
    folder = kept_in()
    quiet = subprocess.DEVNULL
    if device != "cpu" or folder is None or (folder / _DONE).exists():
        yield
        return
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM], stdin=subprocess.PIPE, stdout=quiet, stderr=quiet
    ) as process:
        try:
            yield
        except BaseException:
            process.kill()
            raise
        process.wait()


def compile_kernels() -> None:
    """Compile all kernels and mark them complete; ends with the process at the other end of stdin."""
    threading.Thread(target=lambda: (os.read(0, 1), os._exit(1)), daemon=True).start()
    use_kernels()
    if (folder := kept_in()) is not None:
        (folder / _DONE).touch()


def use_kernels() -> None:
    """Call every kernel as the adjustment of a drive does, for a small problem."""
    problem = _small_problem()
    for states in ((), SolveOptions().pose_states):
        descent = solve(problem, SolveOptions(pose_states=states, coarse=not states)).covariance.descent
        corner_gain(descent.whitening)
        whitening = descent.whitening
        whitening.whiten([whitening.pull(torch.zeros(2, len(problem.observations.corner)))])


def _small_problem() -> Problem:
    """A camera two metres up that looks down on six points, from four places."""
    points_map = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-0.6, 0.5)])
    driven_m = np.arange(4) / 5
    seen_px = 250.0 * (points_map - np.stack([driven_m, 0 * driven_m], axis=1)[:, None]) * [1, -1]
    frame, corner = (place.ravel() for place in np.indices(seen_px.shape[:2]))
    noise_px = np.sin(np.arange(seen_px.size))
    covariance_px = np.tile(np.eye(2), (len(frame), 1, 1))
    measured_px = (seen_px + noise_px.reshape(seen_px.shape)).reshape(-1, 2)
    map_from_vehicle = np.tile(np.eye(4), (4, 1, 1))
    map_from_vehicle[:, 0, 3] = driven_m
    cam_from_vehicle = np.diag([1.0, -1.0, -1.0, 1.0])
    cam_from_vehicle[2, 3] = 2.0
    observations = Observations(0 * frame, frame, corner, measured_px, covariance_px)
    lens = np.array([[500.0, 500.0, 0.0, 0.0]])
    return Problem(lens, cam_from_vehicle[None], map_from_vehicle, observations, len(points_map))
