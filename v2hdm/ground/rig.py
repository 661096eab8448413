"""What the ground says of all cameras of a drive, each in a process of its own."""

from __future__ import annotations

from collections.abc import Callable

import cv2

from v2hdm.ground.estimate import estimate_ground
from v2hdm.ground.options import GroundOptions
from v2hdm.ground.results import GroundEstimate
from v2hdm.records import Drive
from v2hdm.workers import share_out

_worker: tuple[Drive, GroundOptions | None] | None = None


def estimate_cameras(
    drive: Drive,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    options: GroundOptions | None = None,
) -> dict[str, GroundEstimate]:
    """Estimate every camera's mounting from bare ground; see :func:`v2hdm.ground.estimate_ground`.

    Args:
        drive: the drive.
        workers: processes, one thread each; 1 stays in this process.
        progress: called as ``progress(done, total)`` after each camera.
        options: of the estimate.

    Raises:
        DriveError: an image cannot be read.
        WorkerError: a process died.
    """
    found: dict[str, GroundEstimate] = {}

    def take(estimate: GroundEstimate) -> None:
        found[estimate.camera] = estimate
        if progress:
            progress(len(found), len(drive.cameras))

    names = list(drive.cameras)
    if workers <= 1 or len(names) == 1:
        for name in names:
            take(estimate_ground(drive, name, options))
    else:
        share_out(_work, names, workers, _start_worker, (drive, options), take)
    return found


def _start_worker(drive: Drive, options: GroundOptions | None) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = drive, options


def _work(camera: str) -> GroundEstimate:
    assert _worker is not None
    drive, options = _worker
    return estimate_ground(drive, camera, options)
