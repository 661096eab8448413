"""A plane of the ground is as sure as the mounting that it is taken from, and knows no more."""

import numpy as np

from tests.ground.scene import INFO, extrinsic
from v2hdm.geometry.ground_plane import by_tangent, plane_in
from v2hdm.geometry.rigid import exp
from v2hdm.ground.planes import plane_of
from v2hdm.records import Calibration

MOUNT = extrinsic(roll_deg=0.5, pitch_deg=20.0, yaw_deg=-1.0)
SIGMAS = np.array([0.03, 0.02, 0.04, 0.002, 0.003, 0.004])


def test_the_derivative_is_that_of_small_motions():
    slope = by_tangent(MOUNT)
    for axis, step in enumerate(1e-6 * np.eye(6)):
        measured = (plane_in(exp(step) @ MOUNT) - plane_in(exp(-step) @ MOUNT)) / 2e-6
        np.testing.assert_allclose(slope[:, axis], measured, atol=1e-8)


def test_mountings_drawn_from_a_covariance_have_planes_of_unit_variance_but_for_the_height():
    """The height is known less well than matches say: its variance is below one."""
    plane = plane_of(Calibration(INFO, MOUNT, np.diag(SIGMAS**2)), np.zeros((2, 6)))
    tangents = np.random.default_rng(0).standard_normal((4000, 6)) * SIGMAS
    off = np.array([plane_in(matrix) for matrix in exp(tangents) @ MOUNT]) - plane.plane_cam
    variance = np.cov(plane.root_information @ off.T)
    np.testing.assert_allclose(variance[:2, :2], np.eye(2), atol=0.08)
    height_m = plane.plane_cam[3]
    stated = np.linalg.inv(plane.root_information[2:, 3:])[0, 0]
    assert stated > np.hypot(0.02, 0.014 * height_m)


def test_a_mounting_without_a_covariance_has_no_plane():
    assert plane_of(Calibration(INFO, MOUNT, None), np.zeros((2, 6))) is None
