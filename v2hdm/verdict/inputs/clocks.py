"""Stamps of poses and images: rates, gaps, repeats, overlap."""

from __future__ import annotations

import numpy as np

from v2hdm.records import Drive, FloatArray
from v2hdm.verdict.inputs.motion import Motion
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.verdict import Finding, Status

_DRIVEN_MPS2 = 2.0
"""Acceleration and turning of ordinary driving: between poses t apart a line errs by this times t^2 / 8."""

_WITHOUT_POSE = 0.1
"""More than this share of images without a pose is no brief loss at the ends of a drive."""

_HALF = 0.5
"""Beyond this share of what was recorded the drive is not the one that was meant."""

_HELD = 0.02
"""More than this share of repeated poses on the way is a receiver slower than its log."""

_VIEWS = 2.0
"""A marking must be seen at least twice within the ROI to be placed and checked."""


def check_clocks(drive: Drive, motion: Motion) -> list[Finding]:
    """Whether poses come often enough, and images have poses."""
    findings = [*_pose_rate(drive, motion), *_held(motion)]
    spans = {name: _stamps(drive, name) for name in drive.cameras}
    for name, stamps in spans.items():
        findings += _posed(drive, name, len(stamps))
        if len(stamps):
            findings += [*_overlap(spans, name), *_spacing(drive, motion, name)]
    return findings


def _pose_rate(drive: Drive, motion: Motion) -> list[Finding]:
    if not motion.moving.any():
        return []
    interval_s = float(np.median(motion.interval_s[motion.moving]))
    longest_s = float(motion.interval_s[motion.moving].max())
    limit_s = float(np.sqrt(8 * max(drive.pose_noise.position_m, 0.01) / _DRIVEN_MPS2))
    error_m = _DRIVEN_MPS2 * longest_s**2 / 8
    rare = judge(
        "pose rate", "poses", interval_s, limit_s, "s",
        fine=f"{1 / interval_s:.0f} poses a second are enough",
        wrong=f"poses are {interval_s:.2f} s apart: between them they err by more than the stated noise; "
        "record the receiver's full rate",
        status=Status.WARN,
    )  # fmt: skip
    if rare.status is not Status.PASS:
        return [rare]
    return [
        rare,
        judge(
            "pose gaps", "poses", longest_s, max(2 * limit_s, 3 * interval_s), "s",
            fine="the poses have no gap while the vehicle moves",
            wrong=f"the poses have a gap of {longest_s:.2f} s while the vehicle moves, across which images' "
            f"poses err by {error_m:.2f} m; lower drive.max_gap_s below it or restore the missing poses",
            status=Status.WARN,
        ),
    ]  # fmt: skip


def _held(motion: Motion) -> list[Finding]:
    """Poses that repeat the one before while the vehicle moves."""
    if not motion.moving.any():
        return []
    same = (np.diff(motion.position, axis=0) == 0).all(axis=1) & motion.moving
    share = float(same.sum() / motion.moving.sum())
    after = motion.step_m[1:][same[:-1]]
    jump_m = float(after.max()) if len(after) else 0.0
    return [
        judge(
            "repeated poses", "poses", share, _HELD, "",
            fine="no pose repeats the one before while the vehicle moves",
            wrong=f"{100 * share:.0f} % of the poses repeat the one before while the vehicle moves, up to "
            f"{jump_m:.2f} m off: the log is faster than the receiver, or the receiver froze; drop the "
            "repeats",
        )
    ]  # fmt: skip


def _posed(drive: Drive, name: str, posed: int) -> list[Finding]:
    without = drive.unposed.get(name, 0)
    share = without / max(1, posed + without)
    return [
        judge(
            "images without pose", name, share, _WITHOUT_POSE, "",
            fine="the images have poses",
            wrong=f"{without} of {posed + without} images have no pose at their time: poses and images "
            "overlap only in part, or the poses have gaps; check that both are of the same drive and on "
            "one clock",
            status=Status.FAIL if share > _HALF else Status.WARN,
        )
    ]  # fmt: skip


def _overlap(spans: dict[str, FloatArray], name: str) -> list[Finding]:
    """How much of the time that any camera recorded this one missed."""
    if len(spans) < 2:
        return []
    start = min(stamps[0] for stamps in spans.values() if len(stamps))
    end = max(stamps[-1] for stamps in spans.values() if len(stamps))
    missed = 1 - (spans[name][-1] - spans[name][0]) / max(end - start, 1e-9)
    return [
        judge(
            "camera span", name, missed, _HALF / 2, "",
            fine="the camera records as long as the others",
            wrong=f"the camera misses {100 * missed:.0f} % of the time that another records; check that its "
            "stamps are on the common clock",
            status=Status.WARN,
        )
    ]  # fmt: skip


def _spacing(drive: Drive, motion: Motion, name: str) -> list[Finding]:
    """Distance between images where the vehicle moves, against the depth of the ROI."""
    images = [image for image in drive.images if image.camera == name]
    centres = np.array([image.map_from_vehicle[:2, 3] for image in images])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    steps = steps[steps > 0]
    if not len(steps) or not len(motion.chords):
        return []
    depth_m = float(np.ptp(drive.cameras[name].roi_vehicle[:, 0]))
    spacing_m = float(np.median(steps))
    return [
        judge(
            "image spacing", name, spacing_m, depth_m / _VIEWS, "m",
            fine="markings stay in the ROI for several images",
            wrong=f"images are {spacing_m:.1f} m apart and the ROI is {depth_m:.1f} m deep: markings are "
            "seen less than twice; drive slower, record more images or enlarge roi_vehicle",
            status=Status.WARN,
        )
    ]  # fmt: skip


def _stamps(drive: Drive, name: str) -> FloatArray:
    return np.array([image.stamp_s for image in drive.images if image.camera == name])
