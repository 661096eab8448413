"""An earlier map: read and held against the drive; its changes, as files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.detection.frames import read_image
from v2hdm.errors import MapFileError
from v2hdm.io.drive.road import lay_flat
from v2hdm.io.maps.evidence import read_exclusions
from v2hdm.io.maps.reading import read_geojson, read_verdict
from v2hdm.io.trajectory import read_tum
from v2hdm.pipeline.config import base_files
from v2hdm.records import Camera, Change, Changes, Drive, Fate, Image
from v2hdm.site.living.changes import Base
from v2hdm.site.standing import Pixels

_SITE_M = 40.0  # markings farther from a route are not seen from it: twice what a camera reaches
LISTED = (Fate.MOVED, Fate.VANISHED, Fate.NEW)  # fates that are changes of the site, and no want of images


def read_base(path: Path) -> Base:
    """Read an earlier map, and the poses and left-out candidates beside it; MapFileError if unusable."""
    path, trajectories, excluded = base_files(path)
    hd_map = read_geojson(path)
    if not hd_map.markings:
        raise MapFileError(f"map.base: {path}: has no markings to update; map the drive without it")
    verdict = read_verdict(path)
    if verdict is not None and verdict.get("status") == "FAIL":
        raise MapFileError(
            f"map.base: {path}: the verdict on its drive is FAIL, so nothing can be built on it; fix "
            "that drive first (docs/verdict.md)"
        )
    if all(marking.covariance_m2 is None or marking.relative_sigma_m is None for marking in hd_map.markings):
        raise MapFileError(
            f"map.base: {path}: states no uncertainty of its markings, like maps of older versions and "
            "naive methods; map its drive again"
        )
    poses = [lay_flat(read_tum(trajectory)).trajectory.map_from_vehicle for trajectory in trajectories]
    left_out = read_exclusions(excluded) if excluded.is_file() else []
    candidates = tuple(
        (exclusion.kind, exclusion.position_map, exclusion.sightings) for exclusion in left_out
    )
    hd_map = replace(hd_map, lanes=tuple(line for lane in hd_map.lanes for line in lane.painted))
    return Base(hd_map, np.concatenate([np.zeros((0, 4, 4)), *poses]), candidates)


def check_together(base: Base, drive: Drive, path: str) -> None:
    """Raise MapFileError, which names both, for a map that is not of the drive's frame or site."""
    if base.hd_map.origin != drive.origin:
        raise MapFileError(
            f"map.base: the origin of {path} is {base.hd_map.origin} and that of drive {drive.name} "
            f"{drive.origin}: their coordinates differ; bring the drive's poses into the map's frame"
        )
    route = cKDTree(drive.route_map)
    centres = np.array([marking.corners_map.mean(axis=0) for marking in base.hd_map.markings])
    nearest_m = float(route.query(centres)[0].min())
    if nearest_m > _SITE_M:
        raise MapFileError(
            f"map.base: drive {drive.name} comes no nearer than {nearest_m:.0f} m to a marking of {path}: it "
            "is a map of another site; map the drive without map.base"
        )


def grey_reader(drive: Drive) -> Callable[[Image], Pixels] | None:
    """Reads a drive's images for their grey values; None where it has no pictures."""
    if not drive.has_pictures:
        return None
    return _GreyReader(drive.cameras)


@dataclass(frozen=True)
class _GreyReader:
    """Reads images of these cameras; other than a closure, it can go to another process."""

    cameras: Mapping[str, Camera]

    def __call__(self, image: Image) -> Pixels:
        # Grey values are wanted of small parts: those of whole images would take a third of the time.
        return read_image(image, self.cameras[image.camera])


def changes_json(changes: Changes) -> dict[str, Any]:
    """The changes in ``metrics.json``: counts, and each change with its evidence."""
    count_of_fate = Counter(change.fate for change in changes.changes)
    return {
        "counts": {"same": changes.same, **{fate.value: count_of_fate[fate] for fate in Fate}},
        "shift_m": changes.shift_m.tolist(),
        "listed": [change_json(change) for fate in LISTED for change in changes.of(fate)],
        "unsure": [change_json(change) for change in changes.changes if change.fate not in LISTED],
    }


def change_json(change: Change) -> dict[str, Any]:
    """A change as plain values."""
    names = {"kind": "class", "before": "before_map", "after": "after_map", "views_showing": "found"}
    plain = {names.get(name, name): value for name, value in vars(change).items()} | {
        "fate": change.fate.value
    }
    return {name: value.tolist() if hasattr(value, "tolist") else value for name, value in plain.items()}
