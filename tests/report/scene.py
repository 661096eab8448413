"""A hand-checkable truth: two diamonds and a straight lane, one camera, three images."""

from pathlib import Path

import numpy as np

from v2hdm.records import DIAMOND, LANE_LINE, Camera, CameraInfo, Drive, HDMap, Image, Lane, Marking, Truth

DIAMOND_CORNERS = np.array([[0.5, 0.0], [0.0, 0.25], [-0.5, 0.0], [0.0, -0.25]])


def diamond_at(east_m: float, north_m: float, sightings: int = 3) -> Marking:
    return Marking(DIAMOND, DIAMOND_CORNERS + np.array([east_m, north_m]), sightings)


def pose_at(east_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = east_m
    return pose


def make_truth(visibility: float = 1.0) -> tuple[Drive, Truth]:
    """The vehicle drives east along y = 0; diamonds at (10, 0) and (10, 40): the second is out of view."""
    info = CameraInfo("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
    camera = Camera(
        info, {"calibrated": np.eye(3)}, "calibrated", np.array([[4.0, -3], [12, -3], [12, 3], [4, 3]])
    )
    poses = np.array([pose_at(x) for x in (0.0, 1.0, 2.0)])
    images = [Image("front", float(i), Path(f"{i}.png"), pose) for i, pose in enumerate(poses)]
    lane = Lane(LANE_LINE, np.column_stack([np.linspace(0, 20, 41), np.full(41, 2.0)]), 1)
    truth = Truth(
        map=HDMap((diamond_at(10, 0), diamond_at(10, 40)), (lane,)),
        cam_from_vehicle={"front": np.eye(4)},
        map_from_vehicle=poses,
        visibility=np.full((3, 2), visibility),
        lane_visible=(lane.points_map[:, 0] <= 10.0,),
        disturbances={},
    )
    return Drive("hand", Path(), {"front": camera}, images), truth
