"""All that matching the ground of one camera needs at hand: its images, its region, the driven path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from v2hdm.ground.adjust import Observations
from v2hdm.ground.motion import Motion
from v2hdm.ground.mount import Mount
from v2hdm.ground.options import GroundOptions
from v2hdm.ground.patches import ImageArray, Matches, View, match_pair, patch_centres
from v2hdm.io.safe.pixels import read_pixels
from v2hdm.records import Drive, FloatArray, IntArray

_PATH_STEP_M = 0.5
_BEYOND_M = 30.0
"""How far the path is continued straight beyond the drive's ends: as far as regions reach."""


@dataclass(frozen=True)
class Round:
    """Matches of all pairs of one round; ``share`` of the patches in view that found a partner."""

    observations: Observations
    correlation: FloatArray
    sought: int
    share: float


class Matcher:
    """Matches ground between images of one camera; images are read once and kept."""

    def __init__(self, drive: Drive, camera: str, motion: Motion, options: GroundOptions):
        self._drive = drive
        self._image = motion.image
        self._roi = np.asarray(drive.cameras[camera].roi_vehicle, dtype=np.float64)
        self._path = path_of(motion)
        self._options = options
        self._grey: dict[int, ImageArray] = {}

    def under(self, motion: Motion, turned: bool = False) -> Matcher:
        """The same images under another reading of the poses, the region ``turned`` to the other end."""
        other = object.__new__(Matcher)
        other.__dict__.update(self.__dict__)
        other._path = path_of(motion)
        other._roi = -self._roi if turned else self._roi
        return other

    def grey(self, row: int) -> ImageArray:
        """The image of a row of the motion, as grey values."""
        if row not in self._grey:
            self._grey[row] = read_grey(str(self._drive.images[int(self._image[row])].path))
        return self._grey[row]

    def match(
        self, mount: Mount, poses: FloatArray, pairs: IntArray, search_m: float, grid_m: float | None = None
    ) -> Round:
        """Match every pair (P, 2) of rows of ``poses``, laid out from ``mount``."""
        options = self._options if grid_m is None else replace(self._options, grid_m=grid_m)
        found: list[Matches] = []
        for first, second in pairs:
            views = [View(self.grey(int(k)), mount, poses[k]) for k in (first, second)]
            centres = patch_centres((poses[first], poses[second]), self._roi, self._path, options)
            if len(centres):
                found.append(match_pair(views[0], views[1], centres, search_m, options))
            else:
                found.append(Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), 0))
        counts = [len(each.correlation) for each in found]
        pair = np.repeat(np.arange(len(pairs)), counts)
        sought = sum(each.sought for each in found)
        return Round(
            Observations(
                first=pairs[pair, 0],
                second=pairs[pair, 1],
                first_px=np.concatenate([np.empty((0, 2)), *(each.first_px for each in found)]),
                second_px=np.concatenate([np.empty((0, 2)), *(each.second_px for each in found)]),
                pair=pair,
            ),
            np.concatenate([np.empty(0), *(each.correlation for each in found)]),
            sought,
            sum(counts) / sought if sought else 0.0,
        )


def path_of(motion: Motion) -> FloatArray:
    """Places (N, 2) of the driven path, half a metre apart, continued straight at both ends."""
    poses = motion.trajectory.map_from_vehicle
    length = motion.path_m[-1]
    at = np.arange(0.0, length + _PATH_STEP_M, _PATH_STEP_M)
    keep = np.concatenate([[True], np.diff(motion.path_m) > 1e-9])
    path = np.column_stack([np.interp(at, motion.path_m[keep], poses[keep, axis, 3]) for axis in (0, 1)])
    beyond = np.arange(_PATH_STEP_M, _BEYOND_M, _PATH_STEP_M)[:, None]
    return np.vstack([path, path[:1] - beyond * poses[0, :2, 0], path[-1:] + beyond * poses[-1, :2, 0]])


def read_grey(path: str) -> ImageArray:
    """The image file at ``path`` as grey values (H, W), uint8.

    Raises:
        DriveError: it cannot be read.
    """
    # A JPEG decoded as grey is its luma, a level or two off the grey of the same pixels stored as PNG.
    return np.asarray(cv2.cvtColor(read_pixels(Path(path), cv2.IMREAD_COLOR), cv2.COLOR_BGR2GRAY))
