"""Whether cameras still sit as they were calibrated: a test for pushes, and one for slow changes.

A push is told by detections that a turned camera would explain and nothing else does (:class:`RigTest`). A
slow change the filter follows, as far as a mounting may creep; what its innovations, by each angle of a
mounting, have moved that mounting by is tested here (:class:`MountingTest`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from v2hdm.localization.belief import CREEP_RAD
from v2hdm.localization.seeing import Look
from v2hdm.records import FloatArray

# Log likelihood ratio from which a mounting counts as turned (Page 1954): of right images one in e^10.
_PUSHED_LIMIT = 10.0
_MATCHED = 3.0  # log likelihood of a detection that the turned mounting explains over one that nothing does
_PUSHED_DRIFT = 1.5  # and what each image takes from it
_SUSPICIOUS = 3.0  # log likelihood ratio from which no bound is stated


@dataclass
class RigTest:
    """For each camera a sequential test of whether its mounting was turned at once."""

    evidence: dict[str, float] = field(default_factory=dict)
    begun_s: dict[str, float] = field(default_factory=dict)

    def note(self, look: Look, gained: int) -> float | None:
        """Take how many more detections a turned mounting explains; since when, once that is sure."""
        before = self.evidence.get(look.camera, 0.0)
        if before == 0.0:
            self.begun_s[look.camera] = look.stamp_s
        now = max(0.0, before + _MATCHED * gained - _PUSHED_DRIFT)
        self.evidence[look.camera] = now
        if now < _PUSHED_LIMIT:
            return None
        begun_s = self.begun_s[look.camera]
        self.evidence.clear()
        return begun_s

    @property
    def is_suspicious(self) -> bool:
        """Whether the last images spoke for a turned mounting, surely or not."""
        return any(evidence > _SUSPICIOUS for evidence in self.evidence.values())


# Squared distance, in sigmas, from which a mounting has changed: of three unknowns one in a million comes so
# far by chance. Right drives of half a minute come to 8.
_CHANGED_SQUARED = 30.0
_BACK_SHARE = 0.4  # of a change: a mounting that is nearer to where it was has been put right
# What the detections' errors, which repeat from image to image, move a mounting by, rad (one sigma).
_WANDER_RAD = np.deg2rad(0.012)
_STEP_S = 0.5  # time between two estimates that are kept
_MOST = 240  # estimates that are kept: of the older half every second one is dropped when there are more
_COURSE = 40  # number of estimates that locate the beginning of a change
_AT_ONCE_S = 2.0  # a mounting that changed within less was pushed
_ANGLES = ("pitch", "yaw", "roll")  # of a camera, about its axes right, down and forward


class Turned(NamedTuple):
    """A camera whose mounting is no longer that of its calibration."""

    camera: str
    since_s: float
    turn_deg: tuple[float, float, float]  # about the camera's axes right, down and forward
    sigma_deg: tuple[float, float, float]
    angle: str  # that has changed most surely: pitch, yaw or roll
    is_slow: bool  # whether it changed gradually


class Estimate(NamedTuple):
    """A mounting's turn (3,) since its calibration, rad, with its covariance (3, 3), at a time."""

    stamp_s: float
    turn_rad: FloatArray
    covariance_rad2: FloatArray


class Change(NamedTuple):
    """How a mounting has changed since a time."""

    before: Estimate
    after: Estimate  # the estimate that showed the change
    since_s: float
    until_s: float  # when it was as far as it is now
    angle: str  # that changed most surely

    @property
    def is_slow(self) -> bool:
        """Whether it changed gradually."""
        return self.until_s - self.since_s > _AT_ONCE_S

    def is_undone(self, now: Estimate) -> bool:
        """Whether the mounting is nearly back where it was."""
        changed = self.after.turn_rad - self.before.turn_rad
        left = now.turn_rad - self.before.turn_rad
        return bool(left @ changed < _BACK_SHARE * (changed @ changed))


@dataclass
class MountingTest:
    """A generalised likelihood ratio test (Willsky and Jones 1976) of one camera's mounting.

    A filter's estimates of what does not change differ by no more than what it has learnt since. The present
    one is compared with all earlier ones and with the calibration. ``creep_rad2_s`` is the variance by
    which a mounting may change within a second.
    """

    calibration_rad2: FloatArray
    creep_rad2_s: float
    estimates: list[Estimate] = field(default_factory=list)
    change: Change | None = None
    loosened_s: float = -np.inf  # when the filter was last told that the mounting may have turned

    def note(self, now: Estimate) -> Change | None:
        """Take an estimate; the change, once there is one for sure."""
        if not self.estimates:
            self.estimates.append(Estimate(now.stamp_s, np.zeros(3), self.calibration_rad2))
        if self.change is not None:
            if not self.change.is_undone(now):
                self._keep(now)
                return self.change
            # The changed estimates belong to a mounting that was corrected.
            begin_s = self.change.since_s
            self.estimates = [item for item in self.estimates if item.stamp_s <= begin_s]
            self.change = None
        squared = self._squared(self.estimates, now)
        farthest = int(np.argmax(squared))
        if squared[farthest] > _CHANGED_SQUARED:
            self.change = self._change(self.estimates[farthest], now)
        self._keep(now)
        return self.change

    def at(self, stamp_s: float) -> Estimate | None:
        """The latest estimate of before a time."""
        earlier = [item for item in self.estimates if item.stamp_s <= stamp_s]
        return earlier[-1] if earlier else None

    def _squared(self, befores: Sequence[Estimate], now: Estimate) -> FloatArray:
        """The squared distances (K,) of earlier estimates from the present one, in sigmas."""
        since_s = now.stamp_s - np.array([before.stamp_s for before in befores])
        creep_rad2 = self.creep_rad2_s * np.maximum(since_s, 0.0) + _WANDER_RAD**2
        # What two estimates differ by of which one is the better has the difference of their covariances
        # (Hausman 1978): what neither tells, such as the vehicle's own pitch from that of both cameras,
        # drops out.
        covariances_rad2 = np.array([before.covariance_rad2 for before in befores])
        values, axes = np.linalg.eigh(covariances_rad2 - now.covariance_rad2)
        spread = (axes * np.abs(values)[:, None]) @ axes.swapaxes(1, 2)
        # A filter that has been loosened since has forgotten what the earlier estimate knew.
        is_forgotten = np.array([before.stamp_s < self.loosened_s for before in befores])
        spread[is_forgotten] = covariances_rad2[is_forgotten] + now.covariance_rad2
        spread += creep_rad2[:, None, None] * np.eye(3)
        moved = now.turn_rad - np.array([before.turn_rad for before in befores])
        return np.asarray((moved * np.linalg.solve(spread, moved[..., None])[..., 0]).sum(axis=1))

    def _change(self, before: Estimate, now: Estimate) -> Change:
        """When the change began and whether it was sudden, from the ramp that fits the estimates best."""
        moved = now.turn_rad - before.turn_rad
        sigma = np.sqrt(np.abs(np.diag(before.covariance_rad2 - now.covariance_rad2)) + _WANDER_RAD**2)
        axis = int(np.argmax(np.abs(moved) / sigma))
        course = [item for item in self.estimates if item.stamp_s >= before.stamp_s]
        course = [*course[:: max(1, len(course) // _COURSE)], now]
        stamps_s = np.array([item.stamp_s for item in course])
        shares = np.array([item.turn_rad[axis] - before.turn_rad[axis] for item in course]) / moved[axis]
        ramps = [(begin, end) for end in range(1, len(course)) for begin in range(end)]
        losses = [_ramp_loss(stamps_s, shares, stamps_s[begin], stamps_s[end]) for begin, end in ramps]
        begin, end = ramps[int(np.argmin(losses))]
        return Change(before, now, float(stamps_s[begin]), float(stamps_s[end]), _ANGLES[axis])

    def _keep(self, now: Estimate) -> None:
        if now.stamp_s - self.estimates[-1].stamp_s < _STEP_S:
            return
        self.estimates.append(now)
        if len(self.estimates) > _MOST:
            half = _MOST // 2
            self.estimates = [*self.estimates[:half:2], *self.estimates[half:]]


def _ramp_loss(stamps_s: FloatArray, shares: FloatArray, begin_s: float, end_s: float) -> float:
    """How badly a change from 0 to 1 between two times fits shares (K,) of it."""
    ramp = np.clip((stamps_s - begin_s) / (end_s - begin_s), 0.0, 1.0)
    return float(((shares - ramp) ** 2).sum())


def sentence(camera: str, change: Change, now: Estimate) -> str:
    """A change in words."""
    axis = _ANGLES.index(change.angle)
    turned_deg = float(np.degrees(now.turn_rad[axis] - change.before.turn_rad[axis]))
    pace = "slowly " if change.is_slow else ""
    since = f"{pace}turned since {change.since_s:.1f} s"
    by_angle = f"{turned_deg:+.2f} deg in {change.angle}"
    return f"the mounting of {camera} has {since}, by {by_angle}; calibrate it again"


class Rig:
    """The mountings of all cameras, of calibrations with covariances (6, 6) by name."""

    def __init__(self, mountings: Mapping[str, FloatArray]) -> None:
        self.pushed = RigTest()
        self._tests = {
            name: MountingTest(covariance[3:, 3:], CREEP_RAD**2) for name, covariance in mountings.items()
        }
        self._latest: dict[str, Estimate] = {}

    def note(self, camera: str, now: Estimate) -> Change | None:
        """Take what the filter says of a camera's mounting after an image of it; a change that is new."""
        had_changed = self._tests[camera].change is not None
        self._latest[camera] = now
        change = self._tests[camera].note(now)
        return None if had_changed else change

    def loosen(self, stamp_s: float) -> None:
        """Take note that from a time on the filter lets all mountings turn."""
        for test in self._tests.values():
            test.loosened_s = stamp_s

    def others(self, camera: str, stamp_s: float) -> dict[str, Estimate]:
        """The mountings, at a time, of the other cameras, which have not changed."""
        tests = {name: test for name, test in self._tests.items() if name != camera and test.change is None}
        estimates = {name: test.at(stamp_s) for name, test in tests.items()}
        return {name: estimate for name, estimate in estimates.items() if estimate is not None}

    @property
    def turned(self) -> tuple[Turned, ...]:
        """The cameras that have surely turned."""
        out = []
        for name, now in self._latest.items():
            change = self._tests[name].change
            if change is not None:
                turn = np.degrees(now.turn_rad).tolist()
                sigma = np.degrees(np.sqrt(np.diag(now.covariance_rad2))).tolist()
                turn_deg = (turn[0], turn[1], turn[2])
                sigma_deg = (sigma[0], sigma[1], sigma[2])
                out.append(Turned(name, change.since_s, turn_deg, sigma_deg, change.angle, change.is_slow))
        return tuple(out)

    @property
    def reasons(self) -> list[str]:
        """A sentence for each of them."""
        changes = ((name, self._tests[name].change, now) for name, now in self._latest.items())
        return [sentence(name, change, now) for name, change, now in changes if change is not None]
