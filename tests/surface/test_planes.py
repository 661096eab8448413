"""Texture shows the mean of a curved ground; the plane under the wheels follows from the surface."""

from dataclasses import replace

import numpy as np
import pytest

from tests.cameras import level, mounted
from v2hdm.geometry.ground_plane import plane_in
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, CameraInfo, GroundPlane
from v2hdm.surface.paths import Paths
from v2hdm.surface.planes import with_planes_over
from v2hdm.surface.surface import Surface

MOUNT = mounted((1.5, 0.0, 2.0), 15)
ROI = np.array([[4.0, -3.0], [10.0, -3.0], [10.0, 3.0], [4.0, 3.0]])
POSES = level(np.arange(40) * 0.6, np.zeros(40), np.zeros(40))
FALL = 0.03  # of the crown that the vehicle drives on, to both sides


def camera():
    info = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))
    plane = GroundPlane(plane_in(MOUNT), np.eye(4)[:3], np.zeros((2, 4)))
    return Camera(info, {"true": ipm_from_extrinsic(info, MOUNT)}, "true", ROI, ground_plane=plane)


def plane_over(parameters):
    """The plane under the wheels, where texture shows the mounting's own over such a surface."""
    surface = Surface.level(Paths.of(POSES, np.zeros(40, dtype=np.int64)))
    surface = replace(surface, parameters=np.pad(parameters, (0, len(surface.parameters) - len(parameters))))
    over = with_planes_over(surface, {"front": camera()}, MOUNT[None], POSES)
    return over["front"].ground_plane.plane_cam


def test_over_level_ground_the_plane_stays():
    np.testing.assert_allclose(plane_over(np.zeros(3)), plane_in(MOUNT), atol=1e-12)


def test_over_a_crown_texture_lies_below_the_wheels():
    """Points at 0, 1 and 2 m beside the path lie 1.2 m off it on average, wheels 0.8 m."""
    plane = plane_over(np.array([0.0, 0.0, FALL]))
    lower_m = FALL * (1.2 - 0.8)
    np.testing.assert_allclose(plane[:3], plane_in(MOUNT)[:3], atol=1e-9)
    assert plane[3] == pytest.approx(camera_centre(MOUNT)[2] - lower_m, abs=1e-4)


def test_a_camera_whose_texture_shows_nothing_stays_as_it_is():
    bare = replace(camera(), ground_plane=None)
    surface = Surface.level(Paths.of(POSES, np.zeros(40, dtype=np.int64)))
    assert with_planes_over(surface, {"front": bare}, MOUNT[None], POSES) == {"front": bare}
