"""Results against each other: cameras alone and together, markings and bare ground, markings that overlap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import cv2
import numpy as np
from scipy.spatial import KDTree

from v2hdm.geometry.ipm import centre_sigmas
from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.geometry.rigid import camera_centre, inverse, log
from v2hdm.ground.results import GroundEstimate, GroundStatus
from v2hdm.mapping.results import MethodResult, OffGround
from v2hdm.records import HEIGHT_NOISE, SIGMA_OF_MAD, Calibration, Drive, FloatArray, Marking
from v2hdm.verdict.verdict import Finding, Status, judge

SAME_M = 1.0  # centres of one marking in the maps of two cameras lie closer than this
_LEAST_SHARED = 8  # markings that two maps must share for their offset to be observable

_OFFSET_LIMIT_SIGMAS = 5.0
"""Largest offset of two cameras' maps, in sigmas of their centres and markings: below 3 on clean drives."""

_LEAST_OFFSET_M = 0.03  # a smaller offset is no finding, however sure it is: corners are good to 2 cm

_MOUNTING_LIMIT_SIGMAS = 5.0
"""Largest deviation of a camera's mounting, solved alone, from that solved with all cameras, in the sigmas of
the drift: below 2 on clean drives."""

_GROUND_LIMIT_SIGMAS = 4.0
"""Largest root mean square of a mounting's deviations, in the sigmas of both: less than one in a million by
chance."""

_LEAST_TURN_DEG = 0.2  # smallest angle between two mountings at which bare ground is the better judge
_LEAST_HEIGHT_M = 0.04  # least height difference, m, at which bare ground is the better judge
_OVERLAP = 0.1  # share of the smaller of two markings of a class that both cover; paint does not lie on paint
_DOUBLES_LIMIT = 0.02  # share of markings that overlap another: none on clean drives, 0.01 on old paint

_SAME_PLACE_M = 2.0  # largest distance between two passes of one place
_ANOTHER_PASS_M = 20.0  # least way between two passes of one place
_STOREY_M = 1.8  # least difference in height of two storeys of a car park
_SURE_SIGMAS = 5.0  # deviation of two passes' heights, in sigmas, that is no noise

_LEAST_VARIANCE = np.array([1e-8] * 3 + [1e-10] * 3)
"""Variances (m^2, rad^2) added to a mounting's: a tenth of a millimetre, a thousandth of a degree."""


def mounting_sigmas(mounting: Calibration, other: Calibration, of_both: bool = False) -> float:
    """Distance of two mountings, root mean square of six parameters in sigmas of ``mounting``, or of both."""
    assert mounting.covariance is not None
    covariance = mounting.covariance + np.diag(_LEAST_VARIANCE)
    if of_both and other.covariance is not None:
        covariance = covariance + other.covariance
    off = _difference(mounting, other)
    return float(np.sqrt(off @ np.linalg.solve(covariance, off) / len(off)))


def _difference(mounting: Calibration, other: Calibration) -> FloatArray:
    """The left tangent (6,) from ``other`` to ``mounting``: translation m, rotation rad."""
    return log(mounting.cam_from_vehicle @ inverse(other.cam_from_vehicle))


def check_agreement(together: MethodResult, drive: Drive) -> Iterator[Finding]:
    """Single cameras, by what each observed alone, against one another and, last, against all of them."""
    alone = together.alone
    for (first, a), (second, b) in combinations(alone.items(), 2):
        offset_m = shared_offsets(a, b, drive)
        if len(offset_m) >= _LEAST_SHARED:
            sigma_m = np.hypot(
                _centre_sigma_m(a.calibrations[first])[:2], _centre_sigma_m(b.calibrations[second])[:2]
            )
            yield _offset(first, second, offset_m, sigma_m)
    for name, result in alone.items():
        if result.calibrations[name].covariance is None or together.calibrations[name].covariance is None:
            continue
        sigmas = mounting_sigmas(result.calibrations[name], together.calibrations[name])
        yield judge(
            "alone and together", name, sigmas, _MOUNTING_LIMIT_SIGMAS, "sigmas",
            fine="solved alone, it has the same mounting as with the others",
            wrong=f"solved alone, its mounting is {sigmas:.0f} sigmas from that with the others"
            ": cameras do not agree; check its clock, its survey and camera_info",
        )  # fmt: skip


def _centre_sigma_m(calibration: Calibration) -> FloatArray:
    if calibration.covariance is None:
        return np.zeros(3)
    return centre_sigmas(calibration.cam_from_vehicle, calibration.covariance)


def _offset(first: str, second: str, offset_m: FloatArray, sigma_m: FloatArray) -> Finding:
    """How far two cameras' maps are apart (N, 2), forward and left, with the sigmas (2,) of their centres."""
    count = len(offset_m)
    middle = np.median(offset_m, axis=0)
    spread = SIGMA_OF_MAD * np.median(np.abs(offset_m - middle), axis=0) / np.sqrt(count)
    sigmas = np.where(np.abs(middle) > _LEAST_OFFSET_M, np.abs(middle) / np.hypot(sigma_m, spread), 0.0)
    axis = int(np.argmax(sigmas))
    where = (("behind", "ahead of"), ("right of", "left of"))[axis][int(middle[axis] > 0)]
    cause = ("clocks or forward surveys of a centre disagree", "headings or lateral surveys disagree")[axis]
    return judge(
        "cameras apart", f"{first}, {second}", float(sigmas[axis]), _OFFSET_LIMIT_SIGMAS, "sigmas",
        fine=f"{count} markings that both saw coincide",
        wrong=f"{second} maps {count} markings {100 * abs(middle[axis]):.0f} cm {where} where {first} "
        f"does: {cause}; synchronise and measure again",
    )  # fmt: skip


def shared_offsets(a: MethodResult, b: MethodResult, drive: Drive) -> FloatArray:
    """Offsets (N, 2), forward and left, of the markings of ``b`` from the nearest same ones of ``a``."""
    if not a.hd_map.markings or not b.hd_map.markings:
        return np.empty((0, 2))
    places = [np.array([marking.corners_map.mean(axis=0) for marking in r.hd_map.markings]) for r in (a, b)]
    trees = [KDTree(centres) for centres in places]
    distance_m, nearest_of_b = trees[1].query(places[0])
    _, nearest_of_a = trees[0].query(places[1])
    pairs = [
        (i, int(j))
        for i, j in enumerate(nearest_of_b)
        if nearest_of_a[j] == i
        and distance_m[i] < SAME_M
        and a.hd_map.markings[i].kind == b.hd_map.markings[j].kind
    ]
    if not pairs:
        return np.empty((0, 2))
    first, second = np.array(pairs).T
    offset_m = places[1][second] - places[0][first]
    poses = np.stack([image.map_from_vehicle for image in drive.images])
    _, nearest = KDTree(poses[:, :2, 3]).query(places[0][first])
    forward = poses[nearest, :2, 0]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return np.stack([(offset_m * forward).sum(1), (offset_m * turned_left(forward)).sum(1)], axis=1)


def check_against_ground(best: MethodResult, ground: Mapping[str, GroundEstimate]) -> Iterator[Finding]:
    """Each camera's mounting from markings against that from bare ground, where there is one.

    Where the solve has taken the ground in, what it owes to it has been taken out again.
    """
    for name, mapped in best.calibrations.items():
        estimate = ground.get(name)
        if estimate is None or estimate.status is not GroundStatus.FOUND or estimate.calibration is None:
            continue
        if mapped.covariance is None or estimate.calibration.covariance is None:
            continue
        taken_in = best.off_ground.get(name)
        if taken_in is not None and taken_in.is_of(estimate.plane):
            yield _judged(name, taken_in)
        else:
            yield _judged(name, _against(mapped, estimate.calibration))


def _against(mapped: Calibration, ground: Calibration) -> OffGround:
    """A mounting ``mapped`` without that ground, against the ground's."""
    off = _difference(ground, mapped)
    turn_deg = np.rad2deg(mapped.cam_from_vehicle[:3, :3].T @ off[3:])
    up_m = float(camera_centre(mapped.cam_from_vehicle)[2] - camera_centre(ground.cam_from_vehicle)[2])
    return OffGround(turn_deg, up_m, mounting_sigmas(ground, mapped, of_both=True))


def _judged(name: str, deviation: OffGround) -> Finding:
    most_deg = np.abs(deviation.turn_deg).max()
    small = most_deg < _LEAST_TURN_DEG and abs(deviation.up_m) < _LEAST_HEIGHT_M
    sigmas = 0.0 if small else deviation.sigmas
    roll, pitch, yaw = deviation.turn_deg
    return judge(
        "ground", name, sigmas, _GROUND_LIMIT_SIGMAS, "sigmas",
        fine=f"markings and bare ground agree on its mounting ({most_deg:.2f} deg at most)",
        wrong=f"markings and bare ground do not agree on its mounting (roll {roll:+.2f}, pitch {pitch:+.2f}, "
        f"yaw {yaw:+.2f} deg, height {100 * deviation.up_m:+.0f} cm): wrong associations, or ground that is "
        "not flat; look at the overlay",
    )  # fmt: skip


def check_doubles(best: MethodResult) -> list[Finding]:
    """Markings mapped twice beside themselves, as clocks, drift and mountings that disagree map them."""
    markings = best.hd_map.markings
    if not markings:
        return []
    pairs = overlapping(markings)
    where = ""
    if pairs:
        x, y = markings[pairs[0][0]].corners_map.mean(axis=0)
        where = f", first at ({x:.1f}, {y:.1f})"
    says = f"{len(pairs)} of {len(markings)} markings overlap another of their class"
    return [
        judge(
            "double markings", "map", len(pairs) / len(markings), _DOUBLES_LIMIT, "",
            fine=says,
            wrong=f"{says}{where}: laps or cameras do not agree; check clocks, fix and mountings",
        )
    ]  # fmt: skip


def overlapping(markings: tuple[Marking, ...]) -> list[tuple[int, int]]:
    """Pairs of markings of one class that share at least :data:`_OVERLAP` of the smaller one."""
    if len(markings) < 2:
        return []
    corners = [np.ascontiguousarray(marking.corners_map, dtype=np.float32) for marking in markings]
    centres = np.array([outline.mean(axis=0) for outline in corners])
    longest_m = max(float(np.ptp(outline, axis=0).max()) for outline in corners)
    close = KDTree(centres).query_pairs(longest_m, output_type="ndarray")
    return [
        (int(a), int(b))
        for a, b in close
        if markings[a].kind == markings[b].kind and _overlap(corners[a], corners[b]) > _OVERLAP
    ]


def _overlap(first: FloatArray, second: FloatArray) -> float:
    area = min(abs(cv2.contourArea(first)), abs(cv2.contourArea(second)))
    # About an origin of their own: in map coordinates single precision would not do.
    origin = first.mean(axis=0)
    shared, _ = cv2.intersectConvexConvex(first - origin, second - origin)
    return float(shared) / max(area, 1e-6)


def check_heights(drive: Drive) -> Iterator[Finding]:
    """Whether the heights that were recorded agree where a place was passed more than once."""
    road = drive.road
    sigma_m = HEIGHT_NOISE * drive.pose_noise.position_m
    if road is None or len(road.points_map) < 2:
        return
    way_m = length_along(road.points_map)
    first, second = KDTree(road.points_map).query_pairs(_SAME_PLACE_M, output_type="ndarray").T
    again = np.abs(way_m[second] - way_m[first]) > _ANOTHER_PASS_M
    first = first[again]
    second = second[again]
    between = road.points_map[second] - road.points_map[first]
    rise = np.einsum("ni,ni->n", between, road.slope[first] + road.slope[second]) / 2
    off_m = np.abs(road.height_m[second] - road.height_m[first] - rise)
    off_m[off_m > _STOREY_M] = 0.0
    if not len(off_m):
        return
    worst = int(off_m.argmax())
    x, y = road.points_map[first[worst]]
    yield judge(
        "heights", "poses", float(off_m[worst]), float(_SURE_SIGMAS * np.sqrt(2.0) * sigma_m), "m",
        fine="the recorded heights of all passes agree",
        wrong=f"at x {x:.0f} m, y {y:.0f} m the heights of two passes differ by {off_m[worst]:.2f} m: check "
        "the receiver's fix on both; map heights there are equally uncertain, positions are not",
        status=Status.WARN,
    )  # fmt: skip
