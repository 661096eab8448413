"""Several drives through one site as one drive, in the frame of the first.

Each drive is a session of the joined one, with its own pose noise and clocks. A camera that two drives
describe alike is one camera of the joined drive; otherwise the later one gets a name such as
``front@tuesday``.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain, count

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.datums import is_same_datum
from v2hdm.geometry.geodetic import enu_axes, enu_from_geodetic, position_of
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.rigid import camera_centre, in_order, log, make_transform
from v2hdm.records import (
    Camera,
    CentrePrior,
    Drive,
    FloatArray,
    GeodeticOrigin,
    Image,
    Reception,
    Road,
    Session,
    Trajectory,
    largest_noise,
)

_log = logging.getLogger(__name__)

_GUESS_SIGMA_RAD = 0.015  # of the direction of a guessed mounting, as :mod:`v2hdm.association.tracks` has it
_GUESS_SIGMA_M = 0.3  # of a coordinate of a guessed camera centre that nobody has surveyed
_SAME_RIG_SIGMAS = 4.0  # guesses that differ by more, in the sigmas of both, are of two mountings
_SAME_LENS = 1e-3  # intrinsics that differ by less, px at the image's border, are of one lens
_REACH_M = 40.0  # routes with a marking in common are no further apart: twice a camera's reach


def _moved(trajectory: Trajectory | None, motion: FloatArray) -> Trajectory | None:
    return (
        None
        if trajectory is None
        else replace(trajectory, map_from_vehicle=motion @ trajectory.map_from_vehicle)
    )


def _moved_road(road: Road | None, motion: FloatArray) -> Road | None:
    if road is None:
        return None
    points = np.column_stack([road.points_map, road.height_m])
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    # The planes of two places on the earth are tilted by the angle between their verticals.
    tilt = motion[2, :2] @ motion[:2, :2].T
    return Road(moved[:, :2], moved[:, 2], road.slope @ motion[:2, :2].T + tilt)


def join_drives(drives: Sequence[Drive], moved_cameras: Collection[tuple[int, str]] = ()) -> Drive:
    """The drives as sessions of one drive, in the frame of the first; one alone stays as it is.

    ``apart`` names (drive, camera) whose mounting is known to have changed. Raises DriveError when they are
    not of one frame or site.
    """
    if len(drives) == 1:
        return drives[0]
    _check(drives)
    names: list[str] = []
    for drive in drives:
        again = (f"{drive.name}-{number}" for number in count(2))
        names.append(next(name for name in chain([drive.name], again) if name not in names))
    cameras: dict[str, Camera] = {}
    images = []
    sessions = []
    roads = []
    for number, (drive, name) in enumerate(zip(drives, names, strict=True)):
        joined_names = {}
        for camera_name, camera in drive.cameras.items():
            is_moved = (number, camera_name) in moved_cameras
            joined_name = _name_of(camera_name, camera, name, cameras, is_moved)
            joined_names[camera_name] = joined_name
        for camera_name, joined_name in joined_names.items():
            camera = drive.cameras[camera_name]
            cameras.setdefault(joined_name, replace(camera, info=replace(camera.info, name=joined_name)))
        whole, planar = _move(drives[0].origin, drive.origin)
        for image in drive.images:
            pose = planar @ image.map_from_vehicle
            joined_name = joined_names[image.camera]
            images.append(replace(image, camera=joined_name, session=number, map_from_vehicle=pose))
        sessions.append(
            Session(
                name, drive.root, drive.pose_noise, drive.truth_dir,
                _moved(drive.trajectory, planar), _moved(drive.recorded, whole), joined_names,
            )
        )  # fmt: skip
        roads.append(_moved_road(drive.road, whole))
    _check_overlap(images, sessions)
    return Drive(
        "+".join(names),
        drives[0].root,
        cameras,
        tuple(sorted(images, key=in_order)),
        largest_noise([drive.pose_noise for drive in drives]),
        drives[0].origin,
        road=_one_road(roads, sessions),
        joined=tuple(sessions),
        reception=_joint_reception([drive.reception for drive in drives]),
    )


def _joint_reception(receptions: Sequence[Reception | None]) -> Reception | None:
    """The sum; what one drive does not state is not stated of all."""
    stated = [reception for reception in receptions if reception is not None]
    if len(stated) < len(receptions):
        return None
    fixed = [reception.rtk_fixed for reception in stated if reception.rtk_fixed is not None]
    heights_m = {reception.geoid_m for reception in stated}
    return Reception(
        sum(reception.positions for reception in stated),
        sum(fixed) if len(fixed) == len(stated) else None,
        heights_m.pop() if len(heights_m) == 1 else None,
    )


def _same_rig(first: Camera, second: Camera) -> bool:
    """Whether two descriptions are of one camera on one mounting: lens exactly, guess by its sigmas."""
    lens = first.info
    other_lens = second.info
    if (lens.width, lens.height) != (other_lens.width, other_lens.height):
        return False
    if lens.distortion_model != other_lens.distortion_model:
        return False
    if not np.allclose(lens.intrinsic, other_lens.intrinsic, rtol=0, atol=_SAME_LENS):
        return False
    if not np.allclose(lens.distortion, other_lens.distortion, rtol=0, atol=_SAME_LENS / lens.width):
        return False
    guesses = [initial_extrinsic(camera) for camera in (first, second)]
    turn_rad = float(np.linalg.norm(log(guesses[0] @ np.linalg.inv(guesses[1]))[3:]))
    if turn_rad > _SAME_RIG_SIGMAS * np.sqrt(2) * _GUESS_SIGMA_RAD:
        return False
    centres = [
        camera.centre_prior or CentrePrior(camera_centre(guess), np.full(3, _GUESS_SIGMA_M))
        for camera, guess in zip((first, second), guesses, strict=True)
    ]
    apart_m = np.abs(centres[0].centre_vehicle - centres[1].centre_vehicle)
    return bool((apart_m <= _SAME_RIG_SIGMAS * np.hypot(centres[0].sigma_m, centres[1].sigma_m)).all())


def _name_of(
    camera: str, described: Camera, session: str, so_far: Mapping[str, Camera], is_moved: bool
) -> str:
    """The joined drive's name for a camera of a session: that of the same rig, if there has been one."""
    if camera not in so_far:
        return camera
    if not is_moved and _same_rig(so_far[camera], described):
        return camera
    why = "its mounting has changed" if is_moved else "its lens or guessed mounting differs"
    _log.warning(
        "camera %s of drive %s is not the earlier one (%s): it is calibrated separately, as %s@%s",
        camera, session, why, camera, session,
    )  # fmt: skip
    return f"{camera}@{session}"


def _check(drives: Sequence[Drive]) -> None:
    roots = [drive.root.resolve() for drive in drives]
    again = [root for root in roots if roots.count(root) > 1]
    if again:
        raise DriveError(f"{again[0]}: given twice; name each drive once in drive.path")
    without = [drive.root for drive in drives if drive.origin is None]
    if without and len(without) < len(drives):
        problem = "has no origin, but other drives have: how their frames are related is unknown"
        raise DriveError(f"{without[0]}: {problem}; state its origin, or remove all origins")
    if without:
        _log.warning("no drive has an origin: their coordinates are assumed to share one frame")
    datums = {drive.origin.datum: drive.root for drive in drives if drive.origin is not None}
    if not all(is_same_datum(datum, next(iter(datums))) for datum in datums):
        stated = ", ".join(f"{root}: {datum}" for datum, root in datums.items())
        raise DriveError(f"drives of several datums ({stated}): transform their poses to one")


def _check_overlap(images: Sequence[Image], sessions: Sequence[Session]) -> None:
    """Refuse a session that comes near to no other: they would have nothing in common."""
    places = np.array([image.map_from_vehicle[:2, 3] for image in images])
    number = np.array([image.session for image in images])
    for session, drive_session in enumerate(sessions):
        session_places = places[number == session]
        others = places[number != session]

        def away_m(place: FloatArray, others: FloatArray = others) -> float:
            return float(np.linalg.norm(others - place, axis=1).min())

        if not any(away_m(place) <= _REACH_M for place in session_places):
            nearest_m = min(map(away_m, session_places))
            raise DriveError(
                f"{drive_session.root}: comes no nearer than {nearest_m:.0f} m to the other drives, "
                "so they have nothing in common; map it separately, or check the frame of its poses"
            )


def _move(to: GeodeticOrigin | None, origin: GeodeticOrigin | None) -> tuple[FloatArray, FloatArray]:
    """The motion (4, 4) from the frame of one origin into that of another, and its part in the plane."""
    if to is None or origin is None or to == origin:
        return np.eye(4), np.eye(4)
    place = np.concatenate([position_of(to), position_of(origin)])
    axes = enu_axes(place)
    whole = make_transform(axes[0].T @ axes[1], enu_from_geodetic(to, place[1:])[0])
    yaw = np.arctan2(whole[1, 0], whole[0, 0])
    planar = np.eye(4)
    planar[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    planar[:2, 3] = whole[:2, 3]
    return whole, planar


def _one_road(roads: Sequence[Road | None], sessions: Sequence[Session]) -> Road | None:
    """The recorded ground of all sessions; one recorded as z = 0 counts where others have heights."""
    if all(road is None for road in roads):
        return None
    ground: list[Road] = []
    for road, session in zip(roads, sessions, strict=True):
        if road is not None:
            ground.append(road)
        elif session.recorded is not None:
            places = session.recorded.map_from_vehicle[:, :3, 3]
            ground.append(Road(places[:, :2], places[:, 2], np.zeros((len(places), 2))))
    return Road(
        np.concatenate([part.points_map for part in ground]),
        np.concatenate([part.height_m for part in ground]),
        np.concatenate([part.slope for part in ground]),
    )
