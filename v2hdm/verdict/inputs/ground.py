"""Findings from bare ground, matched between images: one for each quantity that the drive states.

The limits are above all values of twelve clean drives of a camera, and below the smallest fault that harms a
map; a quantity must also be off by five of its own sigmas.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.ground.results import STEEP_RAD, GroundEstimate, GroundOptions, GroundStatus, Parameter, Reading
from v2hdm.records import FOOT_M, Camera, Drive, FloatArray, Trajectory
from v2hdm.verdict.inputs.heading import Path
from v2hdm.verdict.verdict import Finding, Status, judge, passed

_SURE = 5.0  # sigmas by which a quantity must be off to be reported
_CLOCK_S = 0.015  # clocks of clean drives were found right to 7 ms; 15 ms at 5 m/s are 7 cm
_CORRECTABLE_S = 0.25  # a clock error above this may lie beyond the search; it is not corrected
# Focal lengths of clean drives were found right to 0.8 %; confusion with the pitch costs 1 to 2 %.
_FOCAL = 0.025
# Change of k1 that moves the corner of a lens 74 deg wide by 3 px; clean drives stay below 0.001.
_DISTORTION = 0.02
_GRADE = 0.001  # rise of the poses over the ground, m per m: clean drives stay below 0.0003
_UP_M = 0.08  # heights of clean drives were found right to 6 cm, mostly to 1
_ALONG_M = 0.15  # places in the plane of clean drives were found right to 8 cm
_VAGUE_M = 0.1  # largest sigma of a place in the plane that tests a survey
# Median residual of matched patches: 0.23 to 0.46 on clean drives, 1.1 to 1.5 without a lens' distortion.
_RESIDUAL = 0.8
_POSE_SIGMAS = 3.0  # RMS of the poses' errors in their stated sigmas: up to 2.2 on clean drives
# Lead of another reading over the one as given in the fraction of matching patches: on clean turning drives
# others are 0.1 to 0.2 behind, and differ by 0.03 between pairs of images.
_LEADS = 0.05
# A third of the usual pairs suffices to see whether the ground matches.
_QUICK = GroundOptions(pairs=12, free=(), readings=False)

MATCH = "ground match"  # the check whether bare ground matches between the images of a camera
PATH = "path"  # the check whether it does as the poses are given

CHECKS = (
    MATCH, PATH, "clock", "focal length from ground", "distortion", "grade", "survey height",
    "survey forward", "survey left", "ground residual", "poses against ground",
)  # fmt: skip
"""Names of the checks of this module."""

_READ_AS: Mapping[Reading, str] = {
    Reading.HEADING_FROM_PATH: "the ground matches only if the vehicle heads along its path: "
    "the recorded yaw is wrong (from north, clockwise, or off by a constant); fix it",
    Reading.MIRRORED: "the ground matches only if the path is mirrored: x and y of the positions are swapped "
    "(NED instead of east, north, up), or the images are mirrored; fix the positions or the images",
    Reading.BACKWARDS: "the ground matches only if the camera looks the other way: "
    "images of front and rear are swapped, or yaw is off by 180 deg; fix one of them",
}

_BEHIND_POSES = (Reading.MIRRORED, Reading.BACKWARDS)
"""Readings under which the vehicle goes where it points, too: poses do not tell them from the one given.

A yaw that is not along the path is told by the poses, and where it is along it, its noise alone makes more
ground match along the smoothed path: a lead of 0.03 on a clean drive, of 0.08 if the vehicle stood.
"""

NO_MATCH = (
    "bare ground does not match between the images with these stamps, poses, lens and guess: check the "
    "clock, the unit of the positions (feet?), whether the images are upside down, and the guessed mounting"
)
"""The sentence without a known cause."""

_NOT_CHECKED = {
    GroundStatus.TOO_LITTLE: "too little ground in view, or too little motion, to check lens, clock and "
    "mounting: drive farther, or enlarge roi_vehicle",
    GroundStatus.NO_TEXTURE: "too little of the ground matches other images to check lens and "
    "mounting: drive by day or with more light, shorter exposure, or on rougher ground",
}


@dataclass(frozen=True)
class _Check:
    """The check of a parameter: its limit, ``scale`` to ``unit``, and what is wrong, by its sign."""

    name: str
    limit: float
    unit: str
    scale: float
    status: Status
    ways: tuple[str, str]
    fine: str
    wrong: str


_CHECKS: Mapping[str, _Check] = {
    "focal_scale": _Check(
        "focal length from ground", _FOCAL, "%", 100.0, Status.FAIL, ("too short", "too long"),
        "the ground fits the focal length",
        "the focal length in camera_info is {size:.1f} % {way} for the ground; recalibrate",
    ),
    "distortion_k1": _Check(
        "distortion", _DISTORTION, "", 1.0, Status.FAIL, ("larger", "smaller"),
        "the ground fits the lens' distortion",
        "the distortion differs from distortion_coefficients: k1 should be {size:.2f} {way}; "
        "calibrate the camera (are they zero, or from another lens?)",
    ),
    "grade": _Check(
        "grade", _GRADE, "%", 100.0, Status.WARN, ("rise", "fall"),
        "the recorded heights and pitch fit the ground",
        "the poses {way} over the ground by {size:.2f} %: heights and pitch contradict each other; "
        "fix the receiver's pitch, or write both as 0",
    ),
    "up_m": _Check(
        "survey height", _UP_M, "m", 1.0, Status.WARN, ("low", "high"),
        "the ground fits the camera's surveyed height",
        "centre_prior is {size:.2f} m too {way} for what the ground shows; survey the camera's height above "
        "the road again, or increase its sigma_m",
    ),
    "forward_m": _Check(
        "survey forward", _ALONG_M, "m", 1.0, Status.WARN, ("far behind", "far ahead"),
        "the ground fits the camera's surveyed position along the vehicle",
        "centre_prior puts the camera {size:.1f} m too {way}: poses and survey have different origins (the "
        "antenna instead of the axle?), or its x is wrong; give both for one origin",
    ),
    "left_m": _Check(
        "survey left", _ALONG_M, "m", 1.0, Status.WARN, ("far to the right", "far to the left"),
        "the ground fits the camera's surveyed position across the vehicle",
        "centre_prior puts the camera {size:.1f} m too {way}: poses and survey have different origins (an "
        "antenna at the side?), or its y is wrong; give both for one origin",
    ),
}  # fmt: skip


def rival_of(ground: Mapping[str, GroundEstimate]) -> Reading | None:
    """A reading of the poses that fits every camera better than the one given, if that leaves errors."""
    asked = [estimate for estimate in ground.values() if estimate.status is GroundStatus.FOUND]
    if len(asked) < len(ground) or not any(_is_bent(estimate) for estimate in asked):
        return None
    leads = {
        reading: min(
            estimate.shares.get(reading, 0.0) - estimate.shares.get(Reading.AS_GIVEN, 0.0)
            for estimate in asked
        )
        for reading in _BEHIND_POSES
    }
    best = max(leads, key=lambda reading: leads[reading])
    return best if leads[best] > _LEADS else None


def _is_bent(estimate: GroundEstimate) -> bool:
    focal = estimate.parameters.get("focal_scale")
    return (
        _is_off(estimate.parameters.get("clock_s"))
        or (focal is not None and focal.observable and abs(focal.value) > _FOCAL)
        or max(estimate.innovations.values(), default=0.0) > _POSE_SIGMAS
    )


def path_of(ground: Mapping[str, GroundEstimate]) -> Path | None:
    """The recorded path, judged by all cameras' ground; None if they disagree or do not show it."""
    rival = rival_of(ground)
    readings = {
        rival or estimate.reading
        for estimate in ground.values()
        if estimate.status not in _NOT_CHECKED and max(estimate.shares.values(), default=0.0) > 0
    }
    path_by_reading = {
        Reading.AS_GIVEN: Path.AS_GIVEN,
        Reading.HEADING_FROM_PATH: Path.RIGHT_YAW_WRONG,
        Reading.MIRRORED: Path.MIRRORED,
    }
    return path_by_reading.get(readings.pop()) if len(readings) == 1 else None


def check_ground(
    drive: Drive, ground: Mapping[str, GroundEstimate], cause: str | None = None
) -> list[Finding]:
    """All findings from the cameras' ground; ``cause`` is the reason why none matches, if known."""
    rival = rival_of(ground)
    if rival is not None:
        return [_read_as(name, estimate, rival) for name, estimate in ground.items()]
    findings = [
        finding for name, estimate in ground.items() for finding in _camera(drive, name, estimate, cause)
    ]
    return [*findings, *_clocks(ground)]


def _read_as(name: str, estimate: GroundEstimate, reading: Reading) -> Finding:
    as_given = estimate.shares.get(Reading.AS_GIVEN, 0.0)
    best = estimate.shares.get(reading, 0.0)
    return Finding(PATH, Status.FAIL, as_given, best, "", _READ_AS[reading], name)


def _camera(drive: Drive, name: str, estimate: GroundEstimate, cause: str | None) -> list[Finding]:
    as_given = estimate.shares.get(Reading.AS_GIVEN, 0.0)
    if estimate.reading is not Reading.AS_GIVEN:
        return [_read_as(name, estimate, estimate.reading)]
    if estimate.status in _NOT_CHECKED and cause is None:
        return [passed(MATCH, name, _NOT_CHECKED[estimate.status])]
    if estimate.status is not GroundStatus.FOUND:
        return [Finding(MATCH, Status.FAIL, as_given, None, "", cause or NO_MATCH, name)]
    matched = passed(MATCH, name, "bare ground matches between the images", as_given)
    surveyed = drive.cameras[name].centre_prior is not None
    judged = [
        _judge_parameter(name, parameter, _confounded(estimate, key))
        for key, parameter in estimate.parameters.items()
        if key in _CHECKS and (surveyed or not key.endswith("_m"))
    ]
    return [matched, *judged, *_fit(name, estimate, judged)]


def _confounded(estimate: GroundEstimate, key: str) -> str:
    """Why this drive confuses a parameter of the lens with another quantity; empty if it does not.

    Clean drives: on a straight one, focal lengths came out 6 and 8 % wrong at 15 sigmas, since height and
    focal length slide together; with a level camera, k1 came out 0.05 wrong at 10 sigmas.
    """
    ahead = estimate.parameters.get("forward_m")
    if key == "focal_scale" and ahead is not None and not ahead.observable:
        return "on a straight road focal length and height slide together: include a turn"
    calibration = estimate.calibration
    if key == "distortion_k1" and calibration is not None:
        down_rad = np.arcsin(-calibration.cam_from_vehicle[2, 2])
        if down_rad < STEEP_RAD:
            return "the camera looks too level, so that lens distortion and a curved road look alike"
    return ""


def _judge_parameter(name: str, parameter: Parameter, confounded: str) -> Finding:
    check = _CHECKS[parameter.name]
    vague = parameter.name in ("forward_m", "left_m") and parameter.sigma > _VAGUE_M
    if not parameter.observable or vague or confounded:
        why = parameter.why_not or confounded or "the route turns too little; include a turn"
        says = f"this drive does not show it: {why}"
        return Finding(check.name, Status.PASS, None, check.scale * check.limit, check.unit, says, name)
    value = check.scale * parameter.value
    limit = check.scale * max(check.limit, _SURE * parameter.sigma)
    wrong = check.wrong.format(size=abs(value), way=check.ways[parameter.value < 0])
    return judge(
        check.name, name, value, limit, check.unit, fine=check.fine, wrong=wrong, status=check.status
    )


def _fit(name: str, estimate: GroundEstimate, judged: list[Finding]) -> Iterator[Finding]:
    """Residuals and errors of poses: signs of faults that no parameter above explains."""
    yield judge(
        "ground residual", name, estimate.median_residual, _RESIDUAL, "",
        fine="matched ground lies where lens and mounting predict",
        wrong="matched ground does not lie where any mounting puts it: the lens' distortion or focal "
        "length in camera_info is wrong, or the road in the ROI is no plane",
    )  # fmt: skip
    raised = any(finding.status is not Status.PASS for finding in judged)
    innovations = {part: sigmas for part, sigmas in estimate.innovations.items() if np.isfinite(sigmas)}
    if innovations and not raised and not _is_off(estimate.parameters.get("clock_s")):
        part = max(innovations, key=lambda key: innovations[key])
        yield judge(
            "poses against ground", name, innovations[part], _POSE_SIGMAS, "",
            fine="the images move as the poses do, within pose_noise",
            wrong=f"images and poses move differently: their {part} is {innovations[part]:.0f} times "
            "pose_noise off; state the actual noise, or check the clock",
            status=Status.WARN,
        )  # fmt: skip


def clock_corrections(ground: Mapping[str, GroundEstimate]) -> dict[str, float]:
    """Exposure minus stamp, s, of cameras whose clock is surely and correctably off."""
    if rival_of(ground) is not None:
        return {}
    clocks = {name: clock for name, clock in _asked_clocks(ground).items() if _is_off(clock)}
    return {name: clock.value for name, clock in clocks.items() if abs(clock.value) <= _CORRECTABLE_S}


def _asked_clocks(ground: Mapping[str, GroundEstimate]) -> dict[str, Parameter]:
    return {
        name: estimate.parameters["clock_s"]
        for name, estimate in ground.items()
        if "clock_s" in estimate.parameters and estimate.reading is Reading.AS_GIVEN
    }


def _is_off(clock: Parameter | None) -> bool:
    return clock is not None and clock.observable and abs(clock.value) > max(_CLOCK_S, _SURE * clock.sigma)


def _clocks(ground: Mapping[str, GroundEstimate]) -> Iterator[Finding]:
    """Each camera's clock; one sentence for all if they are off alike."""
    clocks = _asked_clocks(ground)
    late = [clock.value for clock in clocks.values() if _is_off(clock)]
    common = len(late) == len(clocks) > 1 and np.ptp(late) < _CLOCK_S
    for name, clock in clocks.items():
        if not clock.observable:
            says = f"this drive cannot tell whether the clock is right: {clock.why_not}"
            yield Finding("clock", Status.PASS, None, 1e3 * _CLOCK_S, "ms", says, name)
            continue
        size = abs(1e3 * clock.value)
        way = "later" if clock.value > 0 else "earlier"
        correctable = abs(clock.value) <= _CORRECTABLE_S
        recovery = "the map is corrected for it; fix the stamps" if correctable else "fix the stamps"
        whose = "all cameras equally: the poses' clock is off" if common else "this camera's clock is off"
        yield judge(
            "clock", name, 1e3 * clock.value, 1e3 * max(_CLOCK_S, _SURE * clock.sigma), "ms",
            fine="images and poses are on one clock",
            wrong=f"the images were taken {size:.0f} ms {way} than their stamps say ({whose}); {recovery}",
            status=Status.WARN if correctable else Status.FAIL,
        )  # fmt: skip


def find_cause(drive: Drive, ground: Mapping[str, GroundEstimate]) -> str | None:
    """The usual mistake whose correction makes the ground match, if it never does; else None."""
    lost = [
        name
        for name, estimate in ground.items()
        if estimate.status in (GroundStatus.NO_MATCH, GroundStatus.NO_TEXTURE)
        and estimate.reading is Reading.AS_GIVEN
    ]
    if not lost or len(lost) < len(ground):
        return None
    from v2hdm.ground.estimate import estimate_ground

    for undo, says in _MISTAKES:
        if estimate_ground(undo(drive), lost[0], _QUICK).status is GroundStatus.FOUND:
            return says
    return None


def scaled(drive: Drive, factor: float) -> Drive:
    """The drive with all positions multiplied by ``factor``."""

    def moved(map_from_vehicle: FloatArray) -> FloatArray:
        matrices = map_from_vehicle.copy()
        matrices[..., :3, 3] *= factor
        return matrices

    def along(path: Trajectory | None) -> Trajectory | None:
        return None if path is None else replace(path, map_from_vehicle=moved(path.map_from_vehicle))

    images = [replace(image, map_from_vehicle=moved(image.map_from_vehicle)) for image in drive.images]
    trajectory = along(drive.trajectory)
    recorded = along(drive.recorded)
    return replace(drive, images=images, trajectory=trajectory, recorded=recorded, road=None)


def upside_down(drive: Drive) -> Drive:
    """The drive as if all images were rotated by 180 deg: their lenses and IPMs are instead."""
    return replace(drive, cameras={name: _turned(camera) for name, camera in drive.cameras.items()})


def _turned(camera: Camera) -> Camera:
    info = camera.info
    turn = np.array([[-1.0, 0, info.width - 1], [0, -1.0, info.height - 1], [0, 0, 1]])
    intrinsic = info.intrinsic.copy()
    intrinsic[:2, 2] = np.array([info.width - 1, info.height - 1]) - intrinsic[:2, 2]
    distortion = list(info.distortion)
    if info.distortion_model != "equidistant":
        distortion[2:4] = [-distortion[2], -distortion[3]]  # p1 and p2 are even in the point, k1 ... odd
    return replace(
        camera,
        info=replace(info, intrinsic=intrinsic, distortion=tuple(distortion)),
        ipm={name: ipm @ turn for name, ipm in camera.ipm.items()},  # turn is its own inverse
    )


# Mistakes to try, the likelier first, and how to undo them; each costs seconds on a drive that fails anyway.
_MISTAKES: tuple[tuple[Callable[[Drive], Drive], str], ...] = (
    (
        lambda drive: scaled(drive, FOOT_M),
        "the ground matches if positions are in feet; multiply them by 0.3048 to get metres",
    ),
    (
        upside_down,
        "the ground matches if the images are rotated by 180 deg: they are upside down; rotate them",
    ),
)
