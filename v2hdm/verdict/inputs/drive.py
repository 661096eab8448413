"""All checks before a run: poses, clocks, noise, road, cameras, images, and bare ground.

A camera's intrinsics, guess, survey and ROI are compared with each other, without its images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from v2hdm.doors import checked
from v2hdm.executor import open_executor
from v2hdm.geometry.ipm import apply_homography, initial_extrinsic
from v2hdm.geometry.lens import distort_points, has_distortion, undistort_points
from v2hdm.geometry.planar import inside_convex, signed_area
from v2hdm.geometry.rigid import camera_centre
from v2hdm.ground.results import GroundEstimate
from v2hdm.io.drive import as_drive
from v2hdm.io.drive.road import unevenness
from v2hdm.records import FOOT_M, Camera, CameraInfo, CentrePrior, Drive, FloatArray
from v2hdm.settings import Processes
from v2hdm.verdict.inputs import ground as ground_checks
from v2hdm.verdict.inputs.alignment import check_alignment
from v2hdm.verdict.inputs.ground import check_ground, find_cause, path_of
from v2hdm.verdict.inputs.heading import check_heading
from v2hdm.verdict.inputs.origin import CHECK as ORIGIN_HEIGHT
from v2hdm.verdict.inputs.origin import check_origin_height
from v2hdm.verdict.inputs.poses import Motion, check_attitude, check_jumps, check_noise, check_path
from v2hdm.verdict.inputs.recording import check_clocks, check_images
from v2hdm.verdict.verdict import Finding, Status, Verdict, judge, passed

# Lenses are centred to a few percent of the image's width; cropped images are rarely farther off than this.
_OFF_CENTRE = 0.15
# A principal point in the middle of an image smaller or larger by this is of another resolution.
_OTHER_SIZE = 0.15
_SHORTEST = 0.3  # focal length, in image widths, of the widest lens for roads but fisheyes: 118 deg
_LONGEST = 5.0  # focal length, in image widths, of the narrowest lens that maps roads: 11 deg
_SQUARE = 0.03  # pixels are square to far less than this
_MISSHAPEN = 0.03  # clicked homographies depart from K [r1 r2 t] by about one percent
_BORROWED_M = 1.0  # a guess from another vehicle of the same type, or from a drawing, is decimetres off
_NEAR_SURVEY_M = 0.6  # distance of survey and guess at which a changed sign or unit is the cause
# Units that surveys come in, in 1/m.
_SURVEY_UNITS = {"centimetres": 1e2, "millimetres": 1e3, "feet": 1 / FOOT_M, "inches": 1 / 0.0254}
_ROI_IN_VIEW = 0.5  # at least this share of the ROI must be in the image
_ROI_AREA_M2 = 4.0  # a smaller ROI holds no whole marking: a dash alone is 3 m long
# Ground per pixel, along the view, at the ROI's far end: beyond, a pixel of noise is half a metre.
_COARSEST_M = 0.5
_TILTED_DEG = 30.0  # cameras for roads are mounted upright
_LOWEST_M = 0.3  # least height of a camera on a vehicle
_HIGHEST_M = 12.0  # largest height of a camera on a vehicle, straddle carriers included


def check_camera(name: str, camera: Camera) -> list[Finding]:
    """All checks of one camera's description."""
    cam_from_vehicle = initial_extrinsic(camera)
    findings = [
        *check_intrinsics(name, camera.info, is_rectified=camera.frames.rectified_from_camera is not None),
        *check_roi(name, camera, cam_from_vehicle),
        _shape(name, camera.info, camera.ipm[camera.initial_ipm]),
        *_mounting(name, cam_from_vehicle),
    ]
    if camera.centre_prior is not None:
        findings.append(check_survey(name, camera.centre_prior, camera_centre(cam_from_vehicle)))
    return findings


def check_intrinsics(name: str, info: CameraInfo, *, is_rectified: bool = False) -> Iterator[Finding]:
    """Camera matrix against image size; images that were rectified have whatever focal lengths P states."""
    (fx, _, cx), (_, fy, cy), _ = info.intrinsic
    off = max(abs(cx + 0.5 - info.width / 2), abs(cy + 0.5 - info.height / 2)) / info.width
    scale_u = (2 * cx + 1) / info.width
    scale_v = (2 * cy + 1) / info.height
    other = abs(scale_u / max(scale_v, 1e-9) - 1) < _OTHER_SIZE and abs(scale_u - 1) > _OTHER_SIZE
    size = f"{scale_u * info.width:.0f} x {scale_v * info.height:.0f}"
    cause = (
        f"camera_info is for images of about {size}, these are {info.width} x {info.height}; divide fx, "
        f"fy, cx, cy by {scale_u:.3g}"
        if other
        else f"the principal point is {100 * off:.0f} % of the width off the image's centre; check cx and cy"
    )
    yield judge(
        "principal point", name, off, _OFF_CENTRE, "",
        fine="the principal point is near the image's centre",
        wrong=cause,
        status=Status.FAIL if other else Status.WARN,
    )  # fmt: skip
    focal = fx / info.width
    yield judge(
        "focal length", name, focal, _LONGEST, "image widths", least=_SHORTEST,
        fine="the focal length is plausible for road cameras",
        wrong=f"fx is {focal:.2g} image widths, implausible; give it in px of these images, not in mm",
    )  # fmt: skip
    if not is_rectified:
        yield judge(
            "square pixels", name, fx / fy - 1, _SQUARE, "",
            fine="fx and fy agree",
            wrong=f"the focal lengths fx {fx:.0f} and fy {fy:.0f} differ by {100 * abs(fx / fy - 1):.0f} %, "
            "but pixels are square; check both in camera_info",
            status=Status.WARN,
        )  # fmt: skip
    yield _lens(name, info)


def check_roi(name: str, camera: Camera, cam_from_vehicle: FloatArray) -> list[Finding]:
    """Whether the ROI lies before the camera, in its image, and neither too far nor too small."""

    def failed(value: float, limit: float, unit: str, says: str) -> list[Finding]:
        return [Finding("roi", Status.FAIL, value, limit, unit, says, name)]

    grid = _grid(camera.roi_vehicle)
    depth = np.column_stack([grid, np.zeros(len(grid)), np.ones(len(grid))]) @ cam_from_vehicle[2]
    before = 1 - float((depth <= 0).mean())
    if before < _ROI_IN_VIEW:
        says = (
            "roi_vehicle lies behind the camera: its x, or the guess, has the wrong sign (x is forward, a "
            "rear camera's ROI has negative x); fix one of them"
        )
        return failed(before, _ROI_IN_VIEW, "", says)
    share_in_view = _share_in_image(camera, grid, depth)
    if share_in_view < _ROI_IN_VIEW:
        says = (
            f"only {100 * share_in_view:.0f} % of roi_vehicle is in the image, according to the guessed "
            "mounting: fix roi_vehicle or the guess"
        )
        return failed(share_in_view, _ROI_IN_VIEW, "", says)
    area = abs(float(signed_area(camera.roi_vehicle)))
    if area < _ROI_AREA_M2:
        says = f"roi_vehicle covers {area:.2g} m2, less than a marking; enlarge it (metres, not kilometres)"
        return failed(area, _ROI_AREA_M2, "m2", says)
    farthest = _farthest(name, camera, cam_from_vehicle, grid[depth > 0])
    return [passed("roi", name, "the ROI is in the image", share_in_view), farthest]


def check_survey(name: str, prior: CentrePrior, guess_vehicle: FloatArray) -> Finding:
    """The surveyed centre against the one that the guess implies, which may be borrowed."""
    survey = prior.centre_vehicle
    away = float(np.linalg.norm(survey - guess_vehicle))
    return judge(
        "survey against guess", name, away, _BORROWED_M + 3 * float(np.linalg.norm(prior.sigma_m)), "m",
        fine="survey and guess put the camera at about the same place",
        wrong=f"centre_prior puts the camera {away:.1f} m away from its guess: "
        f"{_survey_cause(survey, guess_vehicle)}",
    )  # fmt: skip


def _survey_cause(survey: FloatArray, guess: FloatArray) -> str:
    for axis, letter in enumerate("xyz"):
        flipped = survey.copy()
        flipped[axis] *= -1
        if np.linalg.norm(flipped - guess) < _NEAR_SURVEY_M:
            return f"its {letter} has the wrong sign; write {flipped[axis]:.2f}"
    if np.linalg.norm(survey[[1, 0, 2]] - guess) < _NEAR_SURVEY_M:
        return "its x and y are swapped; x is forward, y left"
    for unit, scale in _SURVEY_UNITS.items():
        if np.linalg.norm(survey / scale - guess) < _NEAR_SURVEY_M:
            return f"it is in {unit}; write it in metres"
    offset = ", ".join(f"{value:+.1f}" for value in survey - guess)
    return f"by {offset} m in x, y, z; survey it from the vehicle's origin on the ground, or fix the guess"


def _mounting(name: str, cam_from_vehicle: FloatArray) -> Iterator[Finding]:
    height = float(camera_centre(cam_from_vehicle)[2])
    yield judge(
        "camera height", name, height, _HIGHEST_M, "m", least=_LOWEST_M,
        fine="the guessed camera height is plausible for a vehicle",
        wrong=f"the guess puts the camera {height:.2f} m above the ground; fix the IPM (in metres)",
    )  # fmt: skip
    tilt_deg = float(np.rad2deg(np.arcsin(np.clip(-cam_from_vehicle[0, 2], -1, 1))))
    if cam_from_vehicle[1, 2] > 0:  # upside down
        tilt_deg = 180.0 - tilt_deg
    yield judge(
        "camera tilt", name, tilt_deg, _TILTED_DEG, "deg",
        fine="the guess has the camera upright",
        wrong=f"the guess tilts the camera by {tilt_deg:.0f} deg about its axis: its axes are x right, y "
        "down, z forward, and v counts downwards; fix the guess, or turn the images",
    )  # fmt: skip


def _shape(name: str, info: CameraInfo, ipm: FloatArray) -> Finding:
    """Deviation of the IPM from K [r1 r2 t]: its ground axes must be equally long and perpendicular."""
    columns = np.linalg.inv(info.intrinsic) @ np.linalg.inv(ipm)
    first = columns[:, 0]
    second = columns[:, 1]
    lengths = np.linalg.norm(first), np.linalg.norm(second)
    ratio = float(lengths[0] / lengths[1] - 1)
    cosine = float(first @ second / (lengths[0] * lengths[1]))
    value, part = max((abs(ratio), "the focal length"), (abs(cosine), "the principal point"))
    return judge(
        "ipm against camera matrix", name, value, _MISSHAPEN, "",
        fine="the IPM is a homography of this camera matrix",
        wrong=f"the IPM and camera_info differ by {100 * value:.0f} %, most in {part}: one of the two is "
        "wrong or at another resolution, or the IPM was made from distorted pixels; recalibrate it",
        status=Status.WARN,
    )  # fmt: skip


def _lens(name: str, info: CameraInfo) -> Finding:
    """Field of view, and whether the lens has distortion; only images show whether that is right."""
    corners = np.array([[0.0, info.height / 2], [info.width - 1.0, info.height / 2]])
    pinhole = (undistort_points(info, corners) - info.intrinsic[:2, 2]) / np.diag(info.intrinsic)[:2]
    width_deg = float(np.rad2deg(np.arctan(np.abs(pinhole[:, 0])).sum()))
    bends = "the lens is undistorted by its coefficients" if has_distortion(info) else "it has no distortion"
    return passed("field of view", name, f"{width_deg:.0f} deg wide; {bends}", width_deg, "deg")


def _farthest(name: str, camera: Camera, cam_from_vehicle: FloatArray, grid: FloatArray) -> Finding:
    """Ground along the view per pixel, m, at the ROI's far end: range^2 / (height focal)."""
    centre = camera_centre(cam_from_vehicle)
    range_m = float(np.linalg.norm(grid - centre[:2], axis=1).max())
    focal = float(camera.info.intrinsic[1, 1])
    coarse = (range_m**2 + centre[2] ** 2) / (max(centre[2], 0.1) * focal)
    return judge(
        "roi range", name, float(coarse), _COARSEST_M, "m/px",
        fine="a pixel covers little ground at the ROI's far end",
        wrong=f"roi_vehicle reaches {range_m:.0f} m, where a pixel covers {coarse:.1f} m; end it closer",
        status=Status.WARN,
    )  # fmt: skip


def _share_in_image(camera: Camera, grid: FloatArray, depth: FloatArray) -> float:
    info = camera.info
    ipm = np.asarray(np.linalg.inv(camera.ipm[camera.initial_ipm]))
    pinhole = apply_homography(ipm, grid[depth > 0])
    # Lens models fold over far outside the image: points of the pinhole there are not in it.
    in_view = inside_convex(_frame(info, 0.5), pinhole)
    points_px = distort_points(info, pinhole[in_view])
    return float(inside_convex(_frame(info, 0.0), points_px).sum() / len(grid))


def _frame(info: CameraInfo, margin: float) -> FloatArray:
    """The image's border, wider by ``margin`` of its size on each side."""
    left = -margin * info.width
    top = -margin * info.height
    right = info.width - 1 - left
    bottom = info.height - 1 - top
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _grid(polygon: FloatArray) -> FloatArray:
    """A grid of points (N, 2) in a convex polygon, with its corners."""
    left, low = polygon.min(axis=0)
    right, high = polygon.max(axis=0)
    x = np.linspace(left, right, 15)
    y = np.linspace(low, high, 15)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.vstack([polygon, grid[inside_convex(polygon, grid)]])


_ROAD_SIGMAS = 3.0  # sigmas of roll and pitch beyond which ground is bent, not noisy
_ROAD_BENT = 10.0  # sigmas of roll and pitch beyond which the map errs by many times what it states
_LEAST_SWAY_RAD = 0.003  # roll and pitch of every vehicle on its suspension, whatever pose_noise states
_STEPS = ("position jumps", "height jumps", "pose scatter", "image spacing", "pose gaps", "pose rate")
_MOUNTING = ("roi", "roi range", "ipm against camera matrix", "camera height", "survey against guess")
_SURVEY = ("survey height", "survey forward", "survey left")
_GROUND = (*ground_checks.CHECKS, ORIGIN_HEIGHT)

HIDES: Mapping[str, tuple[str, ...]] = {
    "path length": (*_STEPS, *_GROUND),
    "speed": (*_STEPS, *_GROUND),
    "heading": ("heading offset", "attitude", "pitch sign", "road", "origin", *_STEPS, *_GROUND),
    "attitude": ("pitch sign", "road", *_GROUND),
    "repeated poses": (*_STEPS, *_GROUND),
    "pose scatter": ("position jumps", *_GROUND),
    "position jumps": _GROUND,
    "pose stamps": ("pose scatter", *_GROUND),
    "pose noise": _GROUND,
    "height jumps": ("road", "grade", "ground match", "ground residual", "poses against ground"),
    "origin": ("survey forward", "poses against ground"),
    ORIGIN_HEIGHT: ("survey height",),
    "own images": ("frozen images", *_GROUND),
    "bright images": ("frozen images", "ground match"),
    "dark images": ("frozen images", "ground match"),
    "frozen images": _GROUND,
    "principal point": ("focal length", *_MOUNTING, *_GROUND),
    "focal length": (*_MOUNTING, *_GROUND),
    "square pixels": (
        "ipm against camera matrix", "ground residual", "focal length from ground", "distortion",
    ),
    "camera tilt": ("roi", "ground match"),
    "camera height": ("survey against guess", "ground match"),
    "roi": ("image spacing", "roi range", "ground match"),
    "survey against guess": _GROUND,
    "distortion": ("focal length from ground", "ground residual", *_SURVEY),
    "focal length from ground": ("ipm against camera matrix", "ground residual", *_SURVEY),
    "clock": ("survey forward", "survey left", "poses against ground"),
}  # fmt: skip
"""Checks that fail because another one did: the cause is reported, its consequences are not."""


@checked
def check_drive(
    drive: Drive | str | Path,
    *,
    ground: bool | Mapping[str, GroundEstimate] = True,
    workers: Processes = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Verdict:
    """Check a drive before any long work: poses, clocks, noise, cameras, images, and bare ground.

    Args:
        drive: the drive, or its folder.
        ground: whether to match bare ground (seconds per camera), or its estimates by camera.
        workers: processes that match ground.
        progress: called as ``progress(done, total)`` cameras.

    Returns:
        All findings, the worst first: each with value, limit, unit, cause and remedy.

    Raises:
        DriveError: the drive, or an image, cannot be read.

    >>> verdict = check_drive(port, ground=False)
    >>> verdict.status.value, len(verdict.raised)
    ('PASS', 0)
    """
    drive = as_drive(drive)
    if isinstance(ground, bool):
        from v2hdm.ground.estimate import estimate_cameras

        with open_executor(workers) as executor:
            ground = estimate_cameras(drive, executor, progress) if ground else {}
    return Verdict.of(input_findings(drive, ground))


def input_findings(drive: Drive, ground: Mapping[str, GroundEstimate] | None = None) -> list[Finding]:
    """The findings of :func:`check_drive`, causes without their consequences; raises DriveError as that."""
    ground = ground or {}
    motion = Motion.of(drive)
    findings = [
        *check_path(motion),
        *check_heading(motion, path_of(ground)),
        *check_alignment(motion, drive.pose_noise, drive.cameras, by_course=drive.headed_by_course),
        *check_attitude(motion),
        *check_jumps(motion, drive.pose_noise),
        *check_clocks(drive, motion),
        *check_noise(motion, drive.pose_noise),
        *check_road(drive),
    ]
    for name, camera in drive.cameras.items():
        findings += check_camera(name, camera)
    if not drive.has_pictures:
        return causes([*findings, *check_origin_height(drive, ground), _without_pictures()])
    findings += check_images(drive)
    explained = any("ground match" in HIDES.get(f.check, ()) for f in findings if f.status is not Status.PASS)
    # Where the ground never matches and nothing else explains that, usual mistakes are tried.
    findings += check_ground(drive, ground, None if explained else find_cause(drive, ground))
    findings += check_origin_height(drive, ground)
    return causes(findings)


def _without_pictures() -> Finding:
    """The finding that a drive without pictures leaves the checks of pictures undone."""
    says = (
        "the drive has detections in place of pictures: mountings, clocks and heights could not be compared "
        "with bare ground, nor could the images; the map alone speaks for them"
    )
    return passed("pictures", "images", says)


def check_road(drive: Drive) -> Iterator[Finding]:
    """Deviation of the ground from the plane beneath the vehicle, within the ROIs' reach."""
    if drive.road is None or len(drive.road.points_map) < 2:
        yield passed("road", "poses", "the ground was recorded as the plane z = 0", 0.0, "deg")
        return
    reach_m = max(
        float(np.linalg.norm(camera.roi_vehicle, axis=1).max()) for camera in drive.cameras.values()
    )
    worst = unevenness(drive.road, reach_m)
    lean_rad = worst.value_m / worst.distance_m
    sigma_rad = max(drive.pose_noise.roll_pitch_rad, _LEAST_SWAY_RAD)
    x, y = worst.at_map
    yield judge(
        "road", "poses", float(np.rad2deg(lean_rad)), float(np.rad2deg(_ROAD_SIGMAS * sigma_rad)), "deg",
        fine="the ground is a plane as far as the cameras look",
        wrong=f"{worst.station_m:.0f} m along the route, at x {x:.0f} m, y {y:.0f} m, the ground bends "
        f"by {worst.value_m:.2f} m over {worst.distance_m:.0f} m (a ramp, a crest or a banked curve): "
        "a plane misplaces markings there; leave mapping.ground at auto, or end roi_vehicle closer",
        status=Status.FAIL if lean_rad > _ROAD_BENT * sigma_rad else Status.WARN,
    )  # fmt: skip


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings that no other one explains (:data:`HIDES`), each as bad as the worst that it explains."""
    findings = list(findings)
    raised = [finding for finding in findings if finding.status is not Status.PASS]
    explained: set[int] = set()
    worst: dict[int, Status] = {}
    for cause in raised:
        consequences = [finding for finding in raised if _explains(cause, finding)]
        explained |= {id(finding) for finding in consequences}
        worst[id(cause)] = max(
            (finding.status for finding in (cause, *consequences)), key=lambda status: status.rank
        )
    return [
        replace(finding, status=worst.get(id(finding), finding.status))
        for finding in findings
        if id(finding) not in explained
    ]


def _explains(cause: Finding, finding: Finding) -> bool:
    same = cause.about == finding.about or cause.about.startswith("pose")
    return same and finding is not cause and finding.check in HIDES.get(cause.check, ())
