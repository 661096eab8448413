"""What a run was made of: the drive, the date, the versions of what computed it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm import __version__
from v2hdm.io.drive import ReadOptions
from v2hdm.io.drive.of_result import told_of
from v2hdm.records import Drive
from v2hdm.store.cache import library_versions


def describe_run(name: str, drive: Drive, paths: Sequence[Path], options: ReadOptions) -> dict[str, Any]:
    """What ``metrics.json`` begins with: name, version, date (UTC), the drive at ``paths`` as it was read."""
    return {
        "name": name,
        "version": __version__,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "drive": _drive(drive, paths, options),
        "versions": {"v2hdm": __version__, **library_versions()},
    }


def _drive(drive: Drive, paths: Sequence[Path], options: ReadOptions) -> dict[str, Any]:
    stamp_s = [image.stamp_s for image in drive.images]
    places = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    return {
        **told_of(drive, paths, options),
        "duration_s": round(float(np.ptp(stamp_s)), 3),
        "length_m": round(float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()), 2),
        "position_sigma_m": drive.pose_noise.position_m,
        "heading_sigma_deg": round(float(np.rad2deg(drive.pose_noise.heading_rad)), 4),
    }
