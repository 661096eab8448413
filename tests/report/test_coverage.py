"""How often and how finely ground is seen, against what a hand computes."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cameras import level
from tests.drive.example import looking_forward
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import Camera, CameraInfo, Drive, HDMap, Image, Marking
from v2hdm.report.coverage import coverage_of, read_coverage, write_coverage
from v2hdm.report.weak import thin_stretches, weak_places
from v2hdm.verdict.check import ground_seen

INFO = CameraInfo("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
HEIGHT_M, PITCH_RAD = 2.0, 0.25
MOUNTING = looking_forward(HEIGHT_M, PITCH_RAD)
SQUARE = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])


def drive_of(at_m):
    """A vehicle that takes an image at each distance along the x axis."""
    roi = np.array([[3.0, -3], [12, -3], [12, 3], [3, 3]])
    camera = Camera(INFO, {"estimated": ipm_from_extrinsic(INFO, MOUNTING)}, "estimated", roi)
    images = [
        Image("front", float(n), Path(f"{n}.png"), pose) for n, pose in enumerate(level(np.array(at_m)))
    ]
    return Drive("hand", Path(), {"front": camera}, images)


def at(coverage, x_m, y_m, what="views"):
    row, column = coverage.cells_of(np.array([[x_m, y_m]]))
    return getattr(coverage, what)[row, column][0]


def test_ground_ahead_is_counted_once_an_image_and_ground_behind_never():
    coverage = coverage_of(drive_of([0.0, 1.0, 2.0]), {"front": MOUNTING})
    assert at(coverage, 10.0, 0.0) == 3
    assert at(coverage, 16.6, 0.0) == 2  # within 16 m of the last two alone
    assert coverage.views.max() == 3
    assert coverage.west_m > 2.0  # the image's lower border meets the ground ahead
    assert coverage.covered_m2 < coverage.seen_m2


def test_the_ground_sample_distance_is_that_of_a_pixel_along_the_view():
    coverage = coverage_of(drive_of([0.0]), {"front": MOUNTING}, cell_m=0.05)
    ahead_m = 10.0
    pixel_down = np.arctan2(240 - 240, 500)  # the principal ray has the camera's pitch
    assert pixel_down == 0
    depth_m = ahead_m * np.cos(PITCH_RAD) + HEIGHT_M * np.sin(PITCH_RAD)
    assert at(coverage, ahead_m, 0.0, "sample_m") == pytest.approx(depth_m**2 / (500 * HEIGHT_M), rel=0.02)


def test_two_directions_are_told_apart():
    outward = drive_of([0.0])
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    back[0, 3] = 20.0
    both_ways = replace(outward, images=[*outward.images, replace(outward.images[0], map_from_vehicle=back)])
    assert at(coverage_of(outward, {"front": MOUNTING}), 10.0, 0.0, "sectors") == 1
    assert at(coverage_of(both_ways, {"front": MOUNTING}), 10.0, 0.0, "sectors") == 2


def test_a_camera_that_looks_at_the_sky_covers_nothing():
    coverage = coverage_of(drive_of([0.0]), {"front": looking_forward(HEIGHT_M, -1.2)})
    assert coverage.seen_m2 == 0
    assert np.isnan(coverage.sample_of_covered_m())


def test_what_is_written_is_read_again_and_damage_is_named(tmp_path):
    coverage = coverage_of(drive_of([0.0, 1.0, 2.0]), {"front": MOUNTING})
    assert read_coverage(tmp_path) is None
    write_coverage(tmp_path, coverage)
    again = read_coverage(tmp_path)
    assert (again.views == coverage.views).all()
    assert np.nanmax(np.abs(again.sample_m - coverage.sample_m)) < 1e-4
    assert (again.west_m, again.north_m, again.cell_m) == (coverage.west_m, coverage.north_m, coverage.cell_m)
    cv2.imwrite(str(tmp_path / "coverage_cells.png"), np.zeros((32, 32), np.uint8))
    with pytest.raises(MapFileError, match=r"coverage_cells\.png: holds no cells; make the report again"):
        read_coverage(tmp_path)


def test_a_stretch_with_few_images_is_named_by_its_place_along_the_route():
    at_m = [x for x in np.arange(0.0, 120.0) if not 40 < x < 75]
    route_map = np.column_stack([np.arange(0.0, 120.0), np.zeros(120)])
    (stretch,) = thin_stretches(coverage_of(drive_of(at_m), {"front": MOUNTING}), route_map)
    assert stretch.from_m == pytest.approx(40 + 14, abs=4)  # images look up to 16 m ahead
    assert stretch.to_m == pytest.approx(75 + 4, abs=4)
    assert thin_stretches(coverage_of(drive_of(np.arange(120.0)), {"front": MOUNTING}), route_map) == ()


def test_check_says_how_finely_ground_is_seen_and_where_to_drive_again():
    ground_line, again = ground_seen(drive_of([x for x in np.arange(0.0, 120.0) if not 40 < x < 75]), {})
    assert re.fullmatch(r"ground: [\d,]+ m2 seen in 3 images or more, .*, at \d+ mm a pixel", ground_line)
    assert re.match(r"drive again: from 5\d m to 7\d m along the route, ", again)
    (seen_alone,) = ground_seen(drive_of(np.arange(120.0)), {})
    assert seen_alone.startswith("ground: ")


def marking(x_m, y_m, sigma_m, accuracy, shared=0.0, sightings=20):
    """A square whose corners err by ``sigma_m``, of which a share of the variance is common."""
    correlation = (1 - shared) * np.eye(8) + shared * np.tile(np.eye(2), (4, 4))
    relative_m = sigma_m * np.sqrt((1 - shared) / 4)
    corners = SQUARE + np.array([x_m, y_m])
    return Marking(
        "diamond", corners, sightings, sigma_m**2 * correlation, float(relative_m), accuracy=accuracy
    )


def test_weak_markings_are_gathered_by_place_with_what_helps():
    route_map = np.column_stack([np.arange(0.0, 100.0), np.zeros(100)])
    far = [marking(x, 12.0, 0.05, "C") for x in (20.0, 25.0)]
    drifting = marking(80.0, 2.0, 0.05, "B", shared=0.99)
    seldom = marking(50.0, -2.0, 0.05, "C", sightings=4)
    good = marking(60.0, 0.0, 0.01, "A")
    places = weak_places(HDMap((*far, drifting, seldom, good)), None, route_map)
    assert [place.markings for place in places] == [2, 1, 1]
    assert places[0].says == "Pass within 8 m: the drive passed 12 m away, with them on its left."
    by_place = {round(float(place.centre_map[0])): place.says for place in places[1:]}
    assert by_place[80].startswith("Survey a control point here")
    assert by_place[50].startswith("Drive past slowly, or record more images: 4 show each marking")
    assert places[0].radius_m == pytest.approx(2.45 * 0.05, rel=0.01)


def test_a_marking_with_one_hidden_end_is_to_be_passed_from_elsewhere():
    route_map = np.column_stack([np.arange(0.0, 100.0), np.zeros(100)])
    hidden = marking(20.0, 2.0, 0.02, "C")
    spread = np.diag([0.2, 0.2, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02]) ** 2
    (place,) = weak_places(HDMap((replace(hidden, covariance_m2=spread),)), None, route_map)
    assert "an end was not seen clearly" in place.says
