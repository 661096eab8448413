"""Paint stays on the ground as the vehicle moves; reflections and things do not."""

import numpy as np
import pytest

from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.persistence import View, settled
from v2hdm.records import MarkingDetection

CAMERA = RoadCamera(camera_from_calibration(rough_calibration("front", 1280, 720, 1.6, 8.0, 70.0)))
HEIGHT_M = 1.6


def at(forward_m):
    pose = np.eye(4)
    pose[0, 3] = forward_m
    return pose


def marking(centre_m, kind="arrow", score=0.9, half_m=0.4):
    """A square about a place on the ground before the vehicle."""
    corners = np.array(centre_m) + half_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return MarkingDetection(kind, score, CAMERA.project(corners), np.eye(8), np.ones(4, dtype=np.bool_))


def drive(place, step_m=1.5, count=8, sigma_deg=1.0):
    """Views of a straight drive; ``place`` tells where a thing seems to lie after a way."""
    ways = step_m * np.arange(count)
    return [View(at(way), CAMERA, [marking(place(way))], np.deg2rad(sigma_deg)) for way in ways]


def stays(views, number=0):
    """How often the thing of a number is taken to stay on the ground."""
    masks = [mask for _, mask in settled(views, lambda view: ("front", view))]
    return [bool(mask[number]) for mask in masks]


def paint(way_m):
    return 20.0 - way_m, 1.0


def test_paint_on_the_ground_stays():
    assert all(stays(drive(paint)))


def test_what_moves_along_with_the_vehicle_does_not_stay():
    """As a cloud mirrored in its bonnet; the first image has but one other that would show the place."""
    assert not any(stays(drive(lambda way: (6.0, 0.5)))[1:])


def test_what_drives_does_not_stay():
    assert not any(stays(drive(lambda way: (12.0 + 0.4 * way, -2.0))))


def test_what_stands_up_does_not_stay():
    """A plate .8 m above the ground seems to lie behind it, which a wrong pitch may do to paint."""
    behind = HEIGHT_M / (HEIGHT_M - 0.8)

    def plate(way_m):
        return behind * (16.0 - way_m), -behind * 1.5

    far = 4
    assert not any(stays(drive(plate, sigma_deg=0.1))[far:])
    assert all(stays(drive(plate, sigma_deg=3.0))[:-1])


def test_paint_that_things_hide_in_half_of_the_images_stays():
    views = drive(paint)
    for k in (1, 4, 6):
        views[k] = View(views[k].map_from_vehicle, CAMERA, [])
    shown = [mask for _, mask in settled(views, lambda view: ("front", view)) if len(mask)]
    assert all(mask.all() for mask in shown)


def test_an_image_from_which_paint_is_beyond_the_range_tells_nothing():
    views = drive(paint, count=10)
    shown = [
        View(view.map_from_vehicle, CAMERA, view.markings if k > 5 else [], reach_m=13.0)
        for k, view in enumerate(views)
    ]
    masks = [mask for _, mask in settled(shown, lambda view: ("front", view)) if len(mask)]
    assert np.concatenate(masks).all()


def test_while_the_vehicle_stands_nothing_is_doubted():
    views = [View(at(0.0), CAMERA, [marking((9.0 + k, 0.0))]) for k in range(6)]
    assert all(stays(views))


def test_an_image_of_another_camera_tells_nothing():
    views = drive(lambda way: (6.0, 0.5), count=4)
    names = iter("abcd")
    masks = [mask for _, mask in settled(views, lambda view: (next(names), view))]
    assert np.concatenate(masks).all()


@pytest.mark.parametrize("count", [0, 1, 3, 12])
def test_every_image_comes_once_and_in_order(count):
    views = drive(paint, count=count) if count else []
    assert [view for view, _ in settled(views, lambda view: ("front", view))] == views
