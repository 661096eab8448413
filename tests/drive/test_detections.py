"""Files of detections in place of pictures: what is written is read again, and damage is one line."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from v2hdm.errors import DriveError
from v2hdm.io.detections import read_detections, write_detections
from v2hdm.io.drive import read_drive
from v2hdm.records import ImageDetections, LaneDetection, MarkingDetection


def detections() -> ImageDetections:
    """A marking with independent corners, one with a full covariance of which a corner is hidden, a line."""
    corners = np.array([[100.25, 300.5], [95.0, 340.125], [135.0, 350.0], [140.0, 310.0]])
    root = np.random.default_rng(1).normal(size=(8, 8))
    is_known = np.array([True, True, False, True])
    plain = MarkingDetection("diamond", 0.9, corners, np.diag(np.arange(1.0, 9.0)), np.ones(4, dtype=bool))
    full = MarkingDetection("lane_dash", 0.7, corners + 50.0, root @ root.T + np.eye(8), is_known)
    line = LaneDetection("lane_line", 0.8, corners, 2, np.array([0.5, 0.6, 0.7, 0.8]))
    return ImageDetections(7, (plain, full), (line,))


def test_detections_are_read_as_they_were_written(tmp_path):
    written = detections()
    write_detections(tmp_path / "a.json", written)
    read = read_detections(tmp_path / "a.json", 7)
    assert read.image == 7
    for before, after in zip(written.markings, read.markings, strict=True):
        assert (before.kind, before.score) == (after.kind, after.score)
        np.testing.assert_allclose(after.corners_px, before.corners_px, atol=1e-5)
        np.testing.assert_allclose(after.covariance_px, before.covariance_px, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(after.corner_valid, before.corner_valid)
    (line,) = read.lanes
    assert (line.kind, line.identity) == ("lane_line", 2)
    np.testing.assert_allclose(line.sigma_px, [0.5, 0.6, 0.7, 0.8])


def test_a_covariance_that_is_nearly_singular_is_positive_definite_when_it_is_read_again(tmp_path):
    """A hidden end is known to a hundredth of a pixel across the marking and to kilometres along it."""
    root = np.random.default_rng(2).normal(size=(8, 8))
    directions, _ = np.linalg.qr(root)
    covariance = directions @ np.diag([1e8, 1e8, 1.0, 1.0, 1.0, 1.0, 1e-4, 1e-4]) @ directions.T
    plain = detections().markings[0]
    written = ImageDetections(0, (replace(plain, covariance_px=(covariance + covariance.T) / 2),), ())
    write_detections(tmp_path / "a.json", written)
    (read,) = read_detections(tmp_path / "a.json", 0).markings
    np.testing.assert_allclose(np.linalg.eigvalsh(read.covariance_px)[:2], 1e-4, rtol=1e-2)


def clockwise(marking: MarkingDetection) -> MarkingDetection:
    """The marking as a tool lists it that counts corners the other way round."""
    order = [0, 3, 2, 1]
    rows = np.arange(8).reshape(4, 2)[order].ravel()
    return replace(
        marking, corners_px=marking.corners_px[order], corner_valid=marking.corner_valid[order],
        covariance_px=marking.covariance_px[np.ix_(rows, rows)],
    )  # fmt: skip


def test_corners_that_a_tool_lists_clockwise_run_the_other_way_with_all_that_is_theirs(tmp_path):
    right = detections()
    listed = ImageDetections(7, tuple(clockwise(marking) for marking in right.markings), ())
    for written in (right, listed):
        write_detections(tmp_path / "a.json", written)
        read = read_detections(tmp_path / "a.json", 7).markings
        for expected, marking in zip(right.markings, read, strict=True):
            np.testing.assert_allclose(marking.corners_px, expected.corners_px, atol=1e-4)
            np.testing.assert_allclose(marking.covariance_px, expected.covariance_px, rtol=1e-5, atol=1e-5)
            np.testing.assert_array_equal(marking.corner_valid, expected.corner_valid)


def test_a_far_marking_that_noise_turns_over_turns_no_other(tmp_path):
    """A dash of 20 x 1 px whose corners are known to 0.5 px, beside a diamond of 40 px."""
    near_marking = detections().markings[0]
    corners = np.array([[200.0, 100.0], [220.0, 100.0], [220.0, 101.0], [200.0, 101.0]])
    far = replace(near_marking, corners_px=corners, covariance_px=0.25 * np.eye(8))
    for markings in ((near_marking, far), (far,)):
        write_detections(tmp_path / "a.json", ImageDetections(0, markings, ()))
        read = read_detections(tmp_path / "a.json", 0).markings
        np.testing.assert_allclose(read[-1].corners_px, corners)


def marking(**changes: object) -> dict[str, object]:
    """The least that a file says of a marking, with changes; None leaves a key out."""
    entry = {"class": "diamond", "corners_px": [[0, 0]] * 4, "sigma_px": [[1, 1]] * 4, **changes}
    return {key: value for key, value in entry.items() if value is not None}


def line(**changes: object) -> dict[str, object]:
    return {"class": "lane_line", "points_px": [[0, 0], [9, 9]], **changes}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({}, "missing key 'markings'"),
        ({"markings": {}}, "expected a list"),
        ({"markings": [marking(sigma_px=None)]}, "give one of sigma_px"),
        ({"markings": [marking(covariance_px=[[0] * 8] * 8)]}, "give one of sigma_px"),
        ({"markings": [marking(sigma_px=[[1, 0]] * 4)]}, "is not above 0"),
        ({"markings": [marking(corners_px=[[0, 0]] * 3)]}, "expected 4 x 2 numbers"),
        ({"markings": [marking(known=[1, 1, 1, 1])]}, "true or false"),
        ({"markings": [marking(colour="white")]}, "unknown key 'colour'"),
        ({"markings": [marking(score=95)]}, "95 is not a probability"),
        ({"markings": [], "lanes": [line(sigma_px=[1.0, -1.0])]}, "is not above 0"),
        ({"markings": [], "lanes": [line(score=-1)]}, "-1 is not a probability"),
    ],
)
def test_a_damaged_file_is_one_line_that_names_it(tmp_path, content, says):
    path = tmp_path / "000000.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DriveError, match=r"000000\.json") as refused:
        read_detections(path, 0)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_drive_has_pictures_or_detections_but_not_both(survey, tmp_path):
    folder = shutil.copytree(survey[0], tmp_path / "drive")
    assert not read_drive(folder).has_pictures
    images = folder / "front" / "images.txt"
    before = images.read_text()
    images.write_text(before.replace("000000.json", "000000.jpg"))
    with pytest.raises(DriveError, match="list pictures or detections, for all cameras"):
        read_drive(folder)
    images.write_text(before.replace("000000.json", "999999.json"))
    with pytest.raises(DriveError, match=r"999999\.json: no such file of detections"):
        read_drive(folder)
