"""What is known of a camera and its vehicle's poses before the ground is seen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from v2hdm.ground.adjust import Believed, Observations
from v2hdm.ground.motion import Motion
from v2hdm.ground.mount import Mount
from v2hdm.ground.noise import pose_information
from v2hdm.records import Camera, Drive, FloatArray, IntArray

_FORWARD_LOOSENED = 2.0
"""At most so much for the place along the path: with more, distance and height slide together."""

_UNSURVEYED_M = 0.5
"""How far the centre that follows from a guess may be off, m."""

_HEIGHT_SIGMA_M = 0.2
"""The ground tells the height to millimetres; a survey's own sigma would only pull it, m."""


@dataclass(frozen=True)
class Beliefs:
    """Poses, survey and their noise; ``clock_s`` is added to the images' stamps.

    ``centre_sigma_m`` replaces the survey's own along single axes; not ``surveyed``, only the
    guess tells where the centre is.
    """

    drive: Drive
    camera: Camera
    motion: Motion
    guess: Mount
    clock_s: float = 0.0
    centre_sigma_m: dict[int, float] = field(default_factory=dict)
    surveyed: bool = True

    def at_clock(self, clock_s: float) -> Beliefs:
        """The same with another offset of the clock."""
        return replace(self, clock_s=clock_s)

    def poses(self) -> FloatArray:
        """``map_from_vehicle`` (I, 4, 4) at all images."""
        return self.motion.poses(self.clock_s)

    def path_m(self) -> FloatArray:
        """Distance driven (I,) at all images."""
        return self.motion.path_at_images(self.clock_s)

    def about(
        self, observations: Observations, loosened: float = 1.0
    ) -> tuple[Observations, Believed, IntArray]:
        """The observations with images counted anew, what is known of these images, and their rows.

        Args:
            observations: matches between rows of the motion.
            loosened: how much further off than stated headings and sideways places may be.
        """
        rows, place = np.unique(
            np.concatenate([observations.first, observations.second]), return_inverse=True
        )
        count = len(observations.first)
        path_m = self.path_m()[rows]
        prior = self.camera.centre_prior if self.surveyed else None
        sigma_m = np.full(3, _UNSURVEYED_M) if prior is None else prior.sigma_m.copy()
        sigma_m[2] = max(sigma_m[2], _HEIGHT_SIGMA_M)
        for axis, wider_m in self.centre_sigma_m.items():
            sigma_m[axis] = wider_m
        ahead = min(loosened, _FORWARD_LOOSENED)
        factors = np.array([1.0, 1.0, loosened, ahead, loosened, 1.0])
        believed = Believed(
            poses=self.poses()[rows],
            pose_information=pose_information(self.drive.pose_noise, path_m, factors),
            velocity=self.motion.velocity_at_images(self.clock_s)[rows],
            climb_m=path_m - path_m.mean(),
            centre_vehicle=self.guess.centre_vehicle if prior is None else prior.centre_vehicle,
            centre_sigma_m=sigma_m,
        )
        return replace(observations, first=place[:count], second=place[count:]), believed, rows
