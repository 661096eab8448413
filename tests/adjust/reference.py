"""The model of the adjustment's problem, written anew in plain numpy."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.adjust.scene import Scene
from v2hdm.adjust import Problem
from v2hdm.records import FloatArray


def reference_residuals(problem: Problem, x: FloatArray) -> dict[str, FloatArray]:
    """The model of the problem's docstring, written anew in plain numpy: residuals by their kind."""
    cameras, frames, count = len(problem.intrinsic), len(problem.map_from_vehicle), problem.corner_count
    extrinsic, state, corners = np.split(x, [6 * cameras, len(x) - 2 * count])
    extrinsic, state, corners = extrinsic.reshape(-1, 6), state.reshape(frames, 6), corners.reshape(-1, 2)
    observations = problem.observations
    rotation = Rotation.from_rotvec(extrinsic[:, 3:]).as_matrix() @ problem.cam_from_vehicle[:, :3, :3]
    centre = extrinsic[:, :3]
    # exp(s) of a pose: a rotation, and the translation V s_t with V by the textbook's closed form.
    angle = np.linalg.norm(state[:, 3:], axis=1)[:, None, None]
    skew = np.cross(np.eye(3)[None], state[:, None, 3:])
    half = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    sixth = (1 - np.sinc(angle / np.pi)) / np.maximum(angle, 1e-30) ** 2
    v = np.eye(3) + half * skew + sixth * skew @ skew
    turned = problem.map_from_vehicle[:, :3, :3] @ Rotation.from_rotvec(state[:, 3:]).as_matrix()
    shift = np.einsum("jab,jbc,jc->ja", problem.map_from_vehicle[:, :3, :3], v, state[:, :3])
    position = problem.map_from_vehicle[:, :3, 3] + shift
    point_map = (
        np.column_stack([corners, np.zeros(count)])[observations.corner] - position[observations.frame]
    )
    point_vehicle = np.einsum("kba,kb->ka", turned[observations.frame], point_map)
    point = np.einsum(
        "kab,kb->ka", rotation[observations.camera], point_vehicle - centre[observations.camera]
    )
    focal, principal = problem.intrinsic[observations.camera, :2], problem.intrinsic[observations.camera, 2:]
    off = focal * point[:, :2] / point[:, 2:] + principal - observations.pinhole_px
    whitened = np.einsum("kab,kb->ka", np.linalg.inv(np.linalg.cholesky(observations.covariance_px)), off)
    prior = (centre - problem.centre_vehicle) / problem.centre_sigma_m
    parts = {"observations": whitened, "centres": prior, "states": state / problem.pose_sigma.by_state()}
    if problem.lengths is not None:
        distances_m = np.linalg.norm(corners[problem.lengths.first] - corners[problem.lengths.second], axis=1)
        parts["lengths"] = (distances_m - problem.lengths.length_m) / problem.lengths.sigma_m
    if problem.control is not None:
        off_m = corners[problem.control.corner] - problem.control.points_map
        parts["control"] = off_m / problem.control.sigma_m
    return parts


def truth_of(scene: Scene) -> FloatArray:
    """The unknowns of :func:`reference_residuals` at the truth: centres and turns, states, corners."""
    problem = scene.problem
    rotation = scene.cam_from_vehicle[:, :3, :3]
    turn = Rotation.from_matrix(rotation @ problem.cam_from_vehicle[:, :3, :3].transpose(0, 2, 1))
    centre = -np.einsum("cji,cj->ci", rotation, scene.cam_from_vehicle[:, :3, 3])
    states = np.zeros(6 * len(problem.map_from_vehicle))
    return np.concatenate(
        [np.column_stack([centre, turn.as_rotvec()]).ravel(), states, scene.corners_map.ravel()]
    )
