"""Several drives through one site as one drive, in the frame of the first.

Each drive stays a visit of the joined one, with the noise of its own poses and its own clocks. A camera that
two drives describe alike is one camera of the joined drive; otherwise both stay apart, the later one under a
name such as ``front@tuesday``.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import enu_axes, enu_from_geodetic
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.geometry.rigid import camera_centre, log
from v2hdm.io.drive.clock import in_order
from v2hdm.records import (
    Camera,
    CameraInfo,
    Drive,
    FloatArray,
    GeodeticOrigin,
    Image,
    Road,
    Trajectory,
    Visit,
    largest_noise,
)

_log = logging.getLogger(__name__)

GUESS_SIGMA_RAD = 0.015
"""Sigma of the direction of a guessed mounting, rad: as ``mapping.association.ipm_sigma_rad``."""

GUESS_SIGMA_M = 0.3
"""Sigma of a guessed camera centre that nobody has surveyed, m a coordinate."""

SAME_RIG_SIGMAS = 4.0
"""Difference of two guesses, in the sigmas of both, from which they are of two mountings."""

_SAME_LENS = 1e-3
"""Difference of two intrinsics, px at the image's border, up to which they are one lens's."""

_REACH_M = 40.0
"""How far apart two routes may be that have seen a marking in common, m: twice what a camera reaches."""


@dataclass(frozen=True)
class _Move:
    """A rigid motion (4, 4) from one drive's frame into the first's, and its part within the plane."""

    whole: FloatArray
    planar: FloatArray

    def trajectory(self, one: Trajectory | None, motion: FloatArray) -> Trajectory | None:
        return None if one is None else replace(one, map_from_vehicle=motion @ one.map_from_vehicle)

    def road(self, road: Road | None) -> Road | None:
        if road is None:
            return None
        points = np.column_stack([road.points_map, road.height_m])
        moved = points @ self.whole[:3, :3].T + self.whole[:3, 3]
        # The planes of two places on the earth are tilted by the angle between their verticals.
        tilt = self.whole[2, :2] @ self.whole[:2, :2].T
        return Road(moved[:, :2], moved[:, 2], road.slope @ self.whole[:2, :2].T + tilt)


def join_drives(drives: Sequence[Drive], apart: Collection[tuple[int, str]] = ()) -> Drive:
    """The drives as visits of one drive; one alone stays as it is.

    Args:
        drives: as they were read, the first of which gives the frame.
        apart: (drive, camera) whose mounting is known to be another one than before.

    Raises:
        DriveError: they are not of one frame or site.
    """
    if len(drives) == 1:
        return drives[0]
    _check(drives)
    names = _distinct([drive.name for drive in drives])
    cameras: dict[str, Camera] = {}
    images: list[Image] = []
    visits: list[Visit] = []
    roads: list[Road | None] = []
    for number, (drive, name) in enumerate(zip(drives, names, strict=True)):
        own = {
            camera: _name_of(camera, one, name, cameras, (number, camera) in apart)
            for camera, one in drive.cameras.items()
        }
        for camera, joined in own.items():
            one = drive.cameras[camera]
            cameras.setdefault(joined, replace(one, info=replace(one.info, name=joined)))
        move = _move(drives[0].origin, drive.origin)
        images += [
            replace(
                image,
                camera=own[image.camera],
                visit=number,
                map_from_vehicle=move.planar @ image.map_from_vehicle,
            )
            for image in drive.images
        ]
        visits.append(
            Visit(
                name=name,
                root=drive.root,
                pose_noise=drive.pose_noise,
                truth_dir=drive.truth_dir,
                trajectory=move.trajectory(drive.trajectory, move.planar),
                recorded=move.trajectory(drive.recorded, move.whole),
                cameras=own,
            )
        )
        roads.append(move.road(drive.road))
    whole = Drive(
        name="+".join(names),
        root=drives[0].root,
        cameras=cameras,
        images=tuple(sorted(images, key=in_order)),
        pose_noise=largest_noise([drive.pose_noise for drive in drives]),
        origin=drives[0].origin,
        road=_one_road(roads, visits),
        joined=tuple(visits),
    )
    _check_overlap(whole)
    return whole


def same_rig(first: Camera, second: Camera) -> bool:
    """Whether two descriptions are of one camera on one mounting: lens exactly, guess by its sigmas."""
    if not _same_lens(first.info, second.info):
        return False
    guesses = [extrinsic_from_ipm(one.info, one.ipm[one.initial_ipm]) for one in (first, second)]
    turn_rad = float(np.linalg.norm(log(guesses[0] @ np.linalg.inv(guesses[1]))[3:]))
    if turn_rad > SAME_RIG_SIGMAS * np.sqrt(2) * GUESS_SIGMA_RAD:
        return False
    priors = [one.centre_prior for one in (first, second)]
    sigma = [np.full(3, GUESS_SIGMA_M) if prior is None else prior.sigma_m for prior in priors]
    centre = [
        camera_centre(guess) if prior is None else prior.centre_vehicle
        for guess, prior in zip(guesses, priors, strict=True)
    ]
    return bool((np.abs(centre[0] - centre[1]) <= SAME_RIG_SIGMAS * np.hypot(*sigma)).all())


def _same_lens(first: CameraInfo, second: CameraInfo) -> bool:
    if (first.width, first.height, first.distortion_model) != (
        second.width,
        second.height,
        second.distortion_model,
    ):
        return False
    return bool(
        np.allclose(first.intrinsic, second.intrinsic, rtol=0, atol=_SAME_LENS)
        and np.allclose(first.distortion, second.distortion, rtol=0, atol=_SAME_LENS / first.width)
    )


def _name_of(camera: str, one: Camera, visit: str, so_far: Mapping[str, Camera], apart: bool) -> str:
    """The joined drive's name for a camera of a visit: that of the same rig, if there has been one."""
    if camera not in so_far:
        return camera
    if not apart and same_rig(so_far[camera], one):
        return camera
    why = "its mounting has changed" if apart else "its lens or the guess of its mounting differs"
    _log.warning(
        "camera %s of drive %s is another one than before (%s): it is calibrated by itself, as %s@%s",
        camera, visit, why, camera, visit,
    )  # fmt: skip
    return f"{camera}@{visit}"


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number behind those that were there before."""
    out: list[str] = []
    for name in names:
        number, one = 2, name
        while one in out:
            number, one = number + 1, f"{name}-{number}"
        out.append(one)
    return out


def _check(drives: Sequence[Drive]) -> None:
    roots = [drive.root.resolve() for drive in drives]
    again = [root for root in roots if roots.count(root) > 1]
    if again:
        raise DriveError(f"{again[0]}: given twice; name each drive once in drive.path")
    without = [drive.root for drive in drives if drive.origin is None]
    if without and len(without) < len(drives):
        raise DriveError(
            f"{without[0]}: has no origin, but other drives have: nobody knows how their frames lie to each "
            "other; state its origin, or those of none"
        )
    if without:
        _log.warning("no drive has an origin: their coordinates are taken to be of one frame")
    datums = {drive.origin.datum: drive.root for drive in drives if drive.origin is not None}
    if len(datums) > 1:
        raise DriveError(
            "drives of several datums ("
            + ", ".join(f"{root}: {datum}" for datum, root in datums.items())
            + "): transform their poses to one"
        )


def _check_overlap(drive: Drive) -> None:
    """Refuse a visit that comes near to no other: nothing would be common to them."""
    from scipy.spatial import cKDTree  # which a drive alone does without

    places = [
        np.array([image.map_from_vehicle[:2, 3] for image in drive.images if image.visit == number])
        for number in range(len(drive.joined))
    ]
    for number, own in enumerate(places):
        others = np.concatenate([one for k, one in enumerate(places) if k != number])
        nearest_m = float(cKDTree(others).query(own)[0].min())
        if nearest_m > _REACH_M:
            raise DriveError(
                f"{drive.joined[number].root}: comes no nearer than {nearest_m:.0f} m to the other drives, "
                "so that they have nothing in common; map it by itself, or check the frame of its poses"
            )


def _move(to: GeodeticOrigin | None, origin: GeodeticOrigin | None) -> _Move:
    """From the frame of one origin into that of another."""
    if to is None or origin is None or to == origin:
        return _Move(np.eye(4), np.eye(4))
    place = np.array([[one.latitude_deg, one.longitude_deg, one.altitude_m] for one in (to, origin)])
    axes = enu_axes(place)
    whole = np.eye(4)
    whole[:3, :3] = axes[0].T @ axes[1]
    whole[:3, 3] = enu_from_geodetic(to, place[1:])[0]
    planar = np.eye(4)
    yaw = np.arctan2(whole[1, 0], whole[0, 0])
    planar[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    planar[:2, 3] = whole[:2, 3]
    return _Move(whole, planar)


def _one_road(roads: Sequence[Road | None], visits: Sequence[Visit]) -> Road | None:
    """The recorded ground of all visits; that of one recorded as z = 0 counts where others have heights."""
    if all(road is None for road in roads):
        return None
    known: list[Road] = []
    for road, visit in zip(roads, visits, strict=True):
        if road is not None:
            known.append(road)
        elif visit.recorded is not None:
            places = visit.recorded.map_from_vehicle[:, :3, 3]
            known.append(Road(places[:, :2], places[:, 2], np.zeros((len(places), 2))))
    return Road(
        np.concatenate([one.points_map for one in known]),
        np.concatenate([one.height_m for one in known]),
        np.concatenate([one.slope for one in known]),
    )
