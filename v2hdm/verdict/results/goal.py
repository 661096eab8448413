"""Whether map and calibrations are as good as the user asks: ``accuracy_goal_cm``, at 95 %.

A map meets the goal where 95 % of its corners lie within that radius, by the covariances that it states in
its own frame: what moves all markings alike counts in full. A mounting meets it where it leaves the ground
ahead known as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.optimize import brentq

from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.results import MethodResult, SolveEvidence
from v2hdm.records import Calibration, FloatArray, Marking
from v2hdm.site.candidates import LACKS_A_CORNER, TOO_UNCERTAIN
from v2hdm.verdict.results.solution import doubted, name_of_input, relied_on
from v2hdm.verdict.verdict import GOAL, Finding, Status

_AHEAD_M = 10.0  # within which a vehicle uses what it sees on the ground
_SHARE = 0.95  # of the corners that have to meet the goal
_CIRCLE_95 = 2.4477  # radius, in sigmas of a coordinate, where both have the same


def check_goal(best: MethodResult, goal_m: float, frame: str) -> Iterator[Finding]:
    """The map against the largest 95 % radius ``goal_m``, then each mounting.

    ``frame`` is what the map's frame rests on, ``poses`` or ``survey``.
    """
    markings, goal = best.hd_map.markings, f"; goal {100 * goal_m:g} cm"
    if markings:
        radius_m = np.array([_corner_radii_m(one) for one in markings])
        reached_m = _radius_of_all_m(radius_m.ravel())
        corners = f"95 % of the corners of {len(markings)} markings"
        says = f"{corners} within {_cm(reached_m)} in the frame of the {frame}"
        says += "" if best.evidence is None else _conditions(best.evidence)
        relative_m = [_CIRCLE_95 * m.relative_sigma_m for m in markings if m.relative_sigma_m is not None]
        if relative_m:
            says += f", {_cm(_radius_of_all_m(np.array(relative_m)))} from marking to marking"
        # The map's own limit on sigmas leaves the worst out, so that the share alone would flatter.
        uncertain = sum(one.reason in (TOO_UNCERTAIN, LACKS_A_CORNER) for one in best.excluded)
        says += f"{goal}; {uncertain} more left out as too uncertain" if uncertain else goal
        coarse = [one for one, own_m in zip(markings, radius_m.max(axis=1), strict=True) if own_m > goal_m]
        met = 100 * (len(markings) - len(coarse)) // len(markings)
        yield _judged(
            "map",
            reached_m,
            goal_m,
            says,
            f"{met} % of the markings meet it; {_largest_part(best, coarse or markings)}",
        )
    for name, one in best.calibrations.items():
        left_m, helps = ground_ahead(one)
        says = f"its mounting leaves the ground ahead known to {_cm(left_m)} (95 %){goal}"
        yield _judged(name, left_m, goal_m, says, helps)


def _conditions(evidence: SolveEvidence) -> str:
    """The inputs that absolute accuracy rests on: one that may be wrong, or those that no image shows."""
    doubtful, relied = doubted(evidence), relied_on(evidence)
    if doubtful is not None:
        return f" (unless the {name_of_input(doubtful)} is off, as it may be)"
    return f" (if {' and '.join(relied)} are right, which this drive cannot show)" if relied else ""


def _judged(about: str, radius_m: float, goal_m: float, says: str, helps: str) -> Finding:
    status = Status.PASS if radius_m <= goal_m else Status.WARN
    value = 100 * radius_m if np.isfinite(radius_m) else None
    says = says if status is Status.PASS else f"{says}: {helps}"
    return Finding(GOAL, status, value, 100 * goal_m, "cm", says, about)


def _largest_part(best: MethodResult, coarse: Sequence[Marking]) -> str:
    """The largest of the errors that are stated of the markings that miss the goal, and what helps."""
    pose_m = [] if best.poses is None else _CIRCLE_95 * best.poses.sigma[best.poses.seen, :2].max(axis=1)
    parts = [
        (_median(pose_m), "the poses: tie them down by mapping.survey"),
        (_median([_own_m(one) for one in coarse]), "each marking's own views: pass them nearer and again"),
    ]
    # What one camera leaves open, a better one settles.
    left_m, helps = min(map(ground_ahead, best.calibrations.values()), default=(np.inf, ""))
    if np.isfinite(left_m):
        parts.append((left_m, f"the mounting: {helps}"))
    size_m, part = max(parts)
    return f"the largest part, {_cm(size_m)}, is {part}"


def _corner_radii_m(marking: Marking) -> FloatArray:
    """The 95 % radii (4,) of a marking's corners, m; infinite where no covariance is stated."""
    if marking.covariance_m2 is None:
        return np.full(4, np.inf)
    blocks = np.einsum("iaib->iab", marking.covariance_m2.reshape(4, 2, 4, 2))
    return np.array([_radius_m(block) for block in blocks])


def _radius_of_all_m(radius_m: FloatArray) -> float:
    """The radius that holds 95 % of all corners, given the radius (N,) that holds each with 95 %.

    Errors are circular normal: with 1 - .05^((r / own)^2) a corner lies within r.
    """
    if np.mean(np.isfinite(radius_m)) < _SHARE:
        return float("inf")

    def missing(radius: float) -> float:
        return float(np.mean((1 - _SHARE) ** ((radius / radius_m) ** 2))) - (1 - _SHARE)

    return float(brentq(missing, 0.0, 5.0 * float(radius_m[np.isfinite(radius_m)].max())))


def _own_m(marking: Marking) -> float:
    """The 95 % radius, m, of a marking's part in a distance and of its worst corner beside its centre."""
    if marking.covariance_m2 is None:
        return 0.0
    centre_m = _radius_m(np.einsum("iajb->ab", marking.covariance_m2.reshape(4, 2, 4, 2)) / 16)
    shape_m2 = max(float(_corner_radii_m(marking).max()) ** 2 - centre_m**2, 0.0)
    return float(np.hypot(_CIRCLE_95 * (marking.relative_sigma_m or 0.0), np.sqrt(shape_m2)))


def ground_ahead(calibration: Calibration) -> tuple[float, str]:
    """The 95 % radius, m, of a ground point as a mounting places it, and what would make it smaller.

    The point is where the camera looks, or 10 m ahead where that is farther; infinite if unknown.
    """
    moves, covariance = _ground_jacobian(calibration.cam_from_vehicle), calibration.covariance
    if covariance is None:
        return float("inf"), "it saw no marking of the map"
    place_m, turn_m, left_m = (
        _radius_m(moves[:, own] @ covariance[own, own] @ moves[:, own].T)
        for own in (slice(0, 3), slice(3, 6), slice(6))
    )
    of_place, of_turn = "drive a turn, or survey the camera's place", "drive past more markings, near and far"
    return left_m, of_place if place_m > turn_m else of_turn


def _ground_jacobian(cam_from_vehicle: FloatArray) -> FloatArray:
    """How the ground (x, y) at one pixel moves with the mounting's left tangent: (2, 6)."""
    to_vehicle, height_m = cam_from_vehicle[:3, :3].T, camera_centre(cam_from_vehicle)[2]
    axis, level = to_vehicle[:, 2], float(np.hypot(*to_vehicle[:2, 2]))
    is_near = -axis[2] * _AHEAD_M > level * height_m
    x, y, z = axis * height_m / -axis[2] if is_near else (*axis[:2] * _AHEAD_M / level, -height_m)
    # exp(xi) moves a point p of the camera by -R'(v + w x p) in the vehicle; its ray meets the ground anew.
    turned = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ to_vehicle
    moved = np.hstack([-to_vehicle, turned])
    return np.asarray(moved[:2] - np.outer([x / z, y / z], moved[2]))


def _radius_m(covariance_m2: FloatArray) -> float:
    """The largest radius, m, that holds 95 % of errors of covariances (..., 2, 2), by Leenhouts (1985)."""
    minor, major = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2), 1e-18)).T
    return float(np.max(major * np.polyval((0.371625, 0.114276, 0.004071, 1.960790), minor / major)))


def _median(values: Sequence[float] | FloatArray) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _cm(size_m: float) -> str:
    return f"{100 * size_m:.{int(size_m < 0.1)}f} cm" if np.isfinite(size_m) else "an unknown distance"
