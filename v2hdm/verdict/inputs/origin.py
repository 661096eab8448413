"""Whether the frame that positions on the vehicle count from is as high above the ground as is stated.

ROS does not prescribe where ``base_link`` is; at axle height it puts all cameras, and the map, too low by one
and the same height, which bare ground shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.ground.results import GroundEstimate, GroundStatus, Reading
from v2hdm.records import Camera, CameraFrames, Drive
from v2hdm.verdict.verdict import Finding, Status, Verdict, judge, passed

CHECK = "origin height"
"""Name of this module's check."""

HEIGHT = "vehicle_frame_height_m"
"""The key of ``drive.yaml`` that states the height."""

# Standard deviations, m, of a camera's stated height above the vehicle's frame.
_DESIGNED_M = 0.03  # of a tree of frames: built as designed, on its tyres and springs
_TYPED_M = 0.1  # of a mounting that someone measured by tape, or took from a drawing
_GROUND_M = 0.02  # of the height that ground shows, beyond its own sigma: 1 cm mostly, 6 at worst
_SURE = 4.0  # sigmas of the common error, beyond which it is no camera's own
_LEAST_M = 0.08  # lower origins are within what tyres and loads do, and as much as ground can show


class _Height(NamedTuple):
    """The excess, m, of a camera's height over the stated one, and the sigma of their difference."""

    value_m: float
    sigma_m: float


def known_frames(camera: Camera, verdict: Verdict) -> CameraFrames:
    """A camera's frames for its calibration: without a chain if the ground contradicts their height."""
    raised = [finding for finding in verdict.raised if finding.check == CHECK]
    return replace(camera.frames, problem=raised[0].says) if raised else camera.frames


def height_to_state(drive: Drive, verdict: Verdict) -> float | None:
    """The height, m, of the vehicle's frame that its cameras show, where it contradicts the one stated."""
    errors_m = [finding.value for finding in verdict.raised if finding.check == CHECK]
    if not errors_m or errors_m[0] is None:
        return None
    return errors_m[0] + next(iter(drive.cameras.values())).frames.height_m


def frame_of(drive: Drive) -> str:
    """The frame that a drive's positions on the vehicle count from, in words."""
    return next(iter(drive.cameras.values())).frames.vehicle or "the origin of mountings and poses"


def check_origin_height(drive: Drive, ground: Mapping[str, GroundEstimate]) -> list[Finding]:
    """The common error of all stated heights of cameras; none where no camera states one."""
    stating = {name: camera for name, camera in drive.cameras.items() if _states_height(camera)}
    # One survey that is wrong is no sign of a wrong origin, and has a check of its own.
    is_lone_survey = len(stating) == 1 and not next(iter(stating.values())).frames.states_height
    if not ground or not stating or is_lone_survey:
        return []
    heights = {
        name: height
        for name in stating
        if name in ground and (height := _height_of(stating[name], ground[name])) is not None
    }
    frame = next(iter(stating.values())).frames
    origin = frame_of(drive)
    if not heights:
        says = "the ground does not show how high the cameras are: drive farther, on rougher ground, by day"
        return [Finding(CHECK, Status.PASS, None, _LEAST_M, "m", says, "poses")]
    values_m = np.array([height.value_m for height in heights.values()])
    weights = np.array([height.sigma_m for height in heights.values()]) ** -2
    common_m = float(weights @ values_m / weights.sum())
    limit_m = max(_LEAST_M, _SURE / float(np.sqrt(weights.sum())))
    if (np.abs(values_m - common_m) * np.sqrt(weights) > _SURE).any():
        says = "the cameras' heights above the ground differ from those stated, but not by one height"
        return [passed(CHECK, "poses", says, common_m, "m")]
    state_m = frame.height_m + common_m
    where = f"{abs(common_m):.2f} m {'below' if common_m > 0 else 'above'}"
    stated = f"the {frame.height_m:g} m below it that are stated" if frame.height_m else origin
    finding = judge(
        CHECK, "poses", common_m, limit_m, "m",
        fine=f"the ground is where the cameras' stated heights put it, below {origin}",
        wrong=f"all cameras show the ground {where} {stated}: heights of the map and calibrations in frames "
        f"of the vehicle are wrong by that; state {HEIGHT}: {state_m:.2f}, the height of "
        f"{origin} above the ground",
        status=Status.WARN,
    )  # fmt: skip
    return [finding]


def _states_height(camera: Camera) -> bool:
    """Whether a camera has a height to compare."""
    frames = camera.frames
    return frames.states_height or (bool(frames.vehicle) and camera.centre_prior is not None)


def _height_of(camera: Camera, estimate: GroundEstimate) -> _Height | None:
    """The height of a camera by bare ground; None where that does not show it."""
    up = estimate.parameters.get("up_m")
    is_found = estimate.status is GroundStatus.FOUND and estimate.reading is Reading.AS_GIVEN
    if up is None or not up.observable or not is_found:
        return None
    stated_m = _DESIGNED_M if camera.frames.steps and not camera.frames.problem else _TYPED_M
    if camera.centre_prior is not None:
        stated_m = float(camera.centre_prior.sigma_m[2])
    return _Height(up.value, float(np.hypot(np.hypot(stated_m, _GROUND_M), up.sigma)))
