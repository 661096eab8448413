"""From a drive to what its bare ground says of one camera."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from v2hdm.ground.adjust import Adjusted, Believed, adjust, tangent_covariance
from v2hdm.ground.matcher import Matcher, Round
from v2hdm.ground.motion import motion_of
from v2hdm.ground.mount import Mount, guessed_mount, rotation
from v2hdm.ground.beliefs import Beliefs
from v2hdm.ground.noise import state_sigmas
from v2hdm.ground.options import GroundOptions
from v2hdm.ground.pairs import changing_pairs, spread_pairs
from v2hdm.ground.results import GroundEstimate, GroundStatus, MatchedGround, Parameter, Reading
from v2hdm.ground.start import Start, find_start
from v2hdm.records import Calibration, Drive, FloatArray

_SEARCH_M = (0.9, 0.5, 0.24, 0.15)
_LOOSENED = (20.0, 8.0, 2.0, 1.0)
"""How much further off than stated the poses' heading and sideways place may be in each round, so that the
few pairs which show a wrong clock do not count as outliers."""

_FREE_CENTRE = {"up_m": (2, 0.3), "forward_m": (0, 2.0), "left_m": (1, 2.0)}
"""Axis of the centre, and how far from its survey it may be, m."""

_LEAST_MATCHES = 60
"""Ten for each of the six quantities of a mounting."""

_LEAST_PATCHES = 200
"""Fewer in view of all pairs tell nothing, matched or not."""


def estimate_ground(drive: Drive, camera: str, options: GroundOptions | None = None) -> GroundEstimate:
    """Estimate the mounting of ``camera`` and what contradicts the drive, from bare ground alone.

    Raises:
        DriveError: an image cannot be read.
    """
    began_s = time.perf_counter()
    work = _Work(drive, camera, options or GroundOptions())
    return replace(work.estimate(), seconds=time.perf_counter() - began_s)


class _Work:
    """One camera's estimate on its way."""

    def __init__(self, drive: Drive, camera: str, options: GroundOptions):
        self.drive, self.camera, self.options = drive, camera, options
        self.motion = motion_of(drive, camera, Reading.AS_GIVEN)
        self.guess = guessed_mount(drive.cameras[camera])
        self.beliefs = Beliefs(drive, drive.cameras[camera], self.motion, self.guess)
        self.matcher = Matcher(drive, camera, self.motion, options)

    def estimate(self) -> GroundEstimate:
        """The result without its time."""
        start, shares, reading = self._readings()
        if start.mount is None:
            few = start.sought < _LEAST_PATCHES and max(shares.values()) == 0
            return self._nothing(GroundStatus.TOO_LITTLE if few else GroundStatus.NO_MATCH, shares, reading)
        pairs = spread_pairs(
            self.motion.path_at_images(), self.options.pairs, self.options.shortest_m, self.options.longest_m
        )
        mount, matched, adjusted = self._rounds(start.mount, pairs)
        if adjusted is None:
            status = GroundStatus.TOO_LITTLE if matched.sought < _LEAST_PATCHES else GroundStatus.NO_MATCH
            return self._nothing(status, shares, reading)
        covariance = tangent_covariance(mount, adjusted.covariance)
        return GroundEstimate(
            camera=self.camera,
            status=GroundStatus.FOUND,
            shares=shares,
            reading=reading,
            calibration=Calibration(mount.info, mount.cam_from_vehicle, covariance),
            guess_cam_from_vehicle=self.guess.cam_from_vehicle,
            parameters={},
            median_residual=float(np.median(adjusted.residual)),
            pulls=self._pulls(adjusted),
            patches=self._patches(matched, pairs),
            seconds=0.0,
        )

    def _rounds(self, mount: Mount, pairs: FloatArray) -> tuple[Mount, Round, Adjusted | None]:
        adjusted = None
        for search_m, loosened in zip(_SEARCH_M, _LOOSENED, strict=True):
            matched = self.matcher.match(mount, self.beliefs.poses(), pairs, search_m)
            if len(matched.correlation) < _LEAST_MATCHES:
                return mount, matched, None
            adjusted = adjust(
                *self.beliefs.about(matched.observations, loosened), mount, tolerance=max(loosened / 2, 1.0)
            )
            mount = adjusted.mount
        return mount, matched, adjusted

    def _readings(self):
        shares = {}
        start = find_start(self.matcher, self.beliefs, self.guess)
        shares[Reading.AS_GIVEN] = start.share if start.mount is not None else 0.0
        return start, shares, Reading.AS_GIVEN

    def _pulls(self, adjusted: Adjusted) -> dict[str, float]:
        pull = adjusted.pose_errors / state_sigmas(self.drive.pose_noise)
        rms = np.sqrt(np.mean(pull**2, axis=0))
        return {
            "heading": float(rms[2]),
            "position": float(np.sqrt(np.mean(rms[3:5] ** 2))),
            "tilt": float(np.sqrt(np.mean(rms[:2] ** 2))),
            "height": float(rms[5]),
        }

    def _patches(self, matched: Round, pairs: FloatArray) -> MatchedGround:
        seen = matched.observations
        return MatchedGround(
            self.motion.image[pairs], seen.pair, seen.first_px, seen.second_px, matched.correlation
        )

    def _nothing(self, status: GroundStatus, shares, reading) -> GroundEstimate:
        return GroundEstimate(
            camera=self.camera,
            status=status,
            shares=shares,
            reading=reading,
            calibration=None,
            guess_cam_from_vehicle=self.guess.cam_from_vehicle,
            parameters={},
            median_residual=float("nan"),
            pulls={},
            patches=None,
            seconds=0.0,
        )


